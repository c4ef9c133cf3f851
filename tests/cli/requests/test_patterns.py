"""Needs by pattern on the command line: asked for, waited for, held, taken, and looked at."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from decimal import Decimal
from typing import Any

import pytest

from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import CLOCK, course, end, events, held_by, out_of, own, read_until
from tests.hang import HANG
from zscout.cli.operator.take import takeover_cost
from zscout.cli.requests.options import HoldOptions
from zscout.cli.requests.waiting import contention_of
from zscout.messages import HoldView, RcmState, RcView
from zscout.types import NO_TERM, Grant, Place

ANY, MORE = "framegrabber/*", "framegrabber/*#2"
F1, F2 = "framegrabber/f1", "framegrabber/f2"


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    rcs = (F1, F2, "robot/a", "radio/rf0:rate=10")
    with fleet_of(tmp_path_factory.mktemp("patterns"), *rcs) as fleet:
        yield fleet


# With real processes


@pytest.mark.live
def test_a_command_is_told_which_device_meets_which_pattern(fleet: CliFleet) -> None:
    script = 'echo "$ZSCOUT_RCS|$ZSCOUT_BOUND"'
    done = fleet.zscout("request", ANY, "robot/a", ANY, "--name", "stereo", "--", "sh", "-c", script)
    assert done.returncode == 0, done.stderr
    rcs, bound = done.stdout.strip().split("|")
    told = json.loads(bound)
    assert rcs == f"{F1} {F2} robot/a"
    assert told.keys() == {ANY, MORE}
    assert sorted(told.values()) == [F1, F2]
    met = {rc: need for need, rc in told.items()}
    assert f"stereo holds {F1} for {met[F1]}, {F2} for {met[F2]}, robot/a: yours for " in done.stderr
    plain = fleet.zscout("request", "robot/a", "--", "sh", "-c", script)
    assert plain.stdout == "robot/a|{}\n"


@pytest.mark.slow
@pytest.mark.live
def test_who_waits_hears_who_has_all_that_match_and_gets_the_first(fleet: CliFleet) -> None:
    first, second = (fleet.holder(name, rc, "--min-runtime", "10m") for name, rc in (("first", F1), ("second", ANY)))
    asked = (ANY, "--json", "--", "true")
    (waits,) = events(fleet.waits("next", *asked, until=lambda line: events(line)[0].get("needs")))
    (need,) = waits["needs"]
    assert (need["need"], need["rc"], need["present"], need["free"]) == (ANY, None, True, [])
    assert [(holder["rc"], holder["arc"]) for holder in need["holders"]] == [(F1, "first"), (F2, "second")]
    assert 500 < waits["starts_in"] < 600

    waiting, _ = fleet.begun('"waits"', "request", "--name", "next", *asked)
    queued, held = json.loads(fleet.zscout("status", "--json").stdout), {F1: "first", F2: "second"}
    assert [wait["needs"] for wait in queued["queue"]] == [{ANY: {}}]
    assert {hold["arc"]: (hold["needs"], hold["bound"]) for hold in queued["holds"]} == {
        "first": ({F1: {}}, {}),
        "second": ({F2: {}}, {ANY: F2}),
    }
    assert {rc["rc"]: rc["holders"][0]["arc"] for rc in queued["rcs"] if rc["holders"]} == held
    shown = fleet.zscout("status").stdout
    assert re.search(rf"^{F2} +exclusive +held +anvil +{re.escape(held_by('second'))}$", shown, re.MULTILINE)
    choices = [rf"{rc} \(held by {re.escape(held_by(arc))}, until {CLOCK} at the latest\)" for rc, arc in held.items()]
    text = ", ".join(choices).replace(f", {F2}", f", {F2.removeprefix('framegrabber/')}")
    assert re.search(rf"^1 +next .* waits for one of {text}  ", shown, re.MULTILINE)

    end(second)
    granted, ended = course(out_of(waiting).read())
    assert (granted["event"], granted["rcs"], granted["bound"]) == ("granted", [F2], {ANY: F2})
    assert (ended["event"], ended["outcome"]) == ("ended", "released")
    assert waiting.wait(HANG) == 0
    end(first)
    assert fleet.idle(F1, F2, ANY)


@pytest.mark.slow
@pytest.mark.live
def test_in_a_pipe_and_at_a_terminal_those_in_the_way_are_named_once(fleet: CliFleet) -> None:
    first, robot = fleet.holder("first", F1), fleet.holder("robot", "robot/a")
    line = fleet.waits("both", ANY, ANY)
    blocker = rf"{own('first')}: {F1} for .*, until {CLOCK} at the latest"
    assert re.fullmatch(rf"both waits for {blocker}; starts at {CLOCK} \(in .*\)", line)
    # One framegrabber is free: who has the other is in nobody's way.
    line = fleet.waits("easy", ANY, "robot/a")
    assert f"waits for {own('robot')}: robot/a, until " in line
    assert "framegrabber" not in line
    end(robot)
    with fleet.terminal("request", ANY, ANY, "--name", "both") as terminal:
        terminal.until(f"  {F1}: {own('first')}, priority 0, ")
        end(first)
        shown = terminal.until("  Ctrl-C gives back")
        assert re.search(r"both holds framegrabber/f1 for framegrabber/\*(#2)?, framegrabber/f2 for ", shown)
        terminal.press("\x03")
        assert terminal.code() == 130
    assert fleet.idle(F1, F2)


@pytest.mark.slow
@pytest.mark.live
def test_why_tells_of_all_that_match(fleet: CliFleet) -> None:
    first, second = fleet.holder("first", F1), fleet.holder("second", ANY)
    radio = fleet.holder("loud", "radio/*:rate=8")
    waiting = [
        fleet.start("request", ANY, "robot/a", "video/*", "--name", "next", "--wait-for-device"),
        fleet.start("request", "radio/*:rate=5", "robot/*", "--name", "quiet"),
    ]
    for process, name in zip(waiting, ("next", "quiet"), strict=True):
        read_until(process, f"{name} waits")
    text = fleet.zscout("why", "next").stdout
    one = rf"{F1} held by {own('first')}, priority 0, since {CLOCK} .* at the latest"
    assert re.search(rf"^  framegrabber/\*: {one}$", text, re.MULTILINE)
    assert f"\n  framegrabber/*: {F2} held by {own('second')}, " in text
    assert "\n  robot/a: no other request holds it\n" in text
    assert "\n  video/*: not on the mesh\n" in text
    assert " ago)  asked for framegrabber/*, robot/a, video/* at priority 0\n" in text
    assert re.search(r"no device on the mesh is left for .*video/\*", text)
    (told,) = json.loads(fleet.zscout("why", "next", "--json").stdout)["arcs"]
    assert [(need["need"], need["rc"], need["present"]) for need in told["needs"]] == [
        (ANY, None, True),
        ("robot/a", "robot/a", True),
        ("video/*", None, False),
    ]
    assert [holder["rc"] for holder in told["needs"][0]["holders"]] == [F1, F2]

    shared = fleet.zscout("why", "quiet").stdout
    assert f"\n  radio/* (rate=5): radio/rf0 shared with {own('loud')} (rate=8), priority 0, since " in shared
    assert "\n  robot/*: no request holds robot/a\n" in shared
    holds = fleet.zscout("why", "second").stdout
    assert f"\nHolds\n  {F2} for {ANY}: no other request holds it\n" in holds
    (told,) = json.loads(fleet.zscout("why", "second", "--json").stdout)["arcs"]
    assert [(need["need"], need["rc"]) for need in told["needs"]] == [(ANY, F2)]
    for process in (*waiting, first, second, radio):
        end(process)
    assert fleet.idle(F1, F2, "radio/rf0")


@pytest.mark.slow
@pytest.mark.live
def test_a_dry_run_and_a_take_by_pattern(fleet: CliFleet) -> None:
    at_once = fleet.zscout("request", ANY, ANY, "--dry-run")
    assert (at_once.returncode, at_once.stdout) == (0, "request would start at once\n")
    never = fleet.zscout("request", ANY, ANY, ANY, "--wait-for-device", "--dry-run", "--json")
    assert never.returncode == 1
    assert "no device on the mesh is left for framegrabber/*" in json.loads(never.stdout)["reason"]

    low, high = fleet.holder("low", F1), fleet.holder("high", ANY, "--priority", "1")
    would = fleet.zscout("request", ANY, "--priority", "5", "--dry-run")
    assert would.stdout == f"request would start at once\nit would preempt {own('low')}\n"
    assert fleet.zscout("take", ANY).returncode == 1
    taken = fleet.zscout("take", ANY, "--yes", "--no-keep", "--min-runtime", "8", "--json")
    preview, granted, _ = course(taken.stdout)
    assert (preview["preempts"], preview["waits_for"], preview["absent"]) == ([], [], [])
    assert [hold["arc"] for hold in preview["may_preempt"]] == ["low", "high"]
    assert granted["bound"] == {ANY: F1}
    assert low.wait(HANG) == 1
    assert high.poll() is None
    # Now one of them is free: nobody has to be asked.
    fleet.state(lambda state: len(state.holds) == 1)
    done = fleet.zscout("take", ANY, "robot/$*a", "--", "sh", "-c", "echo $ZSCOUT_RCS")
    assert (done.returncode, done.stdout) == (0, f"{F1} robot/a\n"), done.stderr
    end(high)
    assert fleet.idle(F1, F2, "robot/a")


# What is made of the RCM's state


def state(rcs: dict[str, str], *, absent: tuple[str, ...] = (), priority: dict[str, int] | None = None) -> RcmState:
    """A state with these RCs and the ARC that holds each (empty: nobody)."""
    views = [RcView(rc, rc not in absent, rc.startswith("radio")) for rc in sorted(rcs)]
    holds = [
        HoldView(
            id="i", arc=arc, client=f"h/{arc}", priority=(priority or {}).get(arc, 0),
            grant=Grant(NO_TERM, at), place=Place(NO_TERM, at),
            needs={rc: {} for rc, holder in rcs.items() if holder == arc},
            min_runtime=Decimal(9), held=1.0, remaining=8.0,
        )
        for at, arc in enumerate(sorted(set(rcs.values()) - {""}))
    ]  # fmt: skip
    return RcmState(NO_TERM, 0, "h", holds, rcs=views)


@pytest.mark.parametrize(
    ("needs", "met"),
    [
        (["fg/*"], {"fg/*": (["fg/c"], True)}),
        (["fg/*", "fg/*#2"], {"fg/*": (["fg/c"], False), "fg/*#2": (["fg/c"], False)}),
        (["fg/*", "fg/c"], {"fg/*": ([], False), "fg/c": (["fg/c"], True)}),
        (["fg/*", "robot/*"], {"fg/*": (["fg/c"], True), "robot/*": ([], False)}),
        (["fg/*", "*/c"], {"fg/*": (["fg/c"], False), "*/c": (["fg/c"], False)}),
        (["fg/a$*"], {"fg/a$*": ([], False)}),
        (["fg/d$*"], {"fg/d$*": ([], False)}),
    ],
)
def test_a_pattern_is_met_where_there_are_free_ones_enough(
    needs: list[str], met: dict[str, tuple[list[str], bool]]
) -> None:
    seen = state({"fg/a": "x", "fg/b": "y", "fg/c": "", "fg/d": "", "robot/r": "x"}, absent=("fg/d",))
    assert {need.need: (need.free, need.met) for need in contention_of(seen, needs)} == met
    # What one holds itself is in its own way never.
    mine = contention_of(seen, needs, "h/x/i")
    assert all("fg/a" in need.free for need in mine if need.need == "fg/*")


@pytest.mark.parametrize(
    ("needs", "costs"),
    [
        (["fg/c"], {"absent": ["fg/c"]}),
        (["fg/*"], {"may_preempt": ["low"]}),
        (["fg/a"], {"preempts": ["low"]}),
        (["fg/a$*"], {"preempts": ["low"]}),
        (["robot/*"], {"waits_for_one_of": {"robot/*": ["high", "peer"]}}),
        (["robot/*", "robot/*#2"], {"waits_for_one_of": {key: ["high", "peer"] for key in ("robot/*", "robot/*#2")}}),
        (["open/*", "open/*#2"], {"waits_for_one_of": {key: ["high", "peer"] for key in ("open/*", "open/*#2")}}),
        (["robot/r"], {"waits_for": ["high"]}),
        (["robot/r$*"], {"waits_for": ["high"]}),
        (["radio/*"], {"may_preempt": ["sharer"]}),
        (["video/*"], {"absent": ["video/*"]}),
        (["fg/a", "fg/*"], {"preempts": ["low"], "waits_for": ["peer"]}),
        (["free/*"], {}),
        (["free/*", "free/*#2"], {"may_preempt": ["low"]}),
    ],
)
def test_what_taking_by_pattern_costs(needs: list[str], costs: dict[str, Any]) -> None:
    seen = state(
        {
            "fg/a": "low", "fg/b": "peer", "robot/r": "high", "robot/s": "peer", "radio/f": "sharer",
            "fg/c": "", "free/x": "", "free/y": "low", "open/x": "", "open/y": "high", "open/z": "peer",
        },
        absent=("fg/c",),
        priority={"high": 11, "peer": 10},
    )  # fmt: skip
    wanted = HoldOptions(
        name="op", needs={need: {} for need in needs}, priority=10, min_runtime=Decimal(1), keep=False,
        timeout=None, grace=Decimal(1), command=(), again=False, as_json=True,
    )  # fmt: skip
    cost = takeover_cost(seen, wanted)
    count = {"robot/*#2": "two"}.get(needs[-1], "one")
    told = cost.as_json()
    either = {need: [hold["arc"] for hold in holds] for need, holds in told.pop("waits_for_one_of").items()}
    absent = told.pop("absent")
    said: dict[str, Any] = {what: [hold["arc"] for hold in holds] for what, holds in told.items()}
    said |= {"waits_for_one_of": either, "absent": absent}
    assert {what: found for what, found in said.items() if found} == costs
    for need, holds in either.items():
        (line,) = [line for line in cost.lines() if line.startswith(f"waits for {count} of ")]
        assert re.findall(r"(\w+) \([^()]*\), priority", line) == holds, need
