"""Keeping components running: what is asked for, what came of a start, when it is tried again, and when no
more.
"""

from __future__ import annotations

from typing import Final

from zscout.balancing.model import SECOND, ComponentId, HostName, Ns
from zscout.placing.choosing import Chooser, in_words
from zscout.placing.entry import Entry, Fate
from zscout.placing.events import Spec, StartAnswered, StopAnswered
from zscout.placing.ground import ANSWER, STOP_ANSWER, Ground
from zscout.placing.inquiries import Inquiries
from zscout.placing.strays import Strays

GRACE: Final[Ns] = 2 * SECOND
"""What is inherited, or went on elsewhere, has as long to be heard of."""
LOOKS: Final = 3
"""A component whose token is missing and of which its host tells nothing so often is lost."""


class Keeper:
    """Places, restarts and stops. A component that is being moved is `moving.Mover`'s."""

    def __init__(self, ground: Ground, strays: Strays, inquiries: Inquiries) -> None:
        self.ground, self.strays, self.inquiries = ground, strays, inquiries
        self.chooser = Chooser(ground)

    # What is asked for

    def place(self, component: ComponentId, spec: Spec) -> None:
        ground = self.ground
        entry = ground.entry(component)
        if entry is None:
            entry = ground.new_entry(component, spec)
            if entry is None:
                ground.refuse(component, "too_many", f"{len(ground.entries)} components are placed already")
                return
            self.chooser.again(entry)
        elif entry.state in ("ended", "given_up"):
            ground.revived(entry)
            self._anew(entry, spec)
            entry.past = True
            self.chooser.again(entry)
        elif not entry.wanted:
            # It is being stopped; what is asked for now comes after that.
            self._anew(entry, spec)
        elif entry.spec != spec:
            message = f"{component} is placed already, and is another: stop it first, or take another name"
            ground.refuse(component, "exists", message)
            return
        ground.touch(component, asked=True)

    def _anew(self, entry: Entry, spec: Spec) -> None:
        entry.spec, entry.wanted, entry.movable = spec, True, False
        entry.restarts = entry.rounds = entry.moves = 0
        entry.dead = None
        entry.reason = entry.cause = entry.tail = ""
        entry.tried.clear()

    def stop(self, entry: Entry) -> None:
        """For good. A move must have been called off before."""
        entry.wanted = False
        self.ground.touch(entry.component, asked=True)
        match entry.state:
            case "ended" | "stopping":
                pass
            case "given_up":
                self.chooser.finish(entry, "ended", "stopped")
            case "waiting" | "backing_off":
                entry.state, entry.reason = "stopping", "asked to stop"
                self._check_stopped(entry)
            case _:
                entry.state, entry.reason, entry.asks = "stopping", "asked to stop", 0
                self._stop_now(entry)

    # What came of a start

    def start_answered(self, entry: Entry, answer: StartAnswered) -> None:
        """Of the entry's own incarnation, which is no move's."""
        entry.start_until = None
        if entry.state == "stopping":
            # The stop may have come before the start: once more.
            if answer.result in ("refused", "failed"):
                self.over(entry)
            else:
                self._stop_now(entry)
        elif answer.result == "failed" and entry.state != "starting":
            self.ended(entry, Fate("failed", answer.reason, answer.tail))
        elif answer.result == "ok":
            entry.movable, entry.told = answer.movable, True
            self.runs(entry)
        elif entry.state == "starting":
            self._not_started(entry, answer)

    def _not_started(self, entry: Entry, answer: StartAnswered) -> None:
        ground, host = self.ground, answer.host
        if answer.result == "unknown":
            pause = ground.pause(entry.asks)
            entry.asks += 1
            entry.reason = f"{host} does not say whether it started: {answer.reason or 'no answer'}"
            ground.wake(entry, ground.now + pause)
            return
        if answer.result == "refused":
            entry.over.append(entry.incarnation)
            ground.left(entry)
            if answer.again:
                # It may know what the placer does not: another incarnation that lives there.
                ground.look(entry.component, host)
            cause = f"{host} refused it: {answer.reason}"
            entry.tried[host] = "" if answer.again else cause
            self.chooser.again(entry, cause)
            return
        self.start_failed(entry, Fate("failed", answer.reason, answer.tail), again=answer.again)

    def start_failed(self, entry: Entry, fate: Fate, *, again: bool = True) -> None:
        """It was started and ended before it ran: the next host at once, a few times."""
        host = entry.host or "its host"
        entry.over.append(entry.incarnation)
        entry.start_until, entry.tail = None, fate.tail
        self.ground.left(entry)
        cause = f"it did not start on {host}: {fate.reason or fate.how}"
        entry.tried[host] = "" if again else cause
        entry.restarts += 1
        if not self._exhausted(entry, cause):
            self.chooser.again(entry, cause)

    def runs(self, entry: Entry) -> None:
        """It is known to run where it is; also what was believed gone."""
        if entry.state != "running":
            entry.state, entry.since, entry.missing = "running", self.ground.now, False
            entry.rounds, entry.reason = 0, entry.why
            entry.tried.clear()
        entry.asks, entry.start_until = 0, None
        self.watch(entry)
        self.ground.drain_soon(entry.host)

    def watch(self, entry: Entry) -> None:
        """Sets when a running component is to be looked at next."""
        ground, settles = self.ground, None
        if not (entry.token and entry.told):
            settles = ground.now + ANSWER
        elif entry.restarts and entry.since is not None:
            settles = max(ground.now, entry.since + ground.rules.settled)
        ground.wake(entry, settles)

    # What ended

    def ended(self, entry: Entry, fate: Fate) -> None:
        """The entry's incarnation is gone for sure, or given up for lost."""
        ground, rules = self.ground, self.ground.rules
        if entry.state == "stopping":
            self.over(entry, sure=fate.how != "lost")
            return
        if entry.state == "starting" and fate.how in ("failed", "lost") and not fate.with_host:
            self.start_failed(entry, fate)
            return
        host, ran = entry.host or "its host", ground.now - entry.since if entry.since is not None else 0
        if fate.how != "lost":
            entry.over.append(entry.incarnation)
        elif entry.host is not None and fate.with_host:
            # It may come back with its host.
            self.inquiries.add(entry.host, entry.component)
        entry.start_until, entry.tail, entry.stays, entry.asks = None, fate.tail, "", 0
        ground.left(entry)
        if fate.how in ("moved", "superseded") and not entry.missing:
            entry.missing = True
            self.chooser.back_off(entry, f"it went on elsewhere ({fate.how}), it is not known where", GRACE)
            return
        cause = _cause(fate, host)
        if fate.how == "completed" and entry.spec.restart != "always":
            self.chooser.finish(entry, "ended", cause)
        elif entry.spec.restart == "never":
            self.chooser.finish(entry, "given_up" if fate.how == "failed" else "ended", cause)
        elif fate.with_host:
            entry.tried.clear()
            self.chooser.again(entry, cause)
        elif ran >= rules.settled:
            entry.restarts = 0
            self.chooser.again(entry, cause)
        else:
            pause = ground.pause(entry.restarts)
            entry.restarts += 1
            if fate.how == "completed" or not self._exhausted(entry, cause):
                self.chooser.back_off(entry, f"{cause}; started again after {in_words(pause)}", pause)
                entry.cause = cause

    def _exhausted(self, entry: Entry, cause: str) -> bool:
        """Whether that was the last try; if so it is given up."""
        if entry.spec.restart == "never":
            self.chooser.finish(entry, "given_up", cause)
        elif entry.restarts >= self.ground.rules.restarts:
            self.chooser.finish(entry, "given_up", f"{cause}; {entry.restarts} starts in a row failed")
        return entry.state == "given_up"

    def host_lost(self, entry: Entry, host: HostName) -> None:
        """The host that it was on is gone."""
        self.ended(entry, Fate("lost", f"host {host} is gone", with_host=True))

    # Stopping

    def _stop_now(self, entry: Entry) -> None:
        if entry.host is None or entry.host not in self.ground.alive:
            if entry.host is None or self.ground.now >= entry.retry_at:
                self.over(entry, sure=False)
            else:
                # Inherited: its host may be there, and has not been seen yet.
                self.ground.wake(entry, entry.retry_at)
            return
        entry.stopped = False
        self.ground.stop(entry.component, entry.incarnation, entry.host)
        self.ground.wake(entry, self.ground.now + STOP_ANSWER)

    def stop_answered(self, entry: Entry, answer: StopAnswered) -> None:
        entry.stopped = answer.done
        if not answer.done:
            entry.asks += 1
            self.ground.wake(entry, self.ground.now + self.ground.pause(entry.asks))
        elif entry.start_until is not None or entry.token:
            # It began after that was said, or its token goes in a moment.
            self.ground.wake(entry, self.ground.now + SECOND)
        else:
            self.over(entry)

    def over(self, entry: Entry, *, sure: bool = True) -> None:
        """What was stopped has ended, or its host is gone."""
        if sure:
            entry.over.append(entry.incarnation)
        elif entry.host is not None:
            self.inquiries.add(entry.host, entry.component)
        entry.start_until = None
        self.ground.left(entry)
        self.ground.wake(entry, None)
        self._check_stopped(entry)

    def _check_stopped(self, entry: Entry) -> None:
        if entry.host is not None or self.strays.any(entry.component):
            return
        if entry.wanted:
            entry.past = True
            self.chooser.again(entry)
        else:
            self.chooser.finish(entry, "ended", "stopped")

    def stray_over(self, component: ComponentId) -> None:
        """One of its strays has ended: perhaps that was what a stop waited for."""
        entry = self.ground.entry(component)
        if entry is not None and entry.state == "stopping":
            self._check_stopped(entry)

    # Time

    def woke(self, entry: Entry) -> None:
        ground = self.ground
        match entry.state:
            case "waiting":
                self.chooser.again(entry, entry.cause)
            case "backing_off" if entry.missing:
                entry.missing = False
                self.ended(entry, Fate("lost", "it went on elsewhere and was not heard of again"))
            case "backing_off":
                self.chooser.again(entry, entry.cause)
            case "starting":
                self._start_again(entry)
            case "running":
                if (fate := self.check(entry)) is not None:
                    self.ended(entry, fate)
            case "stopping":
                if entry.start_until is not None and entry.start_until <= ground.now:
                    entry.start_until = None
                self._stop_now(entry)
            case _:
                ground.forget(entry.component)

    def _start_again(self, entry: Entry) -> None:
        if entry.host is None or entry.host not in self.ground.alive:
            self.host_lost(entry, entry.host or "of its start")
        elif entry.start_until is not None:
            answer = StartAnswered(entry.component, entry.incarnation, entry.host, "unknown")
            self.start_answered(entry, answer)
        else:
            self.ground.start(entry)

    def check(self, entry: Entry) -> Fate | None:
        """Of a running component whose token is missing, or that nobody has told of, asks its host; and
        forgives what has settled.
        Returns what became of it, if it is to be given up for lost."""
        ground, host = self.ground, entry.host
        if entry.since is not None and ground.now - entry.since >= ground.rules.settled:
            entry.restarts = 0
        if entry.token and entry.told:
            self.watch(entry)
            return None
        if host is None or host not in ground.alive:
            return Fate("lost", f"host {host} is gone", with_host=True)
        if entry.asks >= LOOKS and not entry.token:
            self.strays.add(entry.component, entry.incarnation, host)
            return Fate("lost", f"its token is gone, and {host} tells nothing of it")
        entry.asks += 1
        entry.looked = True
        ground.look(entry.component, host)
        ground.wake(entry, ground.now + ANSWER)
        return None


def _cause(fate: Fate, host: HostName) -> str:
    match fate.how:
        case "completed":
            return f"it completed on {host}" + (f": {fate.reason}" if fate.reason else "")
        case "failed":
            return f"it failed on {host}: {fate.reason or 'no reason was told'}"
        case "stopped":
            return f"it was stopped on {host}, and not by the placer"
        case _:
            return fate.reason
