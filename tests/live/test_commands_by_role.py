"""Every command of `zscout` by every role on a secured fleet, as the table of docs/reference/roles.md has it."""

from __future__ import annotations

import asyncio
import re
import subprocess
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final

import click
import pytest

from tests.cli.tools import zscout
from tests.live.closed import ClosedLab
from tests.live.test_doors import env_of
from zscout.cli.main import main

PAGE: Final = (Path(__file__).parents[2] / "docs" / "reference" / "roles.md").read_text()
SECTION: Final = PAGE[PAGE.index("## The table") : PAGE.index("## Rights of each role")]
ROW: Final = re.compile(r"\| `([a-z ]+)` \| (\w+) \| (\w+) \| (\w+) \| (\w+) \|")
TABLE: Final = {match[1]: match.groups()[1:] for match in ROW.finditer(SECTION)}
NAMES: Final = {"wall": "viewer", "eve": "client", "ada": "operator", "cart": "node"}
"""By the columns of the table."""
WORDS: Final[dict[str, tuple[str, ...]]] = {
    "why": ("survey",),
    "booking show": ("tuesday",),
    "booking export": ("--out", "OUT.ics"),
    "component logs": ("beat",),
    "slots": ("robot/b", "--for", "1h"),
    "request": ("robot/b", "--name", "NAME", "--dry-run"),
    "book": ("robot/b", "--name", "NAME", "--at", "DATE 10:00", "--for", "1h"),
    "component start": ("counter", "--name", "NAME", "--no-wait"),
    "release": ("survey", "--yes"),
    "cancel": ("second", "--yes"),
    "booking cancel": ("tuesday", "--yes"),
    "component migrate": ("beat", "--to", "cart", "--yes"),
    "component stop": ("beat", "--yes"),
    "take": ("robot/b", "--yes", "--", "true"),
    "maintain": ("robot/b", "--at", "LATER 10:00", "--for", "1h", "--yes"),
    "drain": ("cart",),
    "uncordon": ("cart",),
}
"""What follows a command. What is named is bob's."""
OTHERS: Final = re.compile(r"`([a-z0-9 ]+)`")


def day(number: int) -> str:
    """In so many days."""
    return f"{datetime.now().astimezone() + timedelta(days=number):%Y-%m-%d} 10:00"


def leaves(command: click.Command, *path: str) -> Iterator[str]:
    if isinstance(command, click.Group):
        for name in command.list_commands(click.Context(command)):
            found = command.get_command(click.Context(command), name)
            assert found is not None
            if not found.hidden or name == "keys":
                yield from leaves(found, *path, name)
    else:
        yield " ".join(path)


def test_every_command_stands_there_once() -> None:
    rest = SECTION[SECTION.index("## Other commands") :]
    others = [
        name for line in rest.splitlines() if line.startswith("| `") for name in OTHERS.findall(line.split("|")[1])
    ]
    assert sorted([*TABLE, *others]) == sorted({*leaves(main)} | {"keys"})


@pytest.mark.live
@pytest.mark.slow
async def test_each_role_may_what_the_table_says(lab: ClosedLab) -> None:
    lab.node("anvil", "robot/a", "robot/b", "robot/c")
    lab.node("cart")
    bob = await lab.person("bob")
    await lab.ready(bob, "robot/a", "robot/b", "robot/c")
    await bob.request("survey", {"robot/a": {}})
    await bob.request("second", {"robot/c": {}})
    for words in (
        ("book", "robot/c", "--name", "tuesday", "--at", day(40), "--for", "1h"),
        ("component", "start", "counter", "--name", "beat", "--host", "anvil", "--host", "cart"),
    ):
        done = await lab.zscout(*words, env=env_of(lab, "bob"))
        assert done.returncode == 0, done

    def run(command: str, name: str) -> subprocess.CompletedProcess[str]:
        date = day([*NAMES].index(name) + 2)
        words = [
            word.replace("NAME", f"{name}s")
            .replace("DATE 10:00", date)
            .replace("LATER 10:00", day(30))
            .replace("OUT", str(lab.folder / name))
            for word in WORDS.get(command, ())
        ]
        return zscout(*command.split(), *words, env=env_of(lab, name))

    wrong = list[str]()
    for command, cells in TABLE.items():
        if set(cells) == {"yes"}:
            # What a viewer may, and a machine, everybody may.
            cells = ("yes", "", "", "yes")
        # Those who may come last: they change what is tried.
        ordered = sorted(zip(NAMES, cells, strict=True), key=lambda column: column[1] == "yes")
        for may in (False, True):
            names = [name for name, cell in ordered if cell and (cell == "yes") is may]
            for name, done in zip(
                names, await asyncio.gather(*(asyncio.to_thread(run, command, name) for name in names)), strict=True
            ):
                told = f"{done.stdout}{done.stderr}"
                refused = re.search(rf"{name} \({NAMES[name]}\) may not ", told) is not None
                fine = done.returncode in (0, 1) if command == "doctor" else done.returncode == 0
                if refused is may or fine is not may:
                    wrong.append(f"{command} as {name}: {done.returncode} {told[-300:]}")
    assert not wrong, "\n".join(wrong)
