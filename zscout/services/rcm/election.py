"""When a candidate may try to lead. Pure: what is seen goes in, with the time; the next step comes out.

There is no vote among candidates. A leader leads until it dies or a higher term is seen; only while no leader is seen
does rank matter: the better candidate tries first, the next waits its turn."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from zscout.types import SECOND, Ns, Term

SETTLE = SECOND // 2
"""From joining the mesh until a leader that exists has been seen."""
TURN = SECOND // 4
"""The head start of each better-ranked candidate."""
RETRY = SECOND // 10
"""From one attempt that failed to the next. Well below TURN: where RCs see the old leader's end a little late, the next
in rank would else try at the same moment."""


class Election:
    """One candidate's view. `ranking` names hosts, best first; empty means every host, by name."""

    def __init__(self, host: str, ranking: Sequence[str], *, silence: Ns, now: Ns) -> None:
        self.host = host
        self.ranking = {name: rank for rank, name in enumerate(ranking)}
        self.silence = silence
        self._candidates = Counter[str]()
        self._leaders: dict[str, Ns] = {}
        """When each leader that has a token last published (or its token was seen first)."""
        self._since = now + SETTLE
        self._not_before: Ns = 0

    def candidate(self, host: str, *, alive: bool) -> None:
        """A candidate's token came or went."""
        self._candidates[host] += 1 if alive else -1
        self._candidates = +self._candidates

    def leader(self, instance: str, *, alive: bool, now: Ns) -> None:
        """A leader's token came or went."""
        if alive:
            self._leaders[instance] = now
        elif self._leaders.pop(instance, None) is not None and not self._leaders:
            # Who has seen a leader is on the mesh: there is nothing to settle any more.
            self._since = now

    def published(self, term: Term, now: Ns) -> None:
        """A leader published something."""
        if term.rcm in self._leaders:
            self._leaders[term.rcm] = now

    def sees_leader(self, now: Ns) -> bool:
        """A leader counts while its token lives and it publishes: one whose program hangs keeps its token."""
        return any(now - at < self.silence for at in self._leaders.values())

    def failed(self, now: Ns) -> None:
        """An attempt did not lead to the lead."""
        self._not_before = now + RETRY

    def next_try(self, now: Ns) -> Ns | None:
        """When to try to lead: now or earlier means at once, None not while things stay as they are."""
        if self.ranking and self.host not in self.ranking:
            return None
        if self.sees_leader(now):
            return max(self._not_before, *(at + self.silence for at in self._leaders.values()))
        better = sum(self._rank(host) < self._rank(self.host) for host in self._candidates)
        return max(self._since + better * TURN, self._not_before)

    def _rank(self, host: str) -> tuple[int, str]:
        return (self.ranking.get(host, len(self.ranking)), host)
