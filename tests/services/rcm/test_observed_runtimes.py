"""What candidates learn of how long holds last, and what their RCMs tell by it."""

from __future__ import annotations

import asyncio
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from tests.mesh.kit import until
from tests.services.journal.kit import holder, over, past, published
from tests.services.rcm.kit import FakeClient, FakeFleet, request
from zscout.config.node import JournalConfig
from zscout.messages import Cancel, ReasonInfo, Release, Who
from zscout.scheduling.runtimes import RequestTraits
from zscout.services.journal.follower import Change, HoldOver, HoldSeen
from zscout.services.journal.journal import Journal
from zscout.services.journal.store import JournalStore
from zscout.services.rcm import observed_runtimes
from zscout.services.rcm.candidate import Candidate, CandidateParts
from zscout.services.rcm.observed_runtimes import RuntimeObserver
from zscout.types import SECOND, Ns

RELEASED = ReasonInfo("released", own=True)
WHO = Who("alice", "ws1", "./survey.py")


async def begin(client: FakeClient, number: int, rc: str = "robot/a") -> None:
    """A run of a program that asks for ten minutes."""
    await client.do(replace(request("survey", rc, seconds=600, who=WHO), id=f"survey{number}"))


async def end(client: FakeClient, number: int) -> None:
    await client.do(Release(f"survey{number}"))


async def test_a_new_leader_knows_how_long_programs_take() -> None:
    fleet = FakeFleet("x", "y")
    candidates: dict[str, Candidate] = {host: fleet.candidate(host) for host in ("x", "y")}
    rc = fleet.rc("robot/a")
    await until(lambda: candidates["x"].rcm)
    await fleet.joined(rc)
    survey, other = fleet.client("survey"), fleet.client("other", "ws2")
    for number in range(4):
        await begin(survey, number)
        told = await other.ask(f"early{number}", "robot/a", seconds=60, estimate=True)
        assert told.starts_in == pytest.approx(600 if number < 3 else 30, abs=0.5)
        assert ((await fleet.state()).holds[0].ends_in is None) == (number < 3)
        await other.do(Cancel(f"early{number}"))
        await asyncio.sleep(30)
        await end(survey, number)
    await begin(survey, 4)
    told = await other.ask("next", "robot/a", seconds=60, estimate=True)
    assert told.starts_in == pytest.approx(30, abs=0.5)
    await asyncio.sleep(10)
    assert (await fleet.state()).holds[0].ends_in == pytest.approx(20, abs=0.5)
    assert rc.arcs == ["survey"]
    # It is given back later than was foretold, and nobody took it.
    await asyncio.sleep(50)
    assert rc.arcs == ["survey"]
    await end(survey, 4)
    await until(lambda: rc.arcs == ["next"])
    await candidates.pop("x").stop()
    await until(lambda: candidates["y"].rcm)
    await other.do(Release("next"))
    await begin(survey, 5)
    state = await fleet.state()
    assert state.host == "y"
    assert state.holds[0].ends_in == pytest.approx(30, abs=0.5)
    await candidates.pop("y").stop()


async def test_one_who_starts_anew_knows_what_its_journal_knows(tmp_path: Path) -> None:
    fleet = FakeFleet("x")
    for life in range(2):
        mesh = fleet.mesh("x")
        silent = fleet.fleet.silence / SECOND
        runtimes = RuntimeObserver()
        wall = lambda: 1e9 + fleet.watcher.now() / SECOND  # noqa: E731
        journal = Journal(mesh, tmp_path, JournalConfig(), silent, wall, runtimes.recall)
        journal.start()
        candidate = Candidate(mesh, fleet.fleet, CandidateParts(journal=journal, runtimes=runtimes))
        candidate.start()
        await until(partial(getattr, candidate, "rcm"))
        await until(partial(getattr, journal, "_follower"))
        rc, client = fleet.rc(f"robot/{'ab'[life]}"), fleet.client(f"c{life}")
        await fleet.joined(rc)
        if life == 0:
            for number in range(4):
                await begin(client, number)
                await asyncio.sleep(30)
                await end(client, number)
        else:
            # Of another RC, so that nothing but the name and the command tell what it is.
            await begin(client, 4, "robot/b")
            assert (await fleet.state()).holds[0].ends_in == pytest.approx(30, abs=0.5)
        await candidate.stop()
        await journal.stop()
        await mesh.close()


def wish(need: str, asked: int = 60) -> RequestTraits:
    return RequestTraits("survey", "./survey.py", frozenset({need}), asked * SECOND)


def tell(
    observer: RuntimeObserver, number: int, lasted: float, outcome: str, why: ReasonInfo | None, **more: Any
) -> None:
    """A hold of a minute, from its first publication to that of its end."""
    begun = replace(holder(number, "robot/a"), **more)
    end = replace(over(number, outcome, "robot/a"), why=why)
    observer.hear(number * 100 * SECOND, published(2 * number - 1, [begun]))
    observer.hear(number * 100 * SECOND + round(lasted * SECOND), published(2 * number, [], [end]))


@pytest.mark.parametrize(
    ("outcome", "why", "learned"),
    [
        ("released", RELEASED, 6 * SECOND),
        ("completed", RELEASED, 6 * SECOND),
        ("released", ReasonInfo("released", detail="bob@ws2"), None),
        ("cancelled", ReasonInfo("cancelled", own=True), None),
        ("preempted", ReasonInfo("preempted"), None),
        ("lost", ReasonInfo("rc_lost"), None),
        ("completed", ReasonInfo("displaced"), None),
        ("completed", ReasonInfo("expired"), None),  # all that was asked for
        ("handed_over", ReasonInfo("handed_over"), None),
        ("released", None, None),  # of an older version
    ],
)
def test_only_what_ended_by_itself_says_how_long_it_takes(
    outcome: str, why: ReasonInfo | None, learned: Ns | None
) -> None:
    heard, recalled = RuntimeObserver(), RuntimeObserver()
    for number in range(1, 9):
        tell(heard, number, 6, outcome, why, bound={"robot/*": "robot/a"})
    assert heard.estimator.runtime(wish("robot/*")) == learned
    assert not heard._open
    ended = {} if why is None else {"code": why.code, "own": why.own}
    recalled.recall(past(number, 0.0, 6.0, outcome, who=WHO, **ended) for number in range(8))
    assert recalled.estimator.runtime(wish("robot/a")) == learned


def test_a_hold_that_is_heard_of_late_began_before() -> None:
    observer = RuntimeObserver()
    for number in range(1, 4):
        tell(observer, number, 50, "completed", RELEASED, remaining=-100.0, keep=True)
    assert observer.estimator.runtime(wish("robot/a")) == 210 * SECOND


def test_what_is_followed_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observed_runtimes, "MAX_OPEN", 10)
    observer = RuntimeObserver()
    for number in range(1, 100):
        observer.hear(number, published(number, [holder(number, "robot/a")]))
    assert len(observer._open) == 10


def test_a_journal_tells_of_what_it_heard_from_beginning_to_end(tmp_path: Path) -> None:
    store = JournalStore(tmp_path, 1e6, 64_000_000)
    store.open()
    whole = past(1, 10.0, 12.0, "released")
    later = past(2, 11.0, 20.0, "preempted")
    changes: list[Change] = [HoldSeen(whole), HoldSeen(later), HoldSeen(past(3, 12)), HoldOver(later), HoldOver(whole)]
    store.commit([*changes, HoldOver(past(4, 13.0, 14.0, "released", late=True))], 5.0, 30.0, 30.0)
    assert [hold.grant.seq for hold in store.latest(5)] == [1, 2]
    assert [hold.grant.seq for hold in store.latest(1)] == [2]
