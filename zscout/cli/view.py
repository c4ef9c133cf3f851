"""`zscout view`: a recording, or the fleet live, in the Rerun viewer: its own window, or a browser's."""

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
from typing import Final
from urllib.parse import quote

import click
import msgspec

from zscout.cli import common, launch
from zscout.config import Recorder
from zscout.keyexpr import valid_name
from zscout.services.recorder_process import BAD_SETTINGS, Job, Recording, encode_job
from zscout.strict import BadInput, quoted

WEB_PORT: Final = 9090
MAGIC: Final = b"RRF"
"""How every recording begins."""
START: Final = 20.0
"""Seconds within which a recorder or a viewer has come up, on a busy machine."""
GRACE: Final = 15.0
"""Seconds for a child to end by itself: the recorder finishes its file."""
MAX_LINE: Final = 65_536
KEPT: Final = 20
"""Last lines of a child's log that are kept, to say why it failed."""
HOSTING: Final = "Hosting a web-viewer at"
_COLOURS: Final = re.compile(r"\x1b\[[0-9;]*m")


@click.command()
@click.argument("file", required=False, type=click.Path(path_type=Path))
@click.option("--web", is_flag=True, help="Serve the viewer to a browser, and print the address to open.")
@click.option(
    "--bind",
    metavar="IP",
    default="127.0.0.1",
    show_default=True,
    help="Where web page and live stream are served; anything but loopback shows them to other hosts.",
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
    show_default=True,
    help="Without FILE: the folder in which the live recording is kept.",
)
@common.json_option("Print one JSON object as soon as it is served or recorded: url, live, file.")
def view(file: Path | None, web: bool, bind: str, port: int | None, out: Path, as_json: bool) -> None:
    """Open the recording FILE (.rrd), or record the fleet and show it live.

    The viewer is a window of its own, which ends the command when it is closed. On a host without a display
    use --web. Ctrl-C ends everything that was started; a live recording is complete then.

    \b
    Examples:
      zscout view
      zscout view --web
      zscout view runs/lab.rrd
      zscout view --web --json | jq -r --unbuffered .url
    """
    try:
        address = ipaddress.ip_address("127.0.0.1" if bind == "localhost" else bind)
    except ValueError:
        raise BadInput(f"--bind: {quoted(bind)} is not an IP address; write one, as in 127.0.0.1") from None
    if file is not None:
        _check(file)
        file = file.absolute()  # it may begin with a dash
    if not web and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise common.Failed(
            "no display is here (neither DISPLAY nor WAYLAND_DISPLAY is set); use --web, and a browser"
        )
    common.run(_view(file, web, str(address), port, out, as_json=as_json))


async def _view(
    file: Path | None, web: bool, bind: str, port: int | None, out: Path, *, as_json: bool
) -> None:
    # The page comes last, so what it shows needs its own port first.
    async with _source(file, bind, None if web else port, out) as (told, recorder):
        children = [recorder] if recorder is not None else []
        shown = told.url or told.file
        if not as_json and recorder is not None:
            common.print_line(f"Recording to {told.file}")
            common.print_line(f"Live at {told.url}")
        address: str | None = None
        command = [str(viewer_binary())]
        if not web:
            command += ["--bind", "127.0.0.1", "--port", "auto", "--hide-welcome-screen"]
            command += ["--connect", shown] if file is None else [shown]
        else:
            page = _free_port(bind, port) if port is not None else _free_port(bind, WEB_PORT, 0)
            stream = _free_port(bind, 0)
            command += ["--serve-web", "--bind", bind, "--web-viewer-port", str(page), "--port", str(stream)]
            command += [shown]
        async with _child("the viewer", command, {"RUST_LOG": "info" if web else "error"}) as viewer:
            if web:
                await viewer.says(HOSTING)
                source = shown if file is None else f"rerun+http://{_host(bind)}:{stream}/proxy"
                url = quote(source.replace(f"//{_bracketed(bind)}:", f"//{_host(bind)}:"), safe="")
                address = f"http://{_host(bind)}:{page}/?url={url}&renderer=webgl&hide_welcome_screen=1"
            if as_json:
                common.print_json({"url": address, "live": told.url, "file": told.file})
            elif web:
                common.print_line(f"Open {address}")
                common.print_line("Ctrl-C ends")
            await _first_to_end([viewer, *children])


@asynccontextmanager
async def _source(
    file: Path | None, bind: str, port: int | None, out: Path
) -> AsyncIterator[tuple[Recording, Child | None]]:
    """What the viewer opens, and the recorder behind it where that is a live stream."""
    if file is not None:
        yield Recording(str(file), None), None
        return
    fleet = common.the_fleet()
    host = os.environ.get("ZSCOUT_HOST") or valid_name(socket.gethostname())
    job = Job(Recorder(out, bind, port or 0), fleet, host)
    command = [sys.executable, "-m", "zscout.services.recorder"]
    async with _child("the recorder", command, {}, job=encode_job(job)) as recorder:
        told = await recorder.told()
        if told.url is None:
            raise common.Failed("the recorder serves no live stream; report this as a bug")
        alone = asyncio.create_task(_say_if_alone())
        try:
            yield told, recorder
        finally:
            alone.cancel()
            await asyncio.gather(alone, return_exceptions=True)


async def _say_if_alone() -> None:
    """Without an RCM the view is empty: that is said, and may mend itself."""
    try:
        async with common.connected("view"):
            pass
    except common.NobodyThere as error:
        common.print_line(f"zscout: {error}", sys.stderr)


class Child:
    """A process that was started here, and what it logs."""

    def __init__(self, what: str, process: asyncio.subprocess.Process) -> None:
        self.what, self.process = what, process
        self.lines: deque[str] = deque(maxlen=KEPT)
        self._news = asyncio.Event()
        self._log = asyncio.create_task(self._read_log())

    async def says(self, words: str) -> None:
        """Returns once these words stand in its log. Raises Failed if it ends first, or takes too long."""
        try:
            async with asyncio.timeout(START):
                while not any(words in line for line in self.lines):
                    if self._log.done():
                        await self.process.wait()
                        raise self.failed()
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            raise common.Failed(
                f"{self.what} did not start within {START:g} s; is this host overloaded?"
            ) from None

    async def told(self) -> Recording:
        """What a recorder says when it records. Raises BadInput and Failed where it can't."""
        stdout = self.process.stdout
        assert stdout is not None  # noqa: S101
        try:
            async with asyncio.timeout(START):
                return msgspec.json.decode(await stdout.readline(), type=Recording)
        except TimeoutError:
            raise common.Failed(
                f"{self.what} did not start within {START:g} s; is this host overloaded?"
            ) from None
        except ValueError:  # it ended before that
            await self.process.wait()
            await self._log
            raise self.failed() from None

    def failed(self) -> Exception:
        """Why it ended, in its own last words."""
        code = self.process.returncode
        words = self.lines[-1] if self.lines else "without a word"
        if self.process.stdout is not None and code == BAD_SETTINGS:
            return BadInput(words.partition(" ERROR ")[2] or words)
        return common.Failed(f"{self.what} ended (code {code}): {words}")

    async def _read_log(self) -> None:
        stderr = self.process.stderr
        assert stderr is not None  # noqa: S101
        while True:
            try:
                line = await stderr.readline()
            except ValueError:  # longer than MAX_LINE: it is skipped
                continue
            if not line:
                self._news.set()
                return
            text = common.clean(_COLOURS.sub("", line.decode(errors="replace"))).strip()
            if text:
                self.lines.append(text)
                self._news.set()

    async def end(self) -> None:
        """Ends it, at first by asking; returns when it is gone."""
        process = self.process
        if process.returncode is None:
            # A recorder ends with its input, a viewer by its signal.
            if process.stdin is not None:
                process.stdin.close()
            else:
                with suppress(ProcessLookupError):
                    process.terminate()
        try:
            async with asyncio.timeout(GRACE):
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
async def _child(
    what: str, command: Sequence[str], env: Mapping[str, str], *, job: bytes | None = None
) -> AsyncIterator[Child]:
    """Starts a child that ends with this context, and with this process however that ends.

    It leads a session of its own: Ctrl-C reaches only us, and we end it in order."""
    assert launch.__file__ is not None  # noqa: S101
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-I", "-S", launch.__file__, str(os.getpid()), "-1"),
        *command,
        stdin=pipe if job is not None else asyncio.subprocess.DEVNULL,
        stdout=pipe if job is not None else asyncio.subprocess.DEVNULL,
        stderr=pipe,
        env=os.environ | env,
        limit=MAX_LINE,
        start_new_session=True,
    )
    child = Child(what, process)
    try:
        if job is not None and process.stdin is not None:
            process.stdin.write(job)
        yield child
    finally:
        await child.end()


async def _first_to_end(children: Sequence[Child]) -> None:
    """Returns when the viewer, the first of them, was closed. Raises Failed when any fails."""
    waits = {asyncio.create_task(child.process.wait()): child for child in children}
    try:
        done, _ = await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in waits:
            task.cancel()
    for task in done:
        child = waits[task]
        if child is not children[0] or child.process.returncode != 0:
            raise child.failed()


def viewer_binary() -> Path:
    """The viewer itself: the `rerun` script only wraps it, and killing the script would orphan it."""
    spec = find_spec("rerun_cli")
    binary = Path(spec.origin).with_name("rerun") if spec is not None and spec.origin is not None else None
    if binary is None or not os.access(binary, os.X_OK):
        raise common.Failed(
            "the Rerun viewer is not installed; install the package rerun-sdk for this platform"
        )
    return binary


def _check(file: Path) -> None:
    """Raises BadInput where FILE can't be a recording."""
    try:
        if not file.is_file():
            raise BadInput(
                f"{file}: there is no such file; recordings of nodes and of zscout view lie in runs/"
            )
        with file.open("rb") as recording:
            begin = recording.read(len(MAGIC))
    except OSError as error:
        raise BadInput(
            f"{file}: can't be read: {error.strerror}; check the path and its permissions"
        ) from None
    if begin != MAGIC:
        raise BadInput(f"{file}: is not a Rerun recording; name a .rrd file")
    if file.suffix != ".rrd":
        raise BadInput(f"{file}: the viewer knows a recording by its name; rename it to end in .rrd")


def _free_port(bind: str, *ports: int) -> int:
    """The first of these ports that is free, 0 for any. Raises BadInput where all are taken."""
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    reason = ""
    for port in ports:
        try:
            with socket.create_server((bind, port), family=family) as server:
                return int(server.getsockname()[1])
        except OSError as error:
            reason = os.strerror(error.errno or 0)
    raise BadInput(f"can't serve on {bind}, port {ports[0]} ({reason}); choose another --port or --bind")


def _bracketed(address: str) -> str:
    return f"[{address}]" if ":" in address else address


def _host(bind: str) -> str:
    """What a browser writes for an address that is served: this host's name where that is every address."""
    return socket.gethostname() if ipaddress.ip_address(bind).is_unspecified else _bracketed(bind)
