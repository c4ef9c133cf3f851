"""`zscout simulate`: serve a building for a time, print how to reach it, and publish positions on the mesh."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import Any, Final

import psutil

from zscout import terminal
from zscout.behaviors.client.client import Client
from zscout.config.fleet import Fleet
from zscout.config.strict import BadInput
from zscout.keyexpr import new_instance
from zscout.mesh import IncomingQuery, Mesh
from zscout.messages.behaviors import BuildingPoses, PlanAsk
from zscout.simulation.building.node_file import node_file
from zscout.simulation.building.plan import Plan
from zscout.simulation.building.plan_file import load_plan, shipped_plans
from zscout.simulation.building.serve import Served

EVERY: Final = 0.2  # s of real time between two publications of positions
SHOWN: Final = 0.5  # s between two live lines
MAX_SECONDS: Final = 1e9


async def simulate(
    plan: Plan,
    *,
    mesh_of: Fleet | None,
    fleet_file: Path | None,
    node: Path | None,
    framegrabbers: int,
    seconds: float | None,
    as_json: bool,
    **of_served: Any,
) -> None:
    """Serve a building (`of_served`: arguments of `Served`) for `seconds` of its time, or without end. `mesh_of`:
    publish positions there. `node`: write a node file there with all devices, in the fleet of `fleet_file`. Raises
    BadInput, MeshError."""
    served = Served(plan, **of_served)
    async with AsyncExitStack() as stack:
        publishing: asyncio.Task[None] | None = None
        await stack.enter_async_context(served)
        access = _access(served)
        if node is not None:
            _write_node(node, node_file(served, fleet=fleet_file, framegrabbers=framegrabbers))
            access["node"] = str(node)
        if mesh_of is not None:
            client = await Client.connect(f"building-{new_instance()}", fleet=mesh_of)
            await stack.enter_async_context(client)
            publishing = asyncio.create_task(_publish(served, client.mesh))
            stack.push_async_callback(_end, publishing)
            access["mesh"] = str(client.mesh.me)
        if as_json:
            terminal.print_json(access)
        else:
            _print(access)
        with _live(served) if not as_json and terminal.at_terminal() else nullcontext():
            await _until(served, publishing, seconds or MAX_SECONDS)
    if not as_json:
        terminal.print_line(_line(served))


async def _until(served: Served, publishing: asyncio.Task[None] | None, seconds: float) -> None:
    """Wait for the building's time; raises errors of the building and of the publications."""
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


def _write_node(path: Path, text: str) -> None:
    try:
        path.write_text(text)
    except OSError as error:
        raise BadInput(f"{path}: can't be written ({error.strerror}); name another file with --node") from None


async def _publish(served: Served, mesh: Mesh) -> None:
    plan = await served.map()

    def answer(request: IncomingQuery[PlanAsk]) -> None:
        request.answer(plan)

    keys = mesh.keys
    queryable = mesh.serve(keys.building_plan(mesh.me), PlanAsk, answer)
    poses = mesh.publisher(keys.building_poses(mesh.me), BuildingPoses, data=True)
    loop = asyncio.get_running_loop()
    try:
        due = loop.time()
        while True:
            poses.put(await served.poses())
            due = max(due + EVERY, loop.time())
            await asyncio.sleep(due - loop.time())
    finally:
        poses.close()
        queryable.close()


def _access(served: Served) -> dict[str, Any]:
    link = served.radio.link
    return {
        "building": served.plan.name,
        "seed": served.seed,
        "speed": served.speed,
        "frames": served.frame_rate,
        "radio": {"port": str(link.absolute()) if link is not None else served.radio.port, "baud": served.radio.baud},
        "http": served.video.page,
        "channels": [
            {"channel": number, "video": f"video/{name}", "url": served.video.url(name)}
            for number, name in enumerate(served.channels, 1)
        ],
        "robots": [{"name": robot.name, "rc": f"robot/{robot.name}", "id": robot.id} for robot in served.plan.robots],
        "node": None,
        "mesh": None,
    }


def _print(access: dict[str, Any]) -> None:
    pace = f" at {access['speed']:g} times real time" if access["speed"] != 1 else ""
    terminal.print_line(f"{access['building']}, seed {access['seed']}{pace}")
    terminal.print_line(f"radio    {access['radio']['port']}  {access['radio']['baud']} baud")
    for channel in access["channels"]:
        terminal.print_line(f"camera   {channel['url']}  channel {channel['channel']}")
    for robot in access["robots"]:
        terminal.print_line(f"robot    {terminal.clean(robot['name'])}  id {robot['id']}")
    if access["node"] is not None:
        terminal.print_line(f"node     {access['node']}: start it with zscout-node {access['node']}")
    if access["mesh"] is not None:
        terminal.print_line(f"mesh     positions on {access['mesh']}")


def _line(served: Served, rate: float | None = None, cpu: float | None = None) -> str:
    radio = served.radio
    slipped = served.clock.slipped
    words = (
        terminal.span(served.time),
        f"{served.frames} frames" if rate is None else f"speed {served.true_speed():.2f}  {rate:.0f} frames/s",
        f"{radio.received} packets received, {radio.lost} lost",
        f"{radio.spoiled} spoiled" if radio.spoiled else "",
        f"{served.late} frames late" if served.late else "",
        f"{terminal.span(slipped)} behind: this machine is too busy" if slipped >= 0.05 else "",
        f"CPU {cpu:.0f} %" if cpu is not None else "",
    )
    return "  ".join(filter(None, words))


@contextmanager
def _live(served: Served) -> Iterator[None]:
    from rich.text import Text

    process, loop = psutil.Process(), asyncio.get_running_loop()

    async def draw() -> None:
        before = loop.time(), served.frames
        while True:
            await asyncio.sleep(SHOWN)
            now = loop.time()
            rate = (served.frames - before[1]) / max(now - before[0], 1e-3)
            before = now, served.frames
            text = Text(_line(served, rate, process.cpu_percent()))
            live.draw(text.append("  Ctrl-C ends", style="dim"))

    with terminal.LiveLine() as live:
        drawing = asyncio.ensure_future(draw())
        try:
            yield
        finally:
            drawing.cancel()


def print_shipped(*, as_json: bool) -> None:
    plans = {name: load_plan(path) for name, path in shipped_plans().items()}
    robots = {name: [robot.name for robot in plan.robots] for name, plan in plans.items()}
    if as_json:
        terminal.print_json(
            [
                {"building": name, "width": plan.width, "depth": plan.depth, "robots": robots[name]}
                for name, plan in plans.items()
            ]
        )
        return
    rows = [
        (name, f"{plan.width:g} x {plan.depth:g}", *(str(len(things)) for things in (plan.furniture, plan.people)))
        for name, plan in plans.items()
    ]
    terminal.print_table(
        ("building", "metres", "furniture", "people", "robots"), [(*row, ", ".join(robots[row[0]])) for row in rows]
    )
