"""Strategy `priority`: the paper's heuristic, with votes that take their time.

The pass visits queued ARCs in rank order. For each, `a`:

1. An RC of `a` that is absent, or held by one that does not yield to `a`: `a` waits.
2. Every sharable RC that `a` needs must accept `a` beside all who would still hold it when the blockers
   (who hold an exclusive RC that `a` needs) and the candidates (who yield, and hold a sharable RC that `a`
   needs) were gone. Otherwise `a` waits, and nobody is preempted.
3. Reprieve: candidates keep their place in rank order as long as the votes allow. The others are preempted.
4. `a` starts.

A vote that is not known yet leaves the visit open. What an open visit would take or free is *off limits* for
lower ranks, and so is what a visit stopped by that would take or free; all others go on. The pass can be
run again from the top at any time: what a lower rank takes never makes a higher one possible (a lower rank
only displaces those who would have yielded to the higher one as well, and votes are monotone), so an answer
that arrives simply runs the next pass, and the outcome is that of votes given on the spot.

**Who need not be visited** (`waits.py`). The outcome is that of a pass over the whole queue, because an ARC
is passed over only where its visit would again come to "waits", stopping nobody and asking nothing:

- It *watches* an RC outside what is off limits. (a) An absent RC: until it joins. (b) An exclusive RC whose
  holder does not yield to it: until that holder goes or overstays. Who takes the RC instead ranks above all
  that still watch it below him, so it does not yield to them either: after the first watcher that takes the
  RC, the others need no look. (c) A sharable RC that vetoed it beside the holders who do not yield: until
  one of them goes or overstays, or the RC's rules change; more holders leave a veto standing, because what
  an RC accepts it accepts of every subset. When the RC becomes off limits, its watchers below are visited.
- It is *asleep* before a silent RC. Its visit reads nothing outside its footprint; it is visited when
  anything within changes, is answered or becomes off limits, and when the silent RC may be asked again.
- Who needs RCs by pattern is always visited, unless an RC that it names keeps it out.
- It is *held back* from an RC that is kept for another (`reservations.py`); it watches that RC until other
  claims stand there.
- It is *open*, but nothing within its footprint has changed. Then it is stopped again, if what it would
  take is off limits and what hides its firm obstacles still is, or it waits for the same votes as before.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Mapping
from operator import attrgetter
from typing import Literal, Protocol, TypeAlias

from zscout.scheduling.floor import Floor
from zscout.scheduling.model import Arc, Need, Ns, Rank, Rc, RcName
from zscout.scheduling.patterns import Binder, nothing_left
from zscout.scheduling.reservations import Bar, Reservations
from zscout.scheduling.visit import Admitted, Open, Refused, Visit, absence, listed, over_quota
from zscout.scheduling.votes import HolderSet, Votes

__all__ = ["UNSETTLED", "Actions", "Strategy", "Visit", "absence", "run_full_pass", "run_pass"]

UNSETTLED = "votes are out"
TRIES = 16
"""Bindings that one visit tries."""
TOLD = 4
"""How many of those who watch an RC are told at once that its holder is another; the rest see it when they
ask. In a long queue every grant would else be news to everyone."""


class Actions(Protocol):
    """What a strategy may do to the floor; each call is carried out at once and told as an effect."""

    def start(self, arc: Arc) -> None: ...
    def displace(self, arc: Arc, by: Arc) -> bool:
        """Takes everything from a running ARC for `by`; True if it is queued again."""
        ...

    def wait(self, arc: Arc, reason: str, *, settled: bool = True) -> None: ...
    def propose(self, rc: Rc, holders: HolderSet) -> None: ...
    def again(self) -> None:
        """Asks for another pass at once: the strategy needs more time, and others shall have their turn."""
        ...


_Verdict: TypeAlias = Refused | Open | Admitted | Bar | Literal["off limits", "over quota"]

Strategy: TypeAlias = Callable[[Floor, Votes, Ns, Actions], None]
"""One pass: reads the floor and the votes, and acts."""


def run_pass(
    floor: Floor,
    votes: Votes,
    now: Ns,
    actions: Actions,
    *,
    off_limits: int = 0,
    reserved: Reservations | None = None,
) -> None:
    """One pass over the queue at `now`, as far as something has changed for those who wait.

    `off_limits`: bits of RCs that another strategy is still deciding about. `reserved`: what is kept for
    others; the paper's own strategy knows no such thing."""
    Pass(floor, votes, now, actions, reserved=reserved).run(
        sorted(floor.waits.open.values(), key=attrgetter("rank")), off_limits
    )


def run_full_pass(floor: Floor, votes: Votes, now: Ns, actions: Actions) -> None:
    """The same pass as if every RC had been freed: whoever waits is looked at, himself or by way of the first
    who watches the same RC, for what keeps him out keeps out all below him. For tests and benchmarks."""
    floor.waits.freed = floor.known()
    Pass(floor, votes, now, actions, told=0).run(floor.waits.open.values())


class Pass:
    """Visits in rank order: those who are open, and those who watch what has been freed."""

    def __init__(
        self,
        floor: Floor,
        votes: Votes,
        now: Ns,
        actions: Actions,
        *,
        told: int = TOLD,
        reserved: Reservations | None = None,
    ) -> None:
        self.floor, self.votes, self.now, self.actions = floor, votes, now, actions
        self.told = told
        self.reserved = reserved
        self.waits = floor.waits
        self.off_limits = 0
        self.changed = 0
        """Bits of the RCs at which something is new since the last pass began."""
        self._coming: list[tuple[Rank, int, Arc, Rc | None]] = []
        """Heap of who is next, beside the open. By way of an RC come its watchers, one after the other."""
        self._walks: dict[int, int] = {}
        """By bit of each RC whose watchers come: how many more of them are told of a new holder."""
        self._done = 0
        """Bits of the RCs at which this pass itself has changed something."""

    def run(self, open_arcs: Iterable[Arc], off_limits: int = 0) -> None:
        """Visits `open_arcs` and whom changes call; `off_limits` are bits of RCs."""
        opened = sorted(open_arcs, key=attrgetter("rank"))
        self._note_votes()
        self._rouse(None)
        self._bar(off_limits, None)
        coming, at, last = self._coming, 0, None
        while coming or at < len(opened):
            if at < len(opened) and (not coming or opened[at].rank <= coming[0][0]):
                arc, rc = opened[at], None
                at += 1
            else:
                _, _, arc, rc = heapq.heappop(coming)
                if rc is not None and not self._worth_a_look(rc, arc):
                    continue
            # One may come by several ways, but then at once: ranks are unique.
            if arc.rank != last:
                last = arc.rank
                if not arc.footprint or not self._stopped_again(arc):
                    self._visit(arc)
            if rc is not None:
                self._walk_on(rc, last)
        # Those who were visited before a change further down have not seen it.
        self.waits.stirred |= self._done

    def _visit(self, arc: Arc) -> None:
        if arc.slots:
            self._visit_flexible(arc)
        else:
            visit = Visit(self.floor, self.votes, self.now, arc)
            self._carry_out(arc, visit, self._judge(arc, visit))

    def _visit_flexible(self, arc: Arc) -> None:
        """Tries one binding after the other, the best first, until one lets the ARC start or asks votes."""
        binder = Binder(self.floor, self.votes, self.now, self.reserved)
        without, tries = 0, 0
        best: tuple[Mapping[Need, RcName], _Verdict] | None = None
        while tries < TRIES and binder.bind(arc, without):
            tries += 1
            visit = Visit(self.floor, self.votes, self.now, arc)
            verdict = self._judge(arc, visit)
            blame = self._blame(arc, verdict)
            best = best or (arc.bound, verdict)
            if not blame:
                best = arc.bound, verdict
                break
            without |= blame
        if best is None:
            self.floor.unbind(arc)
            self.waits.reopen(arc)
            self.actions.wait(arc, nothing_left(self.floor, arc))
            return
        self.floor.bind(arc, best[0])
        self._carry_out(arc, Visit(self.floor, self.votes, self.now, arc), best[1])

    def _blame(self, arc: Arc, verdict: _Verdict) -> int:
        """Bits of those RCs of a binding that keep the ARC out, where others might not."""
        match verdict:
            case Refused(rc) | Bar(rc, _, None):
                bits = rc.bit
            case "off limits":
                bits = self.off_limits
                for rc in arc.rcs:
                    if any(holder.mask & self.off_limits for holder in rc.holders.values()):
                        bits |= rc.bit
            case Open(questions):
                bits = sum(rc.bit for rc, _ in questions if self.votes.silent(rc.name))
            case _:
                bits = 0
        return bits & arc.mask & ~arc.named

    def _judge(self, arc: Arc, visit: Visit) -> _Verdict:
        """What a visit comes to, as things stand."""
        refused = visit.obstacle_outside(self.off_limits)
        if refused is not None:
            return refused
        if self.floor.room(arc) == 0:
            return "over quota"
        bar = self.reserved.bar(arc) if self.reserved is not None else None
        if bar is not None:
            return bar
        if self.off_limits and visit.footprint() & self.off_limits:
            return "off limits"
        return visit.decide()

    def _carry_out(self, arc: Arc, visit: Visit, verdict: _Verdict) -> None:
        match verdict:
            case Refused(rc, reason):
                self._watch(arc, rc)
                self.actions.wait(arc, self._in_words(arc, rc, reason))
            case Bar(rc, _, ask) if ask is not None:
                self.waits.reopen(arc)
                self.actions.wait(arc, UNSETTLED, settled=False)
                self.actions.propose(rc, ask)
            case Bar(rc):
                self._watch(arc, rc)
                self.actions.wait(arc, self._in_words(arc, rc, verdict.reason))
            case "over quota":
                # Whoever of its owner's ends may let it go: no RC tells.
                self.waits.reopen(arc)
                self.actions.wait(arc, over_quota(self.floor, arc))
            case "off limits":
                self._put_off(arc, visit, asked=False)
                self.actions.wait(arc, UNSETTLED, settled=False)
            case Open(questions) if silent := [ask for ask in questions if self.votes.silent(ask[0].name)]:
                if arc.slots:
                    self.waits.reopen(arc)
                else:
                    self.waits.sleep(arc, visit.footprint())
                self.actions.wait(arc, f"{listed([rc.name for rc, _ in silent])} does not answer")
                for rc, holders in silent:
                    self.actions.propose(rc, holders)
            case Open(questions):
                self._put_off(arc, visit, asked=True)
                self.actions.wait(arc, UNSETTLED, settled=False)
                for rc, holders in questions:
                    self.actions.propose(rc, holders)
            case Admitted(victims):
                for victim in victims:
                    if self.actions.displace(victim, by=arc):
                        heapq.heappush(self._coming, (victim.rank, 0, victim, None))
                self.actions.start(arc)
                self._done |= self._rouse(arc.rank)

    def _watch(self, arc: Arc, rc: Rc) -> None:
        """`rc` keeps `arc` out, by itself unless the ARC could do with another."""
        if arc.slots and rc.bit & ~arc.named:
            self.waits.reopen(arc)
        else:
            self.waits.watch(arc, rc)

    def _in_words(self, arc: Arc, rc: Rc, reason: str) -> str:
        need = next((need for need, name in arc.bound.items() if name == rc.name), None)
        return reason if need is None else f"no {need} is to be had: {reason}"

    def _put_off(self, arc: Arc, visit: Visit, *, asked: bool) -> None:
        footprint = visit.footprint()
        if arc.slots:
            # It is looked at again whatever happens: another RC may do.
            self.waits.reopen(arc)
        else:
            self.waits.reopen(arc, footprint, hidden=visit.hidden(), asked=asked)
        self._bar(footprint, arc.rank)

    def _stopped_again(self, arc: Arc) -> bool:
        """Whether a visit that came to no end comes to none again, seen without repeating it."""
        if arc.footprint & self.changed or arc.hidden & ~self.off_limits:
            return False
        if not (arc.asked or arc.footprint & self.off_limits):
            return False
        self._bar(arc.footprint, arc.rank)
        return True

    def _bar(self, footprint: int, rank: Rank | None) -> None:
        """Puts all of `footprint` off limits for those below `rank`; for all of them without a rank."""
        new = footprint & ~self.off_limits
        if new:
            self.off_limits |= new
            self._call(new, new, rank)

    def _note_votes(self) -> None:
        waits, votes, rc = self.waits, self.votes, self.floor.rc
        for name in votes.forgotten:
            waits.freed |= rc(name).bit
        for name in (*votes.heard, *votes.due(self.now)):
            waits.stirred |= rc(name).bit
        votes.forgotten.clear()
        votes.heard.clear()

    def _rouse(self, rank: Rank | None) -> int:
        """Calls whom the latest changes concern, below `rank`; returns where something changed."""
        waits = self.waits
        freed, touched = waits.freed, waits.freed | waits.stirred
        waits.freed = waits.stirred = 0
        self.changed |= touched
        self._call(freed, touched, rank)
        return touched

    def _call(self, walks: int, touched: int, rank: Rank | None) -> None:
        waits = self.waits
        for rc in self.floor.of(walks & waits.watched):
            known = rc.bit in self._walks
            self._walks[rc.bit] = self.told
            if not known:
                self._walk_on(rc, rank)
        if waits.asleep:
            for arc in list(waits.asleep.values()):
                if arc.footprint & touched and (rank is None or arc.rank > rank):
                    waits.reopen(arc)
                    heapq.heappush(self._coming, (arc.rank, 0, arc, None))

    def _walk_on(self, rc: Rc, rank: Rank | None) -> None:
        """The next watcher of `rc` below `rank` comes."""
        following = self.waits.after(rc, rank)
        if following is None:
            del self._walks[rc.bit]
        else:
            heapq.heappush(self._coming, (following, rc.bit, self.floor.queued[following[3]], rc))

    def _worth_a_look(self, rc: Rc, arc: Arc) -> bool:
        """False ends the walk: `rc` has a holder again who yields to nobody from `arc` downwards."""
        if not self._keeps_out(rc, arc):
            return True
        if not self._walks[rc.bit]:
            del self._walks[rc.bit]
            return False
        self._walks[rc.bit] -= 1
        return True

    def _keeps_out(self, rc: Rc, arc: Arc) -> bool:
        """Whether `rc`, exclusive and not off limits, has a holder who does not yield to `arc`."""
        if rc.sharable or not rc.holders or rc.bit & self.off_limits:
            return False
        (holder,) = rc.holders.values()
        return not holder.yields_to(arc, self.now)
