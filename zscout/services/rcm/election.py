"""Decides when a candidate may try to lead. Pure: observations go in with their time, the next try comes out.

There is no vote among candidates. A leader leads until it dies or a higher term is seen; only while no leader is seen
does rank matter: the better candidate tries first, the next waits its turn. A deposed candidate waits longer each time,
so that two candidates that do not see each other do not alternate over RCs that see both."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from zscout.types import SECOND, HostName, Ns, Term

JOIN_TIME = SECOND // 4
"""The time after joining the mesh (0.2 s if no peer answers) by which an existing leader is seen. Before a candidate
leads it asks the RCs, which know of a leader that it has not seen yet."""
TURN = SECOND // 4
"""The head start of each better-ranked candidate."""
RETRY = SECOND // 10
"""The pause after a failed attempt. Well below TURN: if RCs see the old leader's end a little late, the next in rank
does not try at the same moment."""
CALM = 10 * SECOND
"""A candidate not deposed for this long waits as after its first deposition."""
ALONE_SILENCES = 2
"""Silences that a deposed candidate waits at most while no other host answers: its own RCs wait as well."""
MAX_DOUBLINGS = 5
LEADER_WAIT: Ns = 4 * SECOND
"""The time that a candidate waits for a leader seen only by others, before it reopens its session. It sees a living
leader within a silence after that. RCs see a dead leader for a shorter time."""
BACKOFF_S, MAX_BACKOFF_S = 1.0, 30.0
"""Seconds until a failed candidate becomes one again: the first pause, doubled each time, and the longest."""
BACKOFF_RESET_AFTER: Ns = 60 * SECOND
"""After a candidacy of at least this length the next pause is BACKOFF_S again."""


class Setbacks:
    def __init__(self) -> None:
        self._began: Ns = 0
        self._failures = 0

    def began(self, now: Ns) -> None:
        self._began = now

    def delay(self, now: Ns) -> float:
        """A candidacy failed: the seconds until the next one."""
        self._failures = 1 if now - self._began > BACKOFF_RESET_AFTER else self._failures + 1
        return min(BACKOFF_S * 2.0 ** (self._failures - 1), MAX_BACKOFF_S)


def views(sights: Iterable[tuple[HostName, bool]], me: HostName) -> tuple[dict[HostName, bool], bool]:
    """For each other host, and for this one: True if most of its RCs see a leader, as RCs of one host share its view.
    RCs of unknown hosts ("") count as one host, and only if no other host answers."""
    by_host = defaultdict[HostName, list[bool]](list)
    for host, sees in sights:
        by_host[host].append(sees)
    found = {host: sum(seen) * 2 > len(seen) for host, seen in by_host.items()}
    own = found.pop(me, False)
    if len(found) > 1:
        found.pop("", None)
    return found, own


class _Lone(NamedTuple):
    """The only other host that answers, and the time since which it has shown a leader."""

    host: HostName
    since: Ns


class Election:
    """One candidate's view. `ranking` names hosts, best first; empty means every host, by name."""

    def __init__(self, host: str, ranking: Sequence[str], *, silence: Ns, now: Ns) -> None:
        self.host = host
        self.ranking = {name: rank for rank, name in enumerate(ranking)}
        self.silence = silence
        self._candidates = Counter[str]()
        self._leaders: dict[str, Ns] = {}
        """By instance: the time at which a leader with a token last published (or its token appeared)."""
        self._since = now + JOIN_TIME
        self._not_before: Ns = 0
        self._heard: Ns | None = None
        """The time of the last token or publication of a credible leader."""
        self._deposed: Ns | None = None
        self._depositions = 0
        self._led = True
        """True unless the term that deposed this candidate is known to have no leader yet."""
        self._yields_until: Ns = 0
        self._lost: dict[str, Ns] = {}
        """Hosts whose candidates disappeared, and when."""
        self._returned: Ns | None = None
        """The time at which one of those hosts last returned."""
        self._stalled: Ns | None = None
        self._alone_since: Ns | None = None
        self._lone: _Lone | None = None
        self.led_by: HostName | None = None
        """The host of the last leader that was seen."""

    def candidate(self, host: str, *, alive: bool, now: Ns) -> None:
        if alive:
            if self._lost.pop(host, None) is not None:
                self._returned = now
        else:
            self._lost[host] = now
        self._candidates[host] += 1 if alive else -1
        self._candidates = +self._candidates

    def leader(self, instance: str, host: HostName, *, alive: bool, now: Ns) -> None:
        if alive:
            self.led_by = host
            self._leaders[instance] = self._heard = now
            self._alone_since = None
        elif self._leaders.pop(instance, None) is not None and not self._leaders:
            # A candidate that has seen a leader has joined the mesh, and need not wait for JOIN_TIME.
            self._since = now

    def published(self, term: Term, now: Ns) -> None:
        """A leader published something."""
        self._heard = now
        if term.rcm in self._leaders:
            self._leaders[term.rcm] = now

    def sees_leader(self, now: Ns) -> bool:
        """Return True if a leader has a token and has published within a silence: a hanging program keeps its token."""
        return any(now - at < self.silence for at in self._leaders.values())

    def failed(self, now: Ns) -> None:
        self._not_before = max(self._not_before, now + RETRY)

    def outbid(self, now: Ns) -> None:
        """RCs have promised a higher, unknown term. Wait a turn: by then its candidate leads or has failed."""
        self._not_before = now + TURN

    def deposed(self, now: Ns, jitter: float, *, led: bool = True) -> None:
        """A higher term ended the own term. `jitter` is about 1. Unless `led`, it was only promised: a leader of it
        would show itself, or be seen by RCs, within a turn."""
        self._led = led
        if not led:
            self._heard, self._not_before = None, now + TURN
        if self._deposed is None or now - self._deposed > CALM:
            self._depositions = 0
        self._yields_until = now + round((self.silence << min(self._depositions, MAX_DOUBLINGS)) * jitter)
        self._deposed, self._depositions = now, self._depositions + 1

    def stalled(self, now: Ns) -> None:
        """This process stalled until now: hosts that seem to disappear may have lost sight of this host instead."""
        self._stalled = now

    def waited_in_vain(self, others: Mapping[HostName, bool], now: Ns) -> bool:
        """Return True if the only other host that answers has shown a leader for so long that this candidate would have
        seen it. The time restarts when this candidate sees a leader, and continues while no other host answers."""
        if not others:
            return False
        if list(others.values()) != [True]:
            self._lone = None
            return False
        [host] = others
        lone = self._lone
        if lone is None or lone.host != host or (self._heard is not None and self._heard > lone.since):
            lone = self._lone = _Lone(host, now)
        return now - lone.since >= LEADER_WAIT + self.silence

    def must_wait(self, others: Mapping[HostName, bool], own: bool, now: Ns) -> bool:
        """Return True if RCs of most other hosts (`others`), or of this host (`own`), show a leader. `own` counts only
        if no other host answers: this host's RCs see no more than this candidate. If this host may be cut off, the
        candidate waits one more silence. While links return, a single host that shows a leader is enough, as the link
        to that leader may return next."""
        sights = others.values()
        if others:
            self._alone_since = None
            yields = now < self._yields_until and (self.heard_within(self.silence, now) or any(sights))
            return yields or sum(sights) * 2 > len(sights) or (any(sights) and self._is_back(now))
        if (
            self._led
            and self._deposed is not None
            and now < min(self._yields_until, self._deposed + ALONE_SILENCES * self.silence)
        ):
            # The RCM that deposed this candidate may still lead hosts that are unseen here: don't alternate with it.
            return True
        if not own and not self._was_away(now) and self._alone_since is None:
            return False
        self._alone_since = now if self._alone_since is None else self._alone_since
        return now - self._alone_since < self.silence

    def _was_away(self, now: Ns) -> bool:
        """Return True if this host itself may be cut off, or may have been until a silence ago."""
        missed = [at for host, at in self._lost.items() if host not in (self.led_by, self.host)]
        if self._stalled is not None:
            missed.append(self._stalled)
        return any(now - at <= self.silence for at in missed)

    def links_return(self, now: Ns) -> bool:
        """Return True if links of this host may be returning, one after the other."""
        return self._is_back(now) or self._was_away(now)

    def _is_back(self, now: Ns) -> bool:
        """Return True if a vanished candidate's host returned within the last silence."""
        return self._returned is not None and now - self._returned <= self.silence

    def heard_within(self, span: Ns, now: Ns) -> bool:
        """Return True if a credible leader was seen or published within `span`."""
        return self._heard is not None and now - self._heard < span

    def next_try(self, now: Ns) -> Ns | None:
        """The time at which to try to lead; `now` or earlier: at once; None: not before something changes."""
        if self.ranking and self.host not in self.ranking:
            return None
        if self.sees_leader(now):
            return max(self._not_before, *(at + self.silence for at in self._leaders.values()))
        better = sum(self._rank(host) < self._rank(self.host) for host in self._candidates)
        return max(self._since + better * TURN, self._not_before)

    def _rank(self, host: str) -> tuple[int, str]:
        return (self.ranking.get(host, len(self.ranking)), host)
