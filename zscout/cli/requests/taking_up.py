"""`zscout request --booking`: the booking determines needs, priority and duration."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

from zscout.behaviors.client.client import Client
from zscout.cli.booked import ask_bookings, choose, is_own, label, rcs_words
from zscout.cli.common import Failed
from zscout.cli.ownership import User, ask_for_others
from zscout.cli.requests.options import HoldOptions
from zscout.config.strict import BadInput
from zscout.keyexpr import valid_name

EXCLUDED_OPTIONS: Final = ("min_runtime", "release_after", "dry_run")


def check_options(**options: Any) -> None:
    """Check that no option is given that the booking determines. Raises BadInput."""
    for name in EXCLUDED_OPTIONS:
        if options[name] not in (None, False):
            raise BadInput(f"--{name.replace('_', '-')} can't be used with --booking; leave it out")


async def taking_up(
    client: Client, wanted: HoldOptions, *, name: str | None, priority: int | None, yes: bool
) -> HoldOptions:
    """The request that takes up `wanted.booking`, a name or an id; its own name is `name`, else the booking's. Raises
    BadInput if needs or `priority` differ from the booking's; Failed, RequestRefused."""
    me = User.of(client)
    booking = choose((await ask_bookings(client)).bookings, wanted.booking, me)
    if booking.maintenance:
        raise Failed(f"{booking.name} is maintenance, not for requests; end it: zscout booking cancel {booking.name}")
    if wanted.needs and wanted.needs != booking.needs:
        raise BadInput(f"{booking.name} is booked with other devices: {rcs_words(booking)}; leave the devices out")
    if priority not in (None, booking.priority):
        raise BadInput(f"--priority: {booking.name} is booked with priority {booking.priority}; leave --priority out")
    await ask_for_others(client, [] if is_own(booking, me) else [label(booking)], "use", yes=yes)
    return replace(
        wanted,
        name=wanted.name if name is not None else valid_name(booking.name),
        needs=booking.needs,
        priority=booking.priority,
        min_runtime=booking.runtime,
        booking=booking.id,
    )
