"""Report to the RCs of a direct hold that its program has ended, in place of a client that is gone or frozen.

    python -m zscout.behaviors.client.left

The guardian of a command executes this program once the whole command has ended. It takes the hold from the command's
environment."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping
from contextlib import suppress

import msgspec
from msgspec.structs import replace

from zscout.behaviors.client.confirmation import CONFIRM_AGAIN
from zscout.behaviors.client.direct import DEFAULT_SETTLE, REPORT_TIMEOUT, TRY_AGAIN_AFTER
from zscout.config.fleet import beside, fleet_from_env
from zscout.config.strict import BadInput
from zscout.keyexpr import BadName, check_rc, client_of
from zscout.mesh import Mesh, MeshError, ZenohMesh
from zscout.messages import Command, Done
from zscout.types import SECOND, Grant


async def report_left(mesh: Mesh, rcs: list[str], grant: Grant, patience: float) -> None:
    """Send `left` to each RC until it has answered, at most for `patience` seconds: then it has settled anyway."""
    with suppress(TimeoutError):
        async with asyncio.timeout(patience):
            await asyncio.gather(*(_report(mesh, rc, grant) for rc in rcs))


async def _report(mesh: Mesh, rc: str, grant: Grant) -> None:
    left = Command(grant=grant, do={"name": "left"}, ttl=1.0)
    while True:
        reply = await mesh.ask_one(mesh.keys.command(rc, mesh.me), left, Done, timeout=REPORT_TIMEOUT)
        if reply is not None and (reply.problem is None or reply.problem.code not in CONFIRM_AGAIN):
            return
        await asyncio.sleep(TRY_AGAIN_AFTER)


async def _main(env: Mapping[str, str]) -> None:
    fleet, me = fleet_from_env(), client_of(env["ZSCOUT_CLIENT"])
    rcs = [check_rc(rc) for rc in env["ZSCOUT_RCS"].split()]
    grant = msgspec.json.decode(env["ZSCOUT_GRANT"], type=Grant)
    mesh = await ZenohMesh.open(replace(fleet, mesh=beside(fleet.mesh)), me)
    try:
        await report_left(mesh, rcs, grant, (fleet.timing.hold_lease + DEFAULT_SETTLE) / SECOND)
    finally:
        await mesh.close()


if __name__ == "__main__":
    with suppress(BadInput, BadName, KeyError, MeshError, msgspec.DecodeError):  # the RCs settle anyway
        asyncio.run(_main(os.environ))
