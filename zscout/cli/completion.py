"""What the shell offers at Tab: components, hosts and RCs of the fleet, kinds that are installed here; and
`zscout completion`, the script that makes it do so."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click
from click.shell_completion import get_completion_class

if TYPE_CHECKING:
    from zscout.mesh import Mesh

LOOK: Final = 1.0
"""Seconds that Tab may take, beyond joining the mesh."""
SHELLS: Final = ("bash", "zsh", "fish")


@click.command()
@click.argument("shell", required=False, type=click.Choice(SHELLS))
@click.pass_context
def completion(ctx: click.Context, shell: str | None) -> None:
    """Print the completion script for a shell; without SHELL, for the one in $SHELL.

    \b
    Examples:
      zscout completion bash > ~/.local/share/bash-completion/completions/zscout
      zscout completion zsh > ~/.zfunc/_zscout
      zscout completion fish > ~/.config/fish/completions/zscout.fish
    """
    name = shell or Path(os.environ.get("SHELL", "")).name
    found = get_completion_class(name) if name in SHELLS else None
    if found is None:
        raise click.UsageError(f"$SHELL names no shell that is known here; write one of {', '.join(SHELLS)}", ctx)
    click.echo(found(ctx.find_root().command, {}, "zscout", "_ZSCOUT_COMPLETE").source())


def kinds(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[str]:
    from zscout.behaviors.components.component import installed_kinds

    return [name for name in installed_kinds() if name.startswith(incomplete)]


def _on_mesh(
    find: Callable[[Mesh, str], Awaitable[Iterable[str]]],
) -> Callable[[click.Context, click.Parameter, str], list[str]]:
    """Offers what `find(mesh, name of the parameter)` finds, but what is given; nothing without a mesh."""

    def offered(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
        from zscout.cli import common
        from zscout.config.strict import BadInput
        from zscout.keyexpr import BadName
        from zscout.mesh import MeshError

        async def look() -> Iterable[str]:
            async with common.connected("complete", need_rcm=False) as client:
                # A mesh that was just joined shows nobody yet.
                with suppress(common.NobodyThere, TimeoutError):
                    async with asyncio.timeout(LOOK):
                        await common.see_rcm(client)
                return await find(client.mesh, param.name or "")

        try:
            with ctx.scope(cleanup=False):
                names = asyncio.run(look())
        except (BadInput, BadName, MeshError):
            return []
        given = ctx.params.get(param.name or "")
        taken = given if isinstance(given, tuple) else ()
        return sorted(name for name in names if name.startswith(incomplete) and name not in taken)

    return offered


@_on_mesh
async def components(mesh: Mesh, _parameter: str) -> Iterable[str]:
    from zscout.messages import ListPlacements, Placements

    listed = await mesh.ask_one(mesh.keys.placer, ListPlacements(), Placements, timeout=LOOK)
    return {one.component for one in listed.message.components} if listed and listed.message else ()


@_on_mesh
async def hosts(mesh: Mesh, _parameter: str) -> Iterable[str]:
    return {token.host for token in await mesh.living(mesh.keys.alive_any("node"), timeout=LOOK)}


@_on_mesh
async def rcs(mesh: Mesh, kind: str) -> Iterable[str]:
    """Of the kind that the parameter is called by."""
    names = {token.name for token in await mesh.living(mesh.keys.alive_any("rc"), timeout=LOOK)}
    return {name for name in names if name.startswith(f"{kind}/")}
