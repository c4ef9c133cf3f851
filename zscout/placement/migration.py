"""Migration of running components: on request, off a drained host, or because it pays (`rebalancing`).

A standby starts on the target, then the source hands over to it. On any failure one of the two continues; where no
answer decides which, both hosts are probed."""

from __future__ import annotations

from typing import Final

from zscout.messages import Phase
from zscout.placement.balancer import MAX_HOSTS
from zscout.placement.events import MoveAnswered, StartAnswered
from zscout.placement.lifecycle import Lifecycle
from zscout.placement.state import PROBE_TIMEOUT, ComponentRecord, Migration, PlacementState, Termination, TimerKind
from zscout.types import SECOND, ComponentId, HostName, Ns

MAX_STARTS: Final = 3
"""Unanswered starts of the standby."""
HAND_OVER_TIMEOUT: Final[Ns] = 30 * SECOND
"""After this both hosts are probed."""
MAX_PROBES: Final = 3
MAX_PATIENT_PROBES: Final = 15
"""Unanswered probes of a running source or a standby, which may still be busy; a standby ends itself after 30 s."""
RETRY: Final[Ns] = 5 * SECOND
"""Pause after a failed move off a drained host."""
MOVES_PER_HOST: Final = 2


class Migrations:
    def __init__(self, state: PlacementState, lifecycle: Lifecycle) -> None:
        self.state, self.lifecycle = state, lifecycle
        self.maintained: frozenset[HostName] = frozenset()  # hosts in maintenance

    def request(self, component: ComponentId, to: HostName | None) -> None:
        state = self.state
        record = state.known(component)
        if record is None:
            return
        if record.migration is not None:
            if to in (None, record.migration.to):
                state.mark_changed(component, always=True)
            else:
                message = f"{component} is already moving to {record.migration.to}; wait until it is there"
                state.refuse(component, "move_failed", message)
        elif record.state != "running":
            message = f"{component} is not running, it is {record.state.replace('_', ' ')}"
            state.refuse(component, "not_running", message)
        elif to == record.host:
            state.mark_changed(component, always=True)
        elif not record.movable and not record.confirmed:
            message = f"{component} has just started: it is not yet known whether {record.host} can move it"
            state.refuse(component, "busy", f"{message}; ask again")
        elif not record.movable:
            state.refuse(component, "not_movable", f"{component} can't be moved: its kind has no checkpoint()")
        else:
            hosts, why_none = state.eligible_hosts(record.spec, other_than=record.host, only=to)
            if hosts:
                self.begin(record, hosts[0].host, "as asked")
                state.mark_changed(component, always=True)
            elif to is not None:
                state.refuse(component, "unknown_host", f"{component} can't move there: {why_none}")
            else:
                message = f"no other host will do for {component}: {why_none}"
                state.refuse(component, "move_failed", message)

    def begin(self, record: ComponentRecord, to: HostName, why: str) -> None:
        """Move a running, movable record to an eligible host. `why`: in words."""
        state = self.state
        record.enter("moving")
        record.migration = Migration(to, state.next_incarnation(record.component), why)
        record.reason, record.drain_reason = f"moving to {to}, {why}", ""
        state.component_arrives(_reservation(record), record.spec.kind, to)
        state.start(record, record.migration)

    def target_answered(self, record: ComponentRecord, move: Migration, answer: StartAnswered) -> None:
        if move.stage != "starting":
            return
        move.start_until = None
        match answer.result:
            case "ok":
                move.stage, move.tries, move.target = "handing_over", 0, "standby"
                self.state.wake_migration(record, self.state.now + HAND_OVER_TIMEOUT)
                self.state.hand_over(record, move)
                if not record.token:
                    self._probe(record, move)
            case "unknown":
                self._target_silent(record, move, answer.reason or "it does not answer")
            case _:
                move.target = "ended"
                self._stay(record, move, f"{answer.result}: {answer.reason}")

    def _target_silent(self, record: ComponentRecord, move: Migration, reason: str) -> None:
        move.start_until = None
        move.tries += 1
        if move.tries >= MAX_STARTS:
            self._stay(record, move, reason)
        else:
            self.state.wake_migration(record, self.state.now + self.state.back_off_time(move.tries - 1))

    def target_appeared(self, record: ComponentRecord, move: Migration) -> None:
        """The target has taken over; the source soon reports the dead time."""
        move.token, move.target = True, "running"
        if move.stage == "handing_over" and move.source == "running":
            self.state.wake_migration(record, self.state.now + PROBE_TIMEOUT)
        else:
            self._finish(record, move)

    def target_listed(self, record: ComponentRecord, move: Migration, phase: Phase) -> None:
        if phase in ("running", "stopping"):
            move.target = "running"
            if move.stage == "starting":
                self._finish(record, move)
            elif move.stage == "probing":
                self._judge(record, move)
        elif phase == "standby" and move.stage == "starting":
            self.target_answered(record, move, StartAnswered(record.component, move.incarnation, move.to, "ok"))
        elif phase == "standby" and move.stage == "probing":
            move.target = "standby"
            self._judge(record, move)

    def target_ended(self, record: ComponentRecord, move: Migration, reason: str) -> None:
        move.target, move.token = "ended", False
        if move.stage == "starting":
            self._stay(record, move, reason)
        elif move.stage == "probing":
            self._judge(record, move)

    def target_host_lost(self, record: ComponentRecord, move: Migration) -> None:
        if move.source == "ended":
            self._lose(record, move)
        else:
            self._stay(record, move, f"the node of {move.to} is gone")

    def answered(self, record: ComponentRecord, move: Migration, answer: MoveAnswered) -> None:
        if move.stage == "starting":
            return
        if answer.result == "moved":
            move.source = "ended"
            self._finish(record, move, answer.dead)
        elif answer.result == "unknown" or move.token:
            # Refused although the target took over: ask which of the two runs.
            self._probe(record, move)
        else:
            self._stay(record, move, answer.reason)

    def source_ended(self, record: ComponentRecord, move: Migration, end: Termination) -> None:
        if move.stage == "starting":
            self.cancel(record)
            self.lifecycle.ended(record, end)
            return
        move.source, move.termination = "ended", end
        if end.cause == "moved" or move.target == "running":
            self._finish(record, move)
        else:
            self._probe(record, move)

    def source_vanished(self, record: ComponentRecord, move: Migration) -> None:
        """The source's token is gone: usually after a handover, with its answer on the way."""
        if move.stage == "starting":
            record.unanswered = 0
            self.source_timer(record, move)
        elif move.stage == "handing_over":
            self.state.wake_migration(record, self.state.now + PROBE_TIMEOUT)

    def source_timer(self, record: ComponentRecord, move: Migration) -> None:
        if move.stage == "starting" and (end := self.lifecycle.check(record)) is not None:
            self.source_ended(record, move, end)

    def source_runs(self, record: ComponentRecord, move: Migration) -> None:
        if move.stage == "probing":
            move.source = "running"
            self._judge(record, move)

    def _probe(self, record: ComponentRecord, move: Migration) -> None:
        state = self.state
        if move.stage != "probing":
            move.stage, move.tries = "probing", 0
        move.tries += 1
        if move.source != "ended":
            move.source = "unknown"
            state.probe(record.component, record.host)
        if not move.token and move.target != "ended":
            move.target = "unknown"
            state.probe(record.component, move.to)
        state.wake_migration(record, state.now + PROBE_TIMEOUT)
        self._judge(record, move)

    def _judge(self, record: ComponentRecord, move: Migration) -> None:
        match move.source, move.target:
            case _, "running":
                self._finish(record, move)
            case "ended", "ended":
                self._lose(record, move)
            case "ended", "standby" if move.tries > 1 or (move.termination and move.termination.with_host):
                self._lose(record, move)
            case "running", "ended":
                self._stay(record, move, "the standby there has ended")
            case _:
                pass

    def timer(self, record: ComponentRecord, move: Migration) -> None:
        patient = (move.source, move.target) == ("running", "standby")
        probes = MAX_PATIENT_PROBES if patient else MAX_PROBES
        if move.stage == "starting" and move.start_until is not None:
            self._target_silent(record, move, "it does not answer")
        elif move.stage == "starting":
            self.state.start(record, move)
        elif move.stage == "handing_over" or move.tries < probes:
            self._probe(record, move)
        elif move.source == "ended":
            self._lose(record, move)
        else:
            self._stay(record, move, "neither host reported the outcome")

    def _finish(self, record: ComponentRecord, move: Migration, dead: float | None = None) -> None:
        state, old, source, token = self.state, record.incarnation, record.host, record.token
        self._close(record, move)
        state.component_left(record)
        if move.source == "ended" or source is None:
            record.ended_incarnations.append(old)
        else:
            self.lifecycle.surplus.add(record.component, old, source, token=token)
        record.incarnation, record.host, record.token = move.incarnation, move.to, move.token
        record.moves += 1
        record.dead = dead
        record.start_until, record.confirmed, record.probed = None, True, False
        record.host_reason = f"moved from {source}, {move.why}"
        state.component_arrives(record.component, record.spec.kind, move.to)
        self.lifecycle.runs(record, replaced=True)
        state.drain_soon(source)

    def _stay(self, record: ComponentRecord, move: Migration, reason: str) -> None:
        self.cancel(record, stop_standby=move.target != "ended")
        record.reason = f"it did not move to {move.to}, {move.why}: {reason}"
        record.unanswered = 0
        self.lifecycle.watch(record)
        self.state.drain_soon(record.host)

    def _lose(self, record: ComponentRecord, move: Migration) -> None:
        """Both ended; the lifecycle restarts the component if it is still wanted."""
        self.cancel(record)
        self.lifecycle.ended(record, move.termination or Termination("lost", "it was lost while it moved"))

    def cancel(self, record: ComponentRecord, *, stop_standby: bool = True) -> None:
        move = record.migration
        if move is None:
            return
        self._close(record, move)
        if stop_standby:
            self.lifecycle.surplus.add(record.component, move.incarnation, move.to, move.start_until, token=move.token)

    def _close(self, record: ComponentRecord, move: Migration) -> None:
        state = self.state
        state.balancer.gone(_reservation(record))
        state.rankings.invalidate(move.to)
        record.migration, record.not_before = None, state.now + RETRY
        record.enter("running")
        state.wake_migration(record, None)

    def drain(self, host: HostName) -> None:
        """Drain a host. An unknown one is refused: it is likely a typo."""
        state = self.state
        cordoned = state.balancer.cordoned
        if host not in cordoned:
            if host not in state.alive and host not in state.balancer.reports:
                state.refuse(host, "unknown_host", f"unknown host {host}; zscout status lists all")
                return
            if len(cordoned) >= MAX_HOSTS:
                state.refuse(
                    host,
                    "too_many",
                    f"{len(cordoned)} hosts are drained, the most allowed; use one again with zscout uncordon",
                )
                return
        self._cordon(host)

    def maintain(self, hosts: frozenset[HostName]) -> None:
        """Hosts are drained while they are in maintenance, known or not."""
        before, self.maintained = self.maintained, hosts
        for host in sorted(hosts - before):
            self._cordon(host)
        for host in sorted(before - hosts):
            self.uncordon(host)

    def _cordon(self, host: HostName) -> None:
        self.state.balancer.cordoned.add(host)
        self.state.rankings.begin(self.state.now)
        self.state.drain_soon(host)

    def uncordon(self, host: HostName) -> None:
        state = self.state
        if host in self.maintained:
            state.refuse(host, "in_maintenance", f"{host} is in maintenance; end that with zscout booking cancel")
            return
        state.balancer.cordoned.discard(host)
        state.rankings.begin(state.now)
        for record in state.components.values():
            if record.state == "waiting":
                state.wake(record, max(state.now, record.not_before))
            elif record.host == host and record.drain_reason:
                record.drain_reason = ""
                state.mark_changed(record.component)

    def drain_timer(self) -> None:
        on: dict[HostName, list[ComponentRecord]] = {}
        for record in self.state.components.values():
            if record.host in self.state.balancer.cordoned and record.state in ("running", "moving"):
                on.setdefault(record.host, []).append(record)
        for host in sorted(on):
            self._empty(host, on[host])

    def _empty(self, host: HostName, records: list[ComponentRecord]) -> None:
        """Move components that may go now, and note why the rest stay."""
        state = self.state
        room = MOVES_PER_HOST - sum(record.migration is not None for record in records)
        names = [(record.component, record.spec.kind) for record in records if record.migration is None]
        for component in state.balancer.heaviest_first(names):
            record = state.components[component]
            state.mark_changed(component)
            if not record.movable:
                record.drain_reason = f"it can't be moved; {host} is drained"
            elif record.not_before <= state.now and room > 0:
                hosts, why_none = state.eligible_hosts(record.spec, other_than=host)
                if hosts:
                    room -= 1
                    self.begin(record, hosts[0].host, f"{host} is drained")
                else:
                    record.not_before = state.now + RETRY
                    record.drain_reason = f"{host} is drained, and no other host will do: {why_none}"
        if any(record.movable and record.migration is None for record in records):
            state.timers.set(TimerKind.DRAIN, "", state.now + RETRY)


def _reservation(record: ComponentRecord) -> ComponentId:
    """The name under which a move reserves room on its target. With its blanks it can't be a component's own name."""
    return f"{record.component} on its way"
