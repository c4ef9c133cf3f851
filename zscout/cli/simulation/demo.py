"""`zscout demo`: demonstrations on a live mesh on this machine."""

from __future__ import annotations

import sys
from collections.abc import Callable, Coroutine
from contextlib import AsyncExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar
from urllib.parse import urlsplit

import click

from zscout import terminal
from zscout.cli import common
from zscout.cli.simulation.options import DefaultGroup
from zscout.cli.simulation.simulate import BUILDING, buildings
from zscout.config.strict import BadInput
from zscout.types import POLICIES, Policy

if TYPE_CHECKING:
    from zscout.cli.fleet.view import Child
    from zscout.simulation.demo.screen import LiveView

SCENARIOS: Final = ("at-once", "staggered")

F = TypeVar("F", bound=Callable[..., Any])


@click.group(cls=DefaultGroup, default="robots")
def demo() -> None:
    """Show what zscout does on a live mesh on this machine. Default: robots.

    \b
    Examples:
      zscout demo
      zscout demo --web
      zscout demo table1 --out demo.rrd
      zscout demo placement
    """


class _Live:
    """The Rerun viewer beside a demo: a window, or a page for a browser, which keeps its address for the recording."""

    def __init__(self, stack: AsyncExitStack, *, web: bool) -> None:
        self._stack, self._web = stack, web
        self._port = self._stream = 0
        self._window: Child | None = None

    async def open(self, url: str) -> str:
        from zscout.cli.fleet.view import WEB_PORT, open_viewer
        from zscout.ports import free_port
        from zscout.services.recorder.process import Recording

        self._stream = urlsplit(url).port or 0
        self._port = free_port("127.0.0.1", WEB_PORT, 0)
        shown = open_viewer(Recording("", url), web=self._web, port=self._port)
        self._window, address = await self._stack.enter_async_context(shown)
        return f"Live: open {address}" if address is not None else "Live in the viewer's window"

    async def finished(self, recording: Path) -> None:
        from zscout.cli.fleet.view import open_viewer
        from zscout.services.recorder.process import Recording

        if self._web:
            await self._stack.aclose()
            shown = open_viewer(Recording(str(recording), None), web=True, port=self._port, stream=self._stream)
            self._window, address = await self._stack.enter_async_context(shown)
            terminal.print_line(f"The page stays at {address}; Ctrl-C ends", sys.stderr)
        if self._window is not None:
            await self._window.process.wait()


def live_options(command: F) -> F:
    command = click.option("--view", is_flag=True, help="Show it live in the Rerun viewer's window.")(command)
    return click.option("--web", is_flag=True, help="Show it live in a browser; print the address to open.")(command)


async def _play_live(web: bool, view: bool, play: Callable[[LiveView | None], Coroutine[Any, Any, int]]) -> int:
    async with AsyncExitStack() as stack:
        return await play(_Live(stack, web=web) if web or view else None)


def _check_live(web: bool, view: bool) -> None:
    from zscout.cli.fleet.view import has_display

    if web and view:
        raise BadInput("--web and --view exclude each other; use only one of them")
    if view and not has_display():
        raise common.Failed("there is no display (neither DISPLAY nor WAYLAND_DISPLAY is set); use --web and a browser")


def recording_option(command: F) -> F:
    return click.option(
        "--out",
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="Write the recording here. Default: runs/demo-….rrd",
    )(command)


@demo.command()
@click.option(
    "--building",
    type=BUILDING,
    shell_complete=buildings,
    metavar="BUILDING",
    default="living_room",
    help="Use this building, as in zscout simulate: a name, a TOML file, or random:SEED.",
)
@click.option("--seed", type=click.IntRange(0), default=1, help="Seed of noise, slip and people.")
@click.option(
    "--speed", type=click.FloatRange(0.2, 4.0), default=1.5, help="Seconds of the building in one real second."
)
@recording_option
@live_options
@common.json_option("Print the summary as one JSON object.")
def robots(building: str, seed: int, speed: float, out: Path | None, web: bool, view: bool, as_json: bool) -> int:
    """Let the robots of a building hide in the dark and watch.

    The demo serves a simulated building with four robots, two framegrabbers and one radio, starts three nodes with
    these devices on this machine, apart from every other fleet, and places a sensor net. Halfway an operator takes one
    robot, drives it and releases it. The demo ends when all robots are hidden and a person has walked by, or a minute
    of the building later, after at most two and a half minutes. Only a recording is left, also after Ctrl-C.

    \b
    Examples:
      zscout demo robots
      zscout demo robots --web
      zscout demo robots --building office --speed 1 --out office.rrd
    """
    common.check_recording("--out", out)
    _check_live(web, view)
    # Import Zenoh only here: the help does not need it.
    from zscout.simulation.demo.robots_screen import play

    return common.run(_play_live(web, view, lambda live: play(building, seed, speed, out, as_json=as_json, live=live)))


@demo.command()
@recording_option
@live_options
@common.json_option("Print the tables as JSON.")
def table1(out: Path | None, web: bool, view: bool, as_json: bool) -> int:
    """Play Table 1 of the paper on a live mesh, and compare what happens with Table 2.

    The demo starts three nodes with four devices and five programs on this machine, apart from every other fleet,
    for about 25 seconds, and records them. Only the recording is left. Exit code 1: events came in another order
    than in Table 2; cells that are only late, on a busy machine, are named.

    \b
    Examples:
      zscout demo table1
      zscout demo table1 --out demo.rrd --json
    """
    common.check_recording("--out", out)
    _check_live(web, view)
    from zscout.simulation.demo.table1_screen import play

    return common.run(_play_live(web, view, lambda live: play(out, as_json=as_json, live=live)))


@demo.command()
@click.option(
    "--policy",
    "policies",
    multiple=True,
    type=click.Choice(POLICIES),
    help="Use this policy; repeat it for several. Default: all.",
)
@click.option(
    "--when",
    "scenarios",
    multiple=True,
    type=click.Choice(SCENARIOS),
    help="Start all components at once, or net by net. Default: both.",
)
@click.option(
    "--out",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="Keep a Rerun recording of each trial here.",
)
@common.json_option("Print one JSON object.")
def placement(policies: tuple[Policy, ...], scenarios: tuple[str, ...], out: Path | None, as_json: bool) -> int:
    """Place three Place Sensor Nets on three live nodes under each policy (Figure 3 of the paper).

    Each trial starts three nodes on this machine, apart from every other fleet; each node reports the load of
    its own components. Twelve components, which really use the processor, are started all at once or net by
    net. A trial takes about 12 seconds. Exit code 1: under `pending` two hosts differ by more than one component,
    or a policy with time to react did not use all hosts.

    \b
    Examples:
      zscout demo placement
      zscout demo placement --policy least_loaded --policy pending --when at-once
      zscout demo placement --out runs/figure3 --json
    """
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInput(f"--out {out}: can't be created ({error.strerror}); give another folder") from None
    from zscout.simulation.demo.placement_run import play

    # In the order in which the options list them.
    chosen = [
        (scenario, policy)
        for scenario in SCENARIOS
        if scenario in (scenarios or SCENARIOS)
        for policy in POLICIES
        if policy in (policies or POLICIES)
    ]
    return common.run(play(chosen, out, as_json=as_json))
