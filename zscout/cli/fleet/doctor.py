"""`zscout doctor`: collect evidence on everything that may keep hosts apart, even if the mesh can't be joined.

`findings.py` draws the conclusions."""

from __future__ import annotations

import asyncio
import os
import socket
import time
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import click

from zscout import terminal
from zscout.cli import booked, common
from zscout.cli.fleet.findings import Evidence, Finding, findings
from zscout.cli.fleet.keys import show_keys
from zscout.config.certificates import MAX_FILE, read_cas, read_certificates, read_places_key
from zscout.config.fleet import Fleet
from zscout.config.node import Node, load_node
from zscout.config.strict import BadInput, read_text
from zscout.keyexpr import valid_name
from zscout.services.bookings.host_clock import is_synchronised
from zscout.terminal import Table

SETTLE_TIMEOUT_S: Final = 7.0
"""Within this time all participants are seen, and a candidate takes the lead."""
RELAY_TIMEOUT_S: Final = 1.0
"""Additional time for a link to the relay."""
MAX_ADDRESSES: Final = 3
"""Addresses of one process that are called."""
STYLES: Final = {"ok": "green", "note": "yellow", "mend": "bold red"}


@click.command()
@click.argument("file", required=False, type=click.Path(path_type=Path))
@click.option("--keys", "only_keys", is_flag=True, help="List what is alive on the mesh, and the keys of each.")
@common.json_option("Print one JSON object.")
@common.runs
async def doctor(file: Path | None, only_keys: bool, as_json: bool) -> int:
    """Find out why there is no link, no leader or no device, and how to fix it.

    With FILE, a node file, the checks use that node's files and certificate; without FILE, the fleet file, like any
    command. They take up to ten seconds, and work when nothing else runs.

    STATE is `ok`, `note`, or `mend` for a problem to fix; causes come first. Exit code 0: nothing has to be fixed; 1:
    there is a problem, or a file has a mistake.

    With --keys the command lists the participants on the mesh by host, and their keys, to see whether two hosts see
    each other, to write a client in another language, or to write access rules. HOW: `query` keys are answered, `put`
    keys are published, `hear` keys are subscribed to. Exit code 3: no participant is there.

    \b
    Examples:
      zscout doctor
      zscout doctor lab.toml
      zscout doctor --json | jq -r '.findings[] | select(.state == "mend").says'
      zscout doctor --keys
    """
    if only_keys:
        if file is not None:
            raise BadInput("--keys uses the fleet file; leave FILE out")
        await show_keys(as_json=as_json)
        return 0
    seen = await _look(file)
    found = findings(seen)
    bad = [finding for finding in found if finding.state == "mend"]
    if as_json:
        lines = [{name: getattr(finding, name) for name in Finding.__slots__} for finding in found]
        fleet = seen.fleet.name if seen.fleet is not None else None
        terminal.print_json({"fleet": fleet, "host": seen.host or None, "mend": len(bad), "findings": lines})
    else:
        rows = [(finding.state, finding.about, str(finding)) for finding in found]
        Table("", ("STATE", "ABOUT", "FINDING"), rows, [STYLES[finding.state] for finding in found]).print()
    return int(bool(bad))


async def _look(file: Path | None) -> Evidence:
    seen = Evidence(datetime.now(UTC), clock_kept=is_synchronised())
    try:
        if file is not None:
            seen.node = load_node(file)
            seen.fleet, seen.host = seen.node.fleet, seen.node.host
        else:
            seen.fleet = common.the_fleet()
        seen.file = str(file or common.fleet_file() or "")
    except BadInput as error:
        if (given := file or common.fleet_file()) is not None and not given.exists():
            raise
        seen.bad.append(("files", error))
        return seen
    cas = _look_at_certificates(seen, seen.fleet)
    seen.host = seen.host or os.environ.get("ZSCOUT_HOST") or valid_name(socket.gethostname())
    from zscout.mesh import probing

    if seen.node is not None:
        _look_at_drivers(seen, seen.node)
    mesh = seen.fleet.mesh
    if mesh.multicast:
        seen.interfaces = probing.multicast_problems(mesh)
        seen.heard = await probing.heard(mesh)
    heard = [address for process in seen.heard for address in process.addresses[:MAX_ADDRESSES]]

    async def call() -> None:
        seen.answers = await probing.call(mesh.connect, heard, cas, seen.certificates)
        plain = [answer.address for answer in seen.answers if answer.speaks == "plain"]
        if plain:
            seen.plain = await asyncio.to_thread(probing.plain_fleets, plain)

    async with asyncio.TaskGroup() as both:  # on Ctrl-C it waits until the mesh is left
        both.create_task(call())
        if _may_join(seen, seen.fleet):
            both.create_task(_join(seen, seen.fleet))
    return seen


def _look_at_certificates(seen: Evidence, fleet: Fleet) -> str:
    """Return the trusted CAs in PEM, or ""."""
    if fleet.security is None:
        return ""
    cas = ""
    with suppress(BadInput):
        read_cas(fleet.security / "ca.pem")
        cas = read_text(fleet.security / "ca.pem", max_bytes=MAX_FILE)
    try:
        seen.certificates = read_certificates(fleet.security)
        seen.host = seen.host or seen.certificates.name
        seen.certificates.check(seen.at, seen.host)
        seen.seals = read_places_key(fleet.security) is not None
    except BadInput as error:
        seen.bad.append(("certificate", error))
    return cas


def _look_at_drivers(seen: Evidence, node: Node) -> None:
    from zscout.drivers.registry import driver_for

    try:
        for rc in node.rcs:
            driver_for(rc)
    except BadInput as error:
        seen.bad.append(("drivers", error))


def _may_join(seen: Evidence, fleet: Fleet) -> bool:
    if fleet.security is None:
        return True
    own = seen.certificates
    return (
        own is not None
        and bool(fleet.access.ranks_of(own.name))
        and not any(about == "certificate" for about, _ in seen.bad)
    )


async def _join(seen: Evidence, fleet: Fleet) -> None:
    from zscout.cli.fleet.fleet_view import Devices, FleetView
    from zscout.mesh import MeshError, probing

    try:
        async with common.connected("doctor", fleet, need_rcm=False) as client:
            with FleetView(client) as view:
                devices = Devices(view)
                with suppress(TimeoutError, common.NobodyThere):
                    async with asyncio.timeout(SETTLE_TIMEOUT_S):
                        seen.state = await view.settled()
                with suppress(TimeoutError):
                    async with asyncio.timeout(1.0):
                        await devices.ask()
                if seen.state is not None and (answer := await booked.look(client)) is not None:
                    own = time.time() - answer.time
                    seen.clocks = answer.clocks | ({seen.host: own} if abs(own) > booked.MAX_CLOCK_DIFFERENCE_S else {})
                with suppress(TimeoutError):
                    async with asyncio.timeout(RELAY_TIMEOUT_S if fleet.mesh.site is not None else 0):
                        while not client.mesh.relays():  # noqa: ASYNC110 - no event for it
                            await asyncio.sleep(probing.POLL)
                seen.relays = client.mesh.relays()
                seen.links, seen.hosts, seen.devices = client.mesh.links(), view.hosts, devices.known()
    except (MeshError, BadInput) as error:
        seen.unjoined = str(error)
