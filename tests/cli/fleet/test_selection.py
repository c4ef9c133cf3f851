"""Which part of a fleet is shown under some names."""

from __future__ import annotations

from decimal import Decimal
from typing import Any

from zscout.cli.fleet.fleet_view import Host
from zscout.cli.fleet.selection import Selection
from zscout.messages import HoldView, RcmState, RcView, WaitView
from zscout.types import Grant, Place, Term

HOMES = {"robot/a": "anvil", "robot/b": "bellows", "fg/1": "bellows"}


def fields(arc: str, client: str, rcs: tuple[str, ...]) -> dict[str, Any]:
    told = {"arc": arc, "id": f"id-{arc}", "client": client, "needs": {rc: {} for rc in rcs}, "priority": 0}
    return told | {"min_runtime": Decimal(60), "place": Place(Term(1, "r"), 1)}


def hold(arc: str, client: str, *rcs: str) -> HoldView:
    return HoldView(**fields(arc, client, rcs), held=1.0, remaining=59.0, grant=Grant(Term(1, "r"), 1))


def wait(arc: str, client: str, *rcs: str) -> WaitView:
    return WaitView(**fields(arc, client, rcs), waited=1.0, reason="")


STATE = RcmState(
    host="anvil",
    term=Term(1, "r"),
    seq=1,
    rcs=[RcView(rc=rc, present=True, sharable=False) for rc in HOMES],
    holds=[hold("survey", "desk/p1", "robot/a"), hold("watch", "shed/p2", "robot/b")],
    queue=[wait("next", "desk/p3", "robot/a", "fg/1"), wait("any", "shed/p4", "fg/*")],
)


def chosen(*names: str) -> tuple[list[str], list[str], list[str], list[str]]:
    """RCs, holders, who waits, hosts."""
    there = {host: Host() for host in ("anvil", "bellows", "desk", "shed")}
    found = Selection(names, STATE, HOMES, there)
    assert found.state is not None
    state = found.state
    return (
        [view.rc for view in state.rcs],
        [view.arc for view in state.holds],
        [view.arc for view in state.queue],
        list(found.hosts),
    )


def test_without_names_all_is_shown() -> None:
    assert chosen() == (list(HOMES), ["survey", "watch"], ["next", "any"], ["anvil", "bellows", "desk", "shed"])


def test_an_rc_with_who_holds_it_and_who_waits_for_it() -> None:
    assert chosen("robot/a") == (["robot/a"], ["survey"], ["next"], ["anvil"])
    assert chosen("fg/1") == (["fg/1"], [], ["next", "any"], ["bellows"])


def test_an_arc_with_its_rcs_and_who_holds_them() -> None:
    for name in ("next", "id-next", "desk/p3/id-next"):
        assert chosen(name) == (["robot/a", "fg/1"], ["survey"], ["next"], [])


def test_a_host_with_its_rcs_and_programs() -> None:
    assert chosen("bellows") == (["robot/b", "fg/1"], ["watch"], ["next", "any"], ["bellows"])
    assert chosen("desk") == (["robot/a", "fg/1"], ["survey"], ["next"], ["desk"])


def test_a_pattern() -> None:
    assert chosen("robot/*")[0] == chosen("robot/$*")[0] == ["robot/a", "robot/b"]
    assert chosen("s*")[1] == ["survey", "watch"], "an ARC, and what a host of that name runs"


def test_a_name_that_nothing_has() -> None:
    assert Selection(["robot/a", "anvil"], STATE, HOMES, {"anvil": Host()}).missing() is None
    missing = Selection(["robot/a", "survy"], STATE, HOMES, {"anvil": Host()}).missing()
    assert missing is not None
    assert str(missing) == 'unknown device, request or host "survy"; did you mean survey?'
    missing = Selection(["1"], STATE, HOMES, {}).missing()
    assert str(missing) == 'unknown device, request or host "1"; did you mean fg/1?'
