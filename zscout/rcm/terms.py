"""The terms that a manager believes, and the hosts that it doubts. Pure: evidence goes in with its time.

Without `[security]` all evidence counts. With it a term counts if a leader shows it, a sealed place names it, or an RC
whose token is seen obeys it; a client's word does not count. A host whose RCs alone showed a term that then had no
leader is not believed alone for a while."""

from __future__ import annotations

from collections import deque
from enum import Enum, auto
from typing import Final, NamedTuple

from zscout.messages import absurd, of_the_last
from zscout.types import NO_TERM, SECOND, HostName, Ns, Term

DOUBT: Final[Ns] = 10 * SECOND
"""The length of the first doubt of a host; each further doubt is twice as long."""
MAX_DOUBLINGS: Final = 8
MAX_TRIED: Final = 64
FORGIVEN_AFTER: Final[Ns] = 3_600 * SECOND
"""If the last doubt ended longer ago than this, the next has the first length again."""


class Source(Enum):
    """The kind of evidence for a term."""

    LEADER = auto()
    """A publication on `rcm/grants`, or an answer of `rcm/state`."""
    SEAL = auto()
    """A place that a leader of that term has sealed."""
    RC = auto()
    """An RC obeys it."""
    CLIENT = auto()
    """A client reports that it obeys it."""


class Word(NamedTuple):
    term: Term
    source: Source
    by: str = ""
    """An RC or a client, for the log."""
    host: HostName = ""
    """The host of its token; empty: no token is seen."""


class Verdict(NamedTuple):
    believed: bool
    absent_until: Ns = 0
    """If the term of an RC is not believed: the time until which the RC counts as absent."""
    why: str = ""
    """A line for the log, if any."""
    last: bool = False
    """True if the term is one of the last possible ones, so that another witness is needed."""


BELIEVED: Final = Verdict(believed=True)
IGNORED: Final = Verdict(believed=False)


class _Doubt(NamedTuple):
    """A host whose RCs alone showed `term` is not believed alone until that term has a leader, or `until`."""

    term: Term
    until: Ns
    times: int
    since: Ns = 0


class Terms:
    """The terms of one fleet, as one manager knows them."""

    def __init__(self, *, secured: bool, highest: Term = NO_TERM) -> None:
        self.secured = secured
        self.highest = highest
        """The highest term that is believed."""
        self.goes_above = False
        """True while an RC or client obeys a term so far above that promises must be asked for with `above`."""
        self._led = NO_TERM
        """The highest term that had a leader."""
        self._tried = deque[Term](maxlen=MAX_TRIED)
        """The latest terms in which this manager tried to lead."""
        self._shown: dict[HostName, Term] = {}
        """By host: the highest term above `_led` that its RCs showed."""
        self._doubts: dict[HostName, _Doubt] = {}

    def weigh(self, word: Word, now: Ns, *, heard: bool) -> Verdict:
        """Judge a piece of evidence. `heard`: a credible leader published within the hold lease."""
        term = word.term
        if not self.counts(word):
            return IGNORED
        if of_the_last(term, self.highest):
            until = self.doubted_until(word.host, now) if word.source is Source.RC else 0
            return Verdict(believed=False, absent_until=until, last=True)
        if word.source is Source.RC and self.secured and (until := self._doubted(word, now)):
            why = f"ignored term {term.counter} of {word.by}: {word.host} alone shows it, and is not believed alone now"
            return Verdict(believed=False, absent_until=until, why=why)
        why = ""
        if absurd(term, self.highest, heard=heard):
            if word.host == "" or absurd(term, self.highest, heard=False):
                why = f"ignored term {term.counter}: absurdly far above {self.highest.counter}"
                return Verdict(believed=False, why=why)
            why, self.goes_above = f"{word.by} obeys term {term.counter}: the fleet goes above", True
        self.highest = max(self.highest, term)
        if word.source is Source.LEADER:
            self.led(term, now)
        return Verdict(believed=True, why=why)

    def counts(self, word: Word) -> bool:
        """Return True if such evidence can move the term."""
        obeys = word.source is Source.RC and word.host != ""
        return not self.secured or word.source in (Source.LEADER, Source.SEAL) or obeys

    def is_news(self, term: Term, source: Source) -> bool:
        """Return True if `weigh` could learn from a refusal for this term."""
        return not self.secured or (source is not Source.CLIENT and term > self._led)

    def _doubted(self, word: Word, now: Ns) -> Ns:
        """Note the term that an RC shows. Return when its host is believed again; 0: now, or others show it."""
        term, host = word.term, word.host
        if term <= self._led or term in self._tried:
            return 0
        others = [other for other, shown in self._shown.items() if shown == term and other != host]
        self._shown[host] = max(term, self._shown.get(host, NO_TERM))
        for other in others:
            self._vindicate(other, term, now)
        if term <= self.highest or others:
            return 0
        if until := self.doubted_until(host, now):
            return until
        self.doubt(host, term, now)
        return 0

    def doubt(self, host: HostName, term: Term, now: Ns) -> None:
        """Only RCs of `host` showed `term`, or a leader of it."""
        before = self._doubts.get(host, _Doubt(NO_TERM, 0, 0))
        times = 0 if now - before.until > FORGIVEN_AFTER else before.times
        self._doubts[host] = _Doubt(term, now + (DOUBT << min(times, MAX_DOUBLINGS)), times + 1, now)

    def _vindicate(self, host: HostName, term: Term, now: Ns) -> None:
        doubt = self._doubts.get(host)
        if doubt is not None and doubt.term == term:
            self._doubts[host] = _Doubt(NO_TERM, min(now, doubt.until), doubt.times - 1)

    def tries(self, term: Term) -> None:
        """This manager asks for promises in `term`, so RCs that show `term` are no evidence of another candidate."""
        self._tried.append(term)

    def led(self, term: Term, now: Ns) -> None:
        """A leader of `term` exists: hosts that showed it were right."""
        if term > self._led:
            self._led = term
            self._shown = {host: shown for host, shown in self._shown.items() if shown > term}
            for host in list(self._doubts):
                self._vindicate(host, term, now)

    def is_led_nowhere(self, term: Term, host: HostName, now: Ns, silence: Ns) -> bool:
        """Return True if only `host` shows `term`, and it had no leader for a silence: its RCs can see none."""
        return self.is_doubted(host, now, silence) and self._doubts[host].term == term

    def is_doubted(self, host: HostName, now: Ns, silence: Ns) -> bool:
        """Return True if the leader that `host` alone shows has had a silence to show itself."""
        doubt = self._doubts.get(host)
        return doubt is not None and doubt.since + silence <= now < doubt.until

    def doubted_until(self, host: HostName, now: Ns) -> Ns:
        """Until when a term that only `host` shows is ignored; 0 if it is believed."""
        doubt = self._doubts.get(host)
        return doubt.until if doubt is not None and now < doubt.until else 0
