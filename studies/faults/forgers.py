"""A client, an RC and a keeper of bookings with a certificate of a simulated fleet, whose every answer is forged; and
the check that no leader believes them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping
from decimal import Decimal
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from zscout.config.access import AccessPolicy, Roles
from zscout.config.fleet import Fleet
from zscout.keyexpr import RANDOM, Role, Token, new_instance
from zscout.mesh import IncomingQuery, Mesh
from zscout.messages import (
    BookingRecord,
    BookingsKept,
    ClientRequests,
    Holder,
    OpenRequest,
    RcAsk,
    RcmState,
    RcState,
    ShareBookings,
    StateAsk,
    WaitView,
    Who,
)
from zscout.services.rcm.rcm import Rcm
from zscout.types import NO_TERM, Grant, Place, Term

FORGER: Final = "forger/all"
ITS_RC: Final = "robot/x"
LOOKS_EVERY: Final = 1.0
LISTED: Final = 30
MAY_LIST: Final = 20
PLACE: Final = Place(Term(1, "0"), 1)
HIGH: Final = 1_000_000
FORGED: Final = Who("somebody else")


def closed(fleet: Fleet, hosts: Iterable[str], candidates: Iterable[str]) -> Fleet:
    """The fleet with certificates, in which the forger may ask, and serve one RC."""
    nodes = dict.fromkeys(hosts, ("*/*",)) | {"forger": (ITS_RC,)}
    roles = Roles(operator=(next(iter(nodes)),), client=("forger",), manager=tuple(candidates), node=nodes)
    limits = replace(fleet.limits, max_requests_per_client=MAY_LIST)
    return replace(fleet, security=Path("keys"), access=AccessPolicy(roles), limits=limits)


async def forge(mesh: Mesh, devices: Mapping[str, object], over: Callable[[], bool]) -> None:
    rng, me, others, instance = RANDOM.get(), mesh.me, list[WaitView](), new_instance()

    def lists(query: IncomingQuery[RcAsk]) -> None:
        wanted = [OpenRequest(f"high{rc[-1]}", "high", {rc: {}}, HIGH, Decimal(2), place=PLACE) for rc in devices]
        flood = [
            OpenRequest(f"f{number}", "f", {ITS_RC: {}}, 0, Decimal(2), place=PLACE, who=FORGED)
            for number in range(LISTED)
        ]
        stolen = [OpenRequest(wait.id, "stolen", {ITS_RC: {}}, 0, Decimal(2), place=wait.place) for wait in others]
        query.answer(ClientRequests(str(me), [*wanted, *stolen, *flood]))

    def reports(query: IncomingQuery[RcAsk]) -> None:
        names = [(wait.id, wait.client, wait.place) for wait in others] or [("q", "h0/nobody", PLACE)]
        id_, client, place = rng.choice(names)
        held = Holder(
            id_, "q", client, Grant(Term(1, "0"), rng.randrange(1, 1_000)), place, [ITS_RC], Decimal(600), 600.0, HIGH,
            keep=True, bound={"robot/*": ITS_RC}, who=FORGED, booking="forged@1",
        )  # fmt: skip
        term = query.message.promise or NO_TERM
        query.answer(RcState(ITS_RC, me.host, instance, sharable=False, term=term, holders=[held]))

    def keeps(query: IncomingQuery[ShareBookings]) -> None:
        start = round(query.message.time or 0) + 3_600
        record = BookingRecord("forged", "forged", {rc: {} for rc in devices}, HIGH, start, Decimal(600), Decimal(600))
        forged = replace(record, owner="forger", since=start - 3_600)
        query.answer(BookingsKept(me.host, True, start + 86_400.0, "?", start + 86_400.0, 1e8, records=[forged]))

    keys = mesh.keys
    declared = [
        mesh.serve(keys.requests(me), RcAsk, lists),
        mesh.serve(keys.rc_state(ITS_RC), RcAsk, reports),
        mesh.serve(keys.bookings(me.host), ShareBookings, keeps),
        mesh.alive(Token(me.host, Role.NODE, "node", instance)),
        mesh.alive(Token(me.host, Role.CLIENT, me.client, instance)),
    ]
    while not over():
        token = mesh.alive(Token(me.host, Role.RC, ITS_RC, instance))
        await asyncio.sleep(rng.uniform(0, 2 * LOOKS_EVERY))
        state = await mesh.ask_one(keys.rcm_state, StateAsk(), RcmState, timeout=LOOKS_EVERY)
        queue = state.message.queue if state is not None and state.message is not None else []
        others[:] = [wait for wait in queue if wait.client != str(me)][:LISTED]
        token.close()
        instance = new_instance()
    for left in declared:
        left.close()
    await mesh.close()


def believed(rcm: Rcm) -> str:
    """The forgery that a leader believes; empty: none."""
    status, authority, of_forger = rcm.core.status(), rcm.leader.admission.authority, 0
    for arc in (*status.running, *status.queued):
        host, request = arc.request.client.partition("/")[0], arc.request
        most = authority.highest_priority(host)
        if most is not None and arc.request.priority > most:
            return f"{arc.id} has priority {arc.request.priority}, above its role"
        if request.who is not None and request.who.user == FORGED.user:
            return f"{arc.id} is in another's name"
        of_forger += request.client == FORGER
    if of_forger > rcm.fleet.limits.max_requests_per_client:
        return f"{FORGER} has {of_forger} requests open"
    return "a booking is kept that only a node claims" if rcm.bookings.record("forged") is not None else ""
