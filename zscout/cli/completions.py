"""What the shell offers at Tab: components and hosts of the fleet, kinds that are installed here."""

from __future__ import annotations

import asyncio
import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

if TYPE_CHECKING:
    from zscout.config.fleet import Fleet

LOOK: Final = 1.0
"""Seconds that somebody who has pressed Tab is kept waiting, beyond joining the mesh."""


def kinds(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[str]:
    from zscout.behaviors.components.kinds import installed

    return [name for name in installed() if name.startswith(incomplete)]


def components(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    return _offer(ctx, param, incomplete, hosts=False)


def hosts(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    return _offer(ctx, param, incomplete, hosts=True)


def rcs(ctx: click.Context, kind: str) -> list[str]:
    """The RCs of one kind that are on the mesh."""
    from zscout.config.strict import BadInput
    from zscout.keyexpr import BadName
    from zscout.mesh import MeshError

    try:
        names = asyncio.run(_rcs(_fleet(ctx)))
    except (BadInput, BadName, MeshError):
        return []
    return sorted(name for name in names if name.startswith(f"{kind}/"))


async def _rcs(fleet: Fleet) -> set[str]:
    from zscout.cli import common
    from zscout.keyexpr import Role

    async with common.connected("complete", fleet, need_rcm=False) as client:
        with suppress(common.NobodyThere, TimeoutError):
            async with asyncio.timeout(LOOK):
                await common.see_rcm(client)
        mesh = client.mesh
        return {token.name for token in await mesh.living(mesh.keys.alive_any(Role.RC), timeout=LOOK)}


def _offer(ctx: click.Context, param: click.Parameter, incomplete: str, *, hosts: bool) -> list[str]:
    from zscout.config.strict import BadInput
    from zscout.keyexpr import BadName
    from zscout.mesh import MeshError

    try:
        names = asyncio.run(_names(_fleet(ctx), hosts=hosts))
    except (BadInput, BadName, MeshError):
        return []
    given = ctx.params.get(param.name or "")
    taken = given if isinstance(given, tuple) else ()
    return sorted(name for name in names if name.startswith(incomplete) and name not in taken)


def _fleet(ctx: click.Context) -> Fleet:
    """The fleet that the line is about; Click has not run anything yet."""
    from zscout.config.fleet import fleet_from_env, load_fleet

    given = ctx.find_root().params.get("fleet")
    return load_fleet(Path(os.fspath(given))) if given is not None else fleet_from_env()


async def _names(fleet: Fleet, *, hosts: bool) -> set[str]:
    from zscout.cli import common
    from zscout.keyexpr import Role
    from zscout.messages import ListPlacements, Placements

    async with common.connected("complete", fleet, need_rcm=False) as client:
        keys, mesh = client.mesh.keys, client.mesh
        # Who has just joined sees nobody yet.
        with suppress(common.NobodyThere, TimeoutError):
            async with asyncio.timeout(LOOK):
                await common.see_rcm(client)
        if hosts:
            return {token.host for token in await mesh.living(keys.alive_any(Role.NODE), timeout=LOOK)}
        listed = await mesh.ask_one(keys.placer, ListPlacements(), Placements, timeout=LOOK)
        return {one.component for one in listed.message.components} if listed and listed.message else set()
