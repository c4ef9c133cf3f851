"""Which host a component is started on: the best that was not tried, or none for now, or none at all."""

from __future__ import annotations

import re
from typing import Final, Literal

from zscout.balancing.model import SECOND, Ns, Ranked
from zscout.placing.entry import Entry
from zscout.placing.ground import Ground

TRY_AGAIN: Final[Ns] = SECOND
"""A component for which there is no host looks for one as often."""
AT_ONCE: Final = 100
"""Components that are placed in one instant; the next follow in the next."""
SHORTLY: Final[Ns] = SECOND // 100
TOLD: Final = 4
"""Hosts whose reasons are given when none can start a component."""


class Chooser:
    """Places what is to be placed, at the end of each instant."""

    def __init__(self, ground: Ground) -> None:
        self.ground = ground

    def again(self, entry: Entry, cause: str = "") -> None:
        """Has it placed at the end of this instant."""
        entry.state, entry.cause, entry.missing = "waiting", cause, False
        self.ground.wake(entry, None)
        self.ground.to_place[entry.component] = None

    def place_all(self) -> None:
        """Places what is to be placed, the heaviest first."""
        ground = self.ground
        entries = [ground.entries[name] for name in ground.to_place if name in ground.entries]
        ground.to_place = {}
        waiting = [(one.component, one.spec.kind) for one in entries if one.state == "waiting"]
        order = ground.balancer.heaviest_first(waiting) if len(waiting) > 1 else [name for name, _ in waiting]
        for number, component in enumerate(order):
            entry = ground.entries[component]
            ground.touch(component)
            if number < AT_ONCE:
                self._put(entry)
            else:
                entry.reason = entry.reason or "others are placed first"
                ground.wake(entry, ground.now + SHORTLY)

    def _put(self, entry: Entry) -> None:
        fit = self.ground.fit(entry.spec)
        untried = [one for one in fit.hosts if one.host not in entry.tried]
        if untried:
            self._start(entry, untried[0])
        elif not fit.hosts:
            entry.tried.clear()
            self._wait(entry, fit.why_none())
        elif all(entry.tried[one.host] for one in fit.hosts):
            causes = list(dict.fromkeys(entry.tried[one.host] for one in fit.hosts))
            more = f"; and {len(causes) - TOLD} more" if len(causes) > TOLD else ""
            self.finish(entry, "given_up", f"no host can start it: {'; '.join(causes[:TOLD])}{more}")
        else:
            entry.tried.clear()
            pause = self.ground.pause(entry.rounds)
            entry.rounds += 1
            self.back_off(
                entry, f"no host started it; tried again after {in_words(pause)}: {entry.cause}", pause
            )

    def _wait(self, entry: Entry, why: str) -> None:
        # Ages and amounts in the reason change all the time: that is no news.
        if _words(entry.reason) != _words(reason := f"no host will do: {why}"):
            entry.reason = reason
        self.ground.wake(entry, self.ground.now + TRY_AGAIN)

    def _start(self, entry: Entry, ranked: Ranked) -> None:
        ground = self.ground
        entry.incarnation = ground.fresh(entry.component)
        entry.host, entry.state, entry.past = ranked.host, "starting", False
        entry.since, entry.token, entry.told, entry.looked, entry.asks = None, False, False, False, 0
        entry.why = f"{entry.cause}; here: {ranked.reason}" if entry.cause else ranked.reason
        entry.reason = entry.why
        ground.came(entry.component, entry.spec.kind, ranked.host)
        ground.start(entry)

    def back_off(self, entry: Entry, reason: str, pause: Ns) -> None:
        entry.state, entry.reason = "backing_off", reason
        self.ground.wake(entry, self.ground.now + pause)

    def finish(self, entry: Entry, state: Literal["ended", "given_up"], reason: str) -> None:
        entry.state = state
        entry.reason, entry.stays, entry.cause, entry.missing = reason, "", "", False
        self.ground.ended(entry)


def in_words(pause: Ns) -> str:
    return f"{pause / SECOND:g} s"


def _words(reason: str) -> str:
    """A reason without its figures."""
    return re.sub(r"[\d.,]+", "#", reason)
