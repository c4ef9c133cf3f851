"""Votes of sharable RCs: the answers in force, and the open proposals (their queries end after LATE_VOTE_S of
`services/rcm/rcm.py`).

An RC that accepts a set of holders accepts every subset, so a veto also counts for every superset, and an answer
settles many sets. Answers are in force until the RC's rules change."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any, TypeAlias

from zscout.scheduling.model import QUANTUM
from zscout.types import ArcId, Ns, RcName

HolderSet: TypeAlias = frozenset[ArcId]

ANSWERS_PER_RC = 4096
"""Older answers are dropped; the RC is asked again if they are needed."""
PROPOSALS_PER_SET = 8
"""Open proposals of a set: an unresponsive RC is asked again, and any answer counts."""


@dataclass(frozen=True, slots=True)
class Answer:
    accept: bool
    reason: str = ""


YES = Answer(accept=True)


class RcVotes:
    def __init__(self) -> None:
        self.accepted: dict[HolderSet, None] = {}
        self.vetoed: dict[HolderSet, str] = {}
        self.proposals: dict[HolderSet, list[int]] = {}  # numbers of the open proposals of each set, newest last
        self.overdue: set[HolderSet] = set()  # sets whose newest proposal may be lost: they may be proposed again
        self.retry_at: Ns = 0  # when an unresponsive RC may be asked again
        self._accepted_with: dict[ArcId, dict[HolderSet, None]] = {}
        self._vetoed_at: dict[ArcId, dict[HolderSet, None]] = {}
        """Each vetoed set once, under its ARC with the fewest entries, so that searched lists are short."""

    def known(self, holders: HolderSet) -> Answer | None:
        if holders in self.accepted:
            return YES
        if holders in self.vetoed:
            return Answer(accept=False, reason=self.vetoed[holders])
        with_each = [self._accepted_with.get(arc) for arc in holders]
        if all(with_each):
            fewest = min((sets for sets in with_each if sets), key=len, default={})
            if any(holders < larger for larger in fewest):
                return YES
        for arc in holders:
            for smaller in self._vetoed_at.get(arc, ()):
                if smaller < holders:
                    return Answer(accept=False, reason=self.vetoed[smaller])
        return None

    def accept(self, holders: HolderSet) -> None:
        self.accepted[holders] = None
        for arc in holders:
            self._accepted_with.setdefault(arc, {})[holders] = None
        while len(self.accepted) > ANSWERS_PER_RC:
            self._drop(next(iter(self.accepted)), self.accepted, self._accepted_with)

    def veto(self, holders: HolderSet, reason: str) -> None:
        if holders not in self.vetoed:
            rarest = min(sorted(holders), key=lambda arc: len(self._vetoed_at.get(arc, ())))
            self._vetoed_at.setdefault(rarest, {})[holders] = None
        self.vetoed[holders] = reason
        while len(self.vetoed) > ANSWERS_PER_RC:
            self._drop(next(iter(self.vetoed)), self.vetoed, self._vetoed_at)

    def forget(self, arc: ArcId) -> None:
        """Accepted sets with this ARC are accepted without it; vetoes are dropped."""
        for holders in list(self._accepted_with.get(arc, ())):
            self._drop(holders, self.accepted, self._accepted_with)
            if len(holders) > 1:
                self.accept(holders - {arc})
        for holders in [holders for holders in self.vetoed if arc in holders]:
            self._drop(holders, self.vetoed, self._vetoed_at)

    def rename(self, arc: ArcId, renamed: ArcId) -> list[int]:
        """Return the numbers of the open proposals that name it."""
        for holders in list(self._accepted_with.get(arc, ())):
            self._drop(holders, self.accepted, self._accepted_with)
            self.accept(_renamed(holders, arc, renamed))
        for holders, reason in [item for item in self.vetoed.items() if arc in item[0]]:
            self._drop(holders, self.vetoed, self._vetoed_at)
            self.veto(_renamed(holders, arc, renamed), reason)
        self.overdue = {_renamed(holders, arc, renamed) for holders in self.overdue}
        proposed = [holders for holders in self.proposals if arc in holders]
        for holders in proposed:
            self.proposals[_renamed(holders, arc, renamed)] = self.proposals.pop(holders)
        return [number for holders in proposed for number in self.proposals[_renamed(holders, arc, renamed)]]

    def _drop(
        self, holders: HolderSet, answers: dict[HolderSet, Any], by_arc: dict[ArcId, dict[HolderSet, None]]
    ) -> None:
        del answers[holders]
        for arc in holders:
            sets = by_arc.get(arc, {})
            sets.pop(holders, None)
            if not sets:
                by_arc.pop(arc, None)


def _renamed(holders: HolderSet, arc: ArcId, renamed: ArcId) -> HolderSet:
    return holders - {arc} | {renamed} if arc in holders else holders


class Votes:
    """Proposals are numbered; an answer to a closed number is ignored."""

    def __init__(self) -> None:
        self._by_rc: defaultdict[RcName, RcVotes] = defaultdict(RcVotes)
        self.proposals: dict[int, tuple[RcName, HolderSet]] = {}
        self._next = 1
        self.unresponsive: set[RcName] = set()
        """RCs whose last vote is overdue: no decision waits for them until they answer."""
        self.version = 0
        self.answered: set[RcName] = set()  # RCs that answered or became unresponsive, since a pass last emptied this
        self.invalidated: set[RcName] = set()  # RCs whose answers were dropped, since a pass last emptied this
        self.changed: dict[RcName, list[HolderSet] | None] = {}
        """By RC: the sets that it answered or was late for; None: its answers were dropped. `Calendar` empties it."""

    def known(self, rc: RcName, holders: HolderSet) -> Answer | None:
        """The answer in force for this set, given or implied; None if unknown."""
        return self._by_rc[rc].known(holders)

    def accepts(self, rc: RcName, holders: HolderSet) -> bool:
        answer = self.known(rc, holders)
        return answer is not None and answer.accept

    def vetoed(self, rc: RcName) -> list[HolderSet]:
        """Each vetoed set rules out every larger set as well."""
        return list(self._by_rc[rc].vetoed)

    def due(self, now: Ns) -> list[RcName]:
        return [rc for rc in self.unresponsive if self._by_rc[rc].retry_at <= now]

    def propose(self, rc: RcName, holders: HolderSet, now: Ns) -> int | None:
        """The number of a new proposal; None if one is open or the RC, if unresponsive, was just asked."""
        votes = self._by_rc[rc]
        if rc in self.unresponsive:
            if now < votes.retry_at:
                return None
            votes.retry_at = now + QUANTUM
        elif holders in votes.proposals and holders not in votes.overdue:
            return None
        votes.overdue.discard(holders)
        number = self._next
        self._next += 1
        numbers = votes.proposals.setdefault(holders, [])
        numbers.append(number)
        if len(numbers) > PROPOSALS_PER_SET:
            del self.proposals[numbers.pop(0)]
        self.proposals[number] = (rc, holders)
        return number

    def answer(self, proposal: int, *, accept: bool, reason: str) -> None:
        if proposal not in self.proposals:
            return
        rc, holders = self.proposals[proposal]
        votes = self._by_rc[rc]
        self._close(votes, holders)
        self.unresponsive.discard(rc)
        self.answered.add(rc)
        self._change(rc, holders)
        self.version += 1
        if accept:
            votes.accept(holders)
        else:
            votes.veto(holders, reason)

    def overdue(self, proposal: int, now: Ns) -> None:
        """Mark the RC unresponsive. An answer still counts until the query ends."""
        if proposal not in self.proposals:
            return
        rc, holders = self.proposals[proposal]
        votes = self._by_rc[rc]
        if proposal != votes.proposals[holders][-1]:
            return
        votes.overdue.add(holders)
        self.answered.add(rc)
        self._change(rc, holders)
        self.version += 1
        if rc not in self.unresponsive:
            self.unresponsive.add(rc)
            votes.retry_at = now + QUANTUM

    def forget_rc(self, rc: RcName) -> None:
        """Drop the votes and proposals of an RC that left, restarted or changed its rules."""
        self.invalidated.add(rc)
        self.changed[rc] = None
        self.version += 1
        self.unresponsive.discard(rc)
        votes = self._by_rc.pop(rc, None)
        if votes is not None:
            for holders in list(votes.proposals):
                self._close(votes, holders)

    def forget_arc(self, rc: RcName, arc: ArcId) -> None:
        votes = self._by_rc.get(rc)
        if votes is None:
            return
        votes.forget(arc)
        self.version += 1
        for holders in [holders for holders in votes.proposals if arc in holders]:
            self._close(votes, holders)

    def rename_arc(self, rc: RcName, arc: ArcId, renamed: ArcId) -> None:
        votes = self._by_rc.get(rc)
        if votes is not None:
            for number in votes.rename(arc, renamed):
                self.proposals[number] = (rc, _renamed(self.proposals[number][1], arc, renamed))

    def open(self, rc: RcName) -> int:
        votes = self._by_rc[rc]
        return len(votes.proposals) - len(votes.overdue)

    def is_asked(self, rc: RcName, holders: HolderSet) -> bool:
        votes = self._by_rc[rc]
        return holders in votes.proposals and holders not in votes.overdue

    def retry_at(self, rc: RcName) -> Ns:
        return self._by_rc[rc].retry_at

    def _change(self, rc: RcName, holders: HolderSet) -> None:
        if (sets := self.changed.setdefault(rc, [])) is not None:
            sets.append(holders)

    def _close(self, votes: RcVotes, holders: HolderSet) -> None:
        votes.overdue.discard(holders)
        for number in votes.proposals.pop(holders, ()):
            del self.proposals[number]
