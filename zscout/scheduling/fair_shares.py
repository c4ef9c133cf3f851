"""Fair shares: what each group lately had of what others waited for, and the order of the groups that follows.

A hold is charged each of its RCs for as long as an ARC of another group waits for it: one that is queued, of the hold's
priority or a higher one, all of whose needs are there, and that names the RC or has a pattern which the RC meets. What
nobody else waits for is free. Operators' holds are free, and their ARCs go first as ever.

What was charged halves in each half-life, so a group's account is what it lately had. A group's *share* is that over
its weight. The order is by share, the smallest first; shares that differ by little count as equal, and between these
the shorter minimum runtime goes first, as without fair shares.

Holds and queued ARCs are told as they come and go (`SchedulerState`), so that nothing is summed up in a pass.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Protocol

from zscout.config.scheduling_policy import FairShares
from zscout.scheduling.model import QUANTUM, Arc, Rc
from zscout.types import SECOND, ArcId, Need, Ns

NEAR: Final = 0.01
"""Shares that differ by less than this part,"""
LITTLE: Final = 60.0
"""or by less RC-seconds than this, count as equal."""
FORGOTTEN: Final = 1.0
"""RC-seconds: a group that has less on its account, holds nothing that counts and waits for nothing is forgotten."""
MAX_GROUPS: Final = 1_000
"""Accounts that are kept; beyond, those with least are forgotten,"""
SWEEP: Final[Ns] = 60 * SECOND
"""so often at most."""


@dataclass(slots=True)
class GroupAccount:
    """What one group had."""

    charged: float = 0.0
    """RC-seconds, decayed as of `at`."""
    total: float = 0.0
    """The same, not decayed."""
    at: Ns = 0
    rate: int = 0
    """How many RCs of its holds others wait for."""
    waiting: int = 0
    """How many of its ARCs are queued."""
    position: int = 0
    """Among the groups that wait, as of the last look; the first has 0, and so has who waits for nothing. Groups whose
    shares are near have the same."""


class FleetState(Protocol):
    """What is asked of the state."""

    now: Ns
    present: int

    def rcs_in(self, mask: int) -> Iterator[Rc]: ...
    def matching(self, need: Need) -> list[Rc]: ...
    def operator(self, priority: int) -> bool: ...


class Shares:
    """The accounts of all groups, and who waits for what."""

    def __init__(self, state: FleetState, policy: FairShares) -> None:
        self._state, self._policy = state, policy
        self._accounts: dict[str, GroupAccount] = {}
        self._queued: dict[str, GroupAccount] = {}
        """Those of the groups that wait."""
        self._waiting: dict[int, Counter[tuple[str, int]]] = {}
        """By bit of an RC: how many queued ARCs of each group and priority name it."""
        self._patterns: dict[Need, Counter[tuple[str, int]]] = {}
        """By pattern: likewise."""
        self._charged: dict[ArcId, int] = {}
        """Of each hold that is not an operator's: the bits of its RCs that are charged now."""
        self._next: Ns = 0
        """When the groups are put in order again."""
        self._swept: Ns = 0

    def group(self, arc: Arc) -> str:
        return self._policy.groups.get(arc.owner, arc.owner)

    def position(self, arc: Arc) -> int:
        """The position of its group, for its rank: 0 for an operator's."""
        if self._state.operator(arc.priority):
            return 0
        return self._account(self.group(arc)).position

    def preferred(self, arc: Arc, holders: Iterable[Arc]) -> str:
        """The group of the first of these holders that came while `arc` waited, and would have stood behind it but for
        its group's share; empty if there is none."""
        for one in holders:
            if one.priority == arc.priority and one.position < arc.position and one.hold is not None:
                shorter = (arc.request.min_runtime, arc.place) < (one.request.min_runtime, one.place)
                if shorter and one.hold.start >= arc.since:
                    return self.group(one)
        return ""

    def charged(self) -> dict[str, float]:
        """By group: RC-seconds, decayed as of now, the greatest first; without those that had next to nothing."""
        now = self._state.now
        found = {group: self._settle(account, now).charged for group, account in self._accounts.items()}
        most = sorted(found.items(), key=lambda item: (-item[1], item[0]))[:MAX_GROUPS]
        return {group: had for group, had in most if had >= FORGOTTEN}

    def totals(self) -> dict[str, float]:
        """By group: RC-seconds that were charged in all, since this was begun or the group was forgotten."""
        now = self._state.now
        return {group: self._settle(account, now).total for group, account in self._accounts.items()}

    def restore(self, charged: Mapping[str, float]) -> None:
        """Takes what was charged before this was begun, decayed as of now."""
        for group, had in charged.items():
            self._settle(self._account(group), self._state.now).charged += had

    # What the state tells

    def count_waiting(self, arc: Arc, by: int) -> None:
        """An ARC is queued (1), or is no more (-1)."""
        group = self.group(arc)
        account = self._queued.get(group)
        if account is None:
            account = self._queued[group] = self._account(group)
            self._next = self._state.now  # its place in the order is not known
        account.waiting += by
        if not account.waiting:
            account.position = 0
            del self._queued[group]
        if not arc.named_mask & ~self._state.present:
            self._count(arc, by)

    def count_absent(self, rc: Rc, arcs: Iterable[Arc], by: int) -> None:
        """Of these that are queued, those who name an RC wait for others again (1: it is about to join), or do so no
        more (-1: it is about to leave)."""
        others = self._state.present & ~rc.bit
        for arc in arcs:
            if arc.named_mask & rc.bit and not arc.named_mask & ~rc.bit & ~others:
                self._count(arc, by)

    def hold(self, arc: Arc) -> None:
        """An ARC has begun to hold."""
        if self._state.operator(arc.priority):
            return
        self._charged[arc.id] = 0
        for rc in arc.rcs:
            self._charge(rc, arc)

    def end(self, arc: Arc) -> None:
        """It holds no more."""
        if bits := self._charged.pop(arc.id, 0):
            self._settle(self._account(self.group(arc)), self._state.now).rate -= bits.bit_count()

    # The order

    def order(self) -> bool:
        """Puts the groups that wait in order, once a quantum at most. True: a position has changed."""
        now = self._state.now
        if now < self._next:
            return False
        self._next = now + QUANTUM
        if now >= self._swept + SWEEP:
            self._swept = now
            self._forget(now)
        weights = self._policy.weights
        shares = sorted(
            (self._settle(account, now).charged / weights.get(group, 1.0), group)
            for group, account in self._queued.items()
        )
        position, first, changed = -1, -1.0, False
        for share, group in shares:
            if position < 0 or share - first > max(LITTLE, NEAR * share):
                position, first = position + 1, share
            account = self._queued[group]
            changed |= account.position != position
            account.position = position
        return changed

    def _forget(self, now: Ns) -> None:
        idle = {
            group: self._settle(account, now).charged
            for group, account in self._accounts.items()
            if not account.waiting and not account.rate
        }
        spare = len(self._accounts) - MAX_GROUPS
        for number, (group, had) in enumerate(sorted(idle.items(), key=lambda item: (item[1], item[0]))):
            if had >= FORGOTTEN and number >= spare:
                break
            del self._accounts[group]

    # Accounts

    def _account(self, group: str) -> GroupAccount:
        account = self._accounts.get(group)
        if account is None:
            account = self._accounts[group] = GroupAccount(at=self._state.now)
        return account

    def _settle(self, account: GroupAccount, now: Ns) -> GroupAccount:
        """The account as of now: what it had decays, and so does what it was charged meanwhile."""
        passed = now - account.at
        if passed:
            account.at = now
            account.charged = decayed(account.charged, passed, self._policy.half_life)
            if account.rate:
                account.charged += account.rate * _mean_life(passed, self._policy.half_life)
                account.total += account.rate * passed / SECOND
        return account

    def _count(self, arc: Arc, by: int) -> None:
        who = self.group(arc), arc.priority
        for rc in self._state.rcs_in(arc.named_mask):
            if _counts(self._waiting.setdefault(rc.bit, Counter()), who, by):
                self._charge_all(rc)
        for need in arc.patterns:
            if _counts(self._patterns.setdefault(need, Counter()), who, by):
                for rc in self._state.matching(need):
                    self._charge_all(rc)
                if not self._patterns[need]:
                    del self._patterns[need]

    def _charge_all(self, rc: Rc) -> None:
        for holder in rc.holders.values():
            if holder.id in self._charged:
                self._charge(rc, holder)

    def _charge(self, rc: Rc, holder: Arc) -> None:
        """Whether `holder` is charged for `rc` from now on."""
        charged = self._charged[holder.id]
        if self._is_contended(rc, holder) != bool(charged & rc.bit):
            self._charged[holder.id] = charged ^ rc.bit
            account = self._settle(self._account(self.group(holder)), self._state.now)
            account.rate += -1 if charged & rc.bit else 1

    def _is_contended(self, rc: Rc, holder: Arc) -> bool:
        group, priority = self.group(holder), holder.priority
        if any(one >= priority and other != group for other, one in self._waiting.get(rc.bit, ())):
            return True
        return any(
            one >= priority and other != group and rc in self._state.matching(need)
            for need, waiting in self._patterns.items()
            for other, one in waiting
        )


def _counts(waiting: Counter[tuple[str, int]], who: tuple[str, int], by: int) -> bool:
    """Counts `who`; True where it is the first, or was the last."""
    waiting[who] += by
    if waiting[who] == 0:
        del waiting[who]
        return True
    return by > 0 and waiting[who] == 1


def decayed(charged: float, passed: Ns, half_life: Ns) -> float:
    """What is left of RC-seconds that were charged, after so many ns."""
    return charged * math.exp2(-passed / half_life)


def _mean_life(passed: Ns, half_life: Ns) -> float:
    """What is left of one RC's seconds in the last `passed` ns."""
    # The integral of 2**(-t / half_life), by expm1: for short times the difference of two ones would be all noise.
    return -half_life / SECOND / math.log(2) * math.expm1(-math.log(2) * passed / half_life)
