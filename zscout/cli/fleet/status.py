"""`zscout status`: who holds what, who waits and why, how the hosts are, who leads."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from typing import Any

import click
from msgspec import structs

from zscout.cli import common
from zscout.cli.fleet.devices import Devices
from zscout.cli.fleet.fleet_view import FleetView, Host
from zscout.cli.fleet.overview import Overview, fleet_overview
from zscout.cli.fleet.watching import display_for, pause, show_once
from zscout.keyexpr import Role
from zscout.mesh import clock
from zscout.messages import Notice, RcmState
from zscout.types import SECOND, Ns


@click.command()
@click.option("--watch", is_flag=True, help="Go on showing it; q or Ctrl-C ends.")
@click.option(
    "--devices", "every", is_flag=True, help="Show the figures of all devices: rates, drops, latency."
)
@common.json_option("Print one JSON object; with --watch, one on each line.")
def status(watch: bool, every: bool, as_json: bool) -> None:
    """Show the fleet: RCs and who holds them, ARCs that run and that wait, hosts and their loads.

    The queue stands in rank order, each ARC with what it waits for. Candidates that the fleet file names are
    shown even where they are not there; other hosts that died only with --watch. A device that says that
    something is wrong with it is shown with its words, and counts as lost until it is well. --watch refreshes
    once a second; in a pipe it prints a new block when something else than a load, a time or a figure has
    changed. Exit code 3: no RCM.

    \b
    Examples:
      zscout status
      zscout status --json | jq -r '.queue[] | .arc + ": " + .reason'
      zscout status --devices --watch
    """
    common.run(_watch(every, as_json) if watch else _once(every, as_json))


async def _once(every: bool, as_json: bool) -> None:
    async with common.connected("status", need_rcm=False) as client:
        fleet_view = FleetView(client)
        devices = Devices(fleet_view)
        state, nobody = await _first(fleet_view)
        await devices.ask()
        show_once(Standing(fleet_view, state, devices, every), as_json=as_json)
        if nobody is not None:
            raise nobody


async def _first(fleet_view: FleetView) -> tuple[RcmState | None, common.NobodyThere | None]:
    """The state, or the error where there is none: hosts and RCs are shown all the same."""
    try:
        return await fleet_view.settled(), None
    except common.NobodyThere as nobody:
        return None, nobody


async def _watch(every: bool, as_json: bool) -> None:
    news, stop = asyncio.Event(), asyncio.Event()

    def end() -> None:
        stop.set()
        news.set()

    async with AsyncExitStack() as stack:
        client = await stack.enter_async_context(common.connected("status", need_rcm=False))
        fleet_view = FleetView(client)
        stack.callback(fleet_view.close)
        devices = Devices(fleet_view)
        stack.callback(devices.close)
        # Whatever becomes of an ARC is published to its client.
        notices = client.mesh.subscribe(client.mesh.keys.notice_any, Notice, lambda _key, _notice: news.set())
        stack.callback(notices.close)
        show = display_for(stack, as_json=as_json, end=end)
        state, _ = await _first(fleet_view)
        while not stop.is_set():
            fleet_view.forget_gone()
            await devices.ask()
            show(Standing(fleet_view, state, devices, every))
            await pause(news, stop)
            state = await client.state(forecast=True)


# What is shown


@dataclass(frozen=True, slots=True)
class Standing:
    """How the fleet stands; `state` is None where there is no RCM. `every`: with figures of all devices."""

    fleet_view: FleetView
    state: RcmState | None
    devices: Devices
    every: bool

    def overview(self) -> Overview:
        lost = frozenset(rc for rc in self.devices.living() if self.devices.ill(rc))
        overview = fleet_overview(self.fleet_view, self.state, lost)
        return replace(overview, tables=[*overview.tables, self.devices.table(every=self.every)])

    def as_object(self) -> dict[str, Any]:
        return as_object(self.fleet_view, self.state, self.devices)


def as_object(fleet_view: FleetView, state: RcmState | None, devices: Devices) -> dict[str, Any]:
    """What `--json` prints. Spans are seconds, memory bytes; `rcm` is null where there is none."""
    now = clock.now()
    homes = {token.name: token.host for token in fleet_view.tokens(Role.RC)}
    rcs: list[dict[str, Any]] = []
    for view in state.rcs if state is not None else []:
        holders = [hold for hold in state.holds if view.rc in hold.needs] if state is not None else []
        rcs.append(
            {
                "rc": view.rc,
                "present": view.present,
                "sharable": view.sharable,
                "host": homes.get(view.rc),
                "holders": [{"arc": hold.arc, "id": hold.id, "client": hold.client} for hold in holders],
            }
            | devices.as_object(view.rc)
        )
    return {
        "fleet": fleet_view.client.fleet.name,
        "links": fleet_view.client.mesh.links(),
        "rcm": None if state is None else {"host": state.host, "term": state.term, "seq": state.seq},
        "rcs": rcs,
        "holds": [structs.asdict(hold) for hold in state.holds] if state is not None else [],
        "queue": [structs.asdict(wait) for wait in state.queue] if state is not None else [],
        "more": state.more if state is not None else 0,
        "hosts": [_host_object(fleet_view, name, host, now) for name, host in fleet_view.all_hosts().items()],
    }


def _host_object(fleet_view: FleetView, name: str, host: Host, now: Ns) -> dict[str, Any]:
    return {
        "host": name,
        "leads": host.has(Role.RCM),
        "node": host.has(Role.NODE),
        "candidate": host.has(Role.CANDIDATE),
        "rcs": sorted(token.name for token in host.tokens if token.role == Role.RC),
        "clients": sorted({token.name for token in host.tokens if token.role == Role.CLIENT}),
        "components": host.components,
        "cordoned": name in fleet_view.cordoned,
        "alive": bool(host.tokens),
        "gone": None if host.gone is None else (now - host.gone) / SECOND,
        "stale": fleet_view.stale(host),
        "load": None if host.load is None else structs.asdict(host.load),
        "age": None if host.load is None else (now - host.reported) / SECOND,
    }
