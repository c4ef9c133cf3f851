"""The synchronous API in plain scripts of their own: what interrupts them, and what does not."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import end, held_by, out_of, read_until
from tests.hang import HANG
from tests.live.lab import Lab

pytestmark = pytest.mark.live

LONGER = 10 * HANG
"""Seconds: what a script waits for in vain."""
OPENING = f"""
import signal, sys, threading, time
import zscout
LONGER = {LONGER}

def say(*words):
    print(*words, flush=True)
"""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    with fleet_of(tmp_path_factory.mktemp("blocking"), "robot/a", "robot/b") as fleet:
        yield fleet


def script(lab: Lab, text: str) -> subprocess.Popen[str]:
    """Runs a script. On stderr a process says that it stood still, and why it failed: pytest shows that."""
    return subprocess.Popen(
        [sys.executable, "-c", OPENING + textwrap.dedent(text)],
        env=lab.env,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    )


def rest_of(process: subprocess.Popen[str]) -> list[str]:
    """What it still says, to an end in order."""
    with out_of(process) as out:
        lines = out.read().splitlines()
    assert process.wait(HANG) == 0, lines
    return lines


def holding(body: str, *, how: str = "", told: str = "revoked.outcome") -> str:
    """A script that holds robot/a, does `body` under that, and says what it is `told` where its hold is revoked."""
    return f"""
with zscout.connect() as lab:
    try:
        with lab.hold("survey", {{"robot/a": {{}}}}{how}) as held:
            say("entered")
{textwrap.indent(body, 12 * " ")}
    except zscout.Revoked as revoked:
        say({told})
"""


def take(fleet: CliFleet, rc: str, *options: str) -> None:
    done = fleet.zscout("request", rc, "--name", "taker", *options, "--", "true")
    assert done.returncode == 0, done.stderr


def preempted(fleet: CliFleet, text: str, rc: str = "robot/a") -> list[str]:
    """What a script says from when its hold is preempted."""
    process = script(fleet.lab, text)
    read_until(process, "entered")
    take(fleet, rc, "--priority", "5")
    return rest_of(process)


@pytest.mark.slow
def test_a_direct_body_clears_up_before_the_next_program_begins(fleet: CliFleet, tmp_path: Path) -> None:
    told = tmp_path / "told"
    clears_up = f'time.sleep(1)\n    open({str(told)!r}, "a").write("left\\n")'
    survey = script(fleet.lab, holding(f"try:\n    time.sleep(LONGER)\nfinally:\n    {clears_up}", how=", direct=True"))
    read_until(survey, "entered")
    done = fleet.zscout("request", "robot/a", "--priority", "5", "--", "sh", "-c", f"echo next >> {told}")
    assert done.returncode == 0, done.stderr
    assert rest_of(survey) == ["preempted"]
    assert told.read_text().split() == ["left", "next"]


@pytest.mark.slow
def test_a_direct_body_that_clears_up_for_too_long_is_interrupted_once_more(fleet: CliFleet) -> None:
    body = "try:\n    time.sleep(LONGER)\nfinally:\n    time.sleep(LONGER)"
    told = "revoked.outcome, isinstance(revoked.__context__, zscout.Revoked)"
    assert preempted(fleet, holding(body, how=", direct=True", told=told)) == ["preempted True"]


def test_a_lab_and_its_holds_say_what_they_are(fleet: CliFleet) -> None:
    text = """
        with zscout.connect("notebook") as lab:
            held = lab.acquire("survey", {"robot/a": {}}, min_runtime=60)
            say(repr(lab), "|", repr(held), "|", "robot/a" in str(lab.status()))
            say([row for row in str(lab.status()).splitlines() if row.startswith("robot/")])
            held.release()
            say(repr(held))
        say(repr(lab))
    """
    first, devices, over, closed = rest_of(script(fleet.lab, text))
    lab, held, known = first.split(" | ")
    assert lab.startswith("<Lab ")
    assert "/notebook in fleet " in lab
    assert re.fullmatch(r"<BlockingHeld survey: robot/a; (59|60) s left>", held)
    assert known == "True"
    assert re.search(r"robot/a +\S+ +survey \(.+\), (59|60) s left", devices)
    assert re.search(r"robot/b +\S+ +free", devices)
    assert over == "<BlockingHeld survey: robot/a; over: given up by this client>"
    assert closed == "<Lab closed>"


def test_pictures_come_until_the_hold_is_over(fleet: CliFleet, fleet_kind: str) -> None:
    if fleet_kind == "secured":
        pytest.skip("a person's certificate publishes no pictures")
    text = """
        from zscout.drivers.driver import FrameHead

        def film(mesh, grant, stop):
            camera = mesh.frame_publisher(mesh.keys.frame("robot/a"))
            while not stop.wait(0.02):
                camera.put(FrameHead(7, 1.5, 160, 120, grant), b"jpeg")

        with zscout.connect() as lab, zscout.connect() as other:
            held, stop = lab.acquire("survey", {"robot/a": {}}, min_runtime=60), threading.Event()
            threading.Thread(target=film, args=(other.client.mesh, held.grant, stop)).start()
            seen = 0
            for frame in held.frames("robot/a"):
                seen += 1
                if seen == 3:
                    say(frame, frame.jpeg)
                    held.release()
            say("over")
            stop.set()
    """
    assert rest_of(script(fleet.lab, text)) == ["<Frame 7: 160x120, 4 bytes, taken at 1.500 s> b'jpeg'", "over"]


def test_a_sleep_is_interrupted_when_the_hold_is_preempted(fleet: CliFleet) -> None:
    text = """
        before = signal.getsignal(signal.SIGURG)
        with zscout.connect() as lab:
            try:
                with lab.hold("survey", {"robot/a": {}}) as held:
                    say("entered", held.rcs, held.active)
                    time.sleep(LONGER)
            except zscout.Revoked as revoked:
                say(revoked.outcome, held.active, "|", revoked)
            say("restored", signal.getsignal(signal.SIGURG) is before)
    """
    survey = script(fleet.lab, text)
    assert read_until(survey, "entered")[-1] == "entered ['robot/a'] True"
    take(fleet, "robot/a", "--priority", "5")
    told, restored = rest_of(survey)
    assert told.startswith("preempted False | ")
    assert held_by("taker") in told
    assert restored == "restored True"
    assert fleet.idle("robot/a")


@pytest.mark.parametrize(("how", "waits"), [("min_runtime=1", True), ("min_runtime=2, keep=False", False)])
def test_a_body_whose_time_is_over_is_interrupted(fleet: CliFleet, how: str, *, waits: bool) -> None:
    told = 'revoked.outcome, held.completed, "|", revoked'
    survey = script(fleet.lab, holding("threading.Event().wait(LONGER)", how=f", {how}", told=told))
    read_until(survey, "entered")
    if waits:
        take(fleet, "robot/a")
    (told,) = rest_of(survey)
    assert told.startswith("completed True | its minimum runtime is over")
    assert (held_by("taker") in told) == waits


def test_the_end_of_an_inner_hold_leaves_the_outer_one(fleet: CliFleet) -> None:
    text = """
        with zscout.connect() as lab, lab.hold("outer", {"robot/a": {}}) as outer:
            try:
                with lab.hold("inner", {"robot/b": {}}):
                    say("entered")
                    time.sleep(LONGER)
            except zscout.Revoked as revoked:
                say("inner", revoked.outcome, outer.active)
            say(outer.command("robot/a", {"name": "echo", "value": 5}, ttl=60))
    """
    assert preempted(fleet, text, "robot/b") == ["inner preempted True", "5"]
    assert fleet.idle("robot/a", "robot/b")


def test_the_end_of_the_outer_hold_interrupts_the_wait_for_an_inner_one(fleet: CliFleet) -> None:
    text = """
        with zscout.connect() as lab:
            try:
                with lab.hold("outer", {"robot/a": {}}):
                    say("entered")
                    with lab.hold("inner", {"robot/b": {}}):
                        say("never")
            except zscout.Revoked as revoked:
                say("outer", revoked.outcome)
            say("on")
            time.sleep(0.1)
    """
    blocker = fleet.holder("blocker", "robot/b")
    nested = script(fleet.lab, text)
    read_until(nested, "entered")
    fleet.state(lambda state: [wait.arc for wait in state.queue] == ["inner"])
    take(fleet, "robot/a", "--priority", "5")
    assert rest_of(nested) == ["outer preempted", "on"]
    fleet.state(lambda state: not state.queue)
    end(blocker)


def test_ctrl_c_is_ctrl_c(fleet: CliFleet) -> None:
    text = """
        try:
            with zscout.connect() as lab, lab.hold("survey", {"robot/a": {}}):
                say("entered")
                time.sleep(LONGER)
        except KeyboardInterrupt:
            say("interrupted")
    """
    survey = script(fleet.lab, text)
    read_until(survey, "entered")
    survey.send_signal(signal.SIGINT)
    assert rest_of(survey) == ["interrupted"]
    assert fleet.idle("robot/a")


def test_ctrl_c_ends_the_wait(fleet: CliFleet) -> None:
    text = """
        with zscout.connect() as lab:
            try:
                with lab.hold("survey", {"robot/a": {}}):
                    say("never")
            except KeyboardInterrupt:
                say("interrupted", signal.getsignal(signal.SIGURG) == signal.SIG_DFL)
    """
    blocker = fleet.holder("blocker", "robot/a")
    survey = script(fleet.lab, text)
    fleet.state(lambda state: [wait.arc for wait in state.queue] == ["survey"])
    survey.send_signal(signal.SIGINT)
    assert rest_of(survey) == ["interrupted True"]
    fleet.state(lambda state: not state.queue)
    end(blocker)


def test_a_handler_of_ones_own_gets_its_signals_and_is_put_back(fleet: CliFleet) -> None:
    text = """
        def mine(number, frame):
            say("mine")

        signal.signal(signal.SIGURG, mine)
        with zscout.connect() as lab:
            with lab.hold("survey", {"robot/a": {}}):
                signal.raise_signal(signal.SIGURG)
            say("back", signal.getsignal(signal.SIGURG) is mine)
    """
    assert rest_of(script(fleet.lab, text)) == ["mine", "back True"]


@pytest.mark.parametrize("where", ["thread", "main"])
def test_where_nothing_interrupts_a_body_looks_itself(fleet: CliFleet, where: str) -> None:
    text = f"""
        def body(interrupt):
            try:
                with lab.hold("survey", {{"robot/a": {{}}}}, interrupt=interrupt) as held:
                    say("entered")
                    say(held.wait(LONGER), held.active)
                    time.sleep(0.3)
                    held.check()
            except zscout.Revoked as revoked:
                say("told", revoked.outcome)

        with zscout.connect() as lab:
            if {where == "thread"}:
                thread = threading.Thread(target=body, args=(True,))
                thread.start()
                thread.join()
            else:
                body(False)
    """
    assert preempted(fleet, text) == ["True False", "told preempted"]


def test_a_wait_for_the_end_is_told_by_its_answer_and_by_nothing_else(fleet: CliFleet) -> None:
    # The signal is sent every 0.1 s.
    assert preempted(fleet, holding('say(held.wait())\ntime.sleep(0.5)\nsay("in peace")')) == ["True", "in peace"]


def test_who_was_not_told_is_told_at_the_end(fleet: CliFleet) -> None:
    body = "while held.active:\n    time.sleep(0.01)"
    assert preempted(fleet, holding(body, how=", interrupt=False")) == ["preempted"]


@pytest.mark.slow
def test_a_wait_for_the_grant_ends_with_its_timeout_and_says_why(fleet: CliFleet) -> None:
    text = """
        with zscout.connect() as lab:
            try:
                with lab.hold("survey", {"robot/a": {}}, timeout=10):
                    say("never")
            except TimeoutError as late:
                say(late)
    """
    blocker = fleet.holder("blocker", "robot/a")
    (told,) = rest_of(script(fleet.lab, text))
    assert told.startswith("survey was not granted within 10 s: ")
    assert held_by("blocker") in told
    fleet.state(lambda state: not state.queue)
    end(blocker)


@pytest.mark.slow
def test_without_an_rcm_it_says_so_and_what_to_do(tmp_path: Path) -> None:
    text = """
        with zscout.connect() as lab:
            began = time.monotonic()
            try:
                with lab.hold("survey", {"robot/a": {}}):
                    say("never")
            except zscout.NoRcm as nobody:
                say(f"{time.monotonic() - began:.1f}", nobody)
    """
    lab = Lab(tmp_path)
    (line,) = rest_of(script(lab, text))
    seconds, _, told = line.partition(" ")
    assert float(seconds) >= 3
    assert told.startswith(
        f"no leader is on the mesh of fleet {lab.fleet.name} (no other program either); start zscout-node"
    )
    assert "check the fleet file ($ZSCOUT_FLEET)" in told


def test_a_lab_that_was_closed_says_so(fleet: CliFleet) -> None:
    text = """
        with zscout.connect() as lab:
            with lab.hold("survey", {"robot/a": {}}) as held:
                pass
        for use in (lab.hold("again", {"robot/a": {}}).__enter__, held.wait, lambda: held.command("robot/a", {})):
            try:
                use()
            except RuntimeError as closed:
                say(closed)
    """
    told = rest_of(script(fleet.lab, text))
    assert told == ["this lab is closed; zscout.connect() gives a new one"] * 3


@pytest.mark.slow
def test_who_waits_in_another_thread_as_a_lab_is_closed_is_told(fleet: CliFleet) -> None:
    text = """
        import asyncio
        begun = threading.Event()

        async def work():
            begun.set()
            await asyncio.sleep(LONGER)

        def wait():
            try:
                lab.run(work())
            except RuntimeError as closed:
                say(closed)

        with zscout.connect() as lab:
            thread = threading.Thread(target=wait, daemon=True)
            thread.start()
            begun.wait()
        thread.join()
    """
    assert rest_of(script(fleet.lab, text)) == ["this lab is closed; zscout.connect() gives a new one"]


NOTEBOOK = """
    # As ipykernel does: an event loop runs cells, one by one.
    import ast, asyncio, os

    space = {"zscout": zscout, "say": say, "time": time}

    async def cell(text):
        await asyncio.sleep(0)
        exec(compile(text, "cell", "exec"), space)

    async def served(until):
        while not os.path.exists(until):
            await asyncio.sleep(0.05)
"""


@pytest.mark.parametrize(
    "entering",
    ["lab.hold('survey', {'robot/a': {}}).__enter__()", "lab.acquire('survey', {'robot/a': {}})"],
    ids=["hold", "acquire"],
)
def test_a_hold_that_is_kept_across_cells_ends_no_event_loop(fleet: CliFleet, tmp_path: Path, entering: str) -> None:
    taken = tmp_path / "taken"
    text = (
        NOTEBOOK
        + f"""
    async def kernel():
        await cell({f"lab = zscout.connect(); held = {entering}; held.on_lost(lambda: say('called back'))"!r})
        say("entered")
        await served({str(taken)!r})
        await space["held"].over()
        say("lost", space["held"].lost)
        try:
            await cell("held.command('robot/a', {{'name': 'echo', 'value': 1}})")
        except zscout.Revoked as revoked:
            say("next use", revoked.outcome)
        await cell("held.release(); held.release(); lab.close()")

    asyncio.run(kernel())
    """
    )
    notebook = script(fleet.lab, text)
    read_until(notebook, "entered")
    take(fleet, "robot/a", "--priority", "5")
    taken.touch()
    assert sorted(rest_of(notebook)) == ["called back", "lost True", "next use preempted"]
    assert fleet.idle("robot/a")


def test_a_holder_learns_who_waits_by_a_callback_and_in_any_event_loop(fleet: CliFleet) -> None:
    text = """
    import asyncio
    with zscout.connect() as lab, lab.hold("survey", {"robot/a": {}}, min_runtime=600) as held:
        called = []
        held.on_notice(called.append)
        say("entered", held.upcoming)
        notice = asyncio.run(held.noticed())
        say(notice.code, notice.by.arc, notice.rcs, held.upcoming == [notice])
        say("withdrawn", asyncio.run(held.noticed()).withdrawn, [one.by.arc for one in called][:1])
    """
    holder = script(fleet.lab, text)
    assert read_until(holder, "entered") == ["entered []"]
    waiting = fleet.start("request", "robot/a", "--name", "next")
    try:
        assert read_until(holder, "waits") == ["waits next ['robot/a'] True"]
    finally:
        end(waiting)
    assert rest_of(holder) == ["withdrawn True ['next']"]


def test_a_suspended_body_learns_of_the_end_when_it_runs(fleet: CliFleet, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    text = (
        NOTEBOOK
        + f"""
    async def lifespan(lab):
        with lab.hold("survey", {{"robot/a": {{}}}}) as held:
            say("entered")
            await served({str(taken)!r})
            await held.over()
            say("lost", held.lost)
            held.check()

    async def serve(lab):
        await asyncio.create_task(lifespan(lab))

    with zscout.connect() as lab:
        try:
            asyncio.run(serve(lab))
        except zscout.Revoked as revoked:
            say(revoked.outcome)
    """
    )
    app = script(fleet.lab, text)
    read_until(app, "entered")
    take(fleet, "robot/a", "--priority", "5")
    taken.touch()
    assert rest_of(app) == ["lost True", "preempted"]
    assert fleet.idle("robot/a")


def test_a_body_within_a_context_manager_of_ones_own_is_interrupted(fleet: CliFleet) -> None:
    text = """
        from contextlib import ExitStack, contextmanager

        @contextmanager
        def prepared(lab):
            with ExitStack() as stack:
                yield stack.enter_context(lab.hold("survey", {"robot/a": {}}))

        with zscout.connect() as lab:
            try:
                with prepared(lab):
                    say("entered")
                    time.sleep(LONGER)
            except zscout.Revoked as revoked:
                say(revoked.outcome)
    """
    assert preempted(fleet, text) == ["preempted"]


@pytest.mark.parametrize("start", ["multiprocessing", "os.fork"])
def test_a_forked_process_is_told_to_be_spawned_and_its_parent_goes_on(fleet: CliFleet, start: str) -> None:
    text = f"""
        import multiprocessing, os

        def child():
            for use in (zscout.connect, lambda: lab.hold("other", {{"robot/b": {{}}}}).__enter__(), held.check):
                try:
                    use()
                except (RuntimeError, zscout.MeshError) as error:
                    say("spawn" in str(error), "fork" in str(error))

        with zscout.connect() as lab, lab.hold("survey", {{"robot/a": {{}}}}) as held:
            if {start == "os.fork"}:
                if not (process := os.fork()):
                    child()
                    sys.exit(0)  # leaves the bodies of the parent's `with`
                say(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]))
            else:
                process = multiprocessing.get_context("fork").Process(target=child)
                process.start()
                process.join()
                say(process.exitcode)
            say(held.command("robot/a", {{"name": "echo", "value": 5}}, ttl=60), held.active)
    """
    assert rest_of(script(fleet.lab, text)) == ["True True"] * 3 + ["0", "5 True"]
    assert fleet.idle("robot/a", "robot/b")
