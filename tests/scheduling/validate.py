"""All invariants of a core's state, checked from its inside."""

from __future__ import annotations

from collections import Counter

from zscout.keyexpr import matcher
from zscout.scheduling.core import Core
from zscout.scheduling.model import Arc, ArcState, Rank
from zscout.scheduling.patterns import short
from zscout.scheduling.queue_index import QueueIndex
from zscout.scheduling.state import SchedulerState
from zscout.types import Place

QUEUED = (ArcState.READY, ArcState.VOTING, ArcState.DEFERRED, ArcState.WATCHING, ArcState.PARKED)


def validate(core: Core) -> None:
    """Raises AssertionError that names the breach."""
    state = core._state
    _check_state(state)
    _check_index(state, state.index)
    for arc in state.running.values():
        left = arc.hold is not None and arc.hold.end - state.now >= 0
        assert left or arc.request.keep, f"{arc.id} overran"
        assert arc.reason is None, f"{arc.id} runs and has a reason to wait"
    for arc in state.queued.values():
        assert arc.reason is not None, f"{arc.id} waits without a reason"
    for rc, holders in state.votes.proposals.values():
        assert state.rc(rc).present, f"a proposal is out at {rc}, which is absent"
        assert all(state.voter(arc) for arc in holders), f"a proposal at {rc} names an ARC that ended"
    for claim in state.claims.values():
        assert state.now < claim.booking.end, f"{claim.booking.id} is over"
        arc = claim.arc
        if claim.is_taken:
            assert state.arc(arc.id) is arc, f"{claim.booking.id} is taken up by what ended"
        else:
            assert arc.state is ArcState.NEW, f"what stands for {claim.booking.id} is {arc.state}"
            assert state.now < claim.booking.lapses, f"{claim.booking.id} has lapsed"
        assert claim.kept & ~state.dates.claimed == 0, f"what is kept for {claim.booking.id} is not known to be"
    for arc in (*state.queued.values(), *state.held_back.values(), *state.running.values()):
        assert arc.claim is None or state.claims.get(arc.claim.booking.id) is arc.claim, f"{arc.id}: no such booking"
        wanted = state.claims.get(arc.request.booking)
        if wanted is not None and not (wanted.booking.maintenance or wanted.tentative):
            assert wanted.is_taken, f"{arc.id} has not taken up {wanted.booking.id}, which is open"
    open_arcs = [*state.queued.values(), *state.held_back.values(), *state.running.values()]
    for wanting in core._calendar._wanting.values():
        assert all(arc in open_arcs for arc in wanting), f"of {wanting} one is over"


def _check_state(state: SchedulerState) -> None:
    assert not state.queued.keys() & state.running.keys(), "an ARC both waits and runs"
    for arc in state.queued.values():
        assert arc.hold is None, f"{arc.id} waits and holds"
        assert arc.state in QUEUED
    for arc in state.running.values():
        assert arc.hold is not None, f"{arc.id} runs without a hold"
        assert arc.state is ArcState.RUNNING
        assert arc.mask & ~state.present == 0, f"{arc.id} holds an absent RC"
        assert arc.bound.keys() == set(arc.patterns), f"{arc.id} runs and is not bound"
        for need, rc_name in arc.bound.items():
            assert matcher(need)(rc_name), f"{arc.id} has {rc_name} for {need}"
        assert len(arc.needs) == len(arc.request.needs), f"{arc.id} has one RC for two needs"
        for rc in state.rcs_in(arc.mask):
            assert rc.holders.get(arc.id) is arc, f"{arc.id} holds only a part: not {rc.name}"
    busy = 0
    for rc in state.rcs.values():
        for holder in rc.holders:
            assert holder in state.running, f"{rc.name} is held by {holder}, which does not run"
            assert rc.name in state.running[holder].needs, f"{holder} did not ask for {rc.name}"
        if not rc.sharable:
            assert len(rc.holders) <= 1, f"{rc.name} has two holders: {sorted(rc.holders)}"
            busy |= rc.bit if rc.holders else 0
    assert busy == state.busy, "the mask of busy RCs is wrong"
    counted = Counter(arc.owner for arc in state.running.values())
    assert counted == state.running_by_owner, "the owners' ARCs are miscounted"
    demand: dict[str, list[Rank]] = {}
    for arc in state.queued.values():
        for name in arc.request.needs:
            demand.setdefault(name, []).append(arc.rank)
    for rc in state.rcs.values():
        assert rc.demand == sorted(demand.get(rc.name, [])), f"{rc.name} is not named by {rc.demand}"
    by_pattern = {arc.id for arc in state.queued.values() if arc.patterns}
    assert by_pattern == state.by_pattern.keys(), "those queued by pattern are not those known"
    known = {arc.id for arcs in state._clients.values() for arc in arcs.values()}
    assert not state.held_back.keys() & (state.queued.keys() | state.running.keys()), (
        "an ARC is held back and considered"
    )
    assert known == state.queued.keys() | state.running.keys() | state.held_back.keys(), (
        "the clients' ARCs are not those known"
    )

    at_place: dict[Place, list[Arc]] = {}
    for arc in (*state.running.values(), *state.queued.values(), *state.held_back.values()):
        at_place.setdefault(arc.place, []).append(arc)
    for place, arcs in at_place.items():
        first = state.at_place(place)
        considered = [arc for arc in arcs if arc.state is not ArcState.HELD_BACK or arc.held_back is not None]
        assert first in considered, f"of {arcs} nobody is considered"
        assert all(arc is first or arc.state is ArcState.HELD_BACK for arc in arcs), f"{arcs} may run at once"
        assert all(arc.reason is not None for arc in arcs if arc.hold is None), f"of {arcs} one waits without a reason"
    assert at_place.keys() == state._at_place.keys(), "places of nobody"


def _check_classes(state: SchedulerState, index: QueueIndex) -> None:
    for key, like in state.classes.items():
        members = [arc for arc in state.by_pattern.values() if arc.like is like]
        assert like.members == sorted(arc.rank for arc in members), "not the members of the class"
        assert members, "a class of nobody"
        watching = [arc for arc in members if arc.watched is like]
        assert like.watchers == sorted(arc.rank for arc in watching), "not the watchers of the class"
        assert bool(watching) == (like in index.watched_classes)
        assert all(state._class_key(arc) == key for arc in members)
        for arc in watching:
            assert short(state, arc), f"{arc.id} waits for a change of {list(arc.patterns)}, and there are enough"
            assert arc.claim is None
        for need, mask in like.masks.items():
            out = members[0].named_mask | state.barred(members[0])
            assert [rc.bit for rc in state.matching(need) if not rc.bit & out] == [rc.bit for rc in state.rcs_in(mask)]
    assert all(arc.like in state.classes.values() for arc in state.by_pattern.values())


def _check_index(state: SchedulerState, index: QueueIndex) -> None:
    queued = state.queued.values()
    assert index.ranks == sorted(arc.rank for arc in queued), "the ranks are not those of the queue"
    patient = sorted((arc.starves, arc.id) for arc in queued if not arc.starving)
    assert index._not_starving == patient, "the patient are not those of the queue"
    band = state.band
    starving = sorted((-band(arc.priority), arc.starves, arc.id) for arc in queued if arc.starving)
    assert index.starving == starving, "the starving are not those of the queue"
    for arc in queued:
        places = {ArcState.PARKED: arc.id in index.parked, ArcState.WATCHING: arc.watched is not None}
        assert (arc.id in index.ready) == (not any(places.values())), f"{arc.id} is indexed twice, or nowhere"
        for kind, there in places.items():
            assert there == (arc.state is kind), f"{arc.id} is {arc.state} and not indexed so"
        undecided = arc.state in {ArcState.VOTING, ArcState.DEFERRED, ArcState.PARKED}
        assert (arc.footprint is not None) == undecided, f"{arc.id} is {arc.state}"
        assert arc.watched is None or arc.rank in arc.watched.watchers, f"{arc.id} is not among the watchers"
    _check_classes(state, index)
    for arc in state.running.values():
        assert arc.like is None
        assert arc.watched is None
        assert arc.footprint is None
        assert not arc.starving
