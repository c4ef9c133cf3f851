"""A fleet with certificates: who lies about terms, what counts, and what a manager keeps on disk."""

from __future__ import annotations

import asyncio
from decimal import Decimal
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.mesh.kit import until
from tests.services.rcm.kit import FakeClient, FakeFleet, FakeRc, Refusal, there
from zscout.mesh import IncomingQuery
from zscout.messages import MAX_COUNTER, ClientRequests, Grants, OpenRequest, RcAsk, RcState
from zscout.rcm.places import Places
from zscout.services.rcm.candidate import Candidate
from zscout.services.rcm.election import LEADER_WAIT
from zscout.services.rcm.term_file import FILE, TermFile
from zscout.types import NO_TERM, SECOND, Place, Term

KEY = bytes(range(32))
FAR = Term(2**40, "eve")
SERVED = 0.5


async def led(fleet: FakeFleet, **how: Any) -> Candidate:
    candidate = fleet.candidate("h1", **how)
    await until(lambda: "robot/a" in there(candidate))
    return candidate


def a_fleet() -> FakeFleet:
    fleet = FakeFleet("h1", closed=True)
    fleet.rc("robot/a")
    return fleet


class Liar(FakeClient):
    """Obeys a term above each that it is asked for."""

    def _on_asked(self, query: IncomingQuery[RcAsk]) -> None:
        promise = query.message.promise or NO_TERM
        query.answer(ClientRequests(self.name, self.open, Term(promise.counter + 2, "eve")))


def listed(place: Place, seal: str) -> OpenRequest:
    return OpenRequest("lie", "lie", {"robot/a": {}}, 0, Decimal(60), place=place, seal=seal)


async def test_a_client_that_asks_in_a_higher_term_deposes_nobody() -> None:
    fleet = a_fleet()
    candidate, eve = await led(fleet), fleet.client("eve")
    for _ in range(3):
        with pytest.raises(Refusal, match="old_term"):
            await eve.ask("lie", "robot/a", term=FAR)
    assert candidate.rcm is not None
    assert candidate.rcm.term.counter == 1


@pytest.mark.parametrize("lists", [False, True], ids=["refuses promises", "lists places of higher terms"])
async def test_a_client_that_obeys_a_higher_term_keeps_nobody_from_leading(lists: bool) -> None:
    fleet = a_fleet()
    eve = Liar(fleet.mesh("desk", "eve"), fleet.log)
    eve.open = [listed(Place(FAR, 1), "0" * 32)] if lists else []
    eve.start()
    candidate = await led(fleet, places_key=KEY)
    assert candidate.known.counter == 1
    async with asyncio.timeout(SERVED):
        assert (await fleet.client("bob").ask("survey", "robot/a")).state == "running"


async def test_a_sealed_place_of_a_higher_term_moves_the_fleet_above() -> None:
    """Of a leader that was, if every manager's disk is lost."""
    place = Place(Term(7, "was"), 1)
    fleet = a_fleet()
    client = Liar(fleet.mesh("desk", "eve"), fleet.log)
    client.open = [listed(place, str(Places(fleet.fleet.name, KEY, NO_TERM).seal(place, f"{client.name}/lie")))]
    client.start()
    candidate = await led(fleet, places_key=KEY)
    assert candidate.known.counter == 8
    later = Place(Term(20, "was"), 1)
    seal = Places(fleet.fleet.name, KEY, NO_TERM).seal(later, f"{client.name}/more")
    with pytest.raises(Refusal, match="old_term"):
        await client.ask("more", "robot/a", place=later, seal=seal)
    await until(lambda: candidate.rcm and candidate.rcm.term.counter == 21)


async def test_an_rc_that_claims_terms_costs_one_election_and_then_counts_as_absent() -> None:
    fleet = a_fleet()
    candidate, liar = await led(fleet), FakeRc(fleet.mesh("cart"), "gripper/g")
    liar.start()
    await until(lambda: "gripper/g" in there(candidate))
    liar.term = FAR
    liar.publish()
    async with asyncio.timeout(SERVED):
        await until(lambda: candidate.known > FAR and there(candidate) == {"robot/a", "gripper/g"})
    after = candidate.known
    liar.term = Term(FAR.counter + 9, "eve")
    liar.publish()
    await until(lambda: there(candidate) == {"robot/a"})
    await asyncio.sleep(SERVED)
    assert (candidate.known, there(candidate)) == (after, {"robot/a"})
    await until(lambda: there(candidate) == {"robot/a", "gripper/g"}, within=11)


async def test_an_rc_beside_a_liar_that_has_promised_another_candidate_is_not_lost_before_that_leads() -> None:
    """Its host is not believed alone, and the candidate leads within milliseconds (seed 963496)."""
    fleet = a_fleet()
    candidate, liar = await led(fleet), FakeRc(fleet.mesh("cart", "liar"), "gripper/g")
    honest = FakeRc(fleet.mesh("cart"), "robot/b")
    for rc in (liar, honest):
        rc.start()
    await until(lambda: len(there(candidate)) == 3)
    liar.term = FAR
    liar.publish()
    await until(lambda: candidate.known > FAR and len(there(candidate)) == 3)
    bob = fleet.client("bob")
    assert (await bob.ask("survey", "robot/b")).state == "running"
    honest.term = rival = Term(candidate.known.counter + 1, "rival")
    honest.publish()
    await asyncio.sleep(fleet.fleet.timing.rebuild / SECOND)
    assert "robot/b" in there(candidate)
    fleet.watcher.publisher(fleet.watcher.keys.grants, Grants).put(Grants(rival, 1, 0, 0.5))
    await until(lambda: candidate.rcm is None)
    assert [notice.outcome for notice in bob.notices if notice.outcome] == []


async def test_rcs_that_claim_to_see_the_leader_of_their_term_delay_one_election_by_a_silence() -> None:
    fleet = a_fleet()
    candidate = await led(fleet)
    liars = [FakeRc(fleet.mesh("cart", name), f"gripper/{name}", leader=True) for name in ("f", "g")]
    for liar in liars:
        liar.start()
    await until(lambda: len(there(candidate)) == 3)
    for liar in liars:
        liar.term = FAR
        liar.publish()
    await until(lambda: candidate.rcm is None)
    within = fleet.fleet.silence / SECOND + SERVED
    await until(lambda: candidate.known > FAR and "robot/a" in there(candidate), within=within)


async def test_a_host_whose_rcs_showed_a_term_before_its_leader_spoke_is_believed() -> None:
    """RCs promise a term before anybody leads in it."""
    fleet = a_fleet()
    term = Term(4, "x")
    fleet.rc("robot/b", term=term)
    candidate = fleet.candidate("h1")
    await until(lambda: candidate.known == term)
    assert candidate.terms.doubted_until("devices", candidate.mesh.now())
    fleet.watcher.publisher(fleet.watcher.keys.grants, Grants).put(Grants(term, 1, 0, 0.5))
    await until(lambda: not candidate.terms.doubted_until("devices", candidate.mesh.now()), within=0.1)


class LiarOfHost(FakeRc):
    """May say that it is at another host."""

    host = ""

    def state(self, **more: Any) -> RcState:
        return msgspec.structs.replace(super().state(**more), host=self.host or self.mesh.me.host)


def liars(fleet: FakeFleet, count: int, *, elsewhere: bool = False) -> list[LiarOfHost]:
    """RCs of one node, which always see a leader."""
    found = [LiarOfHost(fleet.mesh("cart", f"g{number}"), f"gripper/g{number}", leader=True) for number in range(count)]
    for number, liar in enumerate(found):
        liar.host = f"elsewhere{number}" if elsewhere else ""
        liar.start()
    return found


@pytest.mark.parametrize("elsewhere", [False, True], ids=["at its host", "at others by their word"])
async def test_many_rcs_of_one_host_that_see_a_leader_keep_nobody_from_leading(elsewhere: bool) -> None:
    fleet = a_fleet()
    fleet.fleet = msgspec.structs.replace(fleet.fleet, candidates=("h1", "h2"))
    first = await led(fleet)
    second, _ = fleet.candidate("h2"), liars(fleet, 20, elsewhere=elsewhere)
    await until(lambda: second.election.sees_leader(second.mesh.now()))
    fleet.network.kill(first.mesh)
    await until(lambda: "robot/a" in there(second), within=SERVED)


async def test_a_host_that_alone_shows_a_leader_delays_one_change_of_leader_for_a_while() -> None:
    """It is not believed alone after that."""
    fleet = FakeFleet("h1", "h2", closed=True)
    bound, silence = (LEADER_WAIT + fleet.fleet.silence) / SECOND, fleet.fleet.silence / SECOND
    first, _ = fleet.candidate("h1"), liars(fleet, 3)
    await until(lambda: there(first), within=bound + SERVED)
    second = fleet.candidate("h2")
    await until(lambda: second.known == first.known)
    fleet.network.kill(first.mesh)
    began = second.mesh.now()
    await until(lambda: there(second), within=bound + SERVED)
    assert (second.mesh.now() - began) / SECOND >= bound
    fleet.watcher.publisher(fleet.watcher.keys.grants, Grants).put(Grants(Term(9, "x"), 1, 0, 0.5))
    await until(lambda: second.rcm is None)
    await until(lambda: there(second), within=1.3 * silence + SERVED)


async def test_without_certificates_a_host_that_alone_shows_a_leader_is_believed() -> None:
    """Where two hosts are cut from each other, one that sees both knows better."""
    fleet = FakeFleet("h1", "h2")
    first, rc, second = fleet.candidate("h1"), fleet.rc("robot/a"), fleet.candidate("h2")
    await until(lambda: second.election.sees_leader(second.mesh.now()))
    rc.leader = True
    fleet.cut(first.mesh, second.mesh)
    await asyncio.sleep(3 * LEADER_WAIT / SECOND)
    assert second.rcm is None


async def test_rcs_of_two_hosts_use_up_no_terms() -> None:
    """Of the last ones: none above is left, and managers keep what they believe on disk."""
    fleet = a_fleet()
    candidate = await led(fleet)
    for host in ("cart", "desk"):
        FakeRc(fleet.mesh(host), f"gripper/{host}", term=Term(MAX_COUNTER, "eve")).start()
    await asyncio.sleep(3)
    assert candidate.known.counter < MAX_COUNTER // 2
    async with asyncio.timeout(SERVED):
        assert (await fleet.client("bob").ask("survey", "robot/a")).state == "running"


async def test_managers_that_start_anew_go_on_above_the_term_on_their_disk(tmp_path: Path) -> None:
    fleet = a_fleet()
    disk = TermFile(tmp_path, fleet.fleet.name)
    await disk.write(Term(41, "was"))
    candidate = await led(fleet, disk=disk)
    assert candidate.known.counter == 42
    assert TermFile(tmp_path, fleet.fleet.name).read() == candidate.known
    fleet.watcher.publisher(fleet.watcher.keys.grants, Grants).put(Grants(Term(50, "other"), 1, 0, 0.5))
    await until(lambda: disk.read() >= Term(50, "other"))


async def test_without_certificates_or_with_a_disk_that_fails_a_candidate_leads_as_before(tmp_path: Path) -> None:
    disk = TermFile(tmp_path / "no" / "folder", "test")
    (tmp_path / "no").write_text("a file")
    assert (await led(a_fleet(), disk=disk)).known.counter == 1
    plain = FakeFleet("h1")
    plain.rc("robot/a")
    kept = TermFile(tmp_path, plain.fleet.name)
    await kept.write(Term(41, "was"))
    assert (await led(plain, disk=kept)).known.counter == 1


@pytest.mark.parametrize(
    "content", [b"", b"{}", b'{"fleet":"other","term":[7,"x"]}', b'{"fleet":"test","term":[-1,""]}']
)
def test_a_term_file_that_is_none_is_not_used(tmp_path: Path, content: bytes) -> None:
    (tmp_path / FILE).write_bytes(content)
    assert TermFile(tmp_path, "test").read() == NO_TERM
