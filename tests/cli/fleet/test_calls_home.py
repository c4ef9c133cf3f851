"""Nothing calls home: what the browser and the programs of `zscout view` open."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from ipaddress import ip_address
from pathlib import Path
from urllib.parse import urlsplit

import psutil
import pytest

from tests.cli.fleet.test_view import page, until, viewing
from tests.hang import HANG
from tests.services.recorder.paper_run import RERUN, play_table1
from zscout.cli.fleet.viewer_page import ViewerPage, silent
from zscout.config.fleet import default_fleet
from zscout.config.node import RecorderConfig
from zscout.services.recorder.process import RecorderJob, encode_job
from zscout.services.recorder.timeline import Timeline

CHROMIUM = shutil.which("chromium")
STRACE = shutil.which("strace")
BROWSER = [
    *("--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run"),
    "--disable-features=OptimizationHints,Translate,MediaRouter",
]
OPENED = re.compile(r'sin6?_port=htons\((\d+)\), (?:sin_addr=inet_addr\("([^"]+)"\)|.*inet_pton\(AF_INET6, "([^"]+)")')


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("quiet") / "run.rrd"
    with Timeline("lab", path=path) as timeline:
        play_table1(timeline)
    return path


def home(folder: Path) -> Mapping[str, str]:
    """The environment of a user who never ran Rerun."""
    left_out = ("XDG_CONFIG_HOME", "XDG_DATA_HOME")
    return {name: value for name, value in os.environ.items() if name not in left_out} | {"HOME": str(folder)}


def asked_for(log: Path, page: str) -> set[str | None]:
    """The hosts that a page asked, by the browser's own log. The browser itself asks others."""
    requests = [line for line in log.read_text().splitlines() if f'"initiator":"{page}"' in line]
    return {urlsplit(url).hostname for line in requests for url in re.findall(r'"url":"(\w+:[^"]+)"', line)}


def _far(address: str) -> bool:
    found = ip_address(address)
    return found.is_global and not found.is_multicast


def opened(trace: Path) -> set[tuple[str, int]]:
    """Name servers and addresses outside the local network that a program connected or sent to."""
    found = [(four or six, int(port)) for port, four, six in OPENED.findall(trace.read_text())]
    return {(address, port) for address, port in found if port in (53, 443) or _far(address)}


@pytest.mark.slow
@pytest.mark.live
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed: a real browser is watched")
def test_the_browser_asks_this_host_alone(recording: Path, tmp_path: Path) -> None:
    assert CHROMIUM is not None
    log = tmp_path / "net.json"
    with viewing(tmp_path, recording, "--web", env=dict(home(tmp_path))) as process:
        url, stream = page(tmp_path, process)
        profile = f"--user-data-dir={tmp_path / 'profile'}"
        command = [CHROMIUM, *BROWSER, profile, f"--log-net-log={log}", "--remote-debugging-port=0", url]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as browser:
            try:
                port = urlsplit(stream.removeprefix("rerun+")).port
                # The viewer runs, and reads its recording.
                until(lambda: log.exists() and f":{port}/" in log.read_text(), "the page never read its recording")
            finally:
                browser.terminate()
                browser.wait(HANG)
    parts = urlsplit(url)
    assert asked_for(log, f"{parts.scheme}://{parts.netloc}") == {"127.0.0.1"}
    names = set(re.findall(r'"host":"([^"]+)"', log.read_text()))
    assert not {name for name in names if re.search(r"rerun|github|font|posthog", name)}
    assert not [*tmp_path.rglob("analytics*")]


@pytest.mark.slow
@pytest.mark.live
@pytest.mark.skipif(STRACE is None, reason="no strace is installed: the programs are watched by it")
@pytest.mark.parametrize("program", ["the viewer", "the page's server", "the recorder"])
def test_each_program_opens_this_host_alone(program: str, recording: Path, tmp_path: Path) -> None:
    assert STRACE is not None
    trace, config = tmp_path / "trace", tmp_path / "config"
    config.mkdir()
    command: list[str] = [str(RERUN), "--bind", "127.0.0.1", "--port", "auto", str(recording)]
    env, job = {**home(tmp_path), **silent(config)}, b""
    if program == "the viewer":
        size, shot = ("--window-size", "800x600"), str(tmp_path / "shot.png")
        command += ["--headless", *size, "--hide-welcome-screen", "--screenshot-to", shot]
    elif program == "the page's server":
        command += ["--serve-web", "--web-viewer-port", "0"]
    else:
        fleet = default_fleet()
        command, env = [sys.executable, "-m", "zscout.services.recorder"], dict(home(tmp_path))
        job = encode_job(RecorderJob(RecorderConfig(tmp_path / "runs", "127.0.0.1", 0), fleet, "anvil", joined=False))
    watched = [STRACE, "-f", "-qq", "-e", "trace=connect,sendto,sendmmsg", "-o", str(trace), *command]
    with subprocess.Popen(
        watched, env=env, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=False
    ) as process:
        assert process.stdin is not None
        assert process.stderr is not None
        try:
            if program == "the viewer":
                words = process.communicate(timeout=HANG)[1]
                if b"anic" in words or process.returncode != 0:
                    pytest.skip("no Vulkan driver: the viewer can't draw here")
            elif program == "the page's server":
                while b"Hosting a web-viewer" not in process.stderr.readline():
                    assert process.poll() is None
            else:
                process.stdin.write(job)
                process.stdin.flush()
                until(lambda: any((tmp_path / "runs").glob("*.rrd")), "nothing is recorded")
        finally:
            if process.poll() is None:
                for child in psutil.Process(process.pid).children(recursive=True):
                    child.terminate()
    assert opened(trace) == set()
    if program != "the recorder":
        assert json.loads((config / "rerun" / "analytics.json").read_text())["analytics_enabled"] is False
    written = {path.name for path in tmp_path.rglob("*") if "analytics" in str(path.relative_to(tmp_path))}
    assert written <= {"analytics.json"}


@pytest.mark.real_time
async def test_the_page_names_no_other_host_and_may_open_none(tmp_path: Path) -> None:
    original = (
        b'<link rel="preconnect" href="https://fonts.gstatic.com" crossorigin />\n'
        b'<link rel="icon" href="favicon.ico" />\n<link\n  href="https://fonts.googleapis.com/css2"\n/>'
    )

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readuntil(b"\r\n\r\n")
        writer.write(b"HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nConnection: close\r\n\r\n" + original)
        writer.close()

    async with await asyncio.start_server(answer, "127.0.0.1", 0) as source:
        where = source.sockets[0].getsockname()
        served = ViewerPage(where, "http://127.0.0.1:9876", "127.0.0.1", 0)
        await served.start()
        reader, writer = await asyncio.open_connection("127.0.0.1", served.port)
        writer.write(b"GET / HTTP/1.1\r\n\r\n")
        head, _, text = (await reader.read()).partition(b"\r\n\r\n")
        writer.close()
        assert await served.page("/../etc/passwd") is None
        await served.stop()
    assert text == b'\n<link rel="icon" href="favicon.ico" />\n'
    assert b"default-src 'none'" in head
    assert b"connect-src 'self' http://127.0.0.1:9876\r\n" in head
