"""The page for users of labgrid: its node file is read, and its commands print what stands below them."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import tomllib
from contextlib import ExitStack
from pathlib import Path
from typing import IO

import pytest

from tests.cli.cli_fleet import fleet_of
from tests.cli.tools import COMMAND, out_of
from tests.hang import HANG
from zscout.config.devices import CapacityRc, ExclusiveRc, read_rc
from zscout.config.strict import Where

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "coming-from-labgrid.md"
TEXT = PAGE.read_text()
BLOCKS = re.findall(r"^```console\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
PROMPT = re.compile(r"(ada|bob)\$ (.*)")
VARIES = (
    (r"\b\d\d:\d\d(:\d\d)?\b", "TIME"),
    (r"\b[0-9a-f]{12}\b", "ID"),
    (r"^Fleet [^:]+:", "Fleet NAME:"),
    (r"\b(yours for|in) [^(]*?(?= \(|\)|$)", r"\1 SPAN"),
    (r"\(\d+ links?\)", "(LINKS)"),
    (r"\bimx6/(one|two)\b", "imx6/N"),
    (r"\bada-[12]\b", "ada-N"),
    (r"^(anvil +leads) .*", r"\1"),
    (r" +", " "),
)
"""What each run has anew: times, ids, and the board that is chosen of two."""


def steady(line: str) -> str:
    for pattern, word in VARIES:
        line = re.sub(pattern, word, line)
    return line.strip()


class Shell:
    """The shell of one user at the host desk."""

    def __init__(self, user: str, env: dict[str, str]) -> None:
        self._user = user
        names = {"LOGNAME": user, "USER": user, "ZSCOUT_HOST": "desk"}
        self._shell = subprocess.Popen(
            ["bash", "--noprofile", "--norc"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=os.environ | env | names,
        )
        self.type(f'zscout() {{ {shlex.join(COMMAND)} "$@"; }}')

    def type(self, line: str) -> None:
        stdin = self._shell.stdin
        assert stdin is not None
        stdin.write(line + "\n")
        stdin.flush()

    @property
    def output(self) -> IO[str]:
        return out_of(self._shell)

    def close(self) -> None:
        """Ends it, with what it started. Its last command has printed all."""
        rest, _ = self._shell.communicate(timeout=HANG)
        assert rest == "", f"{self._user} reads what the page does not show"


def commands(block: str) -> list[tuple[str, str, list[str]]]:
    """User, command, and the lines below it."""
    found: list[tuple[str, str, list[str]]] = []
    for line in block.splitlines():
        if prompt := PROMPT.fullmatch(line):
            found.append((prompt[1], prompt[2], []))
        else:
            found[-1][2].append(line)
    return found


def test_its_node_file_is_read() -> None:
    (toml,) = re.findall(r"^```toml\n(.*?)^```", TEXT, re.MULTILINE | re.DOTALL)
    boards = [read_rc(table, Where("node.toml")) for table in tomllib.loads(toml)["rc"]]
    assert [(board.name, type(board)) for board in boards] == [
        ("imx6/one", ExclusiveRc),
        ("imx6/two", ExclusiveRc),
        ("imx8/one", CapacityRc),
    ]


@pytest.mark.slow
@pytest.mark.live
def test_its_commands_print_what_it_shows(tmp_path: Path) -> None:
    with ExitStack() as stack:
        fleet = stack.enter_context(fleet_of(tmp_path, "imx6/one", "imx6/two", "imx8/one:users=2"))
        users = {name: Shell(name, dict(fleet.lab.env)) for name in ("ada", "bob")}
        for block in BLOCKS:
            for user, command, below in commands(block):
                users[user].type(command)
                for line in below:
                    read = users[user].output.readline().rstrip("\n")
                    assert steady(read) == steady(line), f"{user}$ {command}"
        for shell in users.values():
            shell.close()
