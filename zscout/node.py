"""`zscout-node`: what one host does in its fleet, as its node file says.

It stands as a candidate for the RCM, reports the host's load, runs the host's RCs, starts components, and
runs the recorder as a process of its own.
"""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
from contextlib import AsyncExitStack
from pathlib import Path

import click
import uvloop

from zscout import __version__
from zscout.config import Framegrabber, Node, Radio, RcSpec, Robot, Video, default_node, load_node
from zscout.drivers.base import Driver, ResourceController
from zscout.drivers.generic import CapacityDriver, ExclusiveDriver
from zscout.drivers.video import VideoDriver
from zscout.keyexpr import Role, Sender, Token, new_instance
from zscout.mesh import Mesh, MeshError
from zscout.scheduling.model import SECOND
from zscout.services.candidate import Candidate
from zscout.services.component_host import ComponentHost
from zscout.services.load_reporter import LoadReporter
from zscout.services.recorder_process import RecorderProcess
from zscout.stall import StallWatch
from zscout.strict import BadInput

log = logging.getLogger("zscout.node")

LOOK_FOR_TWIN = 0.5
ALONE_AFTER = 3.0
"""Seconds after which a node that is linked to nobody says so."""


async def run_node(node: Node, stop: asyncio.Event) -> None:
    """Runs a node until `stop`. Raises MeshError where it can't begin."""
    me = Sender(node.host, "node")
    async with AsyncExitStack() as stack:
        mesh = await stack.enter_async_context(await Mesh.open(node.fleet.name, me, node.fleet.mesh))
        await _refuse_twin(mesh)
        stall = StallWatch().start()
        stack.callback(stall.stop)
        token = mesh.alive(Token(me.host, Role.NODE, me.client, new_instance()))
        stack.callback(token.close)
        # Robots end first: their last word goes through a radio, which may be one of this node.
        for spec in sorted(node.rcs, key=lambda spec: isinstance(spec.device, Robot)):
            rc = ResourceController(
                mesh,
                spec.name,
                driver_for(spec),
                hold_lease=node.fleet.timing.hold_lease / SECOND,
                stall=stall,
            )
            await rc.start()
            stack.push_async_callback(rc.stop)
            log.info("runs %s (%s)", spec.name, spec.driver)
        components = ComponentHost(mesh, node.fleet, node.components)
        if node.load:
            reporter = LoadReporter(mesh, node.labels, components, tree=node.load == "tree")
            reporter.start()
            stack.push_async_callback(reporter.stop)
        if node.recorder is not None:
            recorder = RecorderProcess(node.recorder, node.fleet, node.host)
            await recorder.start()
            stack.push_async_callback(recorder.stop)
        if node.candidate:
            candidate = Candidate(mesh, node.fleet)
            candidate.start()
            stack.push_async_callback(candidate.stop)
        await components.start()
        # Before all else: they give back their ARCs while there is an RCM and while there are RCs.
        stack.push_async_callback(components.stop)
        log.info("%s is on the mesh of fleet %s", node.host, node.fleet.name)
        alone = asyncio.get_running_loop().call_later(ALONE_AFTER, _say_if_alone, mesh)
        stack.callback(alone.cancel)
        await stop.wait()
        log.info("stopping")


def driver_for(spec: RcSpec) -> Driver:
    """The driver that an RC of a node file asks for."""
    activation = spec.activation / SECOND
    # What a device needs is loaded where there is one: pyserial, OpenCV.
    match spec.device:
        case Radio() as radio:
            from zscout.drivers.radio import RadioDriver

            return RadioDriver(radio.port, baud=radio.baud, bound=radio.bound / SECOND)
        case Robot() as robot:
            from zscout.drivers.robot import RobotDriver

            return RobotDriver(
                robot.id,
                radio=robot.radio,
                channels=robot.channels,
                warm_up=robot.warm_up / SECOND,
                dead_man=robot.dead_man / SECOND,
            )
        case Video():
            return VideoDriver()
        case Framegrabber() as grabber:
            from zscout.drivers.framegrabber import FramegrabberDriver

            return FramegrabberDriver(grabber.sources, rate=grabber.rate, quality=grabber.quality)
        case None if spec.driver == "capacity":
            return CapacityDriver(spec.capacity, activation=activation)
        case None:
            return ExclusiveDriver(activation=activation)


async def _refuse_twin(mesh: Mesh) -> None:
    """Two nodes of one name would answer each other's questions."""
    living = await mesh.living(mesh.keys.alive_any(Role.NODE), timeout=LOOK_FOR_TWIN)
    if any(token.host == mesh.me.host for token in living):
        raise MeshError(f"a node named {mesh.me.host} is on the mesh already; set another host under [node]")


def _say_if_alone(mesh: Mesh) -> None:
    if mesh.links() == 0:
        log.warning(
            "no link to any other node or program yet; if there should be: is the fleet name the same, does "
            "multicast reach them, or else is `connect` set under [mesh]?"
        )


async def _main(node: Node) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    await run_node(node, stop)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("file", required=False, type=click.Path(path_type=Path))
@click.option("--log-level", type=click.Choice(["debug", "info", "warning", "error"]), default="info")
@click.version_option(__version__)
def main(file: Path | None, log_level: str) -> None:
    """Runs this host's part of a fleet, as the node FILE (TOML) says.

    Without FILE the node stands as a candidate for the RCM of the fleet "zscout" and reports the host's load.

    \b
    Examples:
      zscout-node
      zscout-node /etc/zscout/node.toml
    """
    logging.basicConfig(
        level=log_level.upper(), format="%(asctime)s %(levelname)s %(message)s", stream=sys.stderr
    )
    try:
        node = load_node(file) if file is not None else default_node()
        uvloop.run(_main(node))
    except BadInput as error:
        click.echo(f"zscout-node: {error}", err=True)
        sys.exit(2)
    except MeshError as error:
        click.echo(f"zscout-node: {error}", err=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
