"""A made-up hour of a lab with eight devices: the scheduler's decisions as the messages that its leader publishes."""

from __future__ import annotations

import random
from decimal import Decimal
from typing import Any, Final, Literal

from zscout.messages import (
    BookedDate,
    BookingsTold,
    BookingView,
    Grants,
    Holder,
    Notice,
    RcmState,
    RcView,
    Revocation,
    Who,
)
from zscout.rcm.request_log import reason_info
from zscout.scheduling.model import ArcRequest, Dropped, Effect, Granted, HoldEnded, Queued
from zscout.services.recorder.request_tracker import RequestTracker
from zscout.services.recorder.timeline import Timeline
from zscout.simulation.replay import replay
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND, Grant, Ns, Place, Term

HOUR: Final = 3600
DEVICES: Final = (
    *("robot/arm1", "robot/arm2", "robot/cart1", "robot/cart2"),
    *("framegrabber/fg1", "framegrabber/fg2", "psu/bench1", "scope/tek1"),
)
PEOPLE: Final = {"alice": "ws1", "bob": "ws2", "carla": "ws3", "dmitri": "ws1", "erin": "ws4"}
KINDS: Final = {
    "pick": ("robot/arm1", "framegrabber/fg1"),
    "calibrate": ("robot/arm2", "framegrabber/fg2", "scope/tek1"),
    "survey": ("robot/cart1", "robot/cart2"),
    "burn-in": ("psu/bench1", "scope/tek1"),
    "film": ("framegrabber/fg1", "robot/cart1"),
    "handover": ("robot/arm1", "robot/arm2"),
}
OPERATORS: Final = ((900, 120, "robot/arm1"), (2400, 180, "robot/cart1"), (3470, 400, "robot/arm2"))
"""Takeovers: at, for, of."""
TERM: Final = Term(1, "anvil")


def requests() -> dict[str, tuple[int, ArcRequest, Who]]:
    """By ARC: when it asks, what, and who."""
    chance = random.Random(7)  # noqa: S311
    found: dict[str, tuple[int, ArcRequest, Who]] = {}

    def ask(at: int, name: str, user: str, needs: tuple[str, ...], priority: int, runtime: int, command: str) -> None:
        host = PEOPLE[user]
        who = Who(user, host, command)
        arc = f"{host}/request-{len(found)}/a1"
        request = ArcRequest(
            arc,
            f"{host}/request-{len(found)}",
            {rc: {} for rc in needs},
            priority,
            runtime * SECOND,
            label=name,
            who=who,
        )
        found[arc] = at, request, who

    at = 0
    while at < HOUR:
        name = chance.choice(list(KINDS))
        user = chance.choice(list(PEOPLE))
        ask(at, name, user, KINDS[name], chance.choice((1, 1, 1, 2)), chance.randint(50, 260), f"sh -c ./{name}.sh")
        at += chance.randint(35, 110)
    for at, runtime, rc in OPERATORS:
        ask(at, "drive", "bob", (rc,), 10, runtime, "zscout drive")
    return found


def play(timeline: Timeline, until: int = HOUR) -> RequestTracker:
    """The hour, as the recorder would write it, up to a second of it."""
    asked = requests()
    tracker = RequestTracker(timeline, 10)
    seq, step, grants = 0, 0, dict[str, Grant]()
    holds: dict[str, dict[str, Holder]] = {rc: {} for rc in DEVICES}
    tracker.state(0, RcmState(TERM, 0, "anvil", rcs=[RcView(rc, True, False) for rc in DEVICES]))
    ticked = 0

    def notice(now: Ns, arc: str, state: Literal["queued", "ended"], **more: Any) -> None:
        nonlocal step
        step += 1
        _, request, who = asked[arc]
        tracker.notice(now / SECOND, Notice("a1", request.name, request.client, state, TERM, step, who=who, **more))

    def tick(at: float) -> None:
        nonlocal ticked
        while ticked < at:
            for number, host in enumerate(("anvil", "basil", "crucible")):
                busy = sum(bool(holders) for holders in holds.values())
                timeline.hosts.load(ticked, host, 0.2 + 0.1 * busy * (number + 1) / 2, 0.4)
            ticked += 5
            timeline.regroup(ticked)

    def watch(now: Ns, _core: object, effects: list[Effect]) -> None:
        nonlocal seq
        at = now / SECOND
        if at > until:
            return
        tick(at)
        touched, revoked = set[str](), list[Revocation]()
        for effect in effects:
            match effect:
                case HoldEnded(arc=arc):
                    _, request, _ = asked[arc]
                    for rc in effect.rcs:
                        holds[rc].pop(arc, None)
                    touched |= set(effect.rcs)
                    by = asked[effect.by][1].name if effect.by else None
                    info = reason_info(effect.reason, now)
                    revoked.append(
                        Revocation(
                            "a1",
                            request.name,
                            request.client,
                            grants.pop(arc),
                            list(effect.rcs),
                            effect.outcome.value,
                            str(effect.reason),
                            by,
                            info,
                        )
                    )
                case Granted(arc=arc, rcs=rcs):
                    _, request, who = asked[arc]
                    grants[arc] = Grant(TERM, len(grants) + 1000 * step + seq + 1)
                    holder = Holder(
                        "a1",
                        request.name,
                        request.client,
                        grants[arc],
                        Place(TERM, 1),
                        list(rcs),
                        Decimal(request.min_runtime // SECOND),
                        5.0,
                        request.priority,
                        who=who,
                    )
                    for rc in rcs:
                        holds[rc][arc] = holder
                    touched |= set(rcs)
        if touched or revoked:
            seq += 1
            told = {rc: list(holds[rc].values()) for rc in sorted(touched)}
            tracker.grants(at, Grants(TERM, seq, seq - 1, 1, told, revoked))
        for effect in effects:
            match effect:
                case Queued(arc=arc, reason=reason, settled=True):
                    notice(now, arc, "queued", reason=str(reason), why=reason_info(reason, now))
                case HoldEnded(arc=arc, outcome=outcome, reason=reason) if not effect.requeued:
                    notice(now, arc, "ended", outcome=outcome.value, reason=str(reason))
                case Dropped(arc=arc, outcome=outcome, reason=reason):
                    notice(now, arc, "ended", outcome=outcome.value, reason=str(reason))

    workload = Workload(
        tuple(WorkloadRc(name) for name in DEVICES),
        tuple(Arrival(at * SECOND, request) for at, request, _ in asked.values()),
    )
    replay(workload, watch)
    tick(until)
    return tracker


def booked(now: int, end: int) -> BookingsTold:
    """What is booked, as the leader reports it, in the day from the end of the hour on."""

    def one(name: str, owner: str, rcs: tuple[str, ...], start: float, hours: float, **date: Any) -> BookingView:
        begin = end + round(start * HOUR)
        dates = [BookedDate(begin, begin + round(hours * HOUR), "open", **date)]
        return BookingView(
            name, name, {rc: {} for rc in rcs}, 1, begin, Decimal(hours * HOUR), Decimal(60), owner=owner, dates=dates
        )

    return BookingsTold(
        now,
        [
            one("course", "carla", ("robot/arm1", "robot/arm2"), 2, 3),
            one("nightly", "erin", ("robot/cart1", "psu/bench1"), 10, 6),
            one("demo-day", "alice", ("robot/arm1",), 18, 2, danger="robot/arm1 is held past its date"),
        ],
    )
