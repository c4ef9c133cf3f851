"""Stories of the scheduling core, the leader and the placer as text, in `transcripts/` of each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.placement.transcript import PlacerPlayer
from tests.rcm.transcript import LeaderPlayer
from tests.scheduling.transcript import CorePlayer
from tests.transcripts import Player, check, play

PLAYERS: dict[str, tuple[Callable[[], Player], int]] = {
    "scheduling": (CorePlayer, 12),
    "rcm": (LeaderPlayer, 7),
    "placement": (PlacerPlayer, 10),
}
"""By folder: who plays, and how many stories there are at least."""


def stories(folder: str) -> list[Path]:
    return sorted((Path(__file__).parent / folder / "transcripts").glob("*.txt"))


@pytest.mark.parametrize(
    ("folder", "path"),
    [pytest.param(name, path, id=f"{name}-{path.stem}") for name in PLAYERS for path in stories(name)],
)
def test_transcript(folder: str, path: Path) -> None:
    player, _ = PLAYERS[folder]
    check(player(), path)


@pytest.mark.parametrize("folder", PLAYERS)
def test_the_transcripts_are_found(folder: str) -> None:
    assert len(stories(folder)) >= PLAYERS[folder][1]


@pytest.mark.parametrize(
    ("folder", "text"), [("scheduling", "join robot/a\njion robot/b\n"), ("placement", "host h1\njion robot/b\n")]
)
def test_a_command_that_is_not_understood_is_named_with_its_line(folder: str, text: str) -> None:
    with pytest.raises(ValueError, match=r"story.txt:2: .*no such command: jion"):
        play(PLAYERS[folder][0](), text, "story.txt")
