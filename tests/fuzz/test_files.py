"""Whatever stands in a file, it is read, or refused in one line that says what to mend, in bounded time."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.hostile import NUMBERS, TEXTS, Raw, write
from tests.mesh.kit import run
from tests.thorough import FACTOR, times
from zscout.config.fleet import default_fleet, load_fleet
from zscout.config.node import load_node
from zscout.config.strict import BadInput, read_text
from zscout.drivers.last_holder import LastHolderFile
from zscout.keyexpr import Sender
from zscout.messages import encode
from zscout.rcm.devices import SeenHome
from zscout.services.rcm.inventory import FILE, Inventory, _DeviceFile
from zscout.services.recorder.process import decode_job, new_recording, prune
from zscout.simulation.building.plan_file import load_plan, shipped_plans
from zscout.simulation.workload import MAX_BYTES, parse_workload
from zscout.testing.memory import MemoryNetwork

EXAMPLES: Final = Path(__file__).parents[2] / "examples"
MOST_IN_A_LINE: Final = 1_500
SIZE: Final = 20_000 * FACTOR
"""Bytes of a bomb."""


def _load_workload(path: Path) -> object:
    return parse_workload(read_text(path, max_bytes=MAX_BYTES), str(path))


FILES: Final[dict[str, tuple[Callable[[Path], object], Path]]] = {
    "fleet": (load_fleet, EXAMPLES / "fleet.toml"),
    "node": (load_node, EXAMPLES / "node.toml"),
    "workload": (_load_workload, EXAMPLES / "workload.toml"),
    "plan": (load_plan, shipped_plans()["living_room"]),
}
VALUES: Final = (
    *(text for text in NUMBERS if not text.startswith('"')),
    *("nan", "-inf", "+inf", "0x7fffffffffffffffffff", "0b1", "1_0", "1979-05-27T07:32:00Z", "23:59:60", "1979-05-27"),
    *("true", "[]", "{}", "[[]]", "[{}]", "{ a = 1 }", "[1, 'a', {}]", "'''\n'''", '"', "'", "[", "{", "", "= 1", "#"),
    *(write(text) for text in TEXTS),
)


def loads(read: Callable[[Path], object], path: Path) -> str:
    """What a file is refused with; empty if it is read. All else that is raised fails a test."""
    try:
        read(path)
    except BadInput as error:
        line = str(error)
        assert line.isprintable()
        assert 10 < len(line) < MOST_IN_A_LINE
        return line
    return ""


def spoilt(text: str, faults: int, rng: random.Random) -> bytes:
    for _ in range(faults):
        lines = text.split("\n")
        at = rng.randrange(len(lines))
        name, equals, _ = lines[at].partition("=")
        match rng.randrange(8):
            case 0:
                del lines[at]
            case 1:
                lines.insert(at, lines[rng.randrange(len(lines))])
            case 2:
                lines.insert(at, f"{rng.choice(TEXTS)} = {rng.choice(VALUES)}")
            case 3:
                lines.insert(at, rng.choice(("[x]", "[[x]]", "[a.b]", "[", "[fleet.x]", "[[fleet]]", "[rc]", "[[]]")))
            case _ if equals:
                lines[at] = f"{name}= {rng.choice(VALUES)}"
        text = "\n".join(lines) or "#"
    data = bytearray(text.encode(errors="surrogatepass"))
    match rng.randrange(6) if faults else 5:
        case 0:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        case 1:
            del data[rng.randrange(len(data)) :]
        case 2:
            data[:0] = rng.randbytes(rng.randrange(1, 50))
    return bytes(data)


@settings(max_examples=times(60), derandomize=FACTOR == 1, suppress_health_check=list(HealthCheck))
@given(st.sampled_from(sorted(FILES)), st.integers(0, 4), st.integers(0, 2**32 - 1))
def test_a_file_is_read_or_refused_in_one_line(tmp_path: Path, kind: str, faults: int, seed: int) -> None:
    read, example = FILES[kind]
    (tmp_path / "fleet.toml").write_bytes(FILES["fleet"][1].read_bytes())
    path = tmp_path / "spoilt.toml"
    path.write_bytes(spoilt(example.read_text(), faults, random.Random(seed)))  # noqa: S311 - to fail again
    refused = loads(read, path)
    assert faults or not refused


BOMBS: Final[dict[str, Callable[[int], bytes]]] = {
    "nested arrays": lambda size: b"a = " + b"[" * size,
    "nested arrays that end": lambda size: b"a = " + b"[" * (size // 2) + b"]" * (size // 2),
    "nested tables": lambda size: b"a = " + b"{a=" * (size // 3),
    "a dotted key": lambda size: b".".join([b"a"] * (size // 2)) + b" = 1",
    "a dotted key in quotes": lambda size: b".".join([b'"a"'] * (size // 4)) + b" = 1",
    "a dotted table": lambda size: b"[" + b".".join([b"a"] * (size // 2)) + b"]",
    "dotted keys": lambda size: b"\n".join(b"a.b%d.c.d = 1" % number for number in range(size // 14)),
    "tables": lambda size: b"\n".join(b"[a.b%d]" % number for number in range(size // 8)),
    "tables of a list": lambda size: b"[[rc]]\n" * (size // 7),
    "quotes": lambda size: b'"' * size,
    "quotes apart": lambda size: b' "x' * (size // 3),
    "backslashes": lambda size: b'"' + b"\\" * size,
    "an open text": lambda size: b'a = "' + b"x" * size,
    "a text of many lines": lambda size: b'a = """' + b"\n" * size,
    "a number": lambda size: b"a = " + b"9" * size,
    "a number with a point": lambda size: b"a = 0." + b"9" * size,
    "an exponent": lambda size: b"a = 1e" + b"9" * size,
    "a number in parts": lambda size: b"a = 1" + b"_1" * (size // 2),
    "a long key": lambda size: b"a" * size + b" = 1",
    "a long comment": lambda size: b"#" * size,
    "empty lines": lambda size: b"\r\n" * (size // 2),
    "NUL": lambda size: b"\0" * size,
    "no UTF-8": lambda size: b"\xff" * size,
    "surrogates": lambda size: b"\xed\xa0\x80" * (size // 3),
    "a list": lambda size: b"a = [" + b"1," * (size // 2) + b"]",
    "a list of tables": lambda size: b"rc = [" + b"{}," * (size // 3) + b"]",
}


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("bomb", BOMBS)
def test_a_bomb_is_refused_in_one_line(tmp_path: Path, kind: str, bomb: str) -> None:
    path = tmp_path / "bomb.toml"
    path.write_bytes(BOMBS[bomb](SIZE))
    refused = loads(FILES[kind][0], path)
    assert refused or bomb in ("a long comment", "empty lines", "tables of a list")


@pytest.mark.parametrize("kind", FILES)
def test_what_is_no_file_or_too_large_is_refused_unread(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "large.toml"
    with path.open("wb") as file:
        file.truncate(10**11)
    os.mkfifo(tmp_path / "fifo")
    for name in ("large.toml", "fifo", ".", "nothing", "x\0y", "\ud800", "x" * 300):
        assert loads(FILES[kind][0], tmp_path / name)


# What a node keeps for itself


@settings(max_examples=times(40), derandomize=FACTOR == 1, suppress_health_check=list(HealthCheck))
@given(st.integers(0, 2**32 - 1))
def test_a_node_begins_whatever_stands_in_its_state_folder(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)  # noqa: S311 - to fail again
    text = encode(_DeviceFile(1.0, [SeenHome("robot/a", "h", 3.0), SeenHome("radio/r", "h", why="x")])).decode()
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(text))
        new = rng.choice((*NUMBERS, *map(write, TEXTS), write(Raw("[" * 5_000)), ""))
        text = text[:at] + new + text[at + rng.randrange(4) :]
    (tmp_path / FILE).write_bytes(text.encode(errors="surrogatepass"))

    async def story() -> Any:
        mesh = MemoryNetwork().open("f", Sender("h", "node"))
        inventory = Inventory(mesh, default_fleet(), tmp_path)
        return inventory._contents(mesh.now())

    assert run(story())


def test_a_state_folder_of_other_things_is_no_reason_not_to_begin(tmp_path: Path) -> None:
    async def story(folder: Path) -> None:
        mesh = MemoryNetwork().open("f", Sender("h", "node"))
        assert Inventory(mesh, default_fleet(), folder).devices.homes(mesh.now()) == []
        LastHolderFile(folder, "robot/a")

    odd: tuple[Callable[[Path], object], ...] = (
        lambda folder: os.mkfifo(folder / FILE),
        lambda folder: (folder / FILE).mkdir(),
        lambda folder: (folder / FILE).symlink_to(FILE),
        lambda folder: os.truncate(_touched(folder / FILE), 10**11),
        lambda folder: (folder / "direct").write_bytes(b""),
        lambda folder: (folder / "direct").symlink_to("direct"),
    )
    for number, make in enumerate(odd):
        folder = tmp_path / str(number)
        folder.mkdir()
        make(folder)
        run(story(folder))


def _touched(path: Path) -> Path:
    path.touch()
    return path


def test_old_recordings_are_removed_whatever_else_lies_there(tmp_path: Path) -> None:
    kept = new_recording(tmp_path, "lab")
    name = "lab-20000101-000000"
    (tmp_path / f"{name}.rrd").touch()
    os.utime(tmp_path / f"{name}.rrd", (0, 0))
    (tmp_path / f"{name}-2.rrd").mkdir()
    os.mkfifo(tmp_path / f"{name}-3.rrd")
    (tmp_path / f"{name}-4.rrd").symlink_to(tmp_path / f"{name}-4.rrd")
    others = [f"{name}.rrd\n", f"{name}.rrd.txt", f"other-{name}.rrd", "\udcff", "lab.rrd", "-rf", "x" * 255]
    for other in others:
        (tmp_path / other).touch()
    prune(tmp_path, "lab", keep=1)
    assert not (tmp_path / f"{name}.rrd").exists()
    assert {path.name for path in tmp_path.iterdir()} == {
        *(kept.name, f"{name}-2.rrd", f"{name}-3.rrd", f"{name}-4.rrd"),
        *others,
    }


@pytest.mark.parametrize("line", [b"", b"{}", b"\xff", b"[" * 100_000, b'{"fleet":' + b"9" * 5_000 + b"}", b"\0"])
def test_a_recorder_that_is_given_no_job_says_so(line: bytes) -> None:
    with pytest.raises(BadInput, match="not a job of the recorder"):
        decode_job(line)
