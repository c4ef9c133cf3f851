"""What `--watch` shows of tables that are longer than the terminal."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from zscout import terminal
from zscout.cli.fleet.watching import Overview, Scrolled
from zscout.terminal import Table

WIDTH, HEIGHT = 80, 24


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Console:
    console = Console(file=io.StringIO(), width=WIDTH, height=HEIGHT, force_terminal=False)
    monkeypatch.setattr(terminal, "console", lambda **_: console)
    return console


def overview(rows: int) -> Overview:
    cells = [(f"robot/r{number}", "exclusive", "held by somebody whose name is long " * 2) for number in range(rows)]
    return Overview("Fleet lab: anvil leads", [Table("RCs", ("RC", "USE", "HELD BY"), cells)])


def lines(screen: Console, scrolled: Scrolled, shown: Overview) -> list[str]:
    drawn = screen.render_lines(scrolled.picture(shown), pad=False)
    return ["".join(segment.text for segment in line).rstrip() for line in drawn]


def test_what_fits_is_shown_whole(screen: Console) -> None:
    seen = lines(screen, Scrolled(), overview(3))
    assert seen[0] == "Fleet lab: anvil leads"
    assert seen[-1] == "q or Ctrl-C ends"
    assert sum(line.startswith("robot/") for line in seen) == 3


def test_what_does_not_fit_scrolls_between_its_head_and_the_hint(screen: Console) -> None:
    shown, scrolled = overview(30), Scrolled()
    first = lines(screen, scrolled, shown)
    assert len(first) < HEIGHT, "one line is left, so that nothing runs off the top"
    assert all(len(line) <= WIDTH for line in first)
    assert (first[0], first[-1].startswith("q or Ctrl-C ends; lines 1 to ")) == ("Fleet lab: anvil leads", True)
    assert scrolled.key(b"\x1b[B")
    assert lines(screen, scrolled, shown)[1] == first[2], "a line down"
    assert scrolled.key(b"\x1b[A")
    assert lines(screen, scrolled, shown) == first
    seen = set(first)
    for _ in range(20):
        assert scrolled.key(b"\x1b[6")
        seen |= set(lines(screen, scrolled, shown))
    assert {f"robot/r{number}" for number in range(30)} <= {
        line.split()[0] for line in seen if line.startswith("robot/")
    }
    end = lines(screen, scrolled, shown)
    assert scrolled.key(b"\x1b[B")
    assert lines(screen, scrolled, shown) == end, "there is nothing below the end"
    assert scrolled.key(b"g")
    assert lines(screen, scrolled, shown) == first
    assert not scrolled.key(b"~")


def test_what_has_become_short_is_shown_from_its_beginning(screen: Console) -> None:
    scrolled = Scrolled()
    lines(screen, scrolled, overview(30))
    scrolled.key(b"G")
    assert sum(line.startswith("robot/") for line in lines(screen, scrolled, overview(2))) == 2


def test_a_long_command_leaves_room_for_the_other_columns(screen: Console) -> None:
    who = "root@anvil (python3 -c 'import time; time.sleep(60) # a long command')"
    table = Table("", ("ARC", "WHO", "RCS"), [("survey", who, "robot/arm1 " * 3)], cut={"WHO"})
    head, row = lines(screen, Scrolled(), Overview("Fleet lab", [table]))[2:4]
    assert row.split("…")[1].split() == ["robot/arm1"] * 3
    assert row.index("robot/arm1") == head.index("RCS") < WIDTH - len("robot/arm1 robot/arm1 robot/arm1") + 1
