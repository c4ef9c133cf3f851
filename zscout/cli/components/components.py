"""`zscout component list` and `kinds`: components, where they run, and what each host can start."""

from __future__ import annotations

from contextlib import AsyncExitStack, suppress
from typing import TYPE_CHECKING, Any, Final

import click

from zscout import terminal
from zscout.cli import common, completion
from zscout.cli.components.placing import COMPONENT, ask_nodes, placement_object, placer_of, tail_of, unknown_here
from zscout.cli.fleet.fleet_view import FIND_LOADS_S, FleetView, see_hosts
from zscout.cli.fleet.watching import Overview, show
from zscout.config.strict import BadInput
from zscout.keyexpr import Role
from zscout.messages import ComponentUse, ListComponents, Placement
from zscout.terminal import Table
from zscout.types import SECOND, Ns

if TYPE_CHECKING:
    from zscout.behaviors.client.client import Client

STYLES: Final = {"running": "green", "waiting": "yellow", "backing_off": "yellow", "ended": "dim", "given_up": "red"}


@click.command()
@click.argument("name", type=COMPONENT, required=False, shell_complete=completion.components)
@click.option("--kinds", "only_kinds", is_flag=True, hidden=True, help="The same as zscout component kinds.")
@click.option("--watch", is_flag=True, help="Update the list until q or Ctrl-C.")
@common.json_option("Print one JSON object; with --watch, one on each line.")
@common.runs
async def components(name: str | None, only_kinds: bool, watch: bool, as_json: bool) -> None:
    """List the components of the fleet: where each runs, since when, what it uses, and why it is there.

    Ended components are listed for an hour. RESTARTS counts restarts in a row; CORES and MEMORY include all
    processes of the component; MOVES shows how long the last move took. With NAME the list has that component
    alone, and the end of its output if it failed. Exit code 3: no leader.

    \b
    Examples:
      zscout component list
      zscout component list --watch
      zscout component list counter --json | jq -r .components[0].host
    """
    if only_kinds:
        if name is not None or watch:
            raise BadInput("--kinds takes no NAME and no --watch; leave them out")
        await _kinds(as_json=as_json)
        return
    async with AsyncExitStack() as stack:
        listing = Listing(await stack.enter_async_context(common.connected("components")), name)
        placer = stack.enter_context(listing.placer)
        stack.enter_context(listing.fleet_view)
        await listing.find()
        await show(listing, placer.changed, listing.refresh, watch=watch, as_json=as_json)
        if name is not None and not (watch or as_json) and (tail := tail_of(placer.placements[name])):
            for line in ("", "The end of its output:", *tail):
                terminal.print_line(line)


@click.command()
@common.json_option("Print one JSON object.")
@common.runs
async def kinds(as_json: bool) -> None:
    """List the kinds of component that can be started, and the hosts that have each.

    \b
    Examples:
      zscout component kinds
      zscout component kinds --json | jq -r '.hosts[].kinds[]'
    """
    await _kinds(as_json=as_json)


class Listing:
    def __init__(self, client: Client, name: str | None) -> None:
        self.client, self.name = client, name
        self.placer = placer_of(client, None if name is None else {name})
        self.fleet_view = FleetView(client)
        self._began: dict[tuple[str, int], Ns] = {}
        """Start of each running incarnation, on this host's clock."""

    async def find(self) -> None:
        """Wait for the components and their hosts' load reports. Raises NobodyThere; Failed if `name` is unknown."""
        await self.placer.refresh()
        if self.name is not None and self.name not in self.placer.placements:
            raise await unknown_here(self.placer, self.name)
        hosts = {placement.host for placement in self._running()}

        def reported() -> bool:
            found = [self.fleet_view.hosts.get(host or "") for host in hosts]
            return all(host is not None and (host.load or not host.has(Role.LOAD)) for host in found)

        if hosts:
            await self.fleet_view.ask_loads()
        await common.until(reported, self.fleet_view.changed, FIND_LOADS_S)
        await self.find_ages()

    async def refresh(self) -> None:
        # Without a leader the last known state stays on the screen.
        await self.placer.try_refresh()
        await self.find_ages()

    async def find_ages(self) -> None:
        """Ask the nodes for the uptime of running components whose start is not known yet."""
        running = {(placement.component, placement.incarnation) for placement in self._running()}
        self._began = {key: began for key, began in self._began.items() if key in running}
        if running <= self._began.keys():
            return
        for node in await ask_nodes(self.client.mesh, ListComponents(self.name)):
            now = self.client.mesh.now()
            for view in node.components:
                key = (view.component, view.incarnation)
                if key in running:
                    self._began[key] = now - round(view.uptime * SECOND)

    def overview(self) -> Overview:
        rows, styles = [], [STYLES.get(placement.state, "") for placement in self._all()]
        for placement in self._all():
            use, up = self._use(placement), self._uptime(placement)
            where = f"{placement.host or '-'} > {placement.to}" if placement.to is not None else placement.host or "-"
            since = "-" if up is None else f"{terminal.clock(-up)} ({terminal.span(up)})"
            moves = str(placement.moves) + (f" ({placement.dead * 1000:.0f} ms)" if placement.dead is not None else "")
            cores, memory = ("-", "-") if use is None else (f"{use.cpu:.2f}", f"{use.memory / 2**20:.0f} MiB")
            state = (placement.component, placement.spec.kind, placement.state.replace("_", " "), where, since)
            rows.append((*state, str(placement.restarts), moves, cores, memory, placement.reason))
        columns = ("NAME", "KIND", "STATE", "HOST", "UP", "RESTARTS", "MOVES", "CORES", "MEMORY", "WHY")
        table = Table("Components", columns, rows, styles, ("RESTARTS", "MOVES", "KIND"))
        running = self._running()
        hosts = len({placement.host for placement in running})
        on = f" on {terminal.many(hosts, 'host')}" if running else ""
        cordoned = f"; cordoned: {', '.join(sorted(self.placer.cordoned))}" if self.placer.cordoned else ""
        headline = f"Fleet {self.client.fleet.name}: {len(running)} of {len(self._all())} run{on}{cordoned}"
        return Overview(headline, [table])

    def as_object(self) -> dict[str, Any]:
        """Return the object of `--json`: `cpu` in cores, `memory` in bytes, durations in seconds."""
        found = []
        for placement in self._all():
            use = self._use(placement)
            used = {name: getattr(use, name, None) for name in ("cpu", "memory", "processes")}
            found.append(placement_object(placement) | {"uptime": self._uptime(placement), **used})
        cordoned = sorted(self.placer.cordoned)
        return {"fleet": self.client.fleet.name, "components": found, "cordoned": cordoned}

    def _all(self) -> list[Placement]:
        return [placement for _, placement in sorted(self.placer.placements.items())]

    def _running(self) -> list[Placement]:
        return [placement for placement in self._all() if placement.state in ("running", "moving")]

    def _use(self, placement: Placement) -> ComponentUse | None:
        host = self.fleet_view.hosts.get(placement.host or "")
        if host is None or host.load is None or self.fleet_view.stale(host):
            return None
        uses = (use for use in host.load.components if use.component == placement.component)
        return next((use for use in uses if use.incarnation == placement.incarnation), None)

    def _uptime(self, placement: Placement) -> float | None:
        began = self._began.get((placement.component, placement.incarnation))
        return None if began is None else (self.client.mesh.now() - began) / SECOND


async def _kinds(*, as_json: bool) -> None:
    async with common.connected("components", need_rcm=False) as client:
        with suppress(common.NobodyThere):
            await common.see_rcm(client)
        await see_hosts(client)
        nodes = await ask_nodes(client.mesh, ListComponents())
        fleet = client.fleet.name
    if not nodes:
        raise common.NobodyThere(f"no node of fleet {fleet} answered; start zscout-node, or see its log")
    if as_json:
        hosts = [{"host": node.host, "kinds": sorted(node.kinds or ())} for node in nodes]
        terminal.print_json({"fleet": fleet, "hosts": hosts})
        return
    kinds = sorted({kind for node in nodes for kind in node.kinds or ()})
    rows = [(kind, ", ".join(node.host for node in nodes if kind in (node.kinds or ()))) for kind in kinds]
    without_kinds = [node.host for node in nodes if not node.kinds]
    without = f"; none on {', '.join(without_kinds)}" if without_kinds else ""
    headline = f"Fleet {fleet}: {len(kinds)} kinds can be started{without}"
    Overview(headline, [Table("Kinds", ("KIND", "ON"), rows)]).print()
