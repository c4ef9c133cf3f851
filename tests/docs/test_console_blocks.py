"""Commands of the README, the tutorial and the how-tos, run on a live fleet: each prints what its page shows, but for
times, ids and figures."""

from __future__ import annotations

import re
import shlex
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from tests.cli import tools
from tests.cli.cli_fleet import NOBODY_THERE, CliFleet
from tests.docs.test_coming_from_labgrid import Shell
from tests.hang import HANG

pytestmark = [pytest.mark.live, pytest.mark.slow, pytest.mark.plain_only("the pages show the names of a plain fleet")]
ROOT: Final = Path(__file__).parents[2]


class Block(NamedTuple):
    """A block of a page, and how its commands are run."""

    page: str
    words: str
    """In this block, and in none before it on the page."""
    requests: tuple[str, ...] = ()
    """Present before the block: user, then the arguments of `zscout request --name`. The second waits for the first."""
    user: str = "ada"
    terminal: bool = False
    """At a terminal, as its tables are narrow there."""
    alone: bool = False
    """In a fleet without nodes."""
    settled: bool = False
    """Once the leader refuses unknown devices: a new one waits for them."""
    bash: bool = False
    """In one shell, in the fleet's folder: for variables and for other programs."""


SURVEY: Final = "ada survey robot/scout33 radio/rf0:command_rate=6 -- sleep 600"
CHAT: Final = "bob chat radio/rf0:command_rate=6 -- echo my turn"
ARM: Final = "ada survey robot/arm1 -- sleep 600"
TUTORIAL: Final = "ada survey robot/scout33 radio/rf0:command_rate=6 --min-runtime 5m -- sleep 600"
BLOCKS: Final = [
    Block("docs/tutorial.md", "zscout-node"),
    Block("docs/tutorial.md", "I hold $ZSCOUT_RCS"),
    Block(
        "docs/tutorial.md",
        "zscout why chat",
        (TUTORIAL, "ada chat radio/rf0:command_rate=6 -- sleep 20"),
        terminal=True,
    ),
    Block("docs/tutorial.md", "--name chat", (TUTORIAL,), terminal=True),
    Block("docs/tutorial.md", "zscout take", (TUTORIAL,)),
    Block("docs/tutorial.md", "python hello.py", bash=True),
    Block("README.md", "I hold $ZSCOUT_RCS"),
    Block("README.md", "echo my turn", (SURVEY,), "bob"),
    Block("README.md", "zscout status", (SURVEY, CHAT), "eve", terminal=True),
    Block("README.md", "zscout why chat", (SURVEY, CHAT), "eve"),
    Block("docs/how-to/share-devices.md", "I hold $ZSCOUT_RCS"),
    Block("docs/how-to/share-devices.md", "echo $ZSCOUT_BOUND"),
    Block("docs/how-to/share-devices.md", "zscout why chat", (SURVEY, CHAT), "bob"),
    Block("docs/how-to/share-devices.md", "--reason", (SURVEY,), "eve"),
    Block("docs/how-to/share-devices.md", "zscout release", (SURVEY,), "eve"),
    Block("docs/how-to/run-a-fleet.md", "zscout-node"),
    Block("docs/how-to/run-a-fleet.md", "zscout doctor"),
    Block("docs/how-to/run-a-fleet.md", "zscout drain", (ARM,), "eve", bash=True),
    Block("docs/how-to/book-devices.md", "--name survey"),
    Block("docs/how-to/book-devices.md", "./survey.py"),
    Block("docs/how-to/book-devices.md", "--every week"),
    Block("docs/how-to/calendars.md", "--dry-run", bash=True),
    Block("docs/how-to/calendars.md", "curl", bash=True),
    Block("docs/how-to/calendars.md", "zscout booking export", bash=True),
    Block("docs/how-to/book-devices.md", "new grippers", (ARM,), "eve"),
    Block("docs/how-to/book-devices.md", "--broken", (), "eve"),
    Block("docs/how-to/secure-a-fleet.md", "zscout cert ca", bash=True),
    Block("docs/how-to/secure-a-fleet.md", "zscout cert show", bash=True),
    Block("docs/how-to/secure-a-fleet.md", "zscout cert renew", bash=True),
    Block("docs/how-to/secure-a-fleet.md", "zscout cert ca new-ca", bash=True),
    Block("docs/how-to/use-in-ci.md", "zscout request dut/board"),
    Block("docs/how-to/use-in-ci.md", "zscout acquire", bash=True),
    Block("docs/how-to/use-in-ci.md", "zscout book"),
    Block("docs/how-to/use-in-ci.md", "./nightly.sh"),
    Block("docs/how-to/see-who-held-what.md", "history --since 7d"),
    Block("docs/troubleshooting.md", "robot/arn1", settled=True),
    Block("docs/troubleshooting.md", "zscout why survey", (ARM,)),
    Block("docs/troubleshooting.md", "echo $?", alone=True, bash=True),
    Block("docs/simulation.md", "zscout simulate --list"),
    Block("docs/simulation.md", "simulate living_room", bash=True),
    Block("docs/robots.md", "simulate office", bash=True),
    Block("docs/operations.md", "systemctl reload"),
    Block("docs/components.md", "component start counter"),
]
"""Of each page in an order in which they can be run."""
BEFORE: Final = {"docs/how-to/see-who-held-what.md": "docs/how-to/share-devices.md"}
"""Pages that show holds of another one."""
VARIES: Final = re.compile(
    r"\b(?:Mon|Tue|Wed|Thu|Fri|Sat|Sun)\b|\b(?:Jan|Feb|Mar|Apr|May|Jun|Jul|Aug|Sep|Oct|Nov|Dec)\b"
    r"|-?\b(?:[0-9a-f]{8}|[0-9a-f]{12})\b|\([\w/]+/[\w/]+\)|[\d.,:-]*\d"
    r"|\b(?:d|h|min|s|MiB|GiB)\b|\.\.\.|…|[,;:()]"
)
"""Days, months, ids, zones, numbers, units and punctuation."""
DATE: Final = re.compile(r"\b20\d\d-\d\d-\d\d\b")
WAITS: Final = re.compile(r"^\S+ waits\b", re.MULTILINE)
DEVICES: Final = (
    "robot/arm1",
    "robot/scout33",
    "framegrabber/fg1",
    "radio/rf0:command_rate=10.0",
    "dut/board",
    "dut/one",
    "camera/bench",
)
NEW_DEVICE: Final = '[[rc]]\nname = "robot/arm2"\ndriver = "exclusive"\n'
"""Added to the node file where a page reloads it."""
UNKNOWN: Final = 2
"""Exit code where a device is unknown."""
NO_LEADER: Final = "no leader is on the mesh"
ALONE: Final = "alone.toml"
"""File of a fleet of the same name, in which nothing is found."""
COLUMNS: Final = 120
SCRIPTS: Final = ("survey.py", "test.sh", "flash.sh", "nightly.sh")
"""Programs of the reader, which do nothing here."""
ELSEWHERE: Final = ("ssh", "scp", "systemctl")
"""Programs that would reach other hosts, or this one's: they do nothing here."""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    fleet = CliFleet(tmp_path_factory.mktemp("pages"))
    fleet.lab.env |= {"LOGNAME": "ada", "ZSCOUT_HOST": "anvil"}
    try:
        fleet.lab.node("anvil", *DEVICES, extra='state = "journal"')
        names = {device.partition(":")[0] for device in DEVICES}
        fleet.state(lambda state: {view.rc for view in state.rcs if view.present} == names)
        fleet.balanced("anvil")
        text = fleet.lab.fleet_file.read_text()
        (fleet.folder / ALONE).write_text(re.sub("multicast_address = .*", "multicast = false", text))
        (fleet.folder / "lab.ics").write_text(calendar())
        (fleet.folder / "hello.py").write_text(hello())
        for script in SCRIPTS:
            (fleet.folder / script).write_text("#!/bin/sh\n")
            (fleet.folder / script).chmod(0o755)
        yield fleet
    finally:
        fleet.close()


def calendar() -> str:
    """A calendar with an event for a device and one for none, in nine days."""
    day = datetime.now().astimezone() + timedelta(days=9)
    events = (
        f"BEGIN:VEVENT\nUID:{number}\nSUMMARY:{title}\nDTSTART:{day:%Y%m%d}T170000\nDURATION:PT1H\nEND:VEVENT\n"
        for number, title in enumerate(("Arm 1 class", "Lunch"))
    )
    return f"BEGIN:VCALENDAR\n{''.join(events)}END:VCALENDAR\n"


def hello() -> str:
    """The program of the tutorial."""
    page = (ROOT / "docs/tutorial.md").read_text()
    (program,) = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    return str(program)


def plain(text: str) -> list[str]:
    """The words alone: tables have other widths, lines other ends, and both streams their own order."""
    return VARIES.sub(" ", text).split()


def missing(shown: str, printed: str) -> list[str]:
    """Words that a page shows and a command did not print."""
    return sorted((Counter(plain(shown)) - Counter(plain(printed))).elements())


def sessions(page: str, words: str) -> list[tuple[str, str]]:
    """The commands of the block with these words, each with its output."""
    blocks = re.findall(r"^```console\n(.*?)^```", (ROOT / page).read_text(), re.MULTILINE | re.DOTALL)
    block = next(block for block in blocks if words in block)
    found = re.findall(r"^\$ (.*(?:(?<=\\)\n> .*)*)\n((?:(?!\$ ).*\n)*)", block, re.MULTILINE)
    return [(command.replace("\\\n> ", ""), output) for command, output in found]


class Runner:
    """Runs the commands of one block."""

    def __init__(self, fleet: CliFleet, block: Block) -> None:
        self._fleet, self._terminal = fleet, block.terminal
        fleet.lab.env["LOGNAME"] = block.user
        self._shell = Shell(block.user, dict(fleet.lab.env)) if block.bash else None
        if self._shell is not None:
            self._shell.type(f"export ZSCOUT_HOST=anvil; cd {shlex.quote(str(fleet.folder))}")
            for program in ELSEWHERE:
                self._shell.type(f"{program}() {{ :; }}")
            self._shell.type(f'curl() {{ cat lab.ics; }}; python() {{ {sys.executable} "$@"; }}')
            if block.alone:
                self._shell.type(f"export ZSCOUT_FLEET={ALONE}")

    def run(self, command: str, output: str) -> str:
        """Return what a command prints. End it as soon as it prints that it waits, if it waits on its page."""
        command = re.sub(r"\bsleep \d+", "sleep 0", command).replace(" ./", f" {self._fleet.folder}/")
        command = re.sub(r"(simulate .*)--mesh", r"\1--mesh --for 1", command)
        # The pages' dates will pass.
        command = DATE.sub(f"{datetime.now().astimezone() + timedelta(days=120):%Y-%m-%d}", command)
        if self._shell is not None:
            return self._in_shell(self._shell, command, NO_LEADER in output)
        if command == "systemctl reload zscout-node":
            with (self._fleet.folder / "anvil.toml").open("a") as file:
                file.write(NEW_DEVICE)
            self._fleet.lab.signal("anvil", signal.SIGHUP)
            self._fleet.state(lambda state: any(view.rc == "robot/arm2" and view.present for view in state.rcs))
            return ""
        if command.startswith(("zscout-node ", "journalctl ")):
            return self._logged(output)
        args = shlex.split(command, comments=True)[1:]
        if self._terminal or "[y/N] y" in output:
            return self._at_a_terminal(output, *args)
        if WAITS.search(output):
            process, lines = self._fleet.begun(" waits", *args)
            tools.end(process)
            return "\n".join(lines)
        done = self._fleet.zscout(*args)
        return done.stdout + done.stderr

    def _logged(self, output: str) -> str:
        """The log of the node, which runs already, as soon as it has these words."""
        began = time.monotonic()
        while missing(output, log := self._fleet.lab.log("anvil")) and time.monotonic() - began < HANG:
            time.sleep(0.05)
        return log

    def _at_a_terminal(self, output: str, *args: str) -> str:
        with tools.Terminal(*args, env=self._fleet.lab.env, columns=COLUMNS) as terminal:
            if "[y/N] y" in output:
                terminal.until("[y/N]")
                terminal.press("y\n")
            elif WAITS.search(output):
                terminal.until(" ".join(output.splitlines()[-1].split()[:2]))
                terminal.press("\x03")
            terminal.code()
            return terminal.text

    def _in_shell(self, shell: Shell, command: str, no_leader: bool) -> str:
        """Repeats a command that saw no leader, where there is one: it has done nothing."""
        while True:
            shell.type(f"{command}\necho :end:$?")
            lines = []
            while not (line := shell.output.readline()).startswith(":end:"):
                assert line, f"the shell ended at {command}"
                lines.append(line)
            if no_leader or line != f":end:{NOBODY_THERE}\n":
                return "".join(lines)

    def close(self) -> None:
        self._fleet.end_started()
        if self._shell is not None:
            self._shell.close()


def begin(fleet: CliFleet, request: str, until: str) -> None:
    """Starts a request of a block's beginning; returns when it has printed `until`."""
    user, name, *args = shlex.split(request)
    fleet.lab.env["LOGNAME"] = user
    fleet.begun(f"{name} {until} ", "request", "--name", name, *args)


def played(fleet: CliFleet, block: Block) -> Iterator[tuple[str, str, str]]:
    """Yield each command of a block, with the output on its page and its real output."""
    for request, until in zip(block.requests, ("holds", "waits for"), strict=False):
        begin(fleet, request, until)
    if block.settled:
        fleet.until(lambda done: done.returncode == UNKNOWN, "request", "robot/none", "--dry-run", "--", "true")
    runner = Runner(fleet, block)
    try:
        for command, shown in sessions(block.page, block.words):
            output = re.sub(r"\b([Ff]leet) (lab|zscout)\b", rf"\1 {fleet.lab.fleet.name}", shown)
            output = output.replace("(fleet.toml)", str(fleet.lab.fleet_file)).replace("on eth0", "on lo")
            output = output.replace("/home/ada", str(fleet.folder))
            yield command, output, runner.run(command, output)
    finally:
        runner.close()
        fleet.idle(*(device.partition(":")[0] for device in DEVICES))


@pytest.mark.parametrize("page", dict.fromkeys(block.page for block in BLOCKS))
def test_commands_print_what_their_page_shows(page: str, fleet: CliFleet) -> None:
    for block in BLOCKS:
        if block.page in (page, BEFORE.get(page)):
            for command, output, printed in played(fleet, block):
                assert missing(output, printed) == [], (command, printed)
                assert output or not printed, (command, printed)
