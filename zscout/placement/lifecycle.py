"""The life of a component that does not move: placed, started, restarted, given up, stopped."""

from __future__ import annotations

import difflib
from typing import Final

from zscout.messages import ComponentSpec, ComponentState, RankedHost
from zscout.placement.events import StartAnswered
from zscout.placement.repeating import Probes, SurplusIncarnations
from zscout.placement.state import OVER, PROBE_TIMEOUT, ComponentRecord, PlacementState, Termination, host_gone
from zscout.types import SECOND, ComponentId, HostName, Ns

GRACE: Final[Ns] = 2 * SECOND
"""Time for a host to report an inherited or moved component."""
MAX_PROBES: Final = 3
"""Unanswered probes before a component without token counts as lost."""
ASK_KINDS: Final[Ns] = 2 * SECOND
"""Time for hosts to report a kind that none had."""
TRY_AGAIN: Final[Ns] = SECOND
"""Delay of the next try without an eligible host."""
AT_ONCE: Final = 100
"""Components placed in one instant; the next follow SHORTLY after."""
SHORTLY: Final[Ns] = SECOND // 100
KINDS_NAMED: Final = 8
CAUSES_NAMED: Final = 4


class Lifecycle:
    def __init__(self, state: PlacementState, surplus: SurplusIncarnations, probes: Probes) -> None:
        self.state, self.surplus, self.probes = state, surplus, probes

    def place(self, component: ComponentId, spec: ComponentSpec) -> None:
        state = self.state
        record = state.get(component)
        if record is None:
            record = ComponentRecord(component, spec, asked_at=state.now)
            if not state.add(record):
                state.refuse(
                    component,
                    "too_many",
                    f"{len(state.components)} components are placed, the most allowed; stop one first",
                )
                return
            self.place_again(record)
        elif record.state in OVER:
            state.revive(record)
            self._reset(record, spec)
            record.superseded = True
            self.place_again(record)
        elif not record.wanted:
            # It is placed again after its stop.
            self._reset(record, spec)
        elif record.spec != spec:
            message = f"{component} is already placed with other settings; stop it first, or use another name"
            state.refuse(component, "exists", message)
            return
        state.mark_changed(component, always=True)

    def _reset(self, record: ComponentRecord, spec: ComponentSpec) -> None:
        record.spec, record.wanted, record.movable = spec, True, False
        record.asked_at, record.asked_as = self.state.now, record.incarnation
        record.restarts = record.failed_rounds = record.moves = 0
        record.dead = None
        record.reason = record.restart_cause = record.tail = ""
        record.tried.clear()

    def stop(self, record: ComponentRecord) -> None:
        """Stop for good. A migration must have been cancelled before."""
        record.wanted = False
        self.state.mark_changed(record.component, always=True)
        if record.state == "given_up":
            self._finish(record, "ended", "stopped")
        elif record.state not in ("ended", "stopping"):
            record.enter("stopping")
            record.reason = "asked to stop"
            self.end_incarnation(record)

    def place_again(self, record: ComponentRecord, cause: str = "") -> None:
        record.enter("waiting")
        record.restart_cause, record.whereabouts_unknown = cause, False
        self.state.wake(record, None)
        self.state.to_place[record.component] = None

    def place_waiting(self) -> None:
        state = self.state
        records = [state.components[name] for name in state.to_place if name in state.components]
        state.to_place = {}
        waiting = [(record.component, record.spec.kind) for record in records if record.state == "waiting"]
        for number, component in enumerate(state.balancer.heaviest_first(waiting)):
            record = state.components[component]
            state.mark_changed(component)
            if number < AT_ONCE:
                self._choose_host(record)
            else:
                record.reason = record.reason or "others are placed first"
                state.wake(record, state.now + SHORTLY)

    def _choose_host(self, record: ComponentRecord) -> None:
        hosts, why_none = self.state.eligible_hosts(record.spec)
        tried = record.tried
        untried = next((ranked for ranked in hosts if ranked.host not in tried), None)
        if untried is not None:
            self._start_on(record, untried)
        elif not hosts and (lacking := self._without_kind(record)):
            self._ask_for_kind(record, lacking)
        elif not hosts:
            tried.clear()
            if record.no_host != (why_none, record.reason):
                record.reason = f"no host will do: {why_none}"
                record.no_host = why_none, record.reason
            self.state.wake(record, self.state.now + TRY_AGAIN)
        elif all(tried[ranked.host] for ranked in hosts):
            refusals = list(dict.fromkeys(tried[ranked.host] for ranked in hosts))
            more = f"; and {len(refusals) - CAUSES_NAMED} more" if len(refusals) > CAUSES_NAMED else ""
            reason = f"no host can start it: {'; '.join(refusals[:CAUSES_NAMED])}{more}"
            self._finish(record, "given_up", reason)
        else:
            tried.clear()
            pause = self.state.back_off_time(record.failed_rounds)
            record.failed_rounds += 1
            reason = f"no host started it; tried again after {pause / SECOND:g} s: {record.restart_cause}"
            self._back_off(record, reason, pause)

    def _without_kind(self, record: ComponentRecord) -> set[HostName]:
        """The hosts that lack only the kind of a component that was never started, if no known host has it."""
        return self.state.lacking_everywhere(record.spec) if record.incarnation == record.asked_as else set()

    def _ask_for_kind(self, record: ComponentRecord, hosts: set[HostName]) -> None:
        """Give it up, unless hosts listed their kinds before the request: its kind may be installed by now."""
        state, kind = self.state, record.spec.kind
        before = [host for host in sorted(hosts) if state.kinds[host][0] < record.asked_at]
        if not before or state.now - record.asked_at >= ASK_KINDS:
            there = sorted({name for host in hosts for name in state.kinds[host][1]})
            near = difflib.get_close_matches(kind, there, n=CAUSES_NAMED)
            more = f" and {len(there) - KINDS_NAMED} more" if len(there) > KINDS_NAMED else ""
            known = f"there are {', '.join(there[:KINDS_NAMED])}{more}" if there else "nor any other"
            hint = f"did you mean {' or '.join(near)}?" if near else known
            self._finish(record, "given_up", f"no host has kind {kind}; {hint}")
            return
        for host in before[:AT_ONCE]:
            self.probes.add(host, record.component)
        record.reason = f"no host had kind {kind}; asking the hosts again"
        state.wake(record, record.asked_at + ASK_KINDS)

    def _start_on(self, record: ComponentRecord, chosen: RankedHost) -> None:
        state, cause = self.state, record.restart_cause
        record.enter("starting")
        record.incarnation = state.next_incarnation(record.component)
        record.host, record.superseded, record.running_since = chosen.host, False, None
        record.token, record.confirmed, record.probed, record.unanswered = False, False, False, 0
        record.reason = record.host_reason = f"{cause}; here: {chosen.reason}" if cause else chosen.reason
        state.component_arrives(record.component, record.spec.kind, chosen.host)
        state.start(record)

    def _back_off(self, record: ComponentRecord, reason: str, pause: Ns) -> None:
        record.enter("backing_off")
        record.reason = reason
        self.state.wake(record, self.state.now + pause)

    def _finish(self, record: ComponentRecord, over: ComponentState, reason: str) -> None:
        record.enter(over)
        record.reason, record.drain_reason, record.restart_cause = reason, "", ""
        record.whereabouts_unknown = False
        self.state.retire(record)

    def start_answered(self, record: ComponentRecord, answer: StartAnswered) -> None:
        """For the record's own incarnation, not a migration's target."""
        record.start_until = None
        if answer.result == "failed" and record.state != "starting":
            self.ended(record, Termination("failed", answer.reason, answer.tail, bad_params=answer.bad_params))
        elif answer.result == "ok":
            record.movable, record.confirmed = answer.movable, True
            self.runs(record)
        elif record.state == "starting":
            self._not_started(record, answer)

    def _not_started(self, record: ComponentRecord, answer: StartAnswered) -> None:
        state, host = self.state, answer.host
        if answer.result == "unknown":
            state.wake(record, state.now + state.back_off_time(record.unanswered))
            record.unanswered += 1
            record.reason = f"{host} does not say whether it started: {answer.reason or 'no answer'}"
        elif answer.result == "refused":
            record.ended_incarnations.append(record.incarnation)
            state.component_left(record)
            if answer.again:
                # Another incarnation may live there.
                state.probe(record.component, host)
            cause = f"{host} refused it: {answer.reason}"
            record.tried[host] = "" if answer.again else cause
            self.place_again(record, cause)
        else:
            end = Termination("failed", answer.reason, answer.tail, bad_params=answer.bad_params)
            self._start_failed(record, end, again=answer.again)

    def _start_failed(self, record: ComponentRecord, end: Termination, *, again: bool = True) -> None:
        """Try the next host at once, a few times."""
        host = record.host or "its host"
        record.ended_incarnations.append(record.incarnation)
        record.start_until, record.tail = None, end.tail
        self.state.component_left(record)
        cause = f"it did not start on {host}: {end.reason or end.cause}"
        record.tried[host] = "" if again else cause
        record.restarts += 1
        if end.bad_params:
            self._finish(record, "given_up", cause)
        elif not self._exhausted(record, cause):
            self.place_again(record, cause)

    def runs(self, record: ComponentRecord, *, replaced: bool = False) -> None:
        """Record that it runs; `replaced`: as another incarnation."""
        if record.state != "running" or replaced:
            record.enter("running")
            record.running_since, record.whereabouts_unknown = self.state.now, False
            record.failed_rounds, record.reason = 0, record.host_reason
            record.tried.clear()
        record.unanswered, record.start_until = 0, None
        self.watch(record)
        self.state.drain_soon(record.host)

    def watch(self, record: ComponentRecord) -> None:
        state, at = self.state, None
        if not (record.token and record.confirmed):
            at = state.now + PROBE_TIMEOUT
        elif record.restarts and record.running_since is not None:
            at = max(state.now, record.running_since + state.rules.settled)
        state.wake(record, at)

    def check(self, record: ComponentRecord) -> Termination | None:
        """Probe a component without token or confirmation; reset a settled one's restarts. Returns its end, if lost."""
        state, host = self.state, record.host
        if record.running_since is not None and state.now - record.running_since >= state.rules.settled:
            record.restarts = 0
        if record.token and record.confirmed:
            self.watch(record)
            return None
        if host is None or host not in state.alive:
            return host_gone(host)
        if record.unanswered >= MAX_PROBES and not record.token:
            self.surplus.add(record.component, record.incarnation, host)
            return Termination("lost", f"its token is gone, and {host} does not report it")
        record.unanswered += 1
        record.probed = True
        state.probe(record.component, host)
        state.wake(record, state.now + PROBE_TIMEOUT)
        return None

    def ended(self, record: ComponentRecord, end: Termination) -> None:
        state, rules = self.state, self.state.rules
        if record.state == "stopping":
            if end.cause != "lost":
                record.ended_incarnations.append(record.incarnation)
            self._stopped(record)
            return
        if record.state == "starting" and end.cause in ("failed", "lost") and not end.with_host:
            self._start_failed(record, end)
            return
        host = record.host or "its host"
        ran = state.now - record.running_since if record.running_since is not None else 0
        if end.cause != "lost":
            record.ended_incarnations.append(record.incarnation)
        elif record.host is not None and end.with_host:
            # It may come back with its host.
            self.probes.add(record.host, record.component)
        record.start_until, record.tail, record.drain_reason, record.unanswered = None, end.tail, "", 0
        state.component_left(record)
        if end.cause in ("moved", "superseded") and not record.whereabouts_unknown:
            record.whereabouts_unknown = True
            self._back_off(record, f"it moved to an unknown host ({end.cause})", GRACE)
            return
        cause = _cause(end, host)
        if end.bad_params:
            self._finish(record, "given_up", cause)
        elif end.cause == "completed" and record.spec.restart != "always":
            self._finish(record, "ended", cause)
        elif record.spec.restart == "never":
            self._finish(record, "given_up" if end.cause == "failed" else "ended", cause)
        elif end.with_host:
            record.tried.clear()
            self.place_again(record, cause)
        elif ran >= rules.settled:
            record.restarts = 0
            self.place_again(record, cause)
        else:
            pause = state.back_off_time(record.restarts)
            record.restarts += 1
            if end.cause == "completed" or not self._exhausted(record, cause):
                self._back_off(record, f"{cause}; started again after {pause / SECOND:g} s", pause)
                record.restart_cause = cause

    def _exhausted(self, record: ComponentRecord, cause: str) -> bool:
        if record.spec.restart == "never":
            self._finish(record, "given_up", cause)
        elif record.restarts >= self.state.rules.restarts:
            self._finish(record, "given_up", f"{cause}; {record.restarts} starts in a row failed")
        return record.state == "given_up"

    def end_incarnation(self, record: ComponentRecord) -> None:
        state, host = self.state, record.host
        if host is not None and host in state.alive:
            self.surplus.add(record.component, record.incarnation, host, record.start_until, token=record.token)
            state.wake(record, None)
        elif host is not None and state.now < record.not_before:
            # Inherited: its host may not have joined yet.
            state.wake(record, record.not_before)
        else:
            if host is not None:
                self.probes.add(host, record.component)
            self._stopped(record)

    def _stopped(self, record: ComponentRecord) -> None:
        record.start_until = None
        self.state.component_left(record)
        self.state.wake(record, None)
        self._check_stopped(record)

    def _check_stopped(self, record: ComponentRecord) -> None:
        """A component is stopped once its surplus incarnations have ended, too."""
        if record.host is not None or self.surplus.any(record.component):
            return
        if record.wanted:
            record.superseded = True
            self.place_again(record)
        else:
            self._finish(record, "ended", "stopped")

    def surplus_ended(self, component: ComponentId) -> None:
        record = self.state.get(component)
        if record is None or record.state != "stopping":
            return
        if record.host in self.state.alive and not self.surplus.has(component, record.incarnation):
            self._stopped(record)
        else:
            self._check_stopped(record)

    def timer(self, record: ComponentRecord) -> None:
        match record.state:
            case "backing_off" if record.whereabouts_unknown:
                record.whereabouts_unknown = False
                self.ended(record, Termination("lost", "it moved, and no host has reported it since"))
            case "waiting" | "backing_off":
                self.place_again(record, record.restart_cause)
            case "starting":
                self._repeat_start(record)
            case "running":
                if (end := self.check(record)) is not None:
                    self.ended(record, end)
            case "stopping":
                self.end_incarnation(record)
            case _:
                self.state.forget(record.component)

    def _repeat_start(self, record: ComponentRecord) -> None:
        host = record.host
        if host is None or host not in self.state.alive:
            self.ended(record, host_gone(host or "the host of its start"))
        elif record.start_until is not None:
            self.start_answered(record, StartAnswered(record.component, record.incarnation, host, "unknown"))
        else:
            self.state.start(record)


def _cause(end: Termination, host: HostName) -> str:
    match end.cause:
        case "completed":
            return f"it completed on {host}" + (f": {end.reason}" if end.reason else "")
        case "failed":
            return f"it failed on {host}: {end.reason or 'no reason given'}"
        case "stopped":
            return f"it was stopped on {host}, and not by the placer"
        case _:
            return end.reason
