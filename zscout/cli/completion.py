"""Completion of names that the fleet has when Tab is pressed: RCs, ARCs, bookings, hosts, components, kinds; and
`zscout completion`, which prints the script for a shell.

Without a fleet, completion offers nothing and prints no error."""

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

FIND_S: Final = 1.0
"""Within this time peers of a mesh just joined are seen and answer."""
MAX_DELAY_S: Final = 2.0
"""Longest time between Tab and its answer."""
PROGRAMS: Final = ("zscout", "zscout-node")
SHELLS: Final = ("bash", "zsh", "fish")


@click.command()
@click.argument("shell", required=False, type=click.Choice(SHELLS))
@click.option(
    "--program", type=click.Choice(PROGRAMS), default=PROGRAMS[0], help="Complete the arguments of this program."
)
@click.pass_context
def completion(ctx: click.Context, shell: str | None, program: str) -> None:
    """Print the completion script for a shell; without SHELL, for the one in $SHELL.

    Tab then completes commands and options, and the names of the fleet's current devices, requests, bookings, hosts,
    components and kinds.

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
    """Offers the names that `find(mesh, name of the parameter)` returns but the line lacks; none without a mesh."""

    def complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
        from zscout.cli import common
        from zscout.config.strict import BadInput
        from zscout.keyexpr import BadName
        from zscout.mesh import MeshError

        async def look() -> Iterable[str]:
            async with asyncio.timeout(MAX_DELAY_S), common.connected("complete", need_rcm=False) as client:
                # On a mesh just joined no peers are visible yet.
                with suppress(common.NobodyThere, TimeoutError):
                    async with asyncio.timeout(FIND_S):
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

    return complete


@_on_mesh
async def components(mesh: Mesh, _parameter: str) -> Iterable[str]:
    from zscout.messages import ListPlacements, Placements

    listed = await mesh.ask_one(mesh.keys.placer(mesh.me), ListPlacements(), Placements, timeout=FIND_S)
    return {placement.component for placement in listed.message.components} if listed and listed.message else ()


@_on_mesh
async def hosts(mesh: Mesh, _parameter: str) -> Iterable[str]:
    return await _named(mesh, "node")


@_on_mesh
async def rcs(mesh: Mesh, kind: str) -> Iterable[str]:
    """Names of RCs whose kind is the parameter's name."""
    return {name for name in await _rc_names(mesh) if name.startswith(f"{kind}/")}


@_on_mesh
async def needs(mesh: Mesh, _parameter: str) -> Iterable[str]:
    return await _rc_names(mesh)


@_on_mesh
async def maintained(mesh: Mesh, _parameter: str) -> Iterable[str]:
    rcs, hosts_ = await asyncio.gather(_rc_names(mesh), _named(mesh, "node"))
    return {*rcs, *hosts_}


@_on_mesh
async def arcs(mesh: Mesh, _parameter: str) -> Iterable[str]:
    return _arc_names(await _state(mesh))


@_on_mesh
async def bookings(mesh: Mesh, _parameter: str) -> Iterable[str]:
    from zscout.messages import BookingsAsk, BookingsTold

    reply = await mesh.ask_one(mesh.keys.ask_bookings(mesh.me), BookingsAsk(), BookingsTold, timeout=FIND_S)
    return (
        {booking.name for booking in reply.message.bookings} if reply is not None and reply.message is not None else ()
    )


@_on_mesh
async def shown(mesh: Mesh, _parameter: str) -> Iterable[str]:
    """All names that `zscout status NAME` takes."""
    found = await asyncio.gather(_rc_names(mesh), _named(mesh, "node"), _state(mesh))
    return {*found[0], *found[1], *_arc_names(found[2])}


@_on_mesh
async def _fleet_kinds(mesh: Mesh, _parameter: str) -> Iterable[str]:
    from zscout.cli import common
    from zscout.messages import ComponentList, ListComponents

    replies = await common.ask_nodes(mesh, ListComponents(), ComponentList, FIND_S)
    return {kind for reply in replies if reply.message is not None for kind in reply.message.kinds or ()}


def kinds(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Kinds that nodes can start; if no node answers, the kinds installed on this host."""
    if found := _fleet_kinds(ctx, param, incomplete):
        return found
    from zscout.behaviors.components.component import installed_kinds

    return [name for name in installed_kinds() if name.startswith(incomplete)]


async def _named(mesh: Mesh, role: str) -> set[str]:
    return {token.host for token in await mesh.living(mesh.keys.alive_any(role), timeout=FIND_S)}


async def _rc_names(mesh: Mesh) -> set[str]:
    return {token.name for token in await mesh.living(mesh.keys.alive_any("rc"), timeout=FIND_S)}


async def _state(mesh: Mesh) -> RcmState | None:
    from zscout.messages import RcmState, StateAsk

    reply = await mesh.ask_one(mesh.keys.ask_state(mesh.me), StateAsk(), RcmState, timeout=FIND_S)
    return reply.message if reply is not None else None


def _arc_names(state: RcmState | None) -> set[str]:
    return set() if state is None else {view.arc for view in (*state.holds, *state.queue)}
