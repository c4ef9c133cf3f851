"""Fair shares: recent contended usage per group, and the order of groups that follows.

A hold is charged for each of its RCs while an ARC of another group waits for it: a queued ARC of the hold's priority or
higher, with all its needs present, that names the RC or has a matching pattern. Uncontended RCs and operators' holds
are free, and operators' ARCs still go first.

Charges halve in each half-life. A group's *share* is its charge over its weight. Groups are in order of share, smallest
first; shares that differ little count as equal, and then the shorter minimum runtime goes first.

`SchedulerState` reports each hold and queued ARC as it comes and goes, so a pass has nothing to sum up."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Protocol

from zscout.config.scheduling_policy import FairShares
from zscout.scheduling.model import QUANTUM, Arc, Rc
from zscout.types import SECOND, ArcId, Need, Ns

NEAR_RATIO: Final = 0.01
"""Shares that differ by no more than this part of the greater count as equal,"""
NEAR_RC_SECONDS: Final = 60.0
"""and so do shares that differ by no more RC-seconds than this."""
FORGOTTEN_RC_SECONDS: Final = 1.0
"""A group with a smaller charge, and without charged holds or queued ARCs, is forgotten."""
MAX_GROUPS: Final = 1_000
"""Groups kept; beyond, those with the smallest charges are forgotten."""
SWEEP_INTERVAL: Final[Ns] = 60 * SECOND
"""How often groups are forgotten."""


@dataclass(slots=True)
class GroupAccount:
    charged: float = 0.0  # RC-seconds, decayed as of `at`
    total: float = 0.0  # RC-seconds, not decayed
    at: Ns = 0
    rate: int = 0  # contended RCs of its holds
    waiting: int = 0  # queued ARCs
    position: int = 0  # among the waiting groups at the last ordering, from 0; groups with near shares have the same


class FleetState(Protocol):
    now: Ns
    present: int

    def rcs_in(self, mask: int) -> Iterator[Rc]: ...
    def matching(self, need: Need) -> list[Rc]: ...
    def matching_mask(self, need: Need) -> int: ...
    def operator(self, priority: int) -> bool: ...


class Shares:
    def __init__(self, state: FleetState, policy: FairShares) -> None:
        self._state, self._policy = state, policy
        self._accounts: dict[str, GroupAccount] = {}
        self._queued: dict[str, GroupAccount] = {}  # accounts of groups that wait
        self._waiting: dict[int, Counter[tuple[str, int]]] = {}
        """By bit of an RC: how many queued ARCs of each group and priority name it."""
        self._patterns: dict[Need, Counter[tuple[str, int]]] = {}  # the same by pattern
        self._charged: dict[ArcId, int] = {}  # by hold that is not an operator's: bits of its charged RCs
        self._next: Ns = 0  # when the groups are next ordered
        self._swept: Ns = 0

    def group(self, arc: Arc) -> str:
        return self._policy.groups.get(arc.owner, arc.owner)

    def position(self, arc: Arc) -> int:
        if self._state.operator(arc.priority):
            return 0
        return self._account(self.group(arc)).position

    def preferred(self, arc: Arc, holders: Iterable[Arc]) -> str:
        """The group of the first holder that started while `arc` waited and outranked it only by its group's share;
        empty if there is none."""
        for holder in holders:
            if holder.priority == arc.priority and holder.position < arc.position and holder.hold is not None:
                shorter = (arc.request.min_runtime, arc.place) < (holder.request.min_runtime, holder.place)
                if shorter and holder.hold.start >= arc.since:
                    return self.group(holder)
        return ""

    def charged(self) -> dict[str, float]:
        """By group: decayed RC-seconds, greatest first, negligible charges left out."""
        now = self._state.now
        found = {group: self._settle(account, now).charged for group, account in self._accounts.items()}
        most = sorted(found.items(), key=lambda item: (-item[1], item[0]))[:MAX_GROUPS]
        return {group: had for group, had in most if had >= FORGOTTEN_RC_SECONDS}

    def totals(self) -> dict[str, float]:
        """By group: RC-seconds charged in all, since the start or since the group was forgotten."""
        now = self._state.now
        return {group: self._settle(account, now).total for group, account in self._accounts.items()}

    def restore(self, charged: Mapping[str, float]) -> None:
        for group, had in charged.items():
            self._settle(self._account(group), self._state.now).charged += had

    def count_waiting(self, arc: Arc, by: int) -> None:
        group = self.group(arc)
        account = self._queued.get(group)
        if account is None:
            account = self._queued[group] = self._account(group)
            self._next = self._state.now  # its position is not known yet
        account.waiting += by
        if not account.waiting:
            account.position = 0
            del self._queued[group]
        if not arc.named_mask & ~self._state.present:
            self._count(arc, by)

    def count_absent(self, rc: Rc, arcs: Iterable[Arc], by: int) -> None:
        """Count in (1) before `rc` joins, or out (-1) before it leaves, the ARCs that lack no other named RC."""
        others = self._state.present & ~rc.bit
        for arc in arcs:
            if arc.named_mask & rc.bit and not arc.named_mask & ~rc.bit & ~others:
                self._count(arc, by)

    def hold(self, arc: Arc) -> None:
        if self._state.operator(arc.priority) or not arc.vouched:
            return
        self._charged[arc.id] = 0
        for rc in arc.rcs:
            self._charge(rc, arc)

    def end(self, arc: Arc) -> None:
        if bits := self._charged.pop(arc.id, 0):
            self._settle(self._account(self.group(arc)), self._state.now).rate -= bits.bit_count()

    def next_order(self) -> Ns:
        return self._next if self._next > self._state.now else self._state.now + QUANTUM

    def order(self) -> bool:
        """Order the waiting groups, at most once a quantum. Return True if a position has changed."""
        now = self._state.now
        if now < self._next:
            return False
        self._next = now + QUANTUM
        if now >= self._swept + SWEEP_INTERVAL:
            self._swept = now
            self._forget(now)
        weights = self._policy.weights
        shares = sorted(
            (self._settle(account, now).charged / weights.get(group, 1.0), group)
            for group, account in self._queued.items()
        )
        position, first, changed = -1, -1.0, False
        for share, group in shares:
            if position < 0 or share - first > max(NEAR_RC_SECONDS, NEAR_RATIO * share):
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
            if had >= FORGOTTEN_RC_SECONDS and number >= spare:
                break
            del self._accounts[group]

    def _account(self, group: str) -> GroupAccount:
        account = self._accounts.get(group)
        if account is None:
            account = self._accounts[group] = GroupAccount(at=self._state.now)
        return account

    def _settle(self, account: GroupAccount, now: Ns) -> GroupAccount:
        """Bring the account up to date: its charge decays, and so does the charge added since."""
        passed = now - account.at
        if passed:
            account.at = now
            account.charged = decayed(account.charged, passed, self._policy.half_life)
            if account.rate:
                account.charged += account.rate * _mean_life(passed, self._policy.half_life)
                account.total += account.rate * passed / SECOND
        return account

    def _count(self, arc: Arc, by: int) -> None:
        waiter = self.group(arc), arc.priority
        for rc in self._state.rcs_in(arc.named_mask):
            if _change_count(self._waiting.setdefault(rc.bit, Counter()), waiter, by):
                self._charge_all(rc)
        for need in arc.patterns:
            if _change_count(self._patterns.setdefault(need, Counter()), waiter, by):
                for rc in self._state.matching(need):
                    self._charge_all(rc)
                if not self._patterns[need]:
                    del self._patterns[need]

    def _charge_all(self, rc: Rc) -> None:
        for holder in rc.holders.values():
            if holder.id in self._charged:
                self._charge(rc, holder)

    def _charge(self, rc: Rc, holder: Arc) -> None:
        charged = self._charged[holder.id]
        if self._is_contended(rc, holder) != bool(charged & rc.bit):
            self._charged[holder.id] = charged ^ rc.bit
            account = self._settle(self._account(self.group(holder)), self._state.now)
            account.rate += -1 if charged & rc.bit else 1

    def _is_contended(self, rc: Rc, holder: Arc) -> bool:
        group, priority = self.group(holder), holder.priority
        if any(level >= priority and other != group for other, level in self._waiting.get(rc.bit, ())):
            return True
        return any(
            level >= priority and other != group and rc.bit & self._state.matching_mask(need)
            for need, waiting in self._patterns.items()
            for other, level in waiting
        )


def _change_count(waiting: Counter[tuple[str, int]], waiter: tuple[str, int], by: int) -> bool:
    """Change the count of waiting ARCs of a group and priority. Return True if it becomes zero or was zero."""
    waiting[waiter] += by
    if waiting[waiter] == 0:
        del waiting[waiter]
        return True
    return by > 0 and waiting[waiter] == 1


def decayed(charged: float, passed: Ns, half_life: Ns) -> float:
    """RC-seconds that remain after `passed` ns."""
    return charged * math.exp2(-passed / half_life)


def _mean_life(passed: Ns, half_life: Ns) -> float:
    """The decayed RC-seconds of one RC in the last `passed` ns."""
    # The integral of 2**(-t / half_life), by expm1: for short times, `1 - exp2(...)` would be all noise.
    return -half_life / SECOND / math.log(2) * math.expm1(-math.log(2) * passed / half_life)
