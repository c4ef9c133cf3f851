"""`zscout simulate`: a building with robots, served so that drivers cannot tell it from a real one."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from click.shell_completion import CompletionItem

from zscout.cli import common
from zscout.config.strict import BadInput, quoted
from zscout.lab.building.plan import Plan
from zscout.lab.building.plan_file import (
    MAX_SEED,
    RANDOM,
    known_buildings,
    load_plan,
    plan_named,
    shipped_plans,
)

if TYPE_CHECKING:
    from zscout.lab.building.serve import Served

MAX_FRAMEGRABBERS: Final = 16
MAX_SECONDS: Final = 1e9
SHOWN: Final = 0.5
"""Seconds from one live line to the next."""
_ADDRESS: Final = re.compile(r"(?:(?P<host>\[[0-9a-fA-F:.]+\]|[^:\[\]]+):)?(?P<port>[0-9]{1,5})")


class Building(click.ParamType[str]):
    """What serves as a building, completed by the names of those that are shipped and by files."""

    name = "building"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        return str(value)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        names = [name for name in (*shipped_plans(), f"{RANDOM}:1") if name.startswith(incomplete)]
        return [CompletionItem(name) for name in names] or [CompletionItem(incomplete, type="file")]


@click.command()
@click.argument("building", type=Building(), required=False)
@click.option("--list", "listing", is_flag=True, help="List the buildings that are shipped, and end.")
@click.option(
    "--seed",
    type=click.IntRange(0, MAX_SEED),
    default=0,
    show_default=True,
    help="Of all that is random in it: the same seed, the same building and noise.",
)
@click.option(
    "--speed",
    type=click.FloatRange(0, 100, min_open=True),
    default=1.0,
    show_default=True,
    help="The building's seconds in one of ours.",
)
@click.option(
    "--frames",
    type=click.FloatRange(0.1, 60),
    default=10.0,
    show_default=True,
    help="Pictures of each channel in a second of the building.",
)
@click.option(
    "--http",
    metavar="HOST:PORT",
    default="127.0.0.1:0",
    show_default=True,
    help="Where cameras are served; port 0 is any free one.",
)
@click.option(
    "--channels", type=click.IntRange(1, 15), default=4, show_default=True, help="Video channels served."
)
@click.option(
    "--baud",
    type=click.IntRange(300, 1_000_000),
    default=9600,
    show_default=True,
    help="Rate of the radio's line; the line is as much faster as the building is.",
)
@click.option(
    "--loss",
    type=click.FloatRange(0, 1),
    default=0.0,
    show_default=True,
    help="Share of the radio's packets that no robot hears.",
)
@click.option(
    "--radio",
    metavar="LINK",
    type=click.Path(path_type=Path),
    help="A name for the radio's port: a symlink, removed at the end.",
)
@click.option(
    "--node",
    metavar="FILE",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write a node file with all the devices: zscout-node FILE serves them.",
)
@click.option(
    "--framegrabbers",
    type=click.IntRange(1, MAX_FRAMEGRABBERS),
    default=2,
    show_default=True,
    help="How many the node file has.",
)
@click.option("--mesh", is_flag=True, help="Show recorders and operators on the mesh who is where.")
@click.option(
    "--for",
    "seconds",
    metavar="SECONDS",
    type=click.FloatRange(0, MAX_SECONDS, min_open=True),
    help="End after so many seconds of the building. Default: at Ctrl-C.",
)
@common.json_option("Print how to reach everything as one JSON object.")
def simulate(building: str | None, listing: bool, as_json: bool, **options: Any) -> None:
    """Serves a simulated building: a radio on a serial port, cameras as MJPEG over HTTP, in real time.

    BUILDING is the name of one that is shipped (--list), a TOML file, or random:SEED for one that is drawn.
    Robots move and see as packets over the radio tell them to; docs/simulation.md says what is true to life
    in it, and how a building is written.

    \b
    Examples:
      zscout simulate --list
      zscout simulate living_room --node lab.toml --radio radio0 --mesh
      zscout simulate random:7 --speed 2 --http 127.0.0.1:8080 --loss 0.05
    """
    if listing:
        _list(as_json=as_json)
        return
    if building is None:
        raise BadInput(f"which building? name one of {known_buildings()}, or a file")
    common.run(_serve(plan_named(building), as_json=as_json, **options))


def _list(*, as_json: bool) -> None:
    rows = [(name, load_plan(path)) for name, path in shipped_plans().items()]
    if as_json:
        common.print_json(
            [
                {
                    "building": name,
                    "width": plan.width,
                    "depth": plan.depth,
                    "robots": [robot.name for robot in plan.robots],
                }
                for name, plan in rows
            ]
        )
        return
    common.print_table(
        ("building", "metres", "furniture", "people", "robots"),
        [
            (
                name,
                f"{plan.width:g} x {plan.depth:g}",
                str(len(plan.furniture)),
                str(len(plan.people)),
                ", ".join(robot.name for robot in plan.robots),
            )
            for name, plan in rows
        ],
    )


def _address(text: str) -> tuple[str, int]:
    """Host and port of `HOST:PORT` or `PORT`. Raises BadInput."""
    found = _ADDRESS.fullmatch(text)
    if found is None or int(found["port"]) > 65_535:
        raise BadInput(f"--http {quoted(text)}: write HOST:PORT, as in 127.0.0.1:8080")
    return (found["host"] or "127.0.0.1").strip("[]"), int(found["port"])


async def _serve(
    plan: Plan,
    *,
    seed: int,
    speed: float,
    frames: float,
    http: str,
    channels: int,
    baud: int,
    loss: float,
    radio: Path | None,
    node: Path | None,
    framegrabbers: int,
    mesh: bool,
    seconds: float | None,
    as_json: bool,
) -> None:
    from zscout.lab.building.serve import Served

    # Asked for before anything is there to be cleared up: its file may be wrong.
    fleet = common.the_fleet() if mesh else None
    served = Served(
        plan,
        seed=seed,
        speed=speed,
        frame_rate=frames,
        baud=baud,
        loss=loss,
        http=_address(http),
        radio_link=radio,
        channels=channels,
    )
    async with AsyncExitStack() as stack:
        publishing: asyncio.Task[None] | None = None
        await stack.enter_async_context(served)
        access = _access(served)
        if node is not None:
            _write_node(node, served, framegrabbers)
            access["node"] = str(node)
        if mesh:
            from zscout.cli.lab.simulate_mesh import publish

            client = await stack.enter_async_context(common.connected("building", fleet, need_rcm=False))
            publishing = asyncio.create_task(publish(served, client.mesh))
            stack.push_async_callback(_end, publishing)
            access["mesh"] = str(client.mesh.me)
        if as_json:
            common.print_json(access)
        else:
            _print(access)
        with _live(served) if not as_json and common.at_terminal() else nullcontext():
            await _until(served, publishing, seconds or MAX_SECONDS)
    if not as_json:
        common.print_line(_line(served))


async def _until(served: Served, publishing: asyncio.Task[None] | None, seconds: float) -> None:
    """Until the building's time; raises what went wrong in it, or on its way to the mesh."""
    ending = asyncio.create_task(served.until(seconds))
    try:
        tasks = {ending} | ({publishing} if publishing is not None else set())
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        await _end(ending)


async def _end(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


def _write_node(path: Path, served: Served, framegrabbers: int) -> None:
    from zscout.lab.building.node_file import node_file

    text = node_file(served, fleet=common.fleet_file(), framegrabbers=framegrabbers)
    try:
        path.write_text(text)
    except OSError as error:
        raise BadInput(f"{path}: can't be written ({error.strerror}); give another --node") from None


# How to reach it


def _access(served: Served) -> dict[str, Any]:
    """How to reach everything, for `--json`."""
    link = served.radio.link
    return {
        "building": served.plan.name,
        "seed": served.seed,
        "speed": served.speed,
        "frames": served.frame_rate,
        "radio": {
            "port": str(link.absolute()) if link is not None else served.radio.port,
            "baud": served.radio.baud,
        },
        "http": served.video.page,
        "channels": [
            {"channel": number, "video": f"video/{name}", "url": served.video.url(name)}
            for number, name in enumerate(served.channels, 1)
        ],
        "robots": [
            {"name": robot.name, "rc": f"robot/{robot.name}", "id": robot.id} for robot in served.plan.robots
        ],
        "node": None,
        "mesh": None,
    }


def _print(access: dict[str, Any]) -> None:
    pace = f" at {access['speed']:g} times real time" if access["speed"] != 1 else ""
    common.print_line(f"{access['building']}, seed {access['seed']}{pace}")
    common.print_line(f"radio    {access['radio']['port']}  {access['radio']['baud']} baud")
    for channel in access["channels"]:
        common.print_line(f"camera   {channel['url']}  channel {channel['channel']}")
    for robot in access["robots"]:
        common.print_line(f"robot    {common.clean(robot['name'])}  id {robot['id']}")
    if access["node"] is not None:
        common.print_line(f"node     {access['node']}: start it with zscout-node {access['node']}")
    if access["mesh"] is not None:
        common.print_line(f"mesh     {access['mesh']} tells who is where")


def _line(served: Served, rate: float | None = None, cpu: float | None = None) -> str:
    """How it is, in one line."""
    radio = served.radio
    words = [common.span(served.time)]
    if rate is not None:
        words += [f"speed {served.true_speed():.2f}", f"{rate:.0f} frames/s"]
    else:
        words += [f"{served.frames} frames"]
    words += [f"{radio.received} packets heard, {radio.lost} lost"]
    if radio.spoiled:
        words += [f"{radio.spoiled} spoiled"]
    if served.late:
        words += [f"{served.late} frames late"]
    if served.clock.slipped >= 0.05:
        words += [f"{common.span(served.clock.slipped)} behind: this machine is too busy"]
    if cpu is not None:
        words += [f"CPU {cpu:.0f} %"]
    return "  ".join(words)


@contextmanager
def _live(served: Served) -> Iterator[None]:
    """A line in place at the terminal, as long as the context lasts."""
    import psutil
    from rich.live import Live
    from rich.text import Text

    process, loop = psutil.Process(), asyncio.get_running_loop()
    before = loop.time(), served.frames

    def shown() -> Text:
        nonlocal before
        now = loop.time()
        rate = (served.frames - before[1]) / max(now - before[0], 1e-3)
        before = now, served.frames
        text = Text(_line(served, rate, process.cpu_percent()))
        return text.append("  Ctrl-C ends", style="dim")

    async def draw() -> None:
        while True:
            await asyncio.sleep(SHOWN)
            live.update(shown(), refresh=True)

    with Live(console=common.console(), auto_refresh=False, transient=True) as live:
        drawing = asyncio.ensure_future(draw())
        try:
            yield
        finally:
            drawing.cancel()
