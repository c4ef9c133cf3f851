"""`zscout-node`: one host's part of its fleet, configured by its node file.

It is a candidate for the RCM, reports the host's load, runs the host's RCs, starts components, and runs the recorder as
a process of its own.
"""

from __future__ import annotations

import asyncio
import errno
import functools
import gc
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from ipaddress import ip_address
from pathlib import Path

import click
import uvloop

from zscout import __version__
from zscout.config.certificates import PLACES_KEY, read_places_key
from zscout.config.fleet import Fleet, RcmLimits
from zscout.config.local_users import is_stranger, listeners, user_name
from zscout.config.node import CalendarConfig, MetricsConfig, Node, default_node, load_node
from zscout.config.state_folder import state_folder
from zscout.config.strict import BadInput
from zscout.keyexpr import Role, Sender, Token, new_instance
from zscout.logs import log_to_stderr, shortage
from zscout.mesh import Mesh, MeshError, ZenohMesh
from zscout.mesh.supervision import StallWatch, Supervisor
from zscout.messages import LoadReport
from zscout.rcm.authority import Authority
from zscout.services.bookings.host_clock import is_synchronised
from zscout.services.bookings.keeper import BookingFile, BookingKeeper
from zscout.services.journal.journal import Journal
from zscout.services.metrics.node_figures import NodeFigures
from zscout.services.node.component_host import ComponentHost
from zscout.services.node.load_reporter import LoadReporter
from zscout.services.node.local_rcs import LocalRcs, RcNotOpened
from zscout.services.node.reload import FilesInForce, Reload, rights_of
from zscout.services.node.service_manager import ServiceManager
from zscout.services.notify.notifier import Notifier
from zscout.services.plain_http import PlainHttpServer
from zscout.services.rcm.candidate import Candidate, CandidateParts
from zscout.services.rcm.digest import HoldListener
from zscout.services.rcm.observed_runtimes import RuntimeObserver
from zscout.services.rcm.term_file import TermFile
from zscout.services.recorder.process import RecorderProcess
from zscout.streams import escape_what_cannot_be_written
from zscout.types import SECOND, clean

log = logging.getLogger("zscout.node")

LOOK_FOR_TWIN = 0.5
"""Seconds to look for another node with the same name."""
TWIN_SHOWN = 0.1
"""Seconds for the token of such a node to arrive."""
ALONE_AFTER = 3.0
"""Seconds without any link after which a node logs a warning."""

LIMITS = [f"limits.{name}" for name in RcmLimits.__struct_fields__ if name != "max_payload"]
"""Keys that can be reloaded while this node leads."""

THREADS_END = 5.0
"""Seconds that threads of drivers have to end after all else."""


class NodeFailed(Exception):
    """A service failed without which the node can't run; it has been logged."""


async def run_node(
    node: Node, stop: asyncio.Event, reload: Reload | None = None, manager: ServiceManager | None = None
) -> None:
    """Run a node until `stop`. Raises MeshError if it can't start, NodeFailed if a service fails."""
    async with await ZenohMesh.open(node.fleet, Sender(node.host, "node"), follow=False) as mesh:
        await run_services(node, mesh, stop, reload, manager)


async def run_services(
    node: Node, mesh: Mesh, stop: asyncio.Event, reload: Reload | None = None, manager: ServiceManager | None = None
) -> None:
    """The recorder, the load reporter and the candidate restart themselves; a failed RC or component host ends the
    node, in order. Raises BadInput if an RC's driver is missing."""
    me, failures = mesh.me, list[Exception]()
    manager = manager or ServiceManager()
    folder = functools.cache(functools.partial(state_folder, node.fleet.name, me.host, node.state))

    def fail(error: Exception) -> None:
        failures.append(error)
        stop.set()

    async with AsyncExitStack() as stack:
        # Two nodes with one name would answer each other's queries.
        key, twin = mesh.keys.alive_any(Role.NODE), f"; end it, or set another host than {me.host} under [node]"
        living = await mesh.living(key, timeout=LOOK_FOR_TWIN)
        if any(token.host == me.host for token in living):
            raise MeshError(f"a node named {me.host} is already on the mesh{twin}")
        stall = StallWatch(mesh.now).start()
        stack.callback(stall.stop)
        mesh.watch_links()
        # If two start at the same time, the later leaves.
        own = Token(me.host, Role.NODE, me.client, f"{time.time_ns() // 1_000:014x}{new_instance()}")
        token = mesh.alive(own)
        stack.callback(token.close)
        await asyncio.sleep(TWIN_SHOWN)
        living = await mesh.living(key, timeout=LOOK_FOR_TWIN)
        if any(token.host == me.host and token.instance < own.instance for token in living):
            raise MeshError(f"a node named {me.host} began at the same time{twin}")
        watching = mesh.watch(key, functools.partial(_look_for_twin, own))
        stack.callback(watching.close)
        rcs = LocalRcs(mesh, node, folder, stall, fail)
        stack.push_async_callback(rcs.stop)
        try:
            await rcs.start()
        except RcNotOpened as error:
            raise NodeFailed(str(error)) from error
        copies: BookingKeeper | None = None

        def keep_copies() -> None:
            """Keep copies of the fleet's bookings on a node with RCs. A candidate does so in any case."""
            nonlocal copies
            if copies is None and rcs.controllers and not node.candidate:
                copies, keeping = _keeper(mesh, node, folder()), Supervisor("booking keeper", fail)
                copies.start(keeping)
                stack.callback(copies.stop)
                stack.push_async_callback(keeping.close)

        keep_copies()
        authority = Authority(node.fleet)
        components = ComponentHost(mesh, node.fleet, node.components, fail, authority=authority)
        recorder = RecorderProcess(node.recorder, node.fleet, node.host) if node.recorder is not None else None
        if node.load:
            files = reload.in_force if reload is not None else FilesInForce(rights_of(node))
            reporter = LoadReporter(
                mesh, node.labels, components.running, files, tree=node.load == "tree", recorder=recorder
            )
            reporter.start()
            stack.push_async_callback(reporter.stop)
        if recorder is not None:
            await recorder.start()
            stack.push_async_callback(recorder.stop)
        candidate: Candidate | None = None
        figures = NodeFigures(node, mesh, rcs)
        listeners: list[HoldListener] = [figures.holds] if node.metrics is not None else []
        if node.candidate:
            journal, runtimes, kept = None, RuntimeObserver(), folder()
            if kept is not None and node.fleet.may_lead(me.host) and not node.journal.off:
                silence = node.fleet.silence / SECOND
                journal = Journal(mesh, kept, node.journal, silence, on_opened=runtimes.recall)
                journal.start()
                stack.push_async_callback(journal.stop)
            parts = CandidateParts(
                kept,
                authority,
                _places_key(node.fleet),
                listeners,
                journal,
                runtimes,
                _keeper(mesh, node, kept),
                TermFile(kept, node.fleet.name) if kept is not None else None,
            )
            if node.notify is not None:
                notifier = Notifier(node.fleet.name, node.notify, lambda: _reports(candidate))
                notifier.start()
                stack.callback(notifier.stop)
                listeners.append(notifier.holds)
                parts = parts._replace(on_danger=notifier.on_danger)
            candidate = Candidate(mesh, node.fleet, parts)
            candidate.start()
            stack.push_async_callback(candidate.stop)
        if node.metrics is not None:
            figures.candidate = candidate
            stack.push_async_callback(await _serve_figures(node.metrics, figures))
        if node.calendar is not None:
            stack.push_async_callback(await _serve_calendars(node.calendar, mesh, node.fleet.name))
        await components.start()
        # Stopped first, so that components give back their ARCs while the RCM and the RCs still run.
        stack.push_async_callback(components.stop)
        status = f"{node.host} is on the mesh of fleet {node.fleet.name}"
        log.info(status)
        if reload is not None:
            reload.takes(lambda new: components.take(new.components), "components")

            def take_fleet(new: Node) -> None:
                authority.reload(new.fleet)
                figures.holds.take(new.fleet.access)
                if candidate is not None:
                    candidate.on_reload(new.fleet)
                mesh.admit(new.fleet.access.members())

            async def take_rcs(new: Node) -> None:
                try:
                    await rcs.take(new)
                finally:
                    keep_copies()

            defaults = "fleet.min_runtime", "fleet.command_min_runtime"
            reload.takes(take_fleet, "roles", "groups", "access", "quotas", "ceilings", "devices", *defaults, *LIMITS)
            reload.takes(take_rcs, "rc")
            reloading = asyncio.create_task(reload.serve(manager, status))
            stack.push_async_callback(_cancelled, reloading)
        manager.ready(status)
        alone = asyncio.get_running_loop().call_later(ALONE_AFTER, _say_if_alone, mesh)
        stack.callback(alone.cancel)
        await stop.wait()
        log.info("stopping")
        manager.stopping("ends in order")
    if failures:
        raise NodeFailed(f"a service failed: {failures[0]!r}; see the log") from failures[0]


def _look_for_twin(own: Token, other: Token, alive: bool) -> None:
    """Both started without seeing each other, and both run."""
    if alive and other.host == own.host and other.instance != own.instance:
        log.error("another node named %s is on the mesh too; end one, or set another host under [node]", own.host)


def _keeper(mesh: Mesh, node: Node, folder: Path | None) -> BookingKeeper:
    disk = BookingFile(folder, node.fleet.name) if folder is not None else None
    return BookingKeeper(mesh, disk, candidate=node.candidate, wall=time.time, synchronised=is_synchronised)


async def _cancelled(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.wait({task})


async def _serve_figures(metrics: MetricsConfig, figures: NodeFigures) -> Callable[[], Awaitable[None]]:
    """Return the function that stops it. Raises NodeFailed."""
    from zscout.services.metrics.server import MetricsServer

    server = MetricsServer(figures.samples, metrics.bind, metrics.port)
    if await _serve("metrics", server):
        log.info("metrics at http://%s:%d/metrics", metrics.bind, server.port)
    return server.stop


async def _serve_calendars(calendar: CalendarConfig, mesh: Mesh, fleet: str) -> Callable[[], Awaitable[None]]:
    """Return the function that stops it. Raises NodeFailed."""
    from zscout.services.bookings.calendar_server import CalendarServer

    server = CalendarServer(mesh, fleet, calendar.bind, calendar.port)
    if await _serve("calendar", server):
        log.info("calendars at http://%s:%d/fleet.ics", calendar.bind, server.port)
    return server.stop


async def _serve(table: str, server: PlainHttpServer) -> bool:
    """Return False if another user of this machine has the port: the node runs without it. Raises NodeFailed."""
    try:
        await server.start()
    except OSError as error:
        words = f"[{table}] can't be served at {server.bind}:{server.port}: {error.strerror}"
        holders = {*listeners(ip_address(server.bind), server.port)}
        if error.errno != errno.EADDRINUSE or not holders or not all(map(is_stranger, holders)):
            raise NodeFailed(words) from error
        log.error(  # noqa: TRY400 - one clear line
            "%s; user %s has the port: running without it", words, ", ".join(map(user_name, holders))
        )
        return False
    return True


def _reports(candidate: Candidate | None) -> list[LoadReport]:
    balancer = None if candidate is None else candidate.balancer
    return [] if balancer is None else [report for _, report in balancer.core.reports.values()]


def _places_key(fleet: Fleet) -> bytes | None:
    """Raises BadInput."""
    if fleet.security is None:
        return None
    if (key := read_places_key(fleet.security)) is None:
        log.warning("%s has no %s: places are not sealed; copy it from the CA's folder", fleet.security, PLACES_KEY)
    return key


def _say_if_alone(mesh: Mesh) -> None:
    if mesh.links() == 0:
        log.warning("no link to any other node or program yet; if you expect one, run zscout doctor NODE_FILE")


async def _main(reload: Reload, manager: ServiceManager) -> None:
    stop = asyncio.Event()
    reload.on_hangup()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    try:
        await run_node(reload.node, stop, reload, manager)
    finally:
        # Python restores its signal handlers at exit; a late SIGHUP would then kill it.
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        # The interpreter waits for threads, and a driver's thread may hang in its device.
        last = threading.Timer(THREADS_END, _end)
        last.daemon = True
        last.start()


def _end() -> None:
    log.warning("a driver's thread hangs: exiting without it")
    logging.shutdown()
    os._exit(1)


@click.command(context_settings={"help_option_names": ["-h", "--help"]})
@click.argument("file", required=False, type=click.Path(path_type=Path))
@click.option("--check", is_flag=True, help="Check FILE and its drivers on this host, and start nothing.")
@click.option("--log-level", type=click.Choice(["debug", "info", "warning", "error"]), default="info")
@click.version_option(__version__)
def main(file: Path | None, check: bool, log_level: str) -> None:
    """Run this host's part of a fleet, as configured by the node FILE (TOML).

    Without FILE, the node may lead the fleet "zscout" and reports the host's load. `zscout simulate --node lab.toml`
    writes a node file for a simulated building; docs/reference/node-file.md lists all settings.

    \b
    Examples:
      zscout-node
      zscout-node lab.toml
      zscout-node --check lab.toml
    """
    escape_what_cannot_be_written()
    log_to_stderr(log_level.upper())
    manager = ServiceManager.from_env()
    try:
        reload = Reload(lambda: load_node(file) if file is not None else default_node())
        if check:
            node = reload.node
            click.echo(f"{node.host} of fleet {node.fleet.name}: {file or 'the defaults'} can be used here")
            return
        # Exclude all imported objects from collections, which would delay a leader's decisions. Collect young objects
        # rarely: there are many, and few are in cycles.
        gc.freeze()
        gc.set_threshold(20_000, 20, 50)
        uvloop.run(_main(reload, manager))
    except Exception as error:
        words = str(error) if isinstance(error, (BadInput, MeshError, NodeFailed)) else shortage(error)
        if not words:
            raise
        manager.stopping(words)
        click.echo(f"zscout-node: {clean(words)}", err=True)
        sys.exit(2 if isinstance(error, BadInput) else 1)


if __name__ == "__main__":
    main()
