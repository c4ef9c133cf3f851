"""Rankings of one instant. To rank a thousand hosts takes milliseconds, and of many components that are
placed in one instant each changes one host: that one is ranked anew, and the others are as they were.
"""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass, replace

from zscout.balancing.balancer import Balancer
from zscout.balancing.model import HostName, Ns, Question, Ranked, Ranking


@dataclass(slots=True)
class _Known:
    question: Question
    ranking: Ranking
    changed: set[HostName]


class Ranks:
    """Asks the balancer, and remembers until the next instant what it said."""

    def __init__(self, balancer: Balancer) -> None:
        self._balancer = balancer
        self._now: Ns = 0
        self._known: dict[Question, _Known] = {}

    def begin(self, now: Ns) -> None:
        """Another instant, or hosts were cordoned: what was known is void."""
        self._now, self._known = now, {}

    def changed(self, host: HostName | None) -> None:
        """A component came to a host or left it."""
        if host is not None:
            for known in self._known.values():
                known.changed.add(host)

    def of(self, question: Question) -> Ranking:
        if question.metric == "auto" or question.policy in ("randomized", "two_choices"):
            # These draw lots, each time anew.
            return self._balancer.rank(self._now, question)
        known = self._known.get(question)
        if known is None:
            known = _Known(question, self._balancer.rank(self._now, question), set())
            self._known[question] = known
        elif known.changed:
            known.ranking = self._mended(known)
            known.changed = set()
        return known.ranking

    def _mended(self, known: _Known) -> Ranking:
        changed, old = known.changed, known.ranking
        if known.question.hosts is not None:
            changed = changed & known.question.hosts
        new = self._balancer.rank(self._now, replace(known.question, hosts=frozenset(changed)))
        hosts = [one for one in old.hosts if one.host not in changed]
        for one in new.hosts:
            insort(hosts, one, key=_order)
        left_out = {host: why for host, why in old.left_out.items() if host not in changed}
        return replace(old, hosts=tuple(hosts), left_out=left_out | dict(new.left_out))


def _order(one: Ranked) -> tuple[float, HostName]:
    """As the balancer sorts."""
    return -one.score, one.host
