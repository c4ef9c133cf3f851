"""Strategy `priority`: the paper's heuristic, with asynchronous votes.

A pass:

1. Collect the changes since the last pass: RCs freed, joined or lost, new and invalidated votes.
2. Collect the ARCs to check: the ready ones, and the first watcher of each freed RC.
3. Check them in rank order (`Arc.rank`), each by an `AdmissionCheck`. For each, `a`:
   a. `a` waits if an RC of `a` is absent, is unwell and `a` is no operator's, or has a holder not preempted for `a`.
   b. Every sharable RC that `a` needs must accept `a` beside its holders without the exclusive victims (of exclusive
    RCs of `a`) and the preemptible sharers (of sharable RCs of `a`). Otherwise `a` waits, and nothing is preempted.
   c. Reprieve: preemptible sharers stay, in rank order, as long as the votes allow; others are preempted.
   d. `a` starts.
4. Index `a` by its obstacle, or preempt its victims and start it; check the ARCs that this affects.

An unknown vote leaves a check undecided, and so does a reservation (`reservations.py`) if this pass has changed any:
the next pass checks again. The RCs that an undecided check would take or free are *off limits* for lower ranks, and so
are the RCs of each lower rank that must wait for this; all other ARCs continue.

**Why a pass can run again at any time.** An RC taken by a lower rank never makes a higher rank possible (a lower rank
only preempts holders that the higher one would preempt too, and votes are monotone). So each answer may run a pass, and
the outcome is the same as with immediate votes.

**Why the index may skip ARCs** (`QueueIndex`). The outcome is the same as for a pass over the whole queue, because an
ARC is skipped only where its check would again end in "waits", without stopping another ARC or asking for a vote:

- WATCHING an RC that is not off limits. (a) Absent or unwell: until it joins or is well. (b) Exclusive, its holder
  not preempted: until the holder ends or passes its minimum runtime. A watcher that takes the RC outranks all
  watchers below it, so they need no check. (c) Sharable, vetoed beside the holders that are not preempted: until one
  of them ends or passes its minimum runtime, or the RC's rules change; more holders leave a veto in force, because an
  RC that accepts a set accepts each subset. (d) Reserved for another (`reservations.py`): until its reservations
  change. When the RC becomes off limits, its watchers below are checked.
- PARKED before an RC that does not answer. Its check reads nothing outside its footprint; it is checked when an RC of
  the footprint changes, answers or becomes off limits, and when the silent RC may be asked again.
- VOTING or DEFERRED without changes in its footprint: its RCs and the mask of its obstacles are still off limits, or it
  waits for the same votes as before.

An ARC with patterns is always checked, unless an RC that it names keeps it out, or it is WATCHING with its class: too
many matching RCs are absent or held without preemption (`patterns.short`) for any member, until one of these RCs joins,
is freed or becomes off limits. Then the members are checked in rank order until the class is short again."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from operator import attrgetter
from typing import Final

from zscout.config.scheduling_policy import RcQuota, StrategyName
from zscout.scheduling.admission import Admissible, AdmissionCheck, Verdict, VotesNeeded, judge, judge_bindings
from zscout.scheduling.model import Arc, ArcState, PatternClass, Rank, Rc
from zscout.scheduling.patterns import all_present, alternatives, bind, class_of, no_match, short
from zscout.scheduling.plan import NO_PLAN, BindingPlan, dry_run
from zscout.scheduling.queue_index import Watched
from zscout.scheduling.reason import Reason, ReasonCode, of_rcs
from zscout.scheduling.reservations import Inadmissible, Reservations
from zscout.scheduling.state import Actions, SchedulerState, Strategy
from zscout.types import Need

VOTING: Final = Reason(ReasonCode.VOTING)
MAX_REPORTED: Final = 4
"""Watchers of an RC that get a report of its new holder; bounds the reports in a long queue. `Core.arc` has the reasons
of the others."""


class Priority(Strategy):
    name: StrategyName = "priority"

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        run_pass(state, actions)


def run_pass(
    state: SchedulerState,
    actions: Actions,
    *,
    off_limits: int = 0,
    reserved: Reservations | None = None,
    plan: BindingPlan | None = None,
) -> None:
    """`off_limits`: bits of RCs that another strategy still decides about. `reserved`: reservations for starving ARCs,
    which the paper does not have."""
    plan = dry_run(state, reserved) if plan is None else plan
    for rc, holders in plan.unknown:
        actions.propose(rc, holders)
    Pass(state, actions, reserved, plan).run(state.index.ready.values(), off_limits)


def reasons_of_now(state: SchedulerState) -> Iterator[tuple[Arc, Reason]]:
    """The new reasons of the best MAX_REPORTED watchers of each RC taken since the last call. Passes don't compute
    them, as most would be out of date before they are read."""
    unreported, state.index.unreported = state.index.unreported & state.index.watched, 0
    classes, state.index.unreported_classes = state.index.unreported_classes, {}
    reported: list[Watched] = [*state.rcs_in(unreported), *classes]
    for on in reported:
        for rank in on.watchers[:MAX_REPORTED]:
            if (reason := reason_of_now(state, state.queued[rank[-1]])) is not None:
                yield state.queued[rank[-1]], reason


def reason_of_now(state: SchedulerState, arc: Arc) -> Reason | None:
    """The present reason of a watcher, apart from votes."""
    if arc.patterns and not bind(state, arc, None):
        return no_match(state, arc)
    obstacle = AdmissionCheck(state, arc).obstacle(0)
    return None if obstacle is None else obstacle.reason._replace(pattern=_pattern_of(arc, obstacle.rc))


def _pattern_of(arc: Arc, rc: Rc) -> Need | None:
    return next((need for need, name in arc.bound.items() if name == rc.name), None)


class Pass:
    def __init__(
        self, state: SchedulerState, actions: Actions, reserved: Reservations | None = None, plan: BindingPlan = NO_PLAN
    ) -> None:
        self.state, self.actions, self.reserved, self.plan = state, actions, reserved, plan
        self.votes, self.index = state.votes, state.index
        self.off_limits = 0
        self.changed = 0  # bits of the RCs changed since the last pass began
        self._heap: list[tuple[Rank, int, Arc, Watched | None]] = []
        """The next ARCs to check, beside the ready ones; each RC and class has one watcher here."""
        self._walked: set[Watched] = set()
        self._changed_here = 0  # bits of the RCs changed by this pass

    def run(self, ready_arcs: Iterable[Arc], off_limits: int = 0) -> None:
        ready = sorted(ready_arcs, key=attrgetter("rank"))
        self._take_votes()
        self._take_changes(None)
        self._put_off_limits(off_limits, None)
        heap, at, last = self._heap, 0, None
        while heap or at < len(ready):
            if at < len(ready) and (not heap or ready[at].rank <= heap[0][0]):
                arc, on = ready[at], None
                at += 1
            else:
                _, _, arc, on = heapq.heappop(heap)
                if on is not None and not self._needs_check(on, arc):
                    continue
            # An ARC may be queued twice in the heap; duplicates are adjacent because ranks are unique.
            if arc.rank != last:
                if self.plan.since is not None and arc.rank >= self.plan.since:
                    self._put_off_limits(self.plan.off_limits, last)
                last = arc.rank
                if arc.footprint is None or not self._still_deferred(arc, arc.footprint):
                    self._check(arc)
            if on is not None:
                self._queue_next_watcher(on, last)
        # ARCs checked before a change of this pass have not seen it.
        self.index.touched |= self._changed_here

    def _check(self, arc: Arc) -> None:
        if arc.patterns:
            self._check_patterns(arc)
        else:
            check = AdmissionCheck(self.state, arc)
            self._apply(arc, check, judge(check, self.reserved, self.off_limits))

    def _check_patterns(self, arc: Arc) -> None:
        """Try bindings, best first, until the ARC starts or asks for votes; none, if too few RCs are usable."""
        if not self.off_limits & class_of(arc).reach and short(self.state, arc):
            self._watch_class(arc)
            return
        verdict = judge_bindings(self.state, arc, self.reserved, self.off_limits, self.plan.bound.get(arc.id))
        if verdict is None:
            self.index.put(arc, ArcState.READY)
            self.actions.wait(arc, no_match(self.state, arc))
            return
        self._apply(arc, AdmissionCheck(self.state, arc), verdict)

    def _watch_class(self, arc: Arc) -> None:
        on: Watched = class_of(arc)
        bound = bind(self.state, arc, self.reserved)
        obstacle = AdmissionCheck(self.state, arc).obstacle(self.off_limits) if bound else None
        if obstacle is None:
            reason = no_match(self.state, arc)
        else:
            reason = obstacle.reason._replace(pattern=_pattern_of(arc, obstacle.rc))
            on = on if reason.pattern is not None else obstacle.rc
        if arc.claim is None or isinstance(on, Rc):
            self.index.watch(arc, on)
        else:
            self.index.put(arc, ArcState.READY)  # its reason is its booking's danger
        self.actions.wait(arc, reason)

    def _apply(self, arc: Arc, check: AdmissionCheck, verdict: Verdict) -> None:
        match verdict:
            case Inadmissible(rc, reason, proposal) if proposal is not None:
                # A silent RC is asked again from time to time; no change there would queue the check.
                silent = rc.name in self.votes.unresponsive
                self.index.put(arc, ArcState.READY)
                self.actions.wait(arc, reason if silent else VOTING, settled=silent)
                self.actions.propose(rc, proposal)
                if not silent:
                    self._put_off_limits(self._within_reach(arc, check), arc.rank)
            case Inadmissible(rc, reason, _, early):
                if reason.code is ReasonCode.RESERVED and self.reserved is not None and not self.reserved.current:
                    self._put_off_limits(self._within_reach(arc, check), arc.rank)
                pattern = _pattern_of(arc, rc)
                if pattern is None:
                    if early:
                        self.index.put(arc, ArcState.READY)
                    else:
                        self.index.watch(arc, rc)
                    self.actions.wait(arc, reason)
                else:
                    # Another RC could serve the ARC.
                    self.index.put(arc, ArcState.READY)
                    if reason.code is ReasonCode.VETOED:
                        reason = reason._replace(rcs=check.refusing(pattern))
                    self.actions.wait(arc, reason._replace(pattern=pattern))
            case "over quota":
                # The end of any ARC of its owner may admit it, and no RC shows that.
                self.index.put(arc, ArcState.READY)
                quota = self.state.policy.max_running_per_host or 0
                self.actions.wait(arc, Reason(ReasonCode.QUOTA, detail=arc.owner, number=quota))
            case RcQuota(name, _, most):
                self.index.put(arc, ArcState.READY)
                self.actions.wait(arc, Reason(ReasonCode.RC_QUOTA, detail=name, number=most))
            case "off limits":
                self._defer(arc, check, ArcState.DEFERRED)
                self.actions.wait(arc, VOTING, settled=False)
            case VotesNeeded(proposals) if unresponsive := [
                proposal for proposal in proposals if proposal[0].name in self.votes.unresponsive
            ]:
                if arc.patterns:
                    self.index.put(arc, ArcState.READY)
                else:
                    self.index.put(arc, ArcState.PARKED, check.footprint())
                self.actions.wait(arc, of_rcs(ReasonCode.SILENT, [rc.name for rc, _ in unresponsive]))
                for rc, holders in unresponsive:
                    self.actions.propose(rc, holders)
            case VotesNeeded(proposals):
                self._defer(arc, check, ArcState.VOTING)
                self.actions.wait(arc, VOTING, settled=False)
                for rc, holders in proposals:
                    self.actions.propose(rc, holders)
            case Admissible(victims):
                for victim in victims:
                    if self.actions.preempt(victim, by=arc):
                        heapq.heappush(self._heap, (victim.rank, 0, victim, None))
                self.actions.start(arc)
                self._changed_here |= self._take_changes(arc.rank)

    def _defer(self, arc: Arc, check: AdmissionCheck, state: ArcState) -> None:
        footprint = self._within_reach(arc, check)
        if arc.patterns:
            # Always checked again: if the RC that is asked refuses, another may serve the ARC.
            self.index.put(arc, ArcState.READY)
        else:
            self.index.put(arc, state, footprint, check.masked_obstacles())
        self._put_off_limits(footprint, arc.rank)

    def _within_reach(self, arc: Arc, check: AdmissionCheck) -> int:
        """Bits of the RCs that the ARC would take or free, and of the alternatives for its patterns."""
        return check.footprint() | (alternatives(self.state, arc) if arc.patterns else 0)

    def _still_deferred(self, arc: Arc, footprint: int) -> bool:
        """Return True if another check would be undecided again."""
        if footprint & self.changed or arc.masked_obstacles & ~self.off_limits:
            return False
        if arc.state is not ArcState.VOTING and not footprint & self.off_limits:
            return False
        self._put_off_limits(footprint, arc.rank)
        return True

    def _put_off_limits(self, footprint: int, rank: Rank | None) -> None:
        """Put `footprint` off limits for ranks below `rank`, or for all (None)."""
        new = footprint & ~self.off_limits
        if new:
            self.off_limits |= new
            self._queue_affected(new, new, rank)

    def _take_votes(self) -> None:
        index, votes, rc = self.index, self.votes, self.state.rc
        for name in votes.invalidated:
            index.freed |= rc(name).bit
        due = votes.due(self.state.now) if votes.unresponsive else ()
        for name in (*votes.answered, *due):
            index.touched |= rc(name).bit
        votes.invalidated.clear()
        votes.answered.clear()

    def _take_changes(self, rank: Rank | None) -> int:
        """Queue the ARCs below `rank` that changes affect. Return bits of the changed RCs."""
        index = self.index
        freed, touched = index.freed, index.freed | index.touched
        index.freed = index.touched = 0
        self.changed |= touched
        self._queue_affected(freed, touched, rank)
        return touched

    def _queue_affected(self, watched: int, touched: int, rank: Rank | None) -> None:
        index = self.index
        for on in self.state.watched_at(watched):
            if on not in self._walked:
                self._walked.add(on)
                self._queue_next_watcher(on, rank)
        for arc in [arc for arc in index.parked.values() if (arc.footprint or 0) & touched]:
            if rank is None or arc.rank > rank:
                index.put(arc, ArcState.READY)
                heapq.heappush(self._heap, (arc.rank, 0, arc, None))

    def _queue_next_watcher(self, on: Watched, rank: Rank | None) -> None:
        following = self.state.next_watcher(on, rank)
        if following is None:
            self._walked.discard(on)
        else:
            heapq.heappush(self._heap, following)

    def _needs_check(self, on: Watched, arc: Arc) -> bool:
        """Return False to end the walk along these watchers: the RC or class is held again, and no watcher from `arc`
        on may preempt the holder. `reasons_of_now` reports their reasons later."""
        if isinstance(on, PatternClass):
            if on.reach & self.off_limits or not all_present(self.state, arc) or not short(self.state, arc):
                return True
            self.index.unreported_classes[on] = None
        else:
            if on.sharable or on.bit & self.off_limits or not on.non_preemptible_holders(arc, self.state.now):
                return True
            self.index.unreported |= on.bit
        self._walked.discard(on)
        return False
