"""The recorder beside real nodes and clients: what its file says when it is read back."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec
import psutil
import pytest
from rerun.chunk import RrdReader

from tests.hang import HANG
from tests.live import bench
from tests.live.lab import Lab, awaited
from tests.ports import free_port
from tests.services.recorder.paper_run import PERSON, USER, colours, events, lanes, rows
from zscout.behaviors.client.arc import hold
from zscout.config.fleet import MeshConfig, beside
from zscout.config.node import RecorderConfig
from zscout.config.strict import BadInput
from zscout.keyexpr import Role, Token
from zscout.messages import Notice, RcState
from zscout.services.recorder.colours import OPERATOR
from zscout.services.recorder.process import RecorderJob, Recording, encode_job, new_recording, prune
from zscout.types import SECOND

pytestmark = pytest.mark.live

MARK = " (operator)"
until = bench.until


def recorder(folder: str = "runs") -> str:
    """Without the past of journals, which a recorder on a busy machine may still learn."""
    return f'[recorder]\npath = "{folder}"\nport = {free_port()}\npast = 0'


async def recording(lab: Lab) -> None:
    """Waits until a recorder misses nothing any more."""
    there = asyncio.Event()
    mesh = lab.clients[0].mesh
    watch = mesh.watch(mesh.keys.alive_any(Role.RECORDER), lambda _token, _alive: there.set())
    async with asyncio.timeout(HANG):
        await there.wait()
    watch.close()


async def recorded(folder: Path, ask: Callable[[Path], bool]) -> None:
    """Waits until the file that is being written is so: to the recorder all comes later than to the test."""

    def is_so() -> bool:
        with suppress(ValueError, RuntimeError, OSError, KeyError), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return ask(the_file(folder))
        return False

    try:
        await until(is_so)
    except TimeoutError:
        pytest.fail(f"never so: {contents(folder)}")


def contents(folder: Path) -> list[tuple[Path, object]]:
    """What the recordings of a folder contain."""
    return [(path, (lanes(path, "/**"), events(path), presence(path))) for path in sorted(folder.glob("*.rrd"))]


async def ended(lab: Lab, host: str) -> None:
    """Ends a node in order; its recorder's file is finished then."""
    lab.nodes[host].terminate()
    assert await asyncio.to_thread(lab.nodes[host].wait, HANG) == 0


def the_file(folder: Path) -> Path:
    (path,) = folder.glob("*.rrd")
    return path


def lane(path: Path, entity: str) -> list[list[str]]:
    """What a lane showed, one after the other."""
    return [[state.replace(PERSON, "") for state in states] for _, states in lanes(path, entity)[entity]]


def loads_in(path: Path) -> list[tuple[str, float, Any]]:
    return list(rows(path, "/load/**", "Scalars:scalars"))


def presence(path: Path) -> list[str]:
    return [text for _, _, texts in rows(path, "/presence", "TextLog:text") for text in texts]


def words(path: Path, arc: str) -> list[str]:
    """The states of an ARC, one after the other, without their details."""
    return [state for state, _ in groupby(text.split(" · ")[0] for (text,) in lane(path, f"/requests/{USER}/{arc}"))]


@pytest.mark.slow
async def test_a_takeover_is_recorded_as_it_happened(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    async with Lab(tmp_path) as lab:
        lab.node("a", "robot/a", "radio/a:rate=10", extra=recorder())
        lab.node("b", "robot/b")
        client = await lab.begun("crew")
        await recording(lab)
        told_why = asyncio.Event()

        def heard(_key: str, notice: Notice) -> None:
            if (notice.arc, notice.state) == ("later", "queued"):
                told_why.set()

        notices = client.mesh.subscribe(client.mesh.keys.notice_any, Notice, heard)
        both = {"robot/a": {}, "robot/b": {}, "radio/a": {"rate": 4}}
        survey = await client.request("survey", both, min_runtime=60)
        listen = await client.request("listen", {"radio/a": {"rate": 5}}, min_runtime=60)
        later = await client.request("later", {"robot/b": {}}, min_runtime=2, keep=False)
        # On a busy machine a vote may be overdue at first.
        await until(lambda: (survey.state, listen.state, later.state) == ("running", "running", "queued"))
        await told_why.wait()
        async with hold(client, "operator", {"robot/a": {}}, priority=10, min_runtime=8, keep=False):
            await lab.state(client, lambda state: {wait.arc for wait in state.queue} == {"survey"})
            await asyncio.Event().wait()
        await lab.state(client, lambda state: "survey" in {held.arc for held in state.holds})
        await recorded(runs, lambda path: {entity for entity, _, _ in loads_in(path)} == {"/load/a", "/load/b"})
        await client.end(survey)
        await client.end(listen)
        await lab.state(client, lambda state: not state.holds and not state.queue)
        await ended(lab, "b")
        await lab.state(client, lambda state: "robot/b" not in {rc.rc for rc in state.rcs if rc.present})
        notices.close()
        await recorded(runs, lambda path: {"node b is gone", "robot/b is gone from b"} <= {*presence(path)})
        await ended(lab, "a")
    path = the_file(tmp_path / "runs")
    robot = lane(path, "/devices/robot/a")
    # Between two holders it may be free for a moment: votes of the radio may be asked again.
    assert [held for (held,) in robot if held] == ["survey", "operator" + MARK, "survey"]
    assert robot[0] == robot[-1] == [""]
    assert [held for held, _ in groupby(lane(path, "/devices/robot/b"))][:4] == [[""], ["survey"], ["later"], [""]]
    radio = lane(path, "/devices/radio/a")
    assert ["survey", "listen"] in radio
    assert radio[-1] == ["", ""]
    assert colours(path, "/devices/robot/**")["/devices/robot/a"]["operator" + PERSON + MARK] == OPERATOR

    assert words(path, "survey")[-4:] == ["running", "waiting again", "running", "done"]
    assert words(path, "listen")[-2:] == ["running", "done"]
    assert words(path, "later") == ["waiting", "running", "done"]
    assert words(path, "operator") == ["running", "done"]
    waiting = next(text for (text,) in lane(path, f"/requests/{USER}/later") if text.startswith("waiting"))
    assert waiting == "waiting · for survey: robot/b"
    again = [text for (text,) in lane(path, f"/requests/{USER}/survey") if text.startswith("waiting again")]
    assert any("operator" in text for text in again)

    assert any(text.startswith(f"survey{PERSON} runs on ") for text in events(path))
    told = [text.replace(PERSON, "") for text in events(path)]
    for text in ("survey runs on radio/a, robot/a, robot/b", "later completed: its minimum runtime is over"):
        assert text in told
    for text in (
        "node b is there",
        "robot/b is offered by b",
        "client test/crew joined",
        "node b is gone",
        "robot/b is gone from b",
    ):
        assert text in presence(path)
        assert text not in told
    assert any(text.startswith("survey is preempted by operator, priority ") for text in told)
    assert any(text in ("a leads", "b leads") for text in told)

    loads = loads_in(path)
    assert {entity for entity, _, _ in loads} == {"/load/a", "/load/b"}
    assert all(0 <= load <= 1000 for _, _, (load,) in loads)
    assert all(0 <= cpu <= 1 for _, _, (cpu,) in rows(path, "/cpu/**", "Scalars:scalars"))


@pytest.mark.slow
async def test_a_recorder_starts_in_the_middle_and_outlives_the_leader(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    async with Lab(tmp_path, candidates=["a", "b"]) as lab:
        lab.node("a")
        client = await lab.begun("crew")
        lab.node("b", "robot/b", "robot/c")
        await lab.ready(client, "robot/b", "robot/c")
        first = await client.request("twin", {"robot/b": {}}, min_runtime=60)
        second = await client.request("twin", {"robot/c": {}}, priority=5, min_runtime=60)
        waiter = await client.request("waiter", {"robot/b": {}}, min_runtime=60)
        lab.node("c", extra="candidate = false\n" + recorder())
        await recording(lab)
        await lab.candidates(client, "b")
        lab.nodes["a"].kill()
        await lab.state(client, lambda state: state.host == "b" and len(state.holds) == 2)
        await client.end(first)
        await lab.state(client, lambda state: "waiter" in {held.arc for held in state.holds})
        await client.end(waiter)
        await client.end(second)
        await lab.state(client, lambda state: not state.holds)
        ends = [["waiter"], [""]], [[""]]
        await recorded(
            runs, lambda path: (lane(path, "/devices/robot/b")[-2:], lane(path, "/devices/robot/c")[-1:]) == ends
        )
        # The node is shot: its recorder finishes the file all the same, as its input closes.
        lab.nodes["c"].kill()
        await until(lambda: finished(the_file(tmp_path / "runs")))
    path = the_file(tmp_path / "runs")
    twins = {lane(path, f"/devices/robot/{rc}")[0][0]: rc for rc in "bc"}
    assert set(twins) == {"twin", "twin.2"}
    label = {rc: name for name, rc in twins.items()}
    assert lane(path, "/devices/robot/b") == [[label["b"]], ["waiter"], [""]]
    assert lane(path, "/devices/robot/c") == [[label["c"]], [""]]
    assert words(path, "waiter") == ["waiting", "running", "done"]
    told = events(path)
    # Two hosts tell of a change of leaders, so either may be heard first.
    led = [text for text in told if " lead" in text]
    assert led[0] == "a leads"
    assert sorted(led[1:]) == ["a does not lead any more", "b leads"]
    assert not any("ended" in text for text in told)


def finished(path: Path) -> bool:
    """Whether the file has its footer: only then can it be opened as a store."""
    from rerun.chunk import RrdReader

    with suppress(ValueError, RuntimeError, OSError, KeyError), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        RrdReader(path).store()
        return True
    return False


@pytest.mark.slow
async def test_what_ends_while_no_rcm_is_there_is_seen_from_the_devices(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    async with Lab(tmp_path, lease=4.0, candidates=["a"]) as lab:
        lab.node("a")
        lab.node("b", "robot/b", extra="candidate = false\n" + recorder())
        client = await lab.begun("crew")
        await recording(lab)
        survey = await client.request("survey", {"robot/b": {}}, min_runtime=60)
        assert await client.granted(survey, confirmed=True)
        over = asyncio.Event()

        def heard(_key: str, state: RcState) -> None:
            if [hold.why for hold in state.ended] == ["lease"]:
                over.set()

        subscription = client.mesh.subscribe(client.mesh.keys.rc_state("robot/b"), RcState, heard)
        # A leader that is killed at once may not have published the grant to the recorder.
        await recorded(runs, lambda path: lane(path, "/devices/robot/b") == [[""], ["survey"]])
        lab.nodes["a"].kill()
        async with asyncio.timeout(HANG):
            await over.wait()
        subscription.close()
        await recorded(runs, lambda path: lane(path, "/devices/robot/b")[:3] == [[""], ["survey"], [""]])
        await ended(lab, "b")


@pytest.mark.slow
async def test_a_recorder_that_dies_is_started_again(tmp_path: Path, lab: Lab) -> None:
    node = lab.node("a", "robot/a", extra=recorder())
    client = await lab.client("crew")
    await recording(lab)
    (child,) = psutil.Process(node.pid).children()
    tokens, again = 0, asyncio.Event()

    def seen(_token: Token, alive: bool) -> None:
        nonlocal tokens
        tokens += alive
        if tokens == 2:
            again.set()

    watch = client.mesh.watch(client.mesh.keys.alive_any(Role.RECORDER), seen)
    child.kill()
    async with asyncio.timeout(HANG):
        await again.wait()
    watch.close()
    assert len(list((tmp_path / "runs").iterdir())) == 2
    (child,) = psutil.Process(node.pid).children()
    # Ended on purpose, it stays ended, and the node goes on.
    child.terminate()
    await until(lambda: "the recorder was ended" in lab.log("a"))
    await lab.ready(client, "robot/a")
    assert psutil.Process(node.pid).children() == []


def run_recorder(lab: Lab, job: bytes, *program: str) -> subprocess.Popen[bytes]:
    process = subprocess.Popen(
        [sys.executable, *(program or ("-m", "zscout.services.recorder"))],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | lab.env,
    )
    lab.others.append(process)
    assert process.stdin is not None
    process.stdin.write(job)
    process.stdin.flush()
    return process


async def at_its_end(process: subprocess.Popen[bytes]) -> None:
    """Ends it as its node does, by closing its input."""
    assert process.stdin is not None
    process.stdin.close()
    assert await asyncio.to_thread(process.wait, HANG) == 0


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, *(pytest.param(number, marks=pytest.mark.slow) for number in (signal.SIGINT, None))]
)
async def test_the_program_says_where_it_records_and_ends_in_order(
    tmp_path: Path, lab: Lab, number: signal.Signals | None
) -> None:
    job = RecorderJob(RecorderConfig(tmp_path / "new" / "runs", "127.0.0.1", 0), lab.fleet_of("a"), "a")
    process = run_recorder(lab, encode_job(job))
    assert process.stdout is not None
    assert process.stdin is not None
    told = msgspec.json.decode(await asyncio.to_thread(process.stdout.readline), type=Recording)
    assert told.url is not None
    socket.create_connection(("127.0.0.1", int(told.url.split(":")[2].split("/")[0])), 5).close()
    name = Path(told.file).name
    assert name.startswith(f"{lab.fleet.name}-{time.strftime('%Y')}")
    if number is None:
        process.stdin.close()
    else:
        process.send_signal(number)
    assert await asyncio.to_thread(process.wait, HANG) == 0
    assert Path(told.file) == the_file(tmp_path / "new" / "runs")


@pytest.mark.slow
async def test_bad_settings_are_one_line_and_code_2(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    async with Lab(tmp_path) as lab:
        with socket.create_server(("127.0.0.1", 0)) as other:
            port = other.getsockname()[1]
            jobs = {
                f"can't listen on 127.0.0.1, port {port}": encode_job(
                    RecorderJob(RecorderConfig(tmp_path / "runs", "127.0.0.1", port), lab.fleet_of("a"), "a")
                ),
                "recordings can't be written to": encode_job(
                    RecorderJob(RecorderConfig(tmp_path / "file" / "runs", "127.0.0.1", 0), lab.fleet_of("a"), "a")
                ),
                "not a job of the recorder": b'{"recorder": 1}\n',
            }
            for line, job in jobs.items():
                process = run_recorder(lab, job)
                _, error = await asyncio.to_thread(process.communicate, None, HANG)
                assert process.returncode == 2
                assert line in error.decode()
                assert len(error.decode().strip().splitlines()) == 1
    assert list((tmp_path / "runs").iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("past", [3_600 * SECOND, 0])
async def test_a_recorder_that_comes_late_has_what_a_journal_kept(tmp_path: Path, past: int) -> None:
    runs = tmp_path / "runs"
    async with Lab(tmp_path) as lab:
        lab.node("a", "robot/a")
        client = await lab.begun("crew")
        async with hold(client, "survey", {"robot/a": {}}, min_runtime=60):
            pass
        film = await client.request("film", {"robot/a": {}}, min_runtime=60)
        await lab.state(client, lambda state: {held.arc for held in state.holds} == {"film"})
        job = RecorderJob(RecorderConfig(runs, "127.0.0.1", 0, past=past), lab.fleet_of("b"), "b")
        process = run_recorder(lab, encode_job(job))
        await recording(lab)
        if past:
            await recorded(runs, lambda path: any("before this recording" in text for text in events(path)))
        await client.end(film)
        await lab.state(client, lambda state: not state.holds)
        await at_its_end(process)
    shown = [state for (state,) in lane(the_file(runs), "/devices/robot/a") if state]
    assert shown == (["survey (journal)", "film (journal)"] if past else []) + ["film"]
    RrdReader(the_file(runs)).store()


IN_A_HURRY = (
    "import zscout.services.recorder.__main__ as program; program.PART, program.CHECK_EVERY = 2.0, 0.2; program.main()"
)
"""The recorder, with parts of seconds."""


@pytest.mark.slow
async def test_parts_follow_one_another_and_the_oldest_make_room(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    runs.mkdir()
    async with Lab(tmp_path) as lab:

        def before(number: int, size: int) -> Path:
            path = runs / f"{lab.fleet.name}-20200101-00000{number}.rrd"
            path.touch()
            os.truncate(path, size)
            os.utime(path, (number, number))
            return path

        def parts() -> list[Path]:
            made = [path for path in runs.glob("*.rrd") if "-20200101-" not in path.name]
            return sorted(made)

        # Far more than the parts come to, whatever time this takes; and no room on the disk.
        old = [before(number, 20_000_000) for number in (1, 2, 3)]
        lab.node("a", "robot/a")
        client = await lab.begun("crew")
        job = RecorderJob(RecorderConfig(runs, "127.0.0.1", 0, limit=50), lab.fleet_of("b"), "b")
        process = run_recorder(lab, encode_job(job), "-c", IN_A_HURRY)
        await recording(lab)
        assert [path.exists() for path in old] == [False, True, True]
        arc = await client.request("survey", {"robot/a": {}}, min_runtime=600)
        await lab.state(client, lambda state: len(state.holds) == 1)
        first = len(parts())
        await until(lambda: len(parts()) >= first + 2)
        # What comes besides makes the oldest go, whenever it comes.
        newer = before(4, 15_000_000)
        await until(lambda: not old[1].exists())
        await client.end(arc)
        await lab.state(client, lambda state: not state.holds)
        written = parts()
        await at_its_end(process)
        assert [path.exists() for path in (*old, newer)] == [False, False, True, True]
        assert set(written) <= set(parts())

    told: list[str] = []
    for number, path in enumerate(parts()):
        RrdReader(path).store()  # it has its footer: it was written anew
        states = [held for (held,) in lane(path, "/devices/robot/a")]
        assert number == 0 or states[0] == told[-1]
        told += states
    assert [held for held, _ in groupby(told)] == ["", "survey", ""]


def test_only_the_newest_recordings_are_kept(tmp_path: Path) -> None:
    made = [new_recording(tmp_path, "lab") for _ in range(5)]
    assert len(set(made)) == 5
    for age, path in enumerate(reversed(made)):
        os.utime(path, ns=(0, 10**18 - age))
    others = [tmp_path / "lab-2-20250101-000000.rrd", tmp_path / "lab.rrd", tmp_path / "notes.txt"]
    for path in others:
        path.touch()
        os.utime(path, ns=(0, 0))
    prune(tmp_path, "lab", keep=2)
    assert set(tmp_path.iterdir()) == {*made[3:], *others}


def test_a_folder_that_cannot_be_made_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BadInput, match=r"file/runs \(Not a directory\); give another folder"):
        new_recording(tmp_path / "file" / "runs", "lab")
    with pytest.raises(BadInput, match=r"file \(it is a file\); give another folder"):
        new_recording(tmp_path / "file", "lab")


def test_a_recorder_joins_beside_its_node() -> None:
    mesh = MeshConfig(
        listen=("tcp/0.0.0.0:7447", "tls/[::]:7448#x=y", "tcp/10.0.0.1:0"), connect=("tcp/10.0.0.2:7447",)
    )
    own = beside(mesh)
    assert own.listen == ("tcp/0.0.0.0:0", "tls/[::]:0#x=y", "tcp/10.0.0.1:0")
    assert own.connect == ("tcp/10.0.0.2:7447", "tcp/127.0.0.1:7447", "tls/[::1]:7448#x=y")
    assert beside(MeshConfig()) == MeshConfig()
    assert beside(MeshConfig(relay=("north", "south"))) == MeshConfig(site="north")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """The folder `runs`, on a disk of 300 kB."""
    runs = tmp_path / "runs"
    runs.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=300k", "none", str(runs)]
    if subprocess.run(command, check=False, capture_output=True).returncode:
        pytest.skip("only root may mount a small disk")
    yield runs
    subprocess.run(["umount", "--lazy", runs], check=True)


@pytest.mark.slow
async def test_a_recorder_whose_disk_is_full_says_so_in_status(small_disk: Path, tmp_path: Path) -> None:
    async with Lab(tmp_path) as lab:
        lab.node("a", "robot/a", extra=recorder())
        await lab.begun("crew")
        await recording(lab)
        with (small_disk / "filler").open("wb", 0) as file, suppress(OSError):
            while file.write(bytes(4096)):
                pass

        async def unrecorded() -> dict[str, str]:
            done = await lab.zscout("status", "--json")
            return dict(msgspec.json.decode(done.stdout)["unrecorded"])

        told = await awaited(unrecorded, bool, lambda: lab.log("a"))
        assert list(told) == ["a"]
        assert "can't be written" in told["a"]
        assert "can't be written" in (await lab.zscout("status")).stdout
        lab.nodes["a"].terminate()
        assert await asyncio.to_thread(lab.nodes["a"].wait, HANG) == 0
        assert "Traceback" not in lab.log("a")
