"""What sharable RCs have said: the answers that stand, and the questions that are out.

An RC accepts or vetoes a set of holders. What it accepts, it accepts of every subset; so a veto holds for
every superset, and one answer settles many questions. Answers stand until the RC's rules change.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TypeAlias

from zscout.scheduling.model import QUANTUM, ArcId, Ns, RcName

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


@dataclass(slots=True)
class Ballot:
    """One RC's answers. `silent` after an overdue vote: nobody waits for this RC until it answers."""

    accepted: dict[HolderSet, None] = field(default_factory=dict)
    vetoed: dict[HolderSet, str] = field(default_factory=dict)
    out: dict[HolderSet, list[int]] = field(default_factory=dict)
    """The proposals of each set that is asked for, newest last."""
    overdue: set[HolderSet] = field(default_factory=set)
    """Those whose newest proposal is overdue, and perhaps lost: they may be asked for anew."""
    silent: bool = False
    ask_again: Ns = 0

    def known(self, holders: HolderSet) -> Answer | None:
        if holders in self.accepted:
            return YES
        if holders in self.vetoed:
            return Answer(accept=False, reason=self.vetoed[holders])
        if any(holders < larger for larger in self.accepted):
            return YES
        for smaller, reason in self.vetoed.items():
            if smaller < holders:
                return Answer(accept=False, reason=reason)
        return None

    def trim(self) -> None:
        for answers in (self.accepted, self.vetoed):
            while len(answers) > ANSWERS_PER_RC:
                del answers[next(iter(answers))]


class Votes:
    """All ballots of a fleet. Proposals are numbered; an answer to a number that is not out is ignored."""

    def __init__(self) -> None:
        self._ballots: dict[RcName, Ballot] = {}
        self._out: dict[int, tuple[RcName, HolderSet]] = {}
        self._next = 1

    def known(self, rc: RcName, holders: HolderSet) -> Answer | None:
        """The answer that stands for exactly this set, by itself or by what it implies; None if unknown."""
        return self._ballots.setdefault(rc, Ballot()).known(holders)

    def vetoed(self, rc: RcName) -> list[HolderSet]:
        """The sets that an RC has vetoed; each rules out every larger one as well."""
        return list(self._ballots.setdefault(rc, Ballot()).vetoed)

    def silent(self, rc: RcName) -> bool:
        return self._ballots.setdefault(rc, Ballot()).silent

    def open_question(self, rc: RcName, holders: HolderSet, now: Ns) -> int | None:
        """The number of a new proposal to send, or None where one is out already or the RC is not due.

        A silent RC is asked again once a quantum, so that it can show that it is back."""
        ballot = self._ballots.setdefault(rc, Ballot())
        if ballot.silent:
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
            del self._out[numbers.pop(0)]
        self._out[number] = (rc, holders)
        return number

    def answer(self, proposal: int, *, accept: bool, reason: str) -> bool:
        """Takes an answer, a late one too. False: nobody asked, or its question has become void."""
        if proposal not in self._out:
            return False
        rc, holders = self._out[proposal]
        ballot = self._ballots[rc]
        self._close(ballot, holders)
        ballot.silent = False
        if accept:
            ballot.accepted[holders] = None
        else:
            ballot.vetoed[holders] = reason
        ballot.trim()
        return True

    def overdue(self, proposal: int, now: Ns) -> bool:
        """Marks the RC silent. The question stays out: its answer is welcome whenever it comes."""
        if proposal not in self._out:
            return False
        rc, holders = self._out[proposal]
        ballot = self._ballots[rc]
        if proposal != ballot.out[holders][-1]:
            return False
        ballot.overdue.add(holders)
        if not ballot.silent:
            ballot.silent = True
            ballot.ask_again = now + QUANTUM
        return True

    def forget_rc(self, rc: RcName) -> None:
        """The RC left, came anew or changed its rules: nothing it said stands, nothing asked is awaited."""
        ballot = self._ballots.pop(rc, None)
        if ballot is not None:
            for holders in list(ballot.out):
                self._close(ballot, holders)

    def forget_arc(self, rc: RcName, arc: ArcId) -> None:
        """An ARC that needed `rc` has ended: what was accepted with it stands without it."""
        ballot = self._ballots.get(rc)
        if ballot is None:
            return
        for holders in [holders for holders in ballot.accepted if arc in holders]:
            del ballot.accepted[holders]
            if len(holders) > 1:
                ballot.accepted[holders - {arc}] = None
        for holders in [holders for holders in ballot.vetoed if arc in holders]:
            del ballot.vetoed[holders]
        for holders in [holders for holders in ballot.out if arc in holders]:
            self._close(ballot, holders)

    def out(self) -> Iterator[tuple[int, RcName, HolderSet]]:
        """The proposals that are out."""
        for number, (rc, holders) in self._out.items():
            yield number, rc, holders

    def _close(self, ballot: Ballot, holders: HolderSet) -> None:
        ballot.overdue.discard(holders)
        for number in ballot.out.pop(holders, ()):
            del self._out[number]
