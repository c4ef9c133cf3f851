"""Decides which incarnation of a component counts, by tokens, hosts' lists and earlier placements, and handles hosts
that come or die. Of two live incarnations the higher counts; the lower is stopped."""

from __future__ import annotations

from typing import Final

from zscout.messages import ComponentState, ComponentView, Incarnation, Placement
from zscout.placement.events import ComponentsListed, TokenAppeared, TokenVanished
from zscout.placement.lifecycle import GRACE, Lifecycle
from zscout.placement.migration import Migrations
from zscout.placement.state import OVER, PROBE_TIMEOUT, ComponentRecord, NoHost, PlacementState, Termination, host_gone
from zscout.types import ComponentId, HostName

RUNNING: Final = ("running", "stopping")
"""Phases in a host's list that count as running."""


class Reconciler:
    def __init__(self, state: PlacementState, lifecycle: Lifecycle, migrations: Migrations) -> None:
        self.state, self.lifecycle, self.migrations = state, lifecycle, migrations
        self.surplus, self.probes = lifecycle.surplus, lifecycle.probes

    def appeared(self, token: TokenAppeared) -> None:
        state, component, incarnation, host = self.state, token.component, token.incarnation, token.host
        record = state.get(component)
        if not state.note_incarnation(component, incarnation):
            return
        self.surplus.token(component, incarnation, alive=True)
        if record is None or host not in state.alive:
            # If its node's token is late, the host is probed when it joins.
            self.probes.add(host, component)
        if record is None:
            return
        if incarnation in record.ended_incarnations:
            # A late report, or it started after its stop.
            self.surplus.add(component, incarnation, host, token=True)
        elif (move := record.migration) is not None and incarnation == move.incarnation:
            self.migrations.target_appeared(record, move)
        elif incarnation != record.incarnation or record.superseded:
            self._other_runs(record, incarnation, host, token=True)
        elif self._must_not_live(record):
            self.surplus.add(component, incarnation, host, token=True)
        elif self._can_be_at(record, host):
            record.token = True
            if record.migration is None and record.state != "stopping":
                self.lifecycle.runs(record)
        elif host in state.alive:
            self._given_twice(record, host, token=True)

    def vanished(self, token: TokenVanished) -> None:
        """A component has ended, for a cause that its host reports; or the network hides its token for a while."""
        component, incarnation = token.component, token.incarnation
        record = self.state.get(component)
        self.surplus.token(component, incarnation, alive=False)
        self.lifecycle.surplus_ended(component)
        if record is None:
            return
        move = record.migration
        if (incarnation, token.host) == (record.incarnation, record.host):
            record.token = False
            if move is not None:
                self.migrations.source_vanished(record, move)
            elif record.state == "running":
                record.unanswered = 0
                self.lifecycle.timer(record)
        elif move is not None and incarnation == move.incarnation:
            move.token, move.target = False, "unknown"

    def _given_twice(self, record: ComponentRecord, host: HostName, *, token: bool) -> None:
        """Two separated placers gave one number twice. Of two live incarnations the greater host's continues, as the
        hosts decide too when they meet."""
        state, other = self.state, record.host
        if other is None or other == host:
            return
        lives = record.token or record.confirmed
        if record.state == "stopping" or (lives and host < other):
            state.stop(record.component, record.incarnation, host)
            return
        if lives:
            state.stop(record.component, record.incarnation, other)
        self._is_at(record, record.incarnation, host, token=token)
        record.confirmed = not token

    def _is_at(self, record: ComponentRecord, incarnation: Incarnation, host: HostName, *, token: bool) -> None:
        self.migrations.cancel(record)
        self.state.component_left(record)
        record.incarnation, record.host, record.token, record.confirmed = incarnation, host, token, False
        record.superseded = False
        record.host_reason = f"found running on {host}"
        self.lifecycle.runs(record, replaced=True)

    def _must_not_live(self, record: ComponentRecord) -> bool:
        """Return True if its incarnation ended, or is being stopped and its host was believed gone."""
        return record.state in OVER or (record.state == "stopping" and record.host is None)

    def _can_be_at(self, record: ComponentRecord, host: HostName) -> bool:
        """Return True if the incarnation can be at that host. If its host was unknown, record this one."""
        if record.host is None and host in self.state.alive:
            record.host = host
            record.host_reason = f"found running on {host}"
        return record.host == host

    def _other_runs(self, record: ComponentRecord, incarnation: Incarnation, host: HostName, *, token: bool) -> None:
        if self.surplus.has(record.component, incarnation):
            return
        stopped = record.state == "stopping" or record.state in OVER
        if stopped or incarnation < record.incarnation + record.superseded:
            self.surplus.add(record.component, incarnation, host, token=token)
            return
        if host not in self.state.alive:
            return
        if record.host is not None:
            self.surplus.add(record.component, record.incarnation, record.host, record.start_until, token=record.token)
        self._is_at(record, incarnation, host, token=token)

    def listed(self, listing: ComponentsListed) -> None:
        state, host, only = self.state, listing.host, listing.only
        # A list sent before the host was lost is no answer.
        answered = self.probes.answered(host, only) if host in state.alive else []
        if listing.kinds is not None:
            state.set_kinds(host, listing.kinds)
        for view in listing.components:
            if only in (None, view.component):
                self._listed(host, view)
        present = {(view.component, view.incarnation) for view in listing.components}
        for record in self._on(host) if only is None else filter(None, [state.components.get(only)]):
            self._not_listed(record, listing, present)
        for name in answered:
            waiting = state.components.get(name)
            if waiting is not None and waiting.state == "waiting":
                state.wake(waiting, state.now)

    def _on(self, host: HostName) -> list[ComponentRecord]:
        return [
            record
            for record in self.state.components.values()
            if record.host == host or (record.migration is not None and record.migration.to == host)
        ]

    def _listed(self, host: HostName, listed: ComponentView) -> None:
        state, component, incarnation = self.state, listed.component, listed.incarnation
        if not state.note_incarnation(component, incarnation):
            return
        record = state.get(component)
        if record is None:
            self._adopt(host, listed)
        elif listed.phase == "ended":
            self._listed_as_ended(record, host, listed)
        elif incarnation in record.ended_incarnations:
            self.surplus.add(component, incarnation, host)
        elif (move := record.migration) is not None and incarnation == move.incarnation:
            self.migrations.target_listed(record, move, listed.phase)
        elif incarnation == record.incarnation and not record.superseded:
            self._listed_alive(record, host, listed)
        elif listed.phase in RUNNING or (listed.phase == "starting" and incarnation < record.incarnation):
            # A starting incarnation may become a standby: once it runs, its token appears.
            self._other_runs(record, incarnation, host, token=False)

    def _adopt(self, host: HostName, listed: ComponentView) -> None:
        record = ComponentRecord(listed.component, listed.spec, "starting", listed.incarnation, host=host)
        if listed.phase in ("ended", "standby") or host not in self.state.alive or not self.state.add(record):
            return
        running = listed.phase in RUNNING
        record.movable, record.confirmed = listed.movable, running
        record.host_reason = f"found running on {host}"
        if running:
            self.lifecycle.runs(record)
        else:
            record.reason = f"found starting on {host}"
            self.state.start(record)

    def _listed_alive(self, record: ComponentRecord, host: HostName, listed: ComponentView) -> None:
        if self._must_not_live(record):
            if listed.phase != "standby":
                self.surplus.add(record.component, listed.incarnation, host)
        elif record.state != "stopping" and listed.phase != "standby" and self._can_be_at(record, host):
            if listed.phase in RUNNING:
                record.movable, record.confirmed = listed.movable, True
                record.unanswered, record.probed = 0, False
                if record.migration is not None:
                    self.migrations.source_runs(record, record.migration)
                else:
                    self.lifecycle.runs(record)
            elif record.state in ("waiting", "backing_off"):
                record.enter("starting")
                self.state.start(record)
        elif listed.phase in RUNNING and host in self.state.alive:
            self._given_twice(record, host, token=False)

    def _listed_as_ended(self, record: ComponentRecord, host: HostName, listed: ComponentView) -> None:
        move, incarnation = record.migration, listed.incarnation
        end = Termination(listed.ended or "lost", listed.reason, listed.tail, bad_params=listed.bad_params)
        if self.surplus.has(record.component, incarnation):
            self.surplus.ended(record.component, incarnation)
            self.lifecycle.surplus_ended(record.component)
        elif incarnation in record.ended_incarnations and record.host is None:
            pass
        elif move is not None and incarnation == move.incarnation:
            record.ended_incarnations.append(incarnation)
            self.migrations.target_ended(record, move, f"the standby there has ended: {end.reason or end.cause}")
        elif incarnation != record.incarnation or record.superseded or record.state in OVER:
            pass
        elif move is not None:
            self.migrations.source_ended(record, move, end)
        elif record.host in (host, None):
            record.host = host
            self.lifecycle.ended(record, end)

    def _not_listed(
        self, record: ComponentRecord, listing: ComponentsListed, present: set[tuple[ComponentId, Incarnation]]
    ) -> None:
        """A missing incarnation is gone, unless a token or an unanswered start is newer than the list."""
        state, move, host = self.state, record.migration, listing.host
        if (
            move is not None
            and move.to == host
            and (record.component, move.incarnation) not in present
            and move.stage == "probing"
            and not move.token
        ):
            state.mark_changed(record.component)
            self.migrations.target_ended(record, move, "the standby there is gone")
        if record.host != host or (record.component, record.incarnation) in present:
            return
        asked = record.probed or listing.only is None
        if record.token or record.start_until is not None or not asked:
            return
        end = Termination("lost", f"{host} knows nothing of it any more")
        state.mark_changed(record.component)
        if record.migration is not None:
            self.migrations.source_ended(record, record.migration, end)
        elif record.state == "running":
            self.lifecycle.ended(record, end)

    def host_joined(self, host: HostName) -> None:
        state = self.state
        if host in state.alive:
            return
        state.alive.add(host)
        state.last_change[host] = state.now
        state.drain_soon(host)
        self.probes.host_joined(host)
        for record in state.components.values():
            if record.state == "waiting":
                if self.probes.has(host, record.component):
                    # It may still run there, which is better than a restart.
                    record.not_before = state.now + PROBE_TIMEOUT
                state.wake(record, max(state.now, record.not_before))
            elif record.state == "stopping" and record.host == host:
                self.lifecycle.end_incarnation(record)
            elif record.state == "running" and record.host == host:
                # Its list or token is about to arrive.
                state.wake(record, state.now + GRACE)

    def host_lost(self, host: HostName) -> None:
        """End its components; they are probed if the host returns, as its node may only have been silent."""
        state = self.state
        state.alive.discard(host)
        state.last_change.pop(host, None)
        state.departed.pop(host, None)
        for component in self.surplus.host_lost(host):
            self.probes.add(host, component)
            self.lifecycle.surplus_ended(component)
        for record in self._on(host):
            state.mark_changed(record.component)
            self.probes.add(host, record.component)
            move = record.migration
            if move is None:
                self.lifecycle.ended(record, host_gone(host))
            elif move.to == host:
                self.migrations.target_host_lost(record, move)
            else:
                self.migrations.source_ended(record, move, host_gone(host))

    def inherited(self, status: Placement) -> None:
        """Take over a published placement, until a host contradicts it, or none confirms it within GRACE."""
        state = self.state
        if not state.note_incarnation(status.component, status.incarnation):
            return
        record = state.get(status.component)
        if record is not None:
            # A host reported first, but only the placement has the stop request.
            if not status.wanted and record.wanted and record.state not in OVER:
                self.migrations.cancel(record)
                self.lifecycle.stop(record)
            return
        moved = status.state == "moving"
        stands: ComponentState = "running" if moved else status.state
        host = status.host if stands in ("starting", "running", "stopping") else None
        record = ComponentRecord(status.component, status.spec, stands, status.incarnation, host=host)
        if not state.add(record):
            return
        record.reason = f"it was to move to {status.to}" if moved else status.reason
        record.host_reason, record.tail, record.wanted = status.reason, status.tail, status.wanted
        if stands == "waiting":
            record.no_host = NoHost(), record.reason  # it keeps that reason while no host is known
        record.movable, record.restarts = status.movable, status.restarts
        record.moves, record.dead = status.moves, status.dead
        record.running_since = state.now if stands == "running" else None
        record.not_before = state.now + GRACE
        if stands in OVER:
            state.retire(record)
        else:
            state.wake(record, record.not_before)
