"""What the shell offers at Tab: RCs, ARCs, bookings, hosts, components and kinds of the fleet as it is
then; and `zscout completion`, the script that makes it do so.

Without a fleet nothing is offered, and nothing said."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

import click
from click.shell_completion import get_completion_class

if TYPE_CHECKING:
    from zscout.mesh import Mesh
    from zscout.messages import RcmState

LOOK: Final = 1.0
"""Seconds in which a mesh that was just joined shows who is there."""
BOUND: Final = 2.0
"""Seconds that Tab may take in all."""
PROGRAMS: Final = ("zscout", "zscout-node")
SHELLS: Final = ("bash", "zsh", "fish")


@click.command()
@click.argument("shell", required=False, type=click.Choice(SHELLS))
@click.option("--program", type=click.Choice(PROGRAMS), default=PROGRAMS[0], help="Whose arguments are completed.")
@click.pass_context
def completion(ctx: click.Context, shell: str | None, program: str) -> None:
    """Print the completion script for a shell; without SHELL, for the one in $SHELL.

    At Tab it offers commands and options, and the current devices, requests, hosts, components and kinds of the fleet.

    \b
    Examples:
      zscout completion bash > ~/.local/share/bash-completion/completions/zscout
      zscout completion zsh > ~/.zfunc/_zscout
      zscout completion fish > ~/.config/fish/completions/zscout.fish
      zscout completion bash --program zscout-node > ~/.local/share/bash-completion/completions/zscout-node
    """
    name = shell or Path(os.environ.get("SHELL", "")).name
    found = get_completion_class(name) if name in SHELLS else None
    if found is None:
        raise click.UsageError(f"no completion for the shell in $SHELL; write one of {', '.join(SHELLS)}", ctx)
    variable = f"_{program.replace('-', '_')}_COMPLETE".upper()
    click.echo(found(ctx.find_root().command, {}, program, variable).source())


Completer: TypeAlias = Callable[[click.Context, click.Parameter, str], list[str]]


def _on_mesh(find: Callable[[Mesh, str], Awaitable[Iterable[str]]]) -> Completer:
    """Offers what `find(mesh, name of the parameter)` finds, but what is given; nothing without a mesh."""

    def offered(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
        from zscout.cli import common
        from zscout.config.strict import BadInput
        from zscout.keyexpr import BadName
        from zscout.mesh import MeshError

        async def look() -> Iterable[str]:
            async with asyncio.timeout(BOUND), common.connected("complete", need_rcm=False) as client:
                # A mesh that was just joined shows nobody yet.
                with suppress(common.NobodyThere, TimeoutError):
                    async with asyncio.timeout(LOOK):
                        await common.see_rcm(client)
                return await find(client.mesh, param.name or "")

        try:
            with ctx.scope(cleanup=False):
                names = asyncio.run(look())
        except (BadInput, BadName, MeshError, TimeoutError):
            return []
        given = ctx.params.get(param.name or "")
        taken = given if isinstance(given, tuple) else ()
        return sorted({name for name in names if name.startswith(incomplete) and name not in taken})

    return offered


@_on_mesh
async def components(mesh: Mesh, _parameter: str) -> Iterable[str]:
    from zscout.messages import ListPlacements, Placements

    listed = await mesh.ask_one(mesh.keys.placer(mesh.me), ListPlacements(), Placements, timeout=LOOK)
    return {one.component for one in listed.message.components} if listed and listed.message else ()


@_on_mesh
async def hosts(mesh: Mesh, _parameter: str) -> Iterable[str]:
    return await _named(mesh, "node")


@_on_mesh
async def rcs(mesh: Mesh, kind: str) -> Iterable[str]:
    """Of the kind that the parameter is called by."""
    return {name for name in await _rc_names(mesh) if name.startswith(f"{kind}/")}


@_on_mesh
async def needs(mesh: Mesh, _parameter: str) -> Iterable[str]:
    return await _rc_names(mesh)


@_on_mesh
async def maintained(mesh: Mesh, _parameter: str) -> Iterable[str]:
    """Devices and hosts."""
    rcs, hosts_ = await asyncio.gather(_rc_names(mesh), _named(mesh, "node"))
    return {*rcs, *hosts_}


@_on_mesh
async def arcs(mesh: Mesh, _parameter: str) -> Iterable[str]:
    return _arc_names(await _state(mesh))


@_on_mesh
async def bookings(mesh: Mesh, _parameter: str) -> Iterable[str]:
    """Names of bookings that are not over."""
    from zscout.messages import BookingsAsk, BookingsTold

    reply = await mesh.ask_one(mesh.keys.ask_bookings(mesh.me), BookingsAsk(), BookingsTold, timeout=LOOK)
    return {one.name for one in reply.message.bookings} if reply is not None and reply.message is not None else ()


@_on_mesh
async def shown(mesh: Mesh, _parameter: str) -> Iterable[str]:
    """Whatever has a name in `zscout status`."""
    found = await asyncio.gather(_rc_names(mesh), _named(mesh, "node"), _state(mesh))
    return {*found[0], *found[1], *_arc_names(found[2])}


@_on_mesh
async def _fleet_kinds(mesh: Mesh, _parameter: str) -> Iterable[str]:
    from zscout.cli import common
    from zscout.messages import ComponentList, ListComponents

    replies = await common.ask_nodes(mesh, ListComponents(), ComponentList, LOOK)
    return {kind for reply in replies if reply.message is not None for kind in reply.message.kinds or ()}


def kinds(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Those that nodes can start; where none tells, those that are installed here."""
    if found := _fleet_kinds(ctx, param, incomplete):
        return found
    from zscout.behaviors.components.component import installed_kinds

    return [name for name in installed_kinds() if name.startswith(incomplete)]


async def _named(mesh: Mesh, role: str) -> set[str]:
    return {token.host for token in await mesh.living(mesh.keys.alive_any(role), timeout=LOOK)}


async def _rc_names(mesh: Mesh) -> set[str]:
    return {token.name for token in await mesh.living(mesh.keys.alive_any("rc"), timeout=LOOK)}


async def _state(mesh: Mesh) -> RcmState | None:
    from zscout.messages import RcmState, StateAsk

    reply = await mesh.ask_one(mesh.keys.ask_state(mesh.me), StateAsk(), RcmState, timeout=LOOK)
    return reply.message if reply is not None else None


def _arc_names(state: RcmState | None) -> set[str]:
    return set() if state is None else {view.arc for view in (*state.holds, *state.queue)}
