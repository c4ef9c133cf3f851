"""Programs that were started badly: standard streams that are closed, and encodings that lack most characters."""

from __future__ import annotations

import io
import itertools
import json
import os
import subprocess
import sys
import threading
from decimal import Decimal
from pathlib import Path

import pytest

from tests.hang import HANG
from zscout.behaviors.guardian import GUARD
from zscout.mesh import MeshError
from zscout.mesh.zenoh_mesh import open_session
from zscout.streams import escape_what_cannot_be_written
from zscout.terminal import Table, print_json, print_line

WORDS = "größe 日本 → 5 V 🤖"
COMBINATIONS = [closed for count in (1, 2, 3) for closed in itertools.combinations(range(3), count)]
SHOW = "import os, sys; open(sys.argv[1], 'w').write(' '.join(os.readlink(f'/proc/self/fd/{fd}') for fd in range(3)))"


def closing(*closed: int) -> list[str]:
    """What runs the arguments behind it with these descriptors closed."""
    return ["sh", "-c", "exec " + " ".join(f"{fd}>&-" for fd in closed) + '; exec "$@"', "sh"]


@pytest.mark.live
@pytest.mark.parametrize("closed", COMBINATIONS, ids=str)
def test_every_program_has_its_standard_streams_and_so_have_those_that_it_starts(
    closed: tuple[int, ...], tmp_path: Path
) -> None:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    script = (
        f"import sys, zscout, subprocess; sys.argv = ['', {str(ours)!r}]\n{SHOW}\n"
        "assert None not in (sys.stdin, sys.stdout, sys.stderr)\n"
        f"subprocess.run([sys.executable, '-I', '-S', '-c', {SHOW!r}, {str(theirs)!r}], check=True)"
    )
    command = [*closing(*closed), sys.executable, "-c", script]
    with (tmp_path / "out").open("w") as out:
        assert subprocess.run(command, stdin=out, stdout=out, stderr=out, timeout=HANG).returncode == 0
    for seen in (ours, theirs):
        found = seen.read_text().split()
        assert [name == "/dev/null" for name in found] == [fd in closed for fd in range(3)], found


@pytest.mark.live
def test_a_guardian_whose_streams_are_closed_starts_its_command_with_open_ones(tmp_path: Path) -> None:
    seen = tmp_path / "seen"
    script = (
        "import os, socket, subprocess, sys; ours, theirs = socket.socketpair()\n"
        "channel = os.dup2(theirs.fileno(), 9)\n"
        "for fd in range(3): os.close(fd)\n"
        f"command = [*{GUARD!r}, '9', '-1', '0', sys.executable, '-I', '-S', '-c', {SHOW!r}, {str(seen)!r}]\n"
        "guardian = subprocess.Popen(command, pass_fds=(9,))\n"
        "theirs.close(); os.close(9); ours.makefile('r').read(); os._exit(guardian.wait())"
    )
    assert subprocess.run([sys.executable, "-I", "-c", script], timeout=HANG).returncode == 0
    assert set(seen.read_text().split()) == {"/dev/null"}


def narrow(monkeypatch: pytest.MonkeyPatch, encoding: str) -> io.BytesIO:
    """What this program writes from now on to a standard output of this encoding."""
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding=encoding))
    escape_what_cannot_be_written()
    return written


ENCODINGS = pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp437", "utf-8"])


@ENCODINGS
def test_json_is_the_same_for_every_encoding(monkeypatch: pytest.MonkeyPatch, encoding: str) -> None:
    written = narrow(monkeypatch, encoding)
    value = {"comment": WORDS, "rate": Decimal("1.5"), "file": "v\udcff.avi"}
    for shown in (value, {"comment": WORDS}):
        print_json(shown)
    found = [json.loads(line) for line in written.getvalue().decode("utf-8").splitlines()]
    assert found == [value | {"rate": 1.5}, {"comment": WORDS}]


@ENCODINGS
def test_lines_and_tables_never_raise_and_stay_aligned(monkeypatch: pytest.MonkeyPatch, encoding: str) -> None:
    written = narrow(monkeypatch, encoding)
    print_line(WORDS)
    Table("", ("COMMENT", "HOST"), [(WORDS, "n"), ("a", "n")]).print()
    line, *table = written.getvalue().decode(encoding).splitlines()
    assert line.endswith(" 5 V 🤖" if encoding == "utf-8" else " 5 V \\ud83e\\udd16")
    assert len(table) == 3
    assert len({row.rstrip().rindex("n") if row[0] != "C" else row.index("HOST") for row in table}) == 1
    for shown, _ in Table("", ("COMMENT",), [(WORDS * 9,)], cut=("COMMENT",)).fitted(30):
        assert len(shown) <= 30
        shown.encode(encoding)


@pytest.mark.live
def test_every_command_starts_with_that() -> None:
    script = (
        "import click; from zscout.cli.main import OneLineErrors; from zscout.terminal import print_line\n"
        f"shown = click.Command('x', callback=lambda: print_line({WORDS!a}))\n"
        "group = OneLineErrors(headings={}, instead={}, commands=[shown])\n"
        "group.resolve_command = lambda *_: ('x', shown, [])\n"
        "group.get_command = lambda *_: shown\n"
        "group.main(['x'])"
    )
    env = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, timeout=HANG)
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(b"gr\\u00f6\\u00dfe ")


@pytest.mark.live
def test_variables_that_steer_zenoh_are_not_left_to_other_programs() -> None:
    script = """if True:
        import asyncio, os, subprocess, sys
        from contextlib import suppress
        from msgspec.structs import replace
        from zscout.config.fleet import MeshConfig, fleet_from_env
        from zscout.keyexpr import Sender
        from zscout.mesh import ZenohMesh

        def accepting():
            for task in os.listdir("/proc/self/task"):
                with suppress(OSError), open(f"/proc/self/task/{task}/comm") as name:
                    yield "acc-" in name.read()

        async def main():
            fleet = replace(fleet_from_env(), mesh=MeshConfig(multicast=False, listen=("tcp/127.0.0.1:0",)))
            async with await ZenohMesh.open(fleet, Sender("h", "x"), follow=False):
                while sum(accepting()) < int(sys.argv[1]):  # a thread has its name a little later
                    await asyncio.sleep(0.02)
                subprocess.run(["env"], check=True)

        asyncio.run(main())"""
    for more, threads in ({}, 4), ({"ZENOH_RUNTIME": "(acc:(worker_threads:7))"}, 7):
        env = {name: value for name, value in os.environ.items() if name != "ZENOH_RUNTIME"} | more
        command = [sys.executable, "-c", script, str(threads)]
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=HANG)
        assert (done.returncode, done.stderr) == (0, "")
        seen = {line.partition("=")[0] for line in done.stdout.splitlines()}
        assert seen ^ env.keys() <= {"_", "LC_CTYPE"}


@pytest.mark.live
@pytest.mark.parametrize("program", ["zscout-node", "zscout"])
def test_too_few_descriptors_are_one_line(program: str, tmp_path: Path) -> None:
    (tmp_path / "n.toml").write_text('[node]\nhost = "n"\n')
    words = ["zscout.cli.main", "status"] if program == "zscout" else ["zscout.node", str(tmp_path / "n.toml")]
    command = ["sh", "-c", 'ulimit -n 20; exec "$@"', "sh", sys.executable, "-m", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=HANG)
    why = "the mesh can't be joined: Too many open files; raise the limit (ulimit -n, in a unit LimitNOFILE=)"
    assert (done.returncode, done.stderr) == (1, f"{program}: {why}\n")


def test_where_threads_are_too_few_those_that_were_tried_end(monkeypatch: pytest.MonkeyPatch) -> None:
    start, started = threading.Thread.start, list[threading.Thread]()

    def limited(thread: threading.Thread) -> None:
        if len(started) == 3:
            raise RuntimeError("can't start new thread")
        started.append(thread)
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", limited)
    with pytest.raises(MeshError, match="no more threads can be started; end some processes"):
        open_session(pytest.fail)
    assert not any(thread.is_alive() for thread in started)
