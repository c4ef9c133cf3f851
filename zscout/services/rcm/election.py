"""When a candidate may try to lead. Pure: what is seen goes in, with the time; the next step comes out.

There is no vote among candidates. A leader leads until it dies or a higher term is seen; only while no leader is seen
does rank matter: the better candidate tries first, the next waits its turn. Who was deposed waits longer each time, so
that two that do not see each other do not take turns over RCs that see both."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from zscout.types import SECOND, HostName, Ns, Term

SETTLE = SECOND // 4
"""From joining the mesh, which takes 0.2 s where nobody answers, until a leader that exists has been seen. One that is
seen later is found by its RCs, which are asked before anybody leads."""
TURN = SECOND // 4
"""The head start of each better-ranked candidate."""
RETRY = SECOND // 10
"""From one attempt that failed to the next. Well below TURN: where RCs see the old leader's end a little late, the next
in rank would else try at the same moment."""
CALM = 10 * SECOND
"""After so long without being deposed, a candidate waits as after the first time."""
ALONE = 2
"""Silences for which a deposed candidate waits at most that sees nobody else: its own RCs wait as well."""
MAX_DOUBLINGS = 5
WAITS: Ns = 4 * SECOND
"""A candidate waits so long for a leader that only others see until it reopens its session. A leader that lives shows
itself within a silence after that. RCs see one that died for a shorter time."""
BACKOFF, MAX_BACKOFF = 1.0, 30.0
"""Seconds until a candidate that failed becomes one again: doubled each time, at most."""
BACKOFF_RESET_AFTER: Ns = 60 * SECOND
"""After a candidacy at least this long the next failure begins with BACKOFF anew."""


class Setbacks:
    """Candidacies that failed one after the other."""

    def __init__(self) -> None:
        self._began: Ns = 0
        self._failures = 0

    def began(self, now: Ns) -> None:
        self._began = now

    def delay(self, now: Ns) -> float:
        """A candidacy failed: the seconds until the next one."""
        self._failures = 1 if now - self._began > BACKOFF_RESET_AFTER else self._failures + 1
        return min(BACKOFF * 2.0 ** (self._failures - 1), MAX_BACKOFF)


def views(sights: Iterable[tuple[HostName, bool]], me: HostName) -> tuple[dict[HostName, bool], bool]:
    """For each other host, and for this one: whether most of its RCs see a leader. RCs of one host share its view of
    the mesh. RCs of unknown hosts ("") count as one host, and only if no other host answers."""
    said = defaultdict[HostName, list[bool]](list)
    for host, sees in sights:
        said[host].append(sees)
    found = {host: sum(seen) * 2 > len(seen) for host, seen in said.items()}
    own = found.pop(me, False)
    if len(found) > 1:
        found.pop("", None)
    return found, own


class _Lone(NamedTuple):
    """The only other host that answers, and since when it has shown a leader."""

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
        """When each leader that has a token last published (or its token was seen first)."""
        self._since = now + SETTLE
        self._not_before: Ns = 0
        self._heard: Ns | None = None
        """When a leader that counts was seen or heard last."""
        self._deposed: Ns | None = None
        self._depositions = 0
        self._led = True
        """Whether somebody may lead in the term that deposed it."""
        self._yields_until: Ns = 0
        self._lost: dict[str, Ns] = {}
        """Hosts whose candidates were seen to go, and when."""
        self._returned: Ns | None = None
        """When one of them came back last."""
        self._stood_still: Ns | None = None
        self._alone_since: Ns | None = None
        self._lone: _Lone | None = None
        self.led_by: HostName | None = None
        """The host of the leader that was seen last."""

    def candidate(self, host: str, *, alive: bool, now: Ns) -> None:
        """A candidate's token came or went."""
        if alive:
            if self._lost.pop(host, None) is not None:
                self._returned = now
        else:
            self._lost[host] = now
        self._candidates[host] += 1 if alive else -1
        self._candidates = +self._candidates

    def leader(self, instance: str, host: HostName, *, alive: bool, now: Ns) -> None:
        """A leader's token came or went."""
        if alive:
            self.led_by = host
            self._leaders[instance] = self._heard = now
            self._alone_since = None
        elif self._leaders.pop(instance, None) is not None and not self._leaders:
            # Who has seen a leader is on the mesh: there is nothing to settle any more.
            self._since = now

    def published(self, term: Term, now: Ns) -> None:
        """A leader published something."""
        self._heard = now
        if term.rcm in self._leaders:
            self._leaders[term.rcm] = now

    def sees_leader(self, now: Ns) -> bool:
        """A leader counts while its token lives and it publishes: one whose program hangs keeps its token."""
        return any(now - at < self.silence for at in self._leaders.values())

    def failed(self, now: Ns) -> None:
        """An attempt did not lead to the lead."""
        self._not_before = max(self._not_before, now + RETRY)

    def rivalled(self, now: Ns) -> None:
        """A higher term than was known is promised: another candidate leads in it within a turn, or has failed."""
        self._not_before = now + TURN

    def deposed(self, now: Ns, jitter: float, *, led: bool = True) -> None:
        """A higher term ended the own one. `jitter` is about 1. Not `led`: it was promised, and nobody is known to lead
        in it; who does shows himself within a turn, or RCs see him."""
        self._led = led
        if not led:
            self._heard, self._not_before = None, now + TURN
        if self._deposed is None or now - self._deposed > CALM:
            self._depositions = 0
        self._yields_until = now + round((self.silence << min(self._depositions, MAX_DOUBLINGS)) * jitter)
        self._deposed, self._depositions = now, self._depositions + 1

    def stood_still(self, now: Ns) -> None:
        """This process has just gone on: what it sees go may have missed it, and not the other way round."""
        self._stood_still = now

    def waited_in_vain(self, others: Mapping[HostName, bool], now: Ns) -> bool:
        """Return True if the only other host that answers has shown a leader for so long that this candidate would have
        seen it. The time begins again when this candidate sees or hears a leader; no answer at all does not stop it."""
        if not others:
            return False
        if list(others.values()) != [True]:
            self._lone = None
            return False
        [host] = others
        lone = self._lone
        if lone is None or lone.host != host or (self._heard is not None and self._heard > lone.since):
            lone = self._lone = _Lone(host, now)
        return now - lone.since >= WAITS + self.silence

    def must_wait(self, others: Mapping[HostName, bool], own: bool, now: Ns) -> bool:
        """Return True if RCs show a leader: most other hosts do (`views`), or this host (`own`).

        This host's RCs count only if no other host answers: they see what it sees. If this host may be cut off,
        the candidate waits for one more silence. While links return, one host that shows a leader is enough: the
        leader's own link may be the next."""
        sights = others.values()
        if others:
            self._alone_since = None
            yields = now < self._yields_until and (self.heard_within(self.silence, now) or any(sights))
            return yields or sum(sights) * 2 > len(sights) or (any(sights) and self._is_back(now))
        if (
            self._led
            and self._deposed is not None
            and now < min(self._yields_until, self._deposed + ALONE * self.silence)
        ):
            # The RCM that deposed this candidate continues, though nobody who shows it is seen: they would take turns.
            return True
        if not own and not self._was_away(now) and self._alone_since is None:
            return False
        self._alone_since = now if self._alone_since is None else self._alone_since
        return now - self._alone_since < self.silence

    def _was_away(self, now: Ns) -> bool:
        """Whether it may be this host that is cut off, or was until a silence ago."""
        missed = [at for host, at in self._lost.items() if host not in (self.led_by, self.host)]
        if self._stood_still is not None:
            missed.append(self._stood_still)
        return any(now - at <= self.silence for at in missed)

    def links_return(self, now: Ns) -> bool:
        """Whether links of this host may be coming back, one after the other."""
        return self._is_back(now) or self._was_away(now)

    def _is_back(self, now: Ns) -> bool:
        """Return True if a host whose candidate had gone came back within a silence."""
        return self._returned is not None and now - self._returned <= self.silence

    def heard_within(self, span: Ns, now: Ns) -> bool:
        """Whether a leader that counts was seen or heard so lately."""
        return self._heard is not None and now - self._heard < span

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
