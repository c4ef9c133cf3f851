"""The journals of candidates on a mesh: fed by what their leader publishes, asked by anybody."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.mesh.kit import until
from tests.services.journal.kit import holder, published
from tests.services.kit import Refusal, answer
from tests.services.rcm.kit import FakeFleet, FakeRc, grant_of
from tests.services.rcm.test_candidate import open_request
from zscout.config.node import JournalConfig
from zscout.drivers.generic import ExclusiveDriver
from zscout.drivers.resource_controller import ResourceController
from zscout.keyexpr import Sender
from zscout.mesh.supervision import StallWatch
from zscout.messages import UNHEARD, Command, Done, History, HistoryAsk, HoldUse, RcState, Release, Who
from zscout.services.journal import journal as journal_module
from zscout.services.journal.accounts import accounts
from zscout.services.journal.journal import Journal
from zscout.services.journal.merging import Span
from zscout.services.journal.store import FILE, JournalStore
from zscout.services.rcm.candidate import Candidate, CandidateParts
from zscout.testing.memory import MemoryMesh
from zscout.types import SECOND, Grant

START = 1_700_000_000.0
"""The wall clock when the story begins."""


class Told:
    """Candidates with journals."""

    def __init__(self, folder: Path, *hosts: str) -> None:
        self.fleet = FakeFleet(*hosts)
        self.folder = folder
        self.journals: dict[str, Journal] = {}
        self.candidates: dict[str, Candidate] = {}
        for host in hosts:
            self.start(host)

    def start(self, host: str, config: JournalConfig = JournalConfig()) -> MemoryMesh:  # noqa: B008 - it is frozen
        mesh, folder = self.fleet.mesh(host), self.folder / host
        folder.mkdir(exist_ok=True)
        silent = self.fleet.fleet.silence / SECOND
        journal = self.journals[host] = Journal(mesh, folder, config, silent, wall=lambda: START + mesh.now() / SECOND)
        journal.start()
        candidate = self.candidates[host] = Candidate(mesh, self.fleet.fleet, CandidateParts(journal=journal))
        candidate.start()
        return mesh

    async def end(self, host: str) -> None:
        await self.candidates.pop(host).stop()
        await self.journals.pop(host).stop()

    async def close(self) -> None:
        for host in [*self.candidates]:
            await self.end(host)

    async def ask(self, host: str = "x", **asked: Any) -> History:
        mesh = self.fleet.watcher
        return await answer(mesh, mesh.keys.history(host, mesh.me), HistoryAsk(**asked), History)

    async def tells(self, condition: Callable[[History], object], host: str = "x", **asked: Any) -> History:
        """What a journal tells as soon as it is so."""
        history: History | None = None
        try:
            async with asyncio.timeout(60):
                while history is None or not condition(history):
                    await asyncio.sleep(0.1)
                    history = await self.ask(host, **asked)
        except TimeoutError:
            raise AssertionError(f"waited in vain; last {history}") from None
        return history


async def telling(folder: Path, *hosts: str, rcs: Sequence[str] = ("robot/a",)) -> tuple[Told, list[FakeRc]]:
    """Candidates with journals, the first of which leads, and RCs that it counts as there."""
    told = Told(folder, *hosts)
    found = [told.fleet.rc(rc) for rc in rcs]
    await until(lambda: told.candidates[hosts[0]].rcm)
    await told.fleet.joined(*found)
    return told, found


async def test_each_candidate_keeps_who_held_what_and_who_took_it(tmp_path: Path) -> None:
    told, (rc,) = await telling(tmp_path, "x", "y")
    one, two = told.fleet.client("one"), told.fleet.client("two", "ws2")
    await one.ask("survey", "robot/a", seconds=600, who=Who("alice", "ws1", "./survey.py"))
    await asyncio.sleep(10)
    await two.ask("take", "robot/a", priority=10, who=Who("bob"))
    await asyncio.sleep(5)
    await two.do(Release("take"))
    await until(lambda: rc.arcs == ["survey"])
    for host in ("x", "y"):
        found = await told.tells(lambda found: len(found.holds) == 3, host)
        again, take, first = found.holds
        assert (first.arc, first.client, first.rcs, first.outcome) == ("survey", "desk/one", ["robot/a"], "preempted")
        assert first.ended is not None
        assert first.ended - first.began == pytest.approx(10, abs=0.1)
        assert (first.waited, first.min_runtime, first.priority) == (0.0, 600.0, 0)
        assert first.who == Who("alice", "ws1", "./survey.py")
        assert first.by is not None
        assert (first.by.arc, first.by.client, first.by.who) == ("take", "ws2/two", Who("bob"))
        assert (take.outcome, take.priority, take.waited) == ("released", 10, 0.0)
        assert (again.ended, again.outcome) == (None, "")
        assert again.waited == pytest.approx(5, abs=0.1)
        assert found.gaps == []
        assert found.since is not None
        assert START <= found.since <= first.began
    await told.close()


async def test_a_takeover_loses_nothing_and_a_restart_is_a_gap(tmp_path: Path) -> None:
    told, _ = await telling(tmp_path, "x", "y", rcs=["robot/a", "robot/b"])
    one = told.fleet.client("one")
    one.open = [
        open_request(await one.ask(arc, need, seconds=600)) for arc, need in (("kept", "robot/a"), ("ends", "robot/b"))
    ]
    await told.tells(lambda found: len(found.holds) == 2, "y")
    # The leader dies with its journal: kill -9.
    told.fleet.network.kill(told.candidates.pop("x").mesh)
    told.journals.pop("x")
    await until(lambda: told.candidates["y"].rcm)
    await asyncio.sleep(60)
    found = await told.ask("y")
    assert {hold.arc for hold in found.holds} == {"kept", "ends"}
    assert found.gaps == []
    await one.do(Release("ends"))
    await told.tells(lambda found: any(hold.outcome == "released" for hold in found.holds), "y")
    # It missed the minute, and one end in it; the other hold goes on.
    told.start("x")
    found = await told.tells(lambda found: any(hold.outcome for hold in found.holds))
    ends = {hold.arc: (hold.outcome, hold.ended) for hold in found.holds}
    (gap,) = found.gaps
    assert gap.cause == "off"
    assert gap.ended is not None
    assert 59 < gap.ended - gap.began < 100
    assert ends == {"kept": ("", None), "ends": (UNHEARD, gap.began)}
    await told.close()


async def test_what_was_heard_is_on_disk_when_a_node_stops(tmp_path: Path) -> None:
    told, _ = await telling(tmp_path, "x")
    one = told.fleet.client("one")
    await one.ask("short", "robot/a", seconds=600)
    await one.do(Release("short"))
    await told.end("x")
    assert not [*(tmp_path / "x").glob("*-wal")]
    told.start("x")
    (hold,) = (await told.tells(lambda found: found.holds)).holds
    assert (hold.arc, hold.outcome) == ("short", "released")
    await told.close()


async def test_how_long_a_hold_was_used_from_its_commands_to_its_account(tmp_path: Path) -> None:
    told = Told(tmp_path, "x", "y")
    # What it is told in heartbeats keeps its hold.
    mesh = told.fleet.mesh("devices", "node")
    stall = StallWatch(mesh.now).start()
    rc = ResourceController(mesh, "robot/a", ExclusiveDriver(), hold_lease=3.0, stall=stall)
    await rc.start()
    old = told.fleet.rc("robot/b")  # of before there was use
    await until(lambda: told.candidates["x"].rcm)
    await told.fleet.joined(old)
    client = told.fleet.client("one")
    await told.tells(lambda found: found.since is not None)
    grant = grant_of(await client.ask("survey", "robot/a", "robot/b", seconds=600))

    async def echo() -> None:
        command = Command({"name": "echo"}, grant, ttl=5.0)
        await answer(client.mesh, mesh.keys.command("robot/a", client.mesh.me), command, Done)

    await asyncio.sleep(5)
    await echo()
    await asyncio.sleep(7)
    await echo()
    await asyncio.sleep(20)
    # It is told while the hold stands as well.
    (standing,) = (await told.tells(lambda found: found.holds and found.holds[0].used)).holds
    assert standing.ended is None
    await client.do(Release("survey"))
    for host in ("x", "y"):
        done = await told.tells(lambda found: found.holds[0].ended and found.holds[0].used, host)
        (hold,) = done.holds
        assert hold.used == {"robot/a": pytest.approx(7, abs=0.1)}
        (account,) = accounts(done.holds, lambda one: [one.arc], Span(START, done.now))
        assert account.held == pytest.approx(32, abs=0.3)
        assert (account.used, account.used_unknown) == (hold.used["robot/a"], 1)
    await rc.stop()
    stall.stop()
    await told.close()


async def test_only_an_rc_tells_of_its_own_use_and_only_ends_wake_the_disk(tmp_path: Path) -> None:
    told, (rc, other) = await telling(tmp_path, "x", rcs=["robot/a", "robot/b"])
    client = told.fleet.client("one")
    grant = grant_of(await client.ask("survey", "robot/a", "robot/b", seconds=600))
    await told.tells(lambda found: found.holds)
    journal = told.journals["x"]
    await until(lambda: not journal._gathered)
    committed = journal._committed
    for seconds in range(1, 6):
        rc.publish(used=[HoldUse(grant, float(seconds))])
        other.publisher.put(rc.state(used=[HoldUse(grant, 1e6)]))
        await asyncio.sleep(1)
    assert journal._committed == committed
    await client.do(Release("survey"))
    rc.publish(used=[HoldUse(grant, 5.5)])
    found = await told.tells(lambda found: found.holds[0].used)
    assert found.holds[0].used == {"robot/a": 5.5}
    await until(lambda: not journal._uses)
    committed = journal._committed
    # Nor does what is said again.
    for _ in range(3):
        rc.publish(used=[HoldUse(grant, 5.5)])
        await asyncio.sleep(1)
    assert journal._committed == committed
    rc.publish(used=[HoldUse(grant, 6.0)])
    await told.tells(lambda found: found.holds[0].used == {"robot/a": 6.0})
    await told.close()


async def test_no_flood_of_words_on_use_takes_unbounded_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "MAX_USES", 20)
    told, (rc,) = await telling(tmp_path, "x")
    client = told.fleet.client("one")
    grant = grant_of(await client.ask("survey", "robot/a", seconds=600))
    await told.tells(lambda found: found.holds)
    rc.publish(used=[HoldUse(Grant(grant.term, 10**6 + number), 1.0) for number in range(200)])
    journal = told.journals["x"]
    await until(lambda: len(journal._uses) == journal._reported_count == 20)
    await until(lambda: not journal._uses)
    rc.publish(used=[HoldUse(grant, 5.5)])
    await until(lambda: journal._uses)
    await client.do(Release("survey"))
    await told.tells(lambda found: found.holds[0].used == {"robot/a": 5.5})
    # A word of an RC that is not said any more is not remembered, nor is one of whom too many came after.
    for number in range(30):
        rc.name = f"robot/{number}"
        rc.mesh.publisher(rc.mesh.keys.rc_state(rc.name), RcState).put(rc.state(used=[HoldUse(grant, 1.0)]))
        await until(lambda: rc.name in journal._reported and not journal._uses)
    assert journal._reported_count == len(journal._reported) == 20
    rc.mesh.publisher(rc.mesh.keys.rc_state(rc.name), RcState).put(rc.state())
    await until(lambda: "robot/29" not in journal._reported)
    assert journal._reported_count == len(journal._reported) == 19
    await told.close()


async def test_no_rcm_heard_is_a_gap_that_lasts(tmp_path: Path) -> None:
    fleet = FakeFleet("x")
    mesh = fleet.mesh("x")
    journal = Journal(mesh, tmp_path, JournalConfig(), 2.0, wall=lambda: START + mesh.now() / SECOND)
    journal.start()
    journal.observe(published(1, [holder(1, "robot/a")], begun={1: 0.0}))
    await asyncio.sleep(10)
    key = mesh.keys.history("x", Sender("all", "watcher"))
    (gap,) = (await answer(fleet.watcher, key, HistoryAsk(), History)).gaps
    assert (gap.cause, gap.ended) == ("silent", None)
    await journal.stop()


async def test_more_than_can_be_kept_is_a_gap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "MAX_GATHERED", 20)
    told = Told(tmp_path, "x")
    await until(lambda: told.candidates["x"].rcm)
    await told.tells(lambda found: found.since is not None)
    journal, rcm = told.journals["x"], told.candidates["x"].rcm
    assert rcm is not None
    for number in range(1, 31):
        journal.observe(published(rcm.seq + number, term=rcm.term))
    found = await told.tells(lambda found: found.gaps)
    (count,) = [gap.count for gap in found.gaps if gap.cause == "dropped"]
    assert count >= 10
    await told.close()


async def test_a_failing_disk_stops_nothing_and_is_told_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "x" / FILE).mkdir(parents=True)
    told, _ = await telling(tmp_path, "x")
    client = told.fleet.client("one")
    await client.ask("survey", "robot/a", seconds=600)
    await asyncio.sleep(120)
    with pytest.raises(Refusal, match="no_journal"):
        await told.ask()
    (tmp_path / "x" / FILE).rmdir()
    # Nothing was lost meanwhile.
    (hold,) = (await told.tells(lambda found: found.holds)).holds
    assert hold.arc == "survey"
    await told.close()
    assert [record.message for record in caplog.records if "can't be written" in record.message][1:] == []


async def test_bad_questions_are_refused(tmp_path: Path) -> None:
    told = Told(tmp_path, "x")
    for asked, code in (({"rc": "robot"}, "bad_name"), ({"limit": 0}, "malformed")):
        with pytest.raises(Refusal, match=code):
            await told.ask(**asked)
    await told.close()


async def test_questions_take_one_thread_of_those_that_all_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a few long ones keep bookings and terms from the disk."""
    told, _ = await telling(tmp_path, "x")
    answering, most = 0, 0
    whole = JournalStore.answer

    def slow(*args: Any) -> History:
        nonlocal answering, most
        answering += 1
        most = max(most, answering)
        time.sleep(0.01)
        answering -= 1
        return whole(*args)

    monkeypatch.setattr(JournalStore, "answer", slow)
    assert len(await asyncio.gather(*(told.ask() for _ in range(5)))) == 5
    assert most == 1
    await told.close()


async def test_a_hold_is_as_long_as_it_was_though_the_clock_was_set(tmp_path: Path) -> None:
    told, _ = await telling(tmp_path, "x")
    mesh, journal = told.candidates["x"].mesh, told.journals["x"]
    journal._wall = lambda: mesh.now() / SECOND  # a host without a clock battery starts in 1970
    await told.tells(lambda found: found.now < START)
    one = told.fleet.client("one")
    await one.ask("survey", "robot/a", seconds=600)
    await asyncio.sleep(10)
    journal._wall = lambda: START + mesh.now() / SECOND
    await asyncio.sleep(10)
    await one.do(Release("survey"))
    (hold,) = (await told.tells(lambda found: found.holds and found.holds[0].ended)).holds
    assert hold.ended is not None
    assert hold.ended - hold.began == pytest.approx(20, abs=0.5)
    assert hold.began > START
    await told.close()


async def test_nothing_is_too_old_by_a_clock_that_was_just_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "STEADY", 60 * SECOND)
    told, _ = await telling(tmp_path, "x")
    mesh, journal = told.candidates["x"].mesh, told.journals["x"]
    one = told.fleet.client("one")
    await one.ask("survey", "robot/a", seconds=5)
    await told.tells(lambda found: found.holds and found.holds[0].ended)
    for ahead in (10 * 365 * 86_400, 0):
        journal._wall = lambda ahead=ahead: START + ahead + mesh.now() / SECOND  # type: ignore[misc]
        await one.ask(f"then{ahead}", "robot/a", seconds=5)
        await asyncio.sleep(20)
    assert {hold.arc for hold in (await told.ask()).holds} >= {"survey", "then0"}
    # By one that is right it is, at last.
    journal._wall = lambda: START + 10 * 365 * 86_400 + mesh.now() / SECOND
    await asyncio.sleep(100)
    assert {hold.arc for hold in (await told.ask()).holds} == {"then315360000"}
    await told.close()
