"""`zscout view`: show a recording, or the fleet live, in the Rerun viewer: in its own window, or in a browser.

If a node of this host records, its recording is shown, including its past; otherwise a recorder is started. Viewer and
recorder are processes of their own that end with the command, however it ends."""

from __future__ import annotations

import asyncio
import ipaddress
import os
import re
import socket
import sys
from collections import deque
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final
from urllib.parse import quote

import click
import msgspec

from zscout import terminal
from zscout.behaviors.launch import LAUNCH
from zscout.cli import common
from zscout.cli.fleet.local_recording import MAGIC, local_address
from zscout.cli.fleet.viewer_page import ViewerPage, silent
from zscout.config.node import MAX_PAST, PAST, RecorderConfig
from zscout.config.strict import DURATIONS, BadInput, parse_duration, quoted
from zscout.keyexpr import NODES
from zscout.ports import free_port
from zscout.services.recorder.process import BAD_SETTINGS, QUIET, RecorderJob, Recording, encode_job
from zscout.types import SECOND, Ns

if TYPE_CHECKING:
    from zscout.config.fleet import Fleet
    from zscout.messages import Recorded

WEB_PORT: Final = 9090
PAGE: Final = "renderer=webgl&hide_welcome_screen=1&theme=dark"
"""Query of the page's address. The light theme, which a browser may prefer, shows names pale on pale."""
HOSTING: Final = "Hosting a web-viewer at"
START_TIMEOUT_S: Final = 20.0
"""Start of a recorder or a viewer, on a busy machine."""
END_TIMEOUT_S: Final = 40.0
"""Time for a child to end by itself: the recorder finishes its file."""
FIND_RECORDER_S: Final = 1.0
"""Timeout of one query for recorders."""
FIND_RECORDER_TRIES: Final = 5
FIND_RECORDER_DELAY_S: Final = 0.2
"""Pause between two such queries."""
CONNECT_TIMEOUT_S: Final = 1.0
MAX_LINE: Final = 65_536
KEPT_LINES: Final = 20
"""Last lines of a child's log that are kept, to explain a failure."""
WINDOW_ARGUMENTS: Final = ("--bind", "127.0.0.1", "--port", "auto", "--hide-welcome-screen")
"""Arguments of a viewer with a window of its own."""
_COLOURS: Final = re.compile(r"\x1b\[[0-9;]*m")


def parse_recorded_past(text: str, option: str) -> Ns:
    """Raises BadInput."""
    found = parse_duration(text)
    if found is None or found > MAX_PAST:
        raise BadInput(f"{option}: {quoted(text)} is not a duration up to {MAX_PAST // 86_400}d; write {DURATIONS}")
    return int(found * SECOND)


@click.command()
@click.argument("file", required=False, type=click.Path(path_type=Path))
@click.option("--web", is_flag=True, help="Serve the viewer to a browser, and print the address to open.")
@click.option(
    "--bind",
    metavar="IP",
    default="127.0.0.1",
    help="Address for the web page and live stream; anything but loopback shows them to other hosts.",
)
@click.option(
    "--port",
    type=click.IntRange(1, 65_535),
    help=f"Port of the web page, or without --web of the live stream. [default: {WEB_PORT} if free, or any]",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("runs"),
    help="Folder of the live recording, if no node of this host records.",
)
@click.option(
    "--past",
    type=common.Parsed("duration", parse_recorded_past),
    help="Show this much of the past from the journals, if no node of this host records; 0: none. [default: 24h]",
)
@common.json_option("Print one JSON object as soon as it is served or recorded: url, live, file.")
@common.runs
async def view(
    file: Path | None, web: bool, bind: str, port: int | None, out: Path, past: int | None, as_json: bool
) -> None:
    """Open the recording FILE (.rrd), or show the fleet live.

    If a node of this host records (table [recorder] in its file), its recording is shown with its past; otherwise
    the fleet is recorded from now on, and earlier holds come from the journals. The viewer opens a window; closing it
    ends the command. On a host without a display use --web. Ctrl-C ends everything that the command started, and
    completes its recording.

    \b
    Examples:
      zscout view
      zscout view --web --past 7d
      zscout view demo.rrd
      zscout view --web --json | jq -r --unbuffered .url
    """
    try:
        bind = str(ipaddress.ip_address("127.0.0.1" if bind == "localhost" else bind))
    except ValueError:
        raise BadInput(f"--bind: {quoted(bind)} is not an IP address; write one, as in 127.0.0.1") from None
    if file is not None:
        file = _checked(file)
    if not web and not has_display():
        raise common.Failed("there is no display (neither DISPLAY nor WAYLAND_DISPLAY is set); use --web and a browser")
    # Choose the port of the live stream first: the page, which is served last, connects to it.
    async with _source(file, bind, None if web else port, out, past) as (recording, recorder):
        if not as_json and file is None:
            terminal.print_line(f"{'Recording to' if recorder is not None else 'A node records to'} {recording.file}")
            terminal.print_line(f"Live at {recording.url}")
        async with open_viewer(recording, web=web, bind=bind, port=port if web else None) as (window, address):
            if as_json:
                terminal.print_json({"url": address, "live": recording.url, "file": recording.file})
            elif web:
                terminal.print_line(f"Open {address}")
                terminal.print_line("Ctrl-C ends")
            children = [window] + ([recorder] if recorder is not None else [])
            ended = await common.first_of(*(child_.process.wait() for child_ in children))
            for child_, over in zip(children, ended, strict=True):
                # The user may close the viewer.
                if over and (child_ is not window or child_.process.returncode != 0):
                    raise await child_.failed()


@asynccontextmanager
async def open_viewer(
    recording: Recording, *, web: bool, bind: str = "127.0.0.1", port: int | None = None, stream: int = 0
) -> AsyncIterator[tuple[Child, str | None]]:
    """Open a viewer with the recording, live if it has a `url`. Yield it, and with `web` the page's address once
    served. port: of the page; None: any. stream: port for a file's data to the page; 0: any. Raises BadInput,
    Failed."""
    shown = recording.url or recording.file
    if not web:
        async with viewer(*WINDOW_ARGUMENTS, *(["--connect"] if recording.url is not None else []), shown) as window:
            yield window, None
        return
    page = serving_port(bind, port) if port is not None else serving_port(bind, WEB_PORT, 0)
    # For a live recording the viewer serves only its page's files.
    own = bind if recording.url is None else "127.0.0.1"
    stream, files = serving_port(own, stream), serving_port(own, 0)
    ports = ("--web-viewer-port", str(files), "--port", str(stream))
    async with viewer("--serve-web", "--bind", own, *ports, shown, log="info") as window:
        await window.logged(HOSTING)
        source = recording.url or f"rerun+http://{_host(bind)}:{stream}/proxy"
        source = source.replace(f"//{_bracketed(bind)}:", f"//{_host(bind)}:")
        here = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(own, own)  # noqa: S104 - to reach it
        allowed = source.removeprefix("rerun+").removesuffix("/proxy")
        served = ViewerPage((here, files), allowed, bind, page)
        try:
            try:
                await served.start()
            except OSError:
                if port is not None:
                    raise
                # Another program took the port since it was found free: use any other.
                page = serving_port(bind, 0)
                served = ViewerPage((here, files), allowed, bind, page)
                await served.start()
        except OSError as error:
            raise BadInput(f"can't serve on {bind}, port {page} ({error.strerror}); choose another --port") from None
        try:
            yield window, f"http://{_host(bind)}:{page}/?url={quote(source, safe='')}&{PAGE}"
        finally:
            await served.stop()


@asynccontextmanager
async def _source(
    file: Path | None, bind: str, port: int | None, out: Path, past: int | None
) -> AsyncIterator[tuple[Recording, Child | None]]:
    """Yield the recording for the viewer, and the recorder if one was started."""
    from zscout.behaviors.client.identity import host_of

    if file is not None:
        yield Recording(str(file), None), None
        return
    fleet = common.the_fleet()
    joined, alone = await _recorded_here(fleet, bind)
    if joined is not None:
        if past is not None:
            terminal.print_line("zscout: --past is ignored: a node records, with the past set in its file", sys.stderr)
        yield joined, None
        return
    host = host_of(fleet)
    job = RecorderJob(
        RecorderConfig(out, bind, port or 0, past=PAST if past is None else past), fleet, host, joined=False
    )
    command = [sys.executable, "-m", "zscout.services.recorder"]
    async with child("the recorder", command, QUIET, job=encode_job(job)) as recorder:
        recording = await recorder.recording()
        if recording.url is None:
            raise common.Failed("the recorder serves no live stream; report this as a bug")
        if alone:
            terminal.print_line(f"zscout: {alone}", sys.stderr)
        yield recording, recorder


async def _recorded_here(fleet: Fleet, bind: str) -> tuple[Recording | None, str]:
    """The recording of a node of this host that pages on `bind` can show, if any, and a line to print if there is no
    RCM: the view is empty, and may fill later."""
    from zscout.messages import Recorded, RecordedAsk

    async with common.connected("view", fleet, need_rcm=False) as client:
        alone = ""
        try:
            await common.see_rcm(client)
        except common.NobodyThere as error:
            alone = str(error)
        mesh = client.mesh
        for _ in range(FIND_RECORDER_TRIES):
            replies = await mesh.ask(mesh.keys.recorded_any, RecordedAsk(), Recorded, timeout=FIND_RECORDER_S)
            for reply in replies:
                if reply.message is None or not _is_node(fleet, mesh.keys.sender_of(reply.key).host):
                    continue
                if (recording := await _reached(reply.message, bind)) is not None:
                    return recording, ""
            if alone:
                break
            # Links are made one after the other: the link to a recorder of this host may be the last.
            await asyncio.sleep(FIND_RECORDER_DELAY_S)
    return None, alone


def _is_node(fleet: Fleet, host: str) -> bool:
    """Return True if this host has the rights of a node; on a plain mesh always."""
    return fleet.security is None or bool(fleet.access.ranks_of(host) & NODES)


async def _reached(recorded: Recorded, bind: str) -> Recording | None:
    """The recording if a recorder of this host writes and serves it. `bind`: of the page; browsers that open it must
    reach the live stream as well."""
    address = await asyncio.to_thread(local_address, recorded, bind)
    if address is None:
        return None
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT_S):
            _, writer = await asyncio.open_connection(address, recorded.port)
    except OSError:
        return None
    writer.close()
    return Recording(recorded.file, f"rerun+http://{_bracketed(address)}:{recorded.port}/proxy")


def _checked(file: Path) -> Path:
    """Return the absolute path of FILE, since a name may begin with a dash. Raises BadInput if it is no recording."""
    try:
        if not file.is_file():
            raise BadInput(f"{file}: there is no such file; recordings of nodes and of zscout view are in runs/")
        with file.open("rb") as recording:
            begin = recording.read(len(MAGIC))
    except OSError as error:
        raise BadInput(f"{file}: can't be read: {error.strerror}; check the path and its permissions") from None
    if begin != MAGIC:
        raise BadInput(f"{file}: not a Rerun recording; name a .rrd file")
    if file.suffix != ".rrd":
        raise BadInput(f"{file}: the name does not end in .rrd; rename it")
    return file.absolute()


def serving_port(bind: str, *ports: int) -> int:
    """Return the first free port of `ports`; 0 means any. Raises BadInput if all are taken."""
    try:
        return free_port(bind, *ports)
    except OSError as error:
        reason = os.strerror(error.errno or 0)
        raise BadInput(f"can't serve on {bind}, port {ports[0]} ({reason}); choose another --port or --bind") from error


def _bracketed(address: str) -> str:
    return f"[{address}]" if ":" in address else address


def _host(bind: str) -> str:
    """Return the host in a URL for `bind`: this host's name if `bind` means all addresses."""
    return socket.gethostname() if ipaddress.ip_address(bind).is_unspecified else _bracketed(bind)


class Child:
    """A child process and the end of its log."""

    def __init__(self, what: str, process: asyncio.subprocess.Process) -> None:
        self.what, self.process = what, process
        self.lines: deque[str] = deque(maxlen=KEPT_LINES)
        self._news = asyncio.Event()
        self._log = asyncio.create_task(self._read_log())

    async def logged(self, words: str) -> None:
        """Wait until its log has these words. Raises Failed if it ends first, or takes too long."""
        async with self._starting():
            while not any(words in line for line in self.lines):
                if self._log.done():
                    raise await self.failed()
                self._news.clear()
                await self._news.wait()

    async def recording(self) -> Recording:
        """Wait until the recorder records; return where. Raises BadInput, Failed."""
        assert self.process.stdout is not None  # noqa: S101
        async with self._starting():
            try:
                return msgspec.json.decode(await self.process.stdout.readline(), type=Recording)
            except ValueError:  # it ended before
                raise await self.failed() from None

    @asynccontextmanager
    async def _starting(self) -> AsyncIterator[None]:
        try:
            async with asyncio.timeout(START_TIMEOUT_S):
                yield
        except TimeoutError:
            raise common.Failed(
                f"{self.what} did not start within {START_TIMEOUT_S:g} s; is this host overloaded?"
            ) from None

    async def failed(self) -> Exception:
        code = await self.process.wait()
        await self._log
        words = self.lines[-1] if self.lines else "it logged nothing"
        if self.process.stdout is not None and code == BAD_SETTINGS:
            return BadInput(words.partition(" ERROR ")[2] or words)
        return common.Failed(f"{self.what} ended (code {code}): {words}")

    async def _read_log(self) -> None:
        stderr = self.process.stderr
        assert stderr is not None  # noqa: S101
        while True:
            try:
                line = await stderr.readline()
            except ValueError:  # longer than MAX_LINE: skip it
                continue
            if text := terminal.clean(_COLOURS.sub("", line.decode(errors="replace"))).strip():
                self.lines.append(text)
            self._news.set()
            if not line:
                return

    async def end(self) -> None:
        process = self.process
        if process.returncode is None:
            # A recorder ends with its input, a viewer by its signal.
            if process.stdin is not None:
                process.stdin.close()
            else:
                with suppress(ProcessLookupError):
                    process.terminate()
        try:
            async with asyncio.timeout(END_TIMEOUT_S):
                await process.wait()
        except (TimeoutError, asyncio.CancelledError) as error:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()
            if isinstance(error, asyncio.CancelledError):  # a second Ctrl-C
                raise
        finally:
            self._log.cancel()


@asynccontextmanager
async def child(
    what: str, command: Sequence[str], env: Mapping[str, str], *, job: bytes | None = None
) -> AsyncIterator[Child]:
    """A child that ends with this context, and with this process however that ends. It has a session of its own: Ctrl-C
    reaches only this process, which then ends the child in order."""
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        *LAUNCH,
        str(os.getpid()),
        *command,
        stdin=pipe if job is not None else asyncio.subprocess.DEVNULL,
        stdout=pipe if job is not None else asyncio.subprocess.DEVNULL,
        stderr=pipe,
        env=os.environ | env,
        limit=MAX_LINE,
        start_new_session=True,
    )
    started = Child(what, process)
    try:
        if job is not None and process.stdin is not None:
            process.stdin.write(job)
        yield started
    finally:
        await started.end()


@asynccontextmanager
async def viewer(*arguments: str, log: str = "error") -> AsyncIterator[Child]:
    """Start the Rerun viewer without its usage reports. `log`: its log level. Raises Failed if it is not installed."""
    # Start the binary: the `rerun` script only wraps it, and killing the script would orphan the viewer.
    spec = find_spec("rerun_cli")
    binary = Path(spec.origin).with_name("rerun") if spec is not None and spec.origin is not None else None
    if binary is None or not os.access(binary, os.X_OK):
        raise common.Failed("the Rerun viewer is not installed; install the package rerun-sdk for this platform")
    with TemporaryDirectory(prefix="zscout-viewer-", ignore_cleanup_errors=True) as folder:
        command = [str(binary), *arguments]
        async with child("the viewer", command, {"RUST_LOG": log, **silent(Path(folder))}) as started:
            yield started


def has_display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
