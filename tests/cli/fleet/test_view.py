"""`zscout view`: the recording is really served, a live one is complete, and nothing is left behind."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import time
import urllib.request
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import psutil
import pytest
from msgspec.structs import replace

from tests.cli.cli_fleet import in_lab
from tests.cli.tools import COMMAND, zscout_here
from tests.hang import HANG
from tests.live.lab import Lab
from tests.ports import free_port
from tests.services.recorder.paper_run import PERSON, RCS, RERUN, TABLE2, lanes, play_table1, second_by_second
from zscout.cli.fleet import local_recording
from zscout.cli.fleet import view as module
from zscout.cli.fleet.local_recording import MAGIC
from zscout.config.access import AccessPolicy, Roles
from zscout.config.fleet import default_fleet
from zscout.keyexpr import Role
from zscout.messages import Recorded
from zscout.services.recorder.process import Recording, writing
from zscout.services.recorder.timeline import Timeline

OPEN = re.compile(rb"^Open (http://\S+)", re.MULTILINE)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("view") / "run.rrd"
    with Timeline("lab", path=path) as timeline:
        play_table1(timeline)
    return path


@contextmanager
def viewing(folder: Path, *args: object, env: dict[str, str] | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """`zscout view` with its output in `view.out` of the folder, and its errors in `view.log`."""
    with (folder / "view.out").open("wb") as out, (folder / "view.log").open("wb") as log:
        command = [*COMMAND, "view", *map(str, args)]
        process = subprocess.Popen(command, stdout=out, stderr=log, env=env, cwd=folder)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait(HANG)


def until(true: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + HANG
    while not true():
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


def page(folder: Path, process: subprocess.Popen[bytes]) -> tuple[str, str]:
    """The address that it said to open, and that of the stream in it."""
    out = folder / "view.out"
    until(lambda: OPEN.search(out.read_bytes()) is not None or process.poll() is not None, "no address was said")
    found = OPEN.search(out.read_bytes())
    assert found is not None, (folder / "view.log").read_text()
    url = found[1].decode()
    (stream,) = parse_qs(urlsplit(url).query)["url"]
    return url, stream


def listens(url: str) -> bool:
    parts = urlsplit(url)
    with suppress(OSError), socket.create_connection((parts.hostname or "", parts.port or 0), timeout=1):
        return True
    return False


def descendants(process: subprocess.Popen[bytes]) -> list[psutil.Process]:
    return psutil.Process(process.pid).children(recursive=True)


@pytest.mark.live
def test_the_page_is_served_with_the_recording_and_ctrl_c_ends_all(recording: Path, tmp_path: Path) -> None:
    with viewing(tmp_path, recording, "--web") as process:
        url, stream = page(tmp_path, process)
        assert urlsplit(url).hostname == "127.0.0.1"
        assert parse_qs(urlsplit(url).query)["theme"] == ["dark"]
        with urllib.request.urlopen(url, timeout=HANG) as answer:  # noqa: S310 - our own page
            assert b"Rerun" in answer.read()
        # Another viewer gets the whole recording from where the page would.
        got = tmp_path / "got.rrd"
        save: list[str | Path] = [RERUN, "--bind", "127.0.0.1", "--port", "auto", "--save", got, stream]
        with subprocess.Popen(save, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as reader:
            try:
                until(lambda: shows_table_2(got), "the recording never came")
            finally:
                reader.kill()
        children = descendants(process)
        assert [child.name() for child in children] == ["rerun"]
        process.send_signal(signal.SIGINT)
        assert process.wait(HANG) == 130
        assert not any(child.is_running() for child in children)
        # Not the page: another viewer may have its port by now.
        assert not listens(stream)


def shows_table_2(path: Path) -> bool:
    with suppress(ValueError, RuntimeError, OSError, KeyError, IndexError), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the file is still being written
        shown = lanes(path, "/devices/**")
        return {rc: second_by_second(shown[f"/devices/{rc}"]) for rc in RCS} == TABLE2
    return False


@pytest.mark.live
def test_as_json_it_says_once_where_all_is(recording: Path, tmp_path: Path) -> None:
    with viewing(tmp_path, recording, "--web", "--json") as process:
        said = said_as_json(tmp_path, process)
        assert (said["file"], said["live"]) == (str(recording), None)
        with urllib.request.urlopen(said["url"], timeout=HANG) as answer:  # noqa: S310 - our own page
            assert b"Rerun" in answer.read()
        process.send_signal(signal.SIGINT)
        assert process.wait(HANG) == 130
    assert (tmp_path / "view.out").read_text().count("\n") == 1
    assert (tmp_path / "view.log").read_text() == ""


def said_as_json(folder: Path, process: subprocess.Popen[bytes]) -> dict[str, Any]:
    out = folder / "view.out"
    until(lambda: b"}\n" in out.read_bytes() or process.poll() is not None, "it said nothing")
    said: dict[str, Any] = json.loads(out.read_text())
    return said


@pytest.mark.live
def test_the_viewer_does_not_outlive_a_command_that_is_killed(recording: Path, tmp_path: Path) -> None:
    with viewing(tmp_path, recording, "--web") as process:
        _, stream = page(tmp_path, process)
        children = descendants(process)
        assert len(children) == 1
        process.kill()
        until(lambda: not any(child.is_running() for child in children), "the viewer was left behind")
        assert not listens(stream)


@pytest.mark.slow
@pytest.mark.live
def test_a_live_view_serves_the_fleet_and_leaves_a_complete_recording(tmp_path: Path) -> None:
    def shown() -> list[str]:
        """The states of the one lane so far; its file is still being written."""
        with suppress(ValueError, RuntimeError, OSError, KeyError, IndexError), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            (file,) = (tmp_path / "out").glob("*.rrd")
            return [state for lane in lanes(file, "/devices/**").values() for _, states in lane for state in states]
        return []

    def has_past() -> bool:
        return f"before{PERSON} (journal)" in shown()

    async def story() -> None:
        async with Lab(tmp_path) as lab:
            lab.node("anvil", "robot/a")
            client = await lab.client("program")
            await lab.ready(client, "robot/a")
            await client.end(await client.request("before", {"robot/a": {}}, min_runtime=600))
            recorded = asyncio.Event()
            client.mesh.watch(client.mesh.keys.alive_any("recorder"), lambda _token, _alive: recorded.set())
            with viewing(tmp_path, "--web", "--out", tmp_path / "out", "--past", "1h", env=lab.env) as process:
                _, stream = await asyncio.to_thread(page, tmp_path, process)
                assert listens(stream)
                async with asyncio.timeout(HANG):
                    await recorded.wait()
                arc = await client.request("survey", {"robot/a": {}}, min_runtime=600)
                # It has no link to who leads yet, perhaps.
                await asyncio.to_thread(until, lambda: shown()[-1:] == [f"survey{PERSON}"], "the hold is not shown")
                await client.end(arc)
                await asyncio.to_thread(until, lambda: shown()[-2:] == [f"survey{PERSON}", ""], "its end is not shown")
                await asyncio.to_thread(until, has_past, "the past is not shown")
                children = descendants(process)
                assert len(children) == 2
                process.send_signal(signal.SIGINT)
                assert await asyncio.to_thread(process.wait, HANG) == 130
                assert not any(child.is_running() for child in children)
                assert not listens(stream)
            (file,) = (tmp_path / "out").glob("*.rrd")
            assert f"Recording to {file}\n" in (tmp_path / "view.out").read_text()
            (lane,) = lanes(file, "/devices/**").values()
            assert [states for _, states in lane][-2:] == [[f"survey{PERSON}"], [""]]

    asyncio.run(story())


@pytest.mark.slow
@pytest.mark.live
@in_lab()
async def test_where_a_node_of_this_host_records_its_recording_is_shown(lab: Lab) -> None:
    port = free_port()
    lab.node("anvil", "robot/a", extra=f'[recorder]\npath = "runs"\nport = {port}')
    client = await lab.client("program")
    await lab.ready(client, "robot/a")
    await lab.living(client, Role.RECORDER, lambda hosts: hosts == ["anvil"])
    options = ("--web", "--json", "--out", lab.folder / "out", "--past", "1h")
    with viewing(lab.folder, *options, env=lab.env) as process:
        said = await asyncio.to_thread(said_as_json, lab.folder, process)
        assert said["live"] == f"rerun+http://127.0.0.1:{port}/proxy"
        assert [Path(said["file"])] == list((lab.folder / "runs").glob("*.rrd"))
        assert "--past is ignored: a node records" in (lab.folder / "view.log").read_text()
        # No second recorder was started.
        assert [child.name() for child in descendants(process)] == ["rerun"]
        assert not (lab.folder / "out").exists()
        process.send_signal(signal.SIGINT)
        assert await asyncio.to_thread(process.wait, HANG) == 130
    assert listens(said["live"])


def test_a_recording_of_another_host_is_not_taken_for_one_of_this_host(tmp_path: Path) -> None:
    file = tmp_path / "run.rrd"
    file.write_bytes(MAGIC)
    with writing(file), socket.create_server(("127.0.0.1", 0)) as server:
        port, inode = server.getsockname()[1], file.stat().st_ino

        def reached(page: str = "127.0.0.1", **more: Any) -> Recording | None:
            told = {"file": str(file), "inode": inode, "bind": "127.0.0.1", "port": port} | more
            return asyncio.run(module._reached(Recorded(**told), page))

        url = f"rerun+http://127.0.0.1:{port}/proxy"
        assert reached() == Recording(str(file), url)
        for other in ({"inode": inode + 1}, {"file": str(tmp_path / "none.rrd")}, {"bind": "evil"}, {"file": "a\0b"}):
            assert reached(**other) is None
        assert reached(bind="127.0.0.2") is None, "nothing listens there"
        assert reached(bind="192.0.2.1") is None, "an address of another host"
        # A page that other hosts open needs a live view that they reach.
        assert reached("0.0.0.0") is None  # noqa: S104
    with writing(file), socket.create_server(("0.0.0.0", 0)) as server:  # noqa: S104
        port = server.getsockname()[1]
        url = f"rerun+http://127.0.0.1:{port}/proxy"
        assert reached(bind="0.0.0.0") == Recording(str(file), url)  # noqa: S104
        assert reached(bind="127.0.0.1") is None, "it listens elsewhere"
    assert reached() is None


@pytest.mark.parametrize(
    "made", ["/proc", "a folder", "a pipe", "a link", "no suffix", "no recording", "an idle file", "another user's"]
)
def test_only_a_file_that_a_recorder_writes_is_believed(
    made: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, real = tmp_path / "run.rrd", tmp_path / "real.rrd"
    real.write_bytes(MAGIC)
    with ExitStack() as stack:
        server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        match made:
            case "/proc":
                file = Path("/proc")
            case "a folder":
                file.mkdir()
            case "a pipe":
                os.mkfifo(file)
            case "a link":
                file.symlink_to(real)
                stack.enter_context(writing(real))
            case "no suffix":
                file = tmp_path / "passwd"
                file.write_bytes(MAGIC)
                stack.enter_context(writing(file))
            case "no recording":
                file.write_bytes(b"password")
                stack.enter_context(writing(file))
            case "an idle file":
                file.write_bytes(MAGIC)
            case "another user's":
                file.write_bytes(MAGIC)
                stack.enter_context(writing(file))
                monkeypatch.setattr(local_recording, "listeners", lambda _address, _port: [4711])
        answer = Recorded(str(file), file.stat().st_ino, "127.0.0.1", server.getsockname()[1])
        assert asyncio.run(module._reached(answer, "127.0.0.1")) is None


def test_in_a_secured_fleet_only_nodes_are_believed() -> None:
    access = AccessPolicy(Roles(operator=("ada",), node={"anvil": ()}))
    closed = replace(default_fleet(), access=access, security=Path("certs"))
    assert [module._is_node(closed, host) for host in ("ada", "anvil", "eve")] == [False, True, False]
    assert module._is_node(default_fleet(), "anvil")


@pytest.mark.slow
@pytest.mark.live
def test_a_live_view_as_json(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    with viewing(tmp_path, "--web", "--json", "--out", tmp_path / "out", env=lab.env) as process:
        said = said_as_json(tmp_path, process)
        assert listens(said["url"])
        assert listens(said["live"])
        process.send_signal(signal.SIGINT)
        assert process.wait(HANG) == 130
    assert [Path(said["file"])] == list((tmp_path / "out").glob("*.rrd"))
    # Nobody leads yet: the view may fill later.
    (line,) = (tmp_path / "view.log").read_text().splitlines()
    assert line.startswith("zscout: no leader is on the mesh")


def test_without_a_display_it_names_web(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    for args in ([recording], []):
        assert zscout_here("view", *args) == 1
        out, line = capsys.readouterr()
        assert (out, len(line.splitlines())) == ("", 1)
        assert "--web" in line


@pytest.mark.live
def test_a_display_that_does_not_answer_is_one_line(recording: Path, tmp_path: Path) -> None:
    env = {key: value for key, value in os.environ.items() if key != "WAYLAND_DISPLAY"}
    with viewing(tmp_path, recording, env=env | {"DISPLAY": "127.0.0.1:4711"}) as process:
        assert process.wait(HANG) == 1
    text = (tmp_path / "view.log").read_text()
    assert text.startswith("zscout: the viewer ended (code 1): ")
    assert len(text.splitlines()) == 1


def test_what_can_t_be_opened_or_served_is_one_line_and_code_2(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = tmp_path / "notes.rrd"
    text.write_text("no recording")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for args, words in (
            ([tmp_path / "none.rrd"], "there is no such file"),
            ([tmp_path], "there is no such file"),
            ([text], "not a Rerun recording"),
            (["--past", "99d"], '--past: "99d" is not a duration up to 31d'),
            (["--past", "soon"], '--past: "soon" is not a duration up to 31d'),
            ([recording, "--bind", "here"], "is not an IP address"),
            ([recording, "--bind", "192.0.2.1"], "can't serve on 192.0.2.1"),
            ([recording, "--port", port], f"port {port} (Address already in use); choose another"),
        ):
            assert zscout_here("view", "--web", *args) == 2
            out, line = capsys.readouterr()
            assert (out, len(line.splitlines())) == ("", 1)
            assert words in line


@pytest.mark.live
@pytest.mark.slow
def test_a_live_stream_on_a_taken_port_is_one_line_and_code_2(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        env = os.environ | {"DISPLAY": ":0", "ZSCOUT_FLEET": ""}
        with viewing(tmp_path, "--port", port, "--out", tmp_path / "out", env=env) as process:
            assert process.wait(HANG) == 2
    text = (tmp_path / "view.log").read_text()
    assert len(text.splitlines()) == 1
    assert f"port {port}" in text
