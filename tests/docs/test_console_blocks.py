"""Commands of the how-tos, run on a live fleet: each prints what its page shows, but for times, ids and figures."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from tests.cli.cli_fleet import CliFleet

pytestmark = [pytest.mark.live, pytest.mark.slow, pytest.mark.plain_only("the pages show the names of a plain fleet")]
DOCS: Final = Path(__file__).parents[2] / "docs"
BLOCKS: Final = [
    ("how-to/share-devices.md", "I hold $ZSCOUT_RCS"),
    ("how-to/share-devices.md", "echo $ZSCOUT_BOUND"),
    ("how-to/book-devices.md", "--name survey"),
    ("how-to/book-devices.md", "--every week"),
    ("how-to/see-who-held-what.md", "history --since 7d"),
    ("components.md", "component start counter"),
]
"""Pages, and words of the block, in an order in which they can be run."""
VARIES: Final = re.compile(
    r"\b(?:Mon|Tue|Wed|Thu|Fri|Sat|Sun)\b|\b(?:[0-9a-f]{8})\b|\([\w/]+/[\w/]+\)|[\d.,:-]*\d|\b(?:d|h|min|s|MiB|GiB)\b"
)
"""Days, ids, zones, numbers and units."""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    fleet = CliFleet(tmp_path_factory.mktemp("pages"))
    fleet.lab.env |= {"LOGNAME": "ada", "ZSCOUT_HOST": "anvil"}
    try:
        fleet.lab.node(
            "anvil", "robot/arm1", "robot/scout33", "framegrabber/fg1", "radio/rf0:command_rate=10.0",
            extra='state = "journal"',
        )  # fmt: skip
        names = {"robot/arm1", "robot/scout33", "framegrabber/fg1", "radio/rf0"}
        fleet.state(lambda state: {view.rc for view in state.rcs if view.present} == names)
        fleet.balanced("anvil")
        yield fleet
    finally:
        fleet.close()


def plain(text: str) -> list[str]:
    """The words alone: tables have other widths, lines other ends, and both streams their own order."""
    return VARIES.sub(" ", text).replace("...", " ").split()


def sessions(page: str, words: str) -> list[tuple[str, str]]:
    """The commands of the block with these words, each with its output."""
    blocks = re.findall(r"^```console\n(.*?)^```", (DOCS / page).read_text(), re.MULTILINE | re.DOTALL)
    block = next(block for block in blocks if words in block)
    return re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", block, re.MULTILINE)


@pytest.mark.parametrize(("page", "words"), BLOCKS)
def test_a_command_prints_what_its_page_shows(page: str, words: str, fleet: CliFleet) -> None:
    for command, output in sessions(page, words):
        done = fleet.zscout(*shlex.split(command)[1:])
        output = output.replace("Fleet lab:", f"Fleet {fleet.lab.fleet.name}:")
        missing = Counter(plain(output)) - Counter(plain(done.stdout + done.stderr))
        assert missing == Counter(), (command, done)
