"""`zscout drain` and `uncordon`: empty a host of components and holds, use it again.

Draining books maintenance of all devices of the host, until it is cancelled. Nodes store it like other bookings, and
the placer cordons the host for as long."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from typing import Final

import click
from msgspec.structs import replace

from zscout import terminal
from zscout.behaviors.client.bookings import MAX_NAMED, BookingsClient
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.placer_client import PlacerClient
from zscout.behaviors.client.request import RequestRefused
from zscout.cli import common
from zscout.cli.booked import ask_bookings, explained, free_name, is_own, maintenance_of
from zscout.cli.components import placing
from zscout.cli.ownership import User
from zscout.cli.requests.options import MAX_PRIORITY, parse_comment, timeout_option
from zscout.cli.requests.waiting import hold_json, request_words
from zscout.keyexpr import of_host
from zscout.messages import WINDOW, DrainHost, Grants, HoldView, Placement, Placements, UncordonHost, Who
from zscout.terminal import clean, clock
from zscout.types import Grant

OLDER: Final = "the leader is of an older version"
CANNOT_DRAIN: Final = {
    "wrong_strategy": 'only strategy "adaptive" drains them',
    "bad_request": OLDER,
    "bad_name": OLDER,
}
"""Why a leader can't drain devices, by the code of its refusal."""


@click.command()
@placing.host_argument
@click.option("--wait", is_flag=True, help="Wait until its devices are free.")
@click.option("--now", is_flag=True, help="End holds of its devices at once; their requests wait, at their places.")
@timeout_option("Wait this long until it is empty, then exit with 1.")
@click.option(
    "--comment", type=common.Parsed("text", parse_comment), default="", help="A comment, shown to requests that wait."
)
@common.json_option("Print one JSON object.")
@common.runs
async def drain(host: str, wait: bool, now: bool, timeout: float | None, comment: str, as_json: bool) -> None:
    """Grant the devices of a host to no request any more, place no component there, and move components away.

    Holds end when their minimum runtimes are over, with --now at once. Waits until no movable component is left, with
    --wait, --now or --timeout until the devices are free too. Exit code 1 names the components and holds that are
    left, and why or until when. The host stays drained, also after Ctrl-C or --timeout and when it restarts, until
    zscout uncordon.

    \b
    Examples:
      zscout drain anvil --wait && ssh anvil sudo reboot
      zscout drain anvil --now --comment 'new disk'
      zscout drain anvil --timeout 2m
    """
    stays_cordoned = f"{host} stays cordoned; to use it again: zscout uncordon {host}"
    async with placing.connected("drain", as_json=as_json) as (client, shown, placer):
        leftovers = _Leftovers(client, placer, host)
        at_first = {placement.component for placement in leftovers.components()}
        waits_for_holds = wait or now or timeout is not None

        def late() -> str:
            return f"{host} is not empty after {terminal.span(timeout or 0)}: {leftovers.words()}; {stays_cordoned}"

        def revoked(_key: str, grants: Grants) -> None:
            if grants.revoked:
                placer.changed.set()

        granted = await _close(client, placer, host, urgent=now, comment=comment)
        with closing(client.mesh.subscribe(client.mesh.keys.grants, Grants, revoked)):
            await leftovers.look()
            async with shown.within(timeout, late, stays_cordoned):
                while leftovers.leaving() or (waits_for_holds and leftovers.holds):
                    shown.update(f"{host}: {leftovers.words()}")
                    await placer.wait_changed()
                    await leftovers.look()
        stay, holds = leftovers.components(), leftovers.holds
        records = [known for name in sorted(at_first) if (known := placer.placements.get(name)) is not None]
        moved = [record for record in records if record.host not in (host, None) and record.state == "running"]
    if as_json:
        went, stays = ([placing.placement_object(record) for record in some] for some in (moved, stay))
        held = [hold_json(hold) | {"rcs": leftovers.rcs_of(hold)} for hold in holds]
        terminal.print_json({"host": host, "moved": went, "stay": stays, "held": held})
    for record in moved:
        shown.finish(f"{record.component} went to {record.host}{placing.out_of_work(record)}")
    if stay or holds:
        ends = ["end them with zscout component stop"] if stay else []
        ends += ["wait for holds with --wait, or end them with --now"] if holds and not granted else []
        raise common.Failed("; ".join((f"{host} is not empty: {leftovers.words()}", *ends, stays_cordoned)))
    still = f"; its devices are still granted: {granted}" if granted and leftovers.rcs else ""
    shown.finish(f"{host} is empty{still}; {stays_cordoned}")


@click.command()
@placing.host_argument
@common.json_option("Print one JSON object.")
@common.runs
async def uncordon(host: str, as_json: bool) -> None:
    """Use a drained host and its devices again. Components that left it do not move back by themselves.

    \b
    Example:
      zscout uncordon anvil
    """
    async with placing.connected("uncordon", as_json=as_json) as (client, _, placer):
        if host not in placer.cordoned:
            for line in await placing.absent(placer.mesh, [host]):
                terminal.print_line(f"zscout: {line}", sys.stderr)
        bookings_list, bookings_client = await ask_bookings(client), BookingsClient(client)
        try:
            for booking, date in maintenance_of(bookings_list, host):
                if len(booking.needs) == 1:
                    await bookings_client.unbook(booking.id, date.start if booking.every else None)
            uncordoned = await placer.request(UncordonHost(host), Placements)
        except RequestRefused as refused:
            raise explained(refused) from None
    if as_json:
        terminal.print_json({"host": host, "components": list(map(placing.placement_object, uncordoned.components))})
    else:
        terminal.print_line(f"{host} is used again")


async def _close(client: Client, placer: PlacerClient, host: str, *, urgent: bool, comment: str) -> str:
    """Book maintenance of the host until it is cancelled; if the leader can't, cordon the host for components alone,
    and return why ("" otherwise). Raises Failed, RequestRefused."""
    known, me, bookings_client = await ask_bookings(client), User.of(client), BookingsClient(client)
    drains = [booking for booking, _ in maintenance_of(known, host) if booking.lasting]
    is_drained = any(booking.urgent or not urgent for booking in drains)
    try:
        if not is_drained:
            await _check_host(client, placer, host)
            # The name of the booking is enough.
            client.who = replace(client.who or Who(), command="")
            await bookings_client.book(
                {of_host(host): {}},
                datetime.fromtimestamp(int(known.time), UTC),
                WINDOW,
                name=free_name(f"drain-{host}"[:MAX_NAMED], [own for own in known.bookings if is_own(own, me)]),
                priority=MAX_PRIORITY,
                maintenance=True,
                urgent=urgent,
                lasting=True,
                comment=comment,
            )
            for booking in drains:
                await bookings_client.unbook(booking.id)
        await placer.refresh()
    except RequestRefused as refused:
        if refused.code not in CANNOT_DRAIN:
            raise explained(refused) from None
        placer.take(*(await placer.request(DrainHost(host), Placements)).components)
        return CANNOT_DRAIN[refused.code]
    return ""


async def _check_host(client: Client, placer: PlacerClient, host: str) -> None:
    """Raises Failed if the host is not on the mesh, and no device or component names it."""
    state = await common.state_of(client)
    if host not in {view.host for view in state.rcs} | {known.host for known in placer.placements.values()}:
        for line in await placing.absent(placer.mesh, [host]):
            raise common.Failed(line)


class _Leftovers:
    def __init__(self, client: Client, placer: PlacerClient, host: str) -> None:
        self._client, self._placer, self._host = client, placer, host
        self.holds: list[HoldView] = []
        self.rcs: set[str] = set()
        self._until: dict[Grant, str] = {}

    async def look(self) -> None:
        """Ask the leader for the holds; without an answer keep the last known ones."""
        if (state := await self._client.state()) is None:
            return
        self.rcs = {view.rc for view in state.rcs if view.host == self._host}
        self.holds = [hold for hold in state.holds if self.rcs & hold.needs.keys()]
        for hold in self.holds:
            # Compute the words for an end once: in a pipe each changed line is printed.
            if hold.remaining > 0:
                self._until.setdefault(hold.grant, f" until {clock(hold.remaining)} at the latest")

    def rcs_of(self, hold: HoldView) -> list[str]:
        return sorted(self.rcs & hold.needs.keys())

    def components(self) -> list[Placement]:
        found = (placement for _, placement in sorted(self._placer.placements.items()))
        here = (known for known in found if self._host in (known.host, known.to))
        return [known for known in here if known.state not in placing.OVER]

    def leaving(self) -> list[Placement]:
        """Return the components that will leave; one that does not run yet is moved as soon as it runs."""
        return [known for known in self.components() if known.movable or known.state != "running"]

    def words(self) -> str:
        return clean(", ".join((*self._held(), *map(_component_words, self.components()))))

    def _held(self) -> Iterator[str]:
        for hold in self.holds:
            holder = request_words(hold.arc, hold.who, hold.client)
            yield f"{holder} holds {', '.join(self.rcs_of(hold))}{self._until.get(hold.grant, '')}"


def _component_words(placement: Placement) -> str:
    why = placement.reason or ("" if placement.movable else "it can't be moved")
    stays = "stays" + (f" ({why})" if why else "")
    return f"{placement.component} {stays if placement.state == 'running' else placing.state_words(placement)}"
