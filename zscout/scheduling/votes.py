"""How sharable RCs have voted: the answers that stand, and the proposals that are out.

An RC accepts or vetoes a set of holders. What it accepts, it accepts of every subset; so a veto holds for
every superset, and one answer settles many questions. Answers stand until the RC's rules change.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TypeAlias

from zscout.scheduling.model import QUANTUM
from zscout.types import ArcId, Ns, RcName

HolderSet: TypeAlias = frozenset[ArcId]

ANSWERS_PER_RC = 4096
"""Oldest answers beyond this many are forgotten; the RC is then asked again."""
QUESTIONS_PER_SET = 8
"""How many proposals of one set may be out: a silent RC is asked anew, and any of its answers will do."""


@dataclass(frozen=True, slots=True)
class Answer:
    accept: bool
    reason: str = ""


YES = Answer(accept=True)


class RcVotes:
    """One RC's answers."""

    def __init__(self) -> None:
        self.accepted: dict[HolderSet, None] = {}
        self.vetoed: dict[HolderSet, str] = {}
        self.out: dict[HolderSet, list[int]] = {}
        """The proposals of each set that is asked for, newest last."""
        self.overdue: set[HolderSet] = set()
        """Those whose newest proposal is overdue, and perhaps lost: they may be asked for anew."""
        self.ask_again: Ns = 0
        """When, if it is silent."""
        self._accepted_with: dict[ArcId, dict[HolderSet, None]] = {}
        """The accepted sets that each ARC is in."""
        self._vetoed_at: dict[ArcId, dict[HolderSet, None]] = {}
        """Each vetoed set once, under whichever of its ARCs had fewest: a veto is looked for among those of
        the set in question, and most vetoes name a holder that is in many others."""

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
            self._drop_accepted(next(iter(self.accepted)))

    def veto(self, holders: HolderSet, reason: str) -> None:
        if holders not in self.vetoed:
            rarest = min(sorted(holders), key=lambda arc: len(self._vetoed_at.get(arc, ())))
            self._vetoed_at.setdefault(rarest, {})[holders] = None
        self.vetoed[holders] = reason
        while len(self.vetoed) > ANSWERS_PER_RC:
            self._drop_vetoed(next(iter(self.vetoed)))

    def forget(self, arc: ArcId) -> None:
        """Of sets with this ARC, what was accepted stands without it and the vetoes fall."""
        for holders in list(self._accepted_with.get(arc, ())):
            self._drop_accepted(holders)
            if len(holders) > 1:
                self.accept(holders - {arc})
        for holders in [holders for holders in self.vetoed if arc in holders]:
            self._drop_vetoed(holders)

    def rename(self, arc: ArcId, renamed: ArcId) -> list[int]:
        """An ARC goes on by another name. Returns the proposals that are out and name it."""
        for holders in list(self._accepted_with.get(arc, ())):
            self._drop_accepted(holders)
            self.accept(_renamed(holders, arc, renamed))
        for holders, reason in [item for item in self.vetoed.items() if arc in item[0]]:
            self._drop_vetoed(holders)
            self.veto(_renamed(holders, arc, renamed), reason)
        self.overdue = {_renamed(holders, arc, renamed) for holders in self.overdue}
        asked = [holders for holders in self.out if arc in holders]
        for holders in asked:
            self.out[_renamed(holders, arc, renamed)] = self.out.pop(holders)
        return [number for holders in asked for number in self.out[_renamed(holders, arc, renamed)]]

    def _drop_accepted(self, holders: HolderSet) -> None:
        del self.accepted[holders]
        for arc in holders:
            _discard(self._accepted_with, arc, holders)

    def _drop_vetoed(self, holders: HolderSet) -> None:
        del self.vetoed[holders]
        for arc in holders:
            _discard(self._vetoed_at, arc, holders)


def _renamed(holders: HolderSet, arc: ArcId, renamed: ArcId) -> HolderSet:
    return holders - {arc} | {renamed} if arc in holders else holders


def _discard(index: dict[ArcId, dict[HolderSet, None]], arc: ArcId, holders: HolderSet) -> None:
    sets = index.get(arc)
    if sets is not None and holders in sets:
        del sets[holders]
        if not sets:
            del index[arc]


class Votes:
    """All ballots of a fleet. Proposals are numbered; an answer to a number that is not out is ignored."""

    def __init__(self) -> None:
        self._ballots: defaultdict[RcName, RcVotes] = defaultdict(RcVotes)
        self.out: dict[int, tuple[RcName, HolderSet]] = {}
        """The proposals that are out, by their numbers."""
        self._next = 1
        self.silent: set[RcName] = set()
        """RCs whose last vote is overdue: nobody waits for them until they answer."""
        self.version = 0
        """Grows with all that changes what is known."""
        self.answered: set[RcName] = set()
        """RCs that answered, or fell silent, since somebody last took note and emptied this."""
        self.invalidated: set[RcName] = set()
        """RCs whose answers no longer stand, likewise."""

    def known(self, rc: RcName, holders: HolderSet) -> Answer | None:
        """The answer that stands for exactly this set, by itself or by what it implies; None if unknown."""
        return self._ballots[rc].known(holders)

    def accepts(self, rc: RcName, holders: HolderSet) -> bool:
        """Whether it is known that an RC accepts this set."""
        answer = self.known(rc, holders)
        return answer is not None and answer.accept

    def vetoed(self, rc: RcName) -> list[HolderSet]:
        """The sets that an RC has vetoed; each rules out every larger one as well."""
        return list(self._ballots[rc].vetoed)

    def due(self, now: Ns) -> list[RcName]:
        """The silent RCs that may be asked again by now."""
        return [rc for rc in self.silent if self._ballots[rc].ask_again <= now]

    def open_question(self, rc: RcName, holders: HolderSet, now: Ns) -> int | None:
        """The number of a new proposal to send, or None where one is out already or the RC is not due.

        A silent RC is asked again once a quantum, so that it can show that it is back."""
        ballot = self._ballots[rc]
        if rc in self.silent:
            if now < ballot.ask_again:
                return None
            ballot.ask_again = now + QUANTUM
        elif holders in ballot.out and holders not in ballot.overdue:
            return None
        ballot.overdue.discard(holders)
        number = self._next
        self._next += 1
        numbers = ballot.out.setdefault(holders, [])
        numbers.append(number)
        if len(numbers) > QUESTIONS_PER_SET:
            del self.out[numbers.pop(0)]
        self.out[number] = (rc, holders)
        return number

    def answer(self, proposal: int, *, accept: bool, reason: str) -> None:
        """Takes an answer, a late one too, unless nobody asked, or the question has become void."""
        if proposal not in self.out:
            return
        rc, holders = self.out[proposal]
        ballot = self._ballots[rc]
        self._close(ballot, holders)
        self.silent.discard(rc)
        self.answered.add(rc)
        self.version += 1
        if accept:
            ballot.accept(holders)
        else:
            ballot.veto(holders, reason)

    def overdue(self, proposal: int, now: Ns) -> None:
        """Marks the RC silent. The proposal stays open: an answer counts until the query for it ends."""
        if proposal not in self.out:
            return
        rc, holders = self.out[proposal]
        ballot = self._ballots[rc]
        if proposal != ballot.out[holders][-1]:
            return
        ballot.overdue.add(holders)
        self.answered.add(rc)
        self.version += 1
        if rc not in self.silent:
            self.silent.add(rc)
            ballot.ask_again = now + QUANTUM

    def forget_rc(self, rc: RcName) -> None:
        """The RC left, came anew or changed its rules: no vote of it stands, no proposal is out."""
        self.invalidated.add(rc)
        self.version += 1
        self.silent.discard(rc)
        ballot = self._ballots.pop(rc, None)
        if ballot is not None:
            for holders in list(ballot.out):
                self._close(ballot, holders)

    def forget_arc(self, rc: RcName, arc: ArcId) -> None:
        """An ARC that needed `rc` has ended: what was accepted with it stands without it."""
        ballot = self._ballots.get(rc)
        if ballot is None:
            return
        ballot.forget(arc)
        self.version += 1
        for holders in [holders for holders in ballot.out if arc in holders]:
            self._close(ballot, holders)

    def rename_arc(self, rc: RcName, arc: ArcId, renamed: ArcId) -> None:
        """An ARC goes on by another name: its votes stand, its proposals stay out."""
        ballot = self._ballots.get(rc)
        if ballot is not None:
            for number in ballot.rename(arc, renamed):
                self.out[number] = (rc, _renamed(self.out[number][1], arc, renamed))

    def _close(self, ballot: RcVotes, holders: HolderSet) -> None:
        ballot.overdue.discard(holders)
        for number in ballot.out.pop(holders, ()):
            del self.out[number]
