"""Shared by the commands about components: the placer's client, progress on stdout, words."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator, Callable, Collection, Iterable
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final

import click
from msgspec import structs

from zscout import terminal
from zscout.behaviors.client.placer_client import PlacerClient
from zscout.cli import common, completion, ownership
from zscout.config.strict import BadInput, quoted
from zscout.keyexpr import Role, check_name
from zscout.messages import ComponentList, ListComponents, ListPlacements, Placement, Placements

if TYPE_CHECKING:
    from zscout.behaviors.client.client import Client
    from zscout.mesh import Mesh


PLACER_TIMEOUT_S: Final = 15.0
"""Long enough for a change of leader meanwhile."""
FIND_HOSTS_S: Final = 1.0
"""Within this time nodes answer, and their tokens are seen."""
OVER: Final = frozenset({"ended", "given_up"})
"""States of a component that will not run again by itself."""


def placer_of(client: Client, only: Collection[str] | None = None) -> PlacerClient:
    return PlacerClient(client.mesh, only, timeout=PLACER_TIMEOUT_S)


@asynccontextmanager
async def connected(
    command: str, only: Collection[str] | None = None, *, as_json: bool
) -> AsyncIterator[tuple[Client, Progress, PlacerClient]]:
    """Client, progress and placer of a command, once the placer has listed all components, or those in `only`. Raises
    NobodyThere, MeshError, RequestRefused."""
    async with common.connected(command) as client:
        with Progress(quiet=as_json) as shown, placer_of(client, only) as placer:
            await placer.refresh()
            yield client, shown, placer


async def ask_for_others(client: Client, placer: PlacerClient, names: Iterable[str], verb: str, *, yes: bool) -> None:
    """Ask before touching components of another certificate (a plain mesh has no owners). Raises Failed for a no."""
    found = [placement for name in names if (placement := placer.placements.get(name)) and placement.spec.owner]
    others = [
        f"{placement.component} of {placement.spec.owner}"
        for placement in found
        if placement.spec.owner != client.mesh.me.host
    ]
    await ownership.ask_for_others(client, others, verb, yes=yes)


class Progress(terminal.LiveLine):
    """Progress on stdout: a live line at a terminal, a line for each change in a pipe, nothing if `quiet`."""

    def __init__(self, *, quiet: bool) -> None:
        super().__init__(shown=not quiet)
        self._quiet = quiet
        self._last = ""

    def update(self, text: str) -> None:
        self.draw(text)
        if text != self._last and not (self.watched or self._quiet):
            self.print(text)
        self._last = text

    def finish(self, text: str) -> None:
        """It stays on the screen."""
        self.hide()
        if not self._quiet:
            self.print(text)

    @asynccontextmanager
    async def within(self, seconds: float | None, late: Callable[[], str], interrupted: str) -> AsyncIterator[None]:
        """Raises Failed with `late()` after `seconds`; on Ctrl-C prints `interrupted` on stderr."""
        try:
            async with asyncio.timeout(seconds):
                yield
        except TimeoutError:
            raise common.Failed(late()) from None
        except asyncio.CancelledError:
            self.hide()
            terminal.print_line(interrupted, sys.stderr)
            raise


STATE_WORDS: Final = {
    "running": "runs on {host}",
    "starting": "is starting on {host}",
    "waiting": "waits for a host{why}",
    "moving": "is moving from {host} to {to}",
    "backing_off": "failed, and will be restarted{why}",
    "stopping": "is being stopped on {host}",
    "ended": "has ended{why}",
    "given_up": "is given up{why}",
}


def state_words(placement: Placement) -> str:
    why = f": {placement.reason}" if placement.reason else ""
    return STATE_WORDS[placement.state].format(
        host=placement.host or "no host", to=placement.to or "another host", why=why
    )


def remedy(placement: Placement) -> str:
    name, kind = placement.component, placement.spec.kind
    if placement.state in OVER:
        again = kind if kind == name else f"{kind} --name {name}"
        return f"see zscout component logs {name}, then start it again: zscout component start {again}"
    if placement.state in ("waiting", "backing_off"):
        return f"zscout component list {name} shows when it runs"
    return "try again when it runs"


async def nodes_of(mesh: Mesh) -> set[str]:
    return {token.host for token in await mesh.living(mesh.keys.alive_any(Role.NODE), timeout=FIND_HOSTS_S)}


async def absent(mesh: Mesh, hosts: Collection[str]) -> list[str]:
    """Return an error line for each of these hosts that is not on the mesh, with similar names."""
    nodes = await nodes_of(mesh) if hosts else set()
    hints = {
        host: common.hint_at(host, nodes, "and there are none; start zscout-node there", "there are")
        for host in hosts
        if host not in nodes
    }
    return [f"unknown host {quoted(host)}{hint}" for host, hint in hints.items()]


async def ask_nodes(mesh: Mesh, asked: ListComponents) -> list[ComponentList]:
    replies = await common.ask_nodes(mesh, asked, ComponentList, FIND_HOSTS_S)
    lists = (reply.message for reply in replies if reply.message is not None)
    return sorted(lists, key=lambda answer: answer.host)


async def check_kind(mesh: Mesh, kind: str) -> None:
    """Raises Failed if every node answers that it lacks this kind."""
    nodes = await nodes_of(mesh)
    answers = {answer.host: answer.kinds for answer in await ask_nodes(mesh, ListComponents())}
    kinds: set[str] = set()
    for host in nodes | answers.keys():
        if (found := answers.get(host)) is None or kind in found:
            return
        kinds |= set(found)
    raise common.unknown("kind", kind, kinds, "and no host has any kind; install it there", "kinds")


def unknown(name: str, known: Iterable[str]) -> common.Failed:
    return common.unknown("component", name, known, "and there are none; see zscout component start", "known")


async def unknown_here(placer: PlacerClient, name: str) -> common.Failed:
    """Like `unknown`, with the names of all components. Raises RequestRefused."""
    every = await placer.request(ListPlacements(), Placements)
    return unknown(name, (placement.component for placement in every.components))


def out_of_work(placement: Placement) -> str:
    return "" if placement.dead is None else f", out of work for {placement.dead * 1000:.0f} ms"


def tail_of(placement: Placement) -> list[str]:
    """Return the last lines of a component's output, without control characters."""
    return [terminal.clean(line.expandtabs()) for line in placement.tail.splitlines()]


def placement_object(placement: Placement) -> dict[str, Any]:
    """Return every field of a placement, defaults included, for `--json`."""
    return structs.asdict(placement) | {"spec": structs.asdict(placement.spec)}


def component_named(text: str, _option: str = "") -> str:
    """Raises BadInput."""
    try:
        return check_name(text, "component")
    except ValueError as error:
        raise BadInput(f"{error}; see zscout component list") from None


COMPONENT: Final = common.Parsed("text", component_named)
component_argument = click.argument("name", type=COMPONENT, shell_complete=completion.components)
host_argument = click.argument("host", type=common.NAME, shell_complete=completion.hosts)


def host_option(name: str, help: str, **more: Any) -> Callable[[common.F], common.F]:  # noqa: A002 - click's word
    return click.option(name, metavar="HOST", type=common.NAME, shell_complete=completion.hosts, help=help, **more)
