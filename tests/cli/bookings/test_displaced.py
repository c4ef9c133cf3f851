"""Whom maintenance displaces, in words, by what the leader tells."""

from __future__ import annotations

from decimal import Decimal
from typing import Any

import pytest

from zscout.cli import booked
from zscout.cli.bookings import displaced
from zscout.cli.bookings.displaced import Displaced
from zscout.messages import BookedDate, BookingsTold, BookingView, HoldView, RcmState, RcView, Who
from zscout.types import Grant, Place, Term

TERM = Term(1, "r")
NOW = 1_800_000_000.0
HOUR = 3600.0


def hold(arc: str, *rcs: str, **more: Any) -> HoldView:
    terms: dict[str, Any] = {"priority": 0, "keep": True, "remaining": 600.0} | more
    who = Who("ada", host="desk")
    needs: dict[str, Any] = {rc: {} for rc in rcs}
    return HoldView(
        id=arc, arc=arc, client="desk/c1", place=Place(TERM, 1), min_runtime=Decimal(600), grant=Grant(TERM, 1),
        needs=needs, held=60.0, who=who, **terms,
    )  # fmt: skip


def booking(name: str, need: str, start: float, **more: Any) -> BookingView:
    bound = more.pop("bound", {})
    terms: dict[str, Any] = {"priority": 0, "patience": Decimal(0), "owner": "desk"} | more
    date = BookedDate(round(NOW + start), round(NOW + start + HOUR), "open", bound)
    return BookingView(
        id=f"{name}-12345678",
        name=name,
        needs={need: {}},
        start=date.start,
        runtime=Decimal(3600),
        dates=[date],
        **terms,
    )


def cost(
    *needs: str, start: float = 0.0, holds: tuple[HoldView, ...] = (), booked_: tuple[BookingView, ...] = ()
) -> Any:
    views = [RcView(rc, True, False, host=host) for rc, host in HOSTS.items()]
    state = RcmState(TERM, 1, "anvil", holds=list(holds), rcs=views)
    told = BookingsTold(NOW, list(booked_))
    return Displaced(needs, [(NOW + start, NOW + start + HOUR)], 10, state, told)


LONG = "at least, and kept for as long as it wants"
HOSTS = {"robot/a": "anvil", "robot/b": "bellows", "camera/c": "anvil"}


@pytest.fixture(autouse=True)
def _clocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Times as seconds from now."""
    for module in (displaced, "zscout.cli.requests.waiting"):
        monkeypatch.setattr(
            f"{module if isinstance(module, str) else module.__name__}.clock", lambda at, **_: f"{at:+g}"
        )
    monkeypatch.setattr(booked, "span_words", lambda start, end, _: f"{start - NOW:+g} to {end - NOW:+g}")


def test_devices_patterns_and_hosts_are_meant() -> None:
    assert cost("robot/a").rcs == {"robot/a"}
    assert cost("robot/*").rcs == {"robot/a", "robot/b"}
    assert cost("@anvil").rcs == {"robot/a", "camera/c"}
    assert cost("@bellows", "camera/*").rcs == {"robot/b", "camera/c"}


def test_nobody_is_displaced_where_nobody_holds_or_booked_it() -> None:
    free = cost("@anvil", holds=(hold("other", "robot/b"),), booked_=(booking("later", "robot/a", 2 * HOUR),))
    assert not free
    assert free.lines() == []


def test_kept_holds_end_and_others_are_waited_for() -> None:
    holds = (
        hold("kept", "robot/a", "robot/b"),
        hold("over", "camera/c", remaining=-5.0),
        hold("ends", "robot/a", keep=False),
        hold("above", "robot/a", priority=11),
    )
    shown = cost("@anvil", holds=holds).lines()
    assert shown == [
        "ends kept (ada@desk), priority 0: robot/a, at +600 (in 10 min)",
        "ends over (ada@desk), priority 0: camera/c, at once",
        "waits for ends (ada@desk), priority 0, since -60 (1 min), until +600 (10 min) at the latest: robot/a",
        f"waits for above (ada@desk), priority 11, since -60 (1 min), until +600 (10 min) {LONG}: robot/a",
    ]
    assert not cost("@anvil", holds=holds[2:])
    later = cost("@anvil", start=HOUR, holds=holds[:3])
    assert later.lines() == [
        "ends kept (ada@desk), priority 0: robot/a, at +3600 (in 1 h)",
        "ends over (ada@desk), priority 0: camera/c, at +3600 (in 1 h)",
    ]
    assert [one["ends_in"] for one in later.as_json()["ends"]] == [3600, 3600]


def test_bookings_of_lower_priority_at_that_time_are_lost() -> None:
    found = cost(
        "@anvil",
        booked_=(
            booking("mine", "robot/a", 1800),
            booking("moved", "robot/*", 1800, bound={"robot/*": "robot/a"}),
            booking("elsewhere", "robot/*", 1800, bound={"robot/*": "robot/b"}),
            booking("operators", "robot/a", 1800, priority=10),
            booking("greased", "robot/a", 1800, maintenance=True),
            booking("after", "robot/a", HOUR),
        ),
    )
    assert found.lines() == [
        "takes from mine (mine-123) of desk: +1800 to +5400",
        "takes from moved (moved-12) of desk: +1800 to +5400",
    ]
