"""Counts the tokens of other hosts, and judges if this leader itself was away when they disappeared (rule 9). Pure.

A leader that was away gives the clients a lease (`roster.py`); it does not stop leading. It steps down when it sees a
higher term (`services/rcm/candidate.py`); until then RCs that miss its publications end their holds themselves."""

from __future__ import annotations

from collections import Counter, deque
from typing import Final

from zscout.types import HostName, Ns

AWAY_PART: Final = 0.25
"""A leader that stalled for more than this part of the mesh lease, or lost several hosts within it, was away itself."""
MAX_TOKENS: Final = 2_000
"""Tokens of one host that count: further tokens are ignored."""


class Sight:
    def __init__(self, me: HostName, lease: Ns) -> None:
        self.me, self.lease, self._span = me, lease, round(AWAY_PART * lease)
        self._tokens: Counter[HostName] = Counter()
        self._stall: tuple[Ns, Ns, bool] = (0, 0, False)
        """The last stall of this process: its length, its end, and True if it ended just now."""
        self._gone: deque[tuple[Ns, HostName]] = deque()
        """Hosts whose last tokens disappeared recently, and when."""
        self._away_until: Ns = 0

    def note_stall(self, length: Ns, ended: Ns, *, fresh: bool) -> None:
        """This process stalled. `fresh`: what arrived meanwhile may not be handled yet."""
        self._stall = length, ended, fresh

    def count(self, host: HostName, *, alive: bool) -> bool:
        """Count a token that appeared or disappeared. Return False if its host has MAX_TOKENS already."""
        if alive and self._tokens[host] >= MAX_TOKENS:
            return False
        self._tokens[host] += 1 if alive else -1
        return True

    def stalled_recently(self, now: Ns) -> bool:
        """Return True if this process stalled for long, less than a lease ago."""
        length, ended, _ = self._stall
        return length > self._span and now - ended < self.lease

    def is_away(self, now: Ns) -> bool:
        return now < self._away_until

    def token_lost(self, now: Ns, host: HostName) -> bool:
        """A token of `host` disappeared. Return True if this leader may be away."""
        if not self._tokens[host]:
            self._gone.append((now, host))
        while self._gone and self._gone[0][0] < now - self._span:
            self._gone.popleft()
        if (self._stall[2] and self.stalled_recently(now)) or self._lost_several:
            self.doubt(now)
        return self.is_away(now)

    def doubt(self, now: Ns) -> None:
        self._away_until = now + self.lease

    def host_answered(self) -> bool:
        """Another host answered. Return True if that shows that this leader is there."""
        if self._stall[2] or self._lost_several:
            return False
        self._away_until = 0
        return True

    @property
    def _lost_several(self) -> bool:
        return len({host for _, host in self._gone}) > 1
