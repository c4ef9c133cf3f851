"""What the timeline writes, read back from real recordings and from a real live server."""

from __future__ import annotations

import math
import socket
import subprocess
import threading
import time
import warnings
from contextlib import suppress
from itertools import combinations
from pathlib import Path

import pytest
import rerun as rr
from rerun.chunk import RrdReader

from tests.hang import HANG
from tests.services.recorder.paper_run import (
    RCS,
    RERUN,
    SCOUT33,
    TABLE2,
    colours,
    events,
    lanes,
    play_table1,
    rows,
    second_by_second,
)
from zscout.services.recorder import drawing, hosts
from zscout.services.recorder import timeline as module
from zscout.services.recorder.blueprint import TIME, WALL_TIME
from zscout.services.recorder.colours import LINES, OPERATOR, PALETTE, STATES
from zscout.services.recorder.drawing import CURVE_TICK, Drawing, HolderRow
from zscout.services.recorder.timeline import OPERATOR_MARK, Timeline, TimelineError


@pytest.fixture(scope="module")
def table1(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("table1") / "run.rrd"
    with Timeline("lab", path=path) as timeline:
        play_table1(timeline)
    return path


def test_table_1_recorded_reads_as_table_2(table1: Path) -> None:
    shown = lanes(table1, "/devices/**")
    assert {rc: second_by_second(shown[f"/devices/{rc}"]) for rc in RCS} == TABLE2
    lane = [(0, "arc0"), (5, "arc3"), (8, "arc2"), (11, "arc4" + OPERATOR_MARK), (14, "arc2"), (18, "")]
    assert shown[f"/devices/{SCOUT33}"] == [(at, [holder]) for at, holder in lane]


def test_arc_lanes_tell_the_story(table1: Path) -> None:
    shown = lanes(table1, "/requests/**")
    assert set(shown) == {f"/requests/arc{number}" for number in range(5)}
    story = [(at, states[0].split(" · ")[0]) for at, states in shown["/requests/arc2"]]
    kept = [change for index, change in enumerate(story) if index == 0 or change[1] != story[index - 1][1]]
    assert kept == [(1, "waiting"), (8, "running"), (11, "preempted"), (14, "running"), (18, "done")]
    assert any("arc2 preempted" in text for text in events(table1))


def test_an_arc_has_one_colour_and_the_operator_has_its_own(table1: Path) -> None:
    by_text: dict[str, set[int]] = {}
    for lane in colours(table1, "/devices/**").values():
        for text, colour in lane.items():
            by_text.setdefault(text, set()).add(colour)
    shades = {f"arc{number}": {PALETTE[number]} for number in range(4)}
    assert by_text == shades | {"arc4" + OPERATOR_MARK: {OPERATOR}}
    for lane in colours(table1, "/requests/**").values():
        for text, colour in lane.items():
            assert colour == STATES[text.split(" · ")[0]]
            assert (colour == OPERATOR) == text.startswith("preempted")


def test_only_what_an_operator_did_is_red_among_the_events(path: Path) -> None:
    """The viewer gives a line without a colour that of the line before."""
    with Timeline("lab", path=path) as timeline:
        timeline.event(0, "one")
        timeline.warn(1, "two", operator=True)
        timeline.event(2, "three")
        timeline.warn(3, "four")
    shown = [colour for _, _, (colour,) in rows(path, "/events", "TextLog:color")]
    assert [colour == OPERATOR for colour in shown] == [False, True, False, False]


@pytest.mark.parametrize("epoch", [None, 1.8e9])
def test_points_of_curves_come_in_few_pieces_and_none_is_lost(path: Path, epoch: float | None) -> None:
    each = rr.ChunkBatcherConfig.ALWAYS_TEST_ONLY()
    stream = rr.RecordingStream("zscout", batcher_config=each)
    stream.save(path)
    drawing = Drawing(stream)
    drawing.epoch = epoch
    told = [(float(second), second / 2) for second in range(23)]
    for at, value in told:
        drawing.point(at, "/load/anvil", value)
    assert (drawing.begin, drawing.end) == (0, 22)
    # What a host told last is not held back for ever.
    drawing.pass_points(22 + CURVE_TICK)
    drawing.point(99, "/load/anvil", 1.0)
    drawing.flush(10)
    stream.disconnect()
    pieces, shown = [], []
    for chunk in RrdReader(path).stream().filter(content="/load/**"):
        batch = chunk.to_record_batch()
        pieces.append(batch.num_rows)
        times = batch.column(TIME if epoch is None else WALL_TIME).cast("int64").to_pylist()
        values = [value for (value,) in batch.column("Scalars:scalars").to_pylist()]
        shown += [(at / 1e9 - (epoch or 0), value) for at, value in zip(times, values, strict=True)]
    assert sorted(pieces) == [1, 5, 6, 6, 6]
    assert sorted(shown) == [*told, (99, 1.0)]


def lab_of(rgba: int) -> tuple[float, float, float]:
    """CIE L*a*b* of an sRGB colour under D65."""
    red, green, blue = (
        channel / 12.92 if channel <= 0.04045 else ((channel + 0.055) / 1.055) ** 2.4
        for channel in ((rgba >> shift & 0xFF) / 255 for shift in (24, 16, 8))
    )
    x = (0.4124 * red + 0.3576 * green + 0.1805 * blue) / 0.9505
    y = 0.2126 * red + 0.7152 * green + 0.0722 * blue
    z = (0.0193 * red + 0.1192 * green + 0.9505 * blue) / 1.0891
    fx, fy, fz = (part ** (1 / 3) if part > 0.008856 else 7.787 * part + 16 / 116 for part in (x, y, z))
    return 116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)


def test_colours_are_well_apart() -> None:
    assert len(PALETTE) >= 12
    near = {
        (f"{one:08X}", f"{two:08X}"): round(math.dist(lab_of(one), lab_of(two)))
        for one, two in combinations(PALETTE, 2)
        if math.dist(lab_of(one), lab_of(two)) < 25  # 2.3 is just noticeable side by side
    }
    assert not near
    others = [*PALETTE, *LINES, *(colour for state, colour in STATES.items() if state != "preempted")]
    assert min(math.dist(lab_of(OPERATOR), lab_of(colour)) for colour in others) > 50


def test_holders_of_a_sharable_rc_keep_their_rows(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        for at, names in enumerate(("a", "ab", "abc", "bc", "bcd", "")):
            timeline.holders(at, "radio/rf0", [HolderRow(name) for name in names])
    assert lanes(path, "/devices/**")["/devices/radio/rf0"] == [
        (0, ["a"]),
        (1, ["a", "b"]),
        (2, ["a", "b", "c"]),
        (3, ["", "b", "c"]),
        (4, ["d", "b", "c"]),
        (5, ["", "", ""]),
    ]


def test_a_crowd_is_summed_up_in_the_last_row(path: Path) -> None:
    crowd = [HolderRow(f"arc{number}") for number in range(11)]
    with Timeline("lab", path=path) as timeline:
        timeline.holders(0, "radio/rf0", crowd)
        timeline.holders(1, "radio/rf0", crowd[:8])
        timeline.holders(2, "radio/rf0", crowd[1:10])
        timeline.holders(3, "radio/rf0", [])
    changes = [states for _, states in lanes(path, "/devices/**")["/devices/radio/rf0"]]
    assert changes[0] == [*(f"arc{number}" for number in range(7)), "4 more"]
    assert changes[1] == [f"arc{number}" for number in range(8)]
    assert changes[2] == ["arc7", *(f"arc{number}" for number in range(1, 7)), "2 more"]
    assert changes[3] == [""] * 8


def test_what_does_not_change_is_not_written_again(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        for at in range(100):
            timeline.holders(at, SCOUT33, [HolderRow("arc0")])
            timeline.arc(at, "arc0", "running")
    assert [len(changes) for changes in lanes(path, "/**").values()] == [1, 1]


def test_names_past_the_limit_are_noted_once(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_ARCS", 3)
    monkeypatch.setattr(module, "MAX_RCS", 2)
    monkeypatch.setattr(hosts, "MAX_HOSTS", 1)
    with Timeline("lab", path=path) as timeline:
        for number in range(6):
            timeline.arc(number, f"arc{number}", "waiting")
            timeline.holders(number, f"robot/r{number}", [])
            timeline.hosts.load(number, f"host{number}", 0.5)
        timeline.holders(7, "robot/r0", [HolderRow("arc5")])
    assert set(lanes(path, "/requests/**")) == {"/requests/arc0", "/requests/arc1", "/requests/arc2"}
    assert set(lanes(path, "/devices/**")) == {"/devices/robot/r0", "/devices/robot/r1"}
    assert {entity for entity, _, _ in rows(path, "/load/**", "Scalars:scalars")} == {"/load/host0"}
    assert lanes(path, "/devices/**")["/devices/robot/r0"][-1] == (7, ["arc5"])
    notes = events(path)
    assert len(notes) == 3
    assert all(note.startswith("timeline: more than ") for note in notes)


def test_a_lane_forgets_the_colours_longest_unused(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "RC_STATES", 16)
    with Timeline("lab", path=path) as timeline:
        for number in range(40):
            timeline.holders(number, SCOUT33, [HolderRow(f"arc{number}")])
    assert list(colours(path, "/devices/**")[f"/devices/{SCOUT33}"]) == [f"arc{number}" for number in range(24, 40)]


def test_hostile_names_and_texts_are_tamed(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        timeline.arc(0, "../a b\n/\x00/" + "x" * 1000, "waiting", "because\n\x1b[31mof " + "y" * 1000)
        timeline.event(0, "one\ntwo\x07 \u65e5\u2716 é " + "z" * 10_000, "SHOUT")
        timeline.hosts.load(0, "anvil", math.nan, math.inf)
        timeline.hosts.load(1, "anvil", 0.5, 0.25)
    ((lane, changes),) = lanes(path, "/requests/**").items()
    assert lane == "/requests/../a_b_/_/" + "x" * 64
    assert changes[0][1][0].startswith("waiting · because [31mof yyy")
    assert len(changes[0][1][0]) == drawing.MAX_STATE
    (text,) = events(path)
    assert text.startswith("one two ?? é zzz")
    assert len(text) == drawing.MAX_EVENT
    assert [value for _, _, value in rows(path, "/load/**", "Scalars:scalars")] == [[0.5]]
    assert [value for _, _, value in rows(path, "/cpu/**", "Scalars:scalars")] == [[0.25]]


@pytest.mark.parametrize("at", [math.nan, math.inf, -math.inf, 1e10])
def test_a_time_that_is_none_is_refused(tmp_path: Path, at: float) -> None:
    with (
        Timeline("lab", path=tmp_path / "run.rrd") as timeline,
        pytest.raises(ValueError, match="is not a time in seconds"),
    ):
        timeline.event(at, "text")


def test_many_threads_keep_their_times(path: Path) -> None:

    def write(number: int) -> None:
        for step in range(50):
            timeline.event(number * 1000 + step, f"{number * 1000 + step}")

    with Timeline("lab", path=path) as timeline:
        threads = [threading.Thread(target=write, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    written = [(at, texts) for _, at, texts in rows(path, "/events", "TextLog:text")]
    assert len(written) == 200
    assert all(texts == [f"{at:.0f}"] for at, texts in written)


@pytest.mark.live
@pytest.mark.slow
def test_live_viewers_get_what_the_file_gets(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.rrd"
    with Timeline("lab", path=path, port=0) as timeline:
        assert timeline.url is not None
        play_table1(timeline)
        # `--save` also listens for loggers of its own, hence the port and the bind address.
        command: list[str | Path] = [RERUN, "--save", copy, "--bind", "127.0.0.1", "--port", "auto", timeline.url]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as viewer:
            try:
                assert becomes_equal(viewer, path, copy)
            finally:
                viewer.kill()


def becomes_equal(viewer: subprocess.Popen[bytes], path: Path, copy: Path) -> bool:
    """Whether Table 2 and its colours come to both files, while all are still open."""
    deadline = time.monotonic() + HANG
    while time.monotonic() < deadline and viewer.poll() is None:
        # A file that is being written has no footer, and at first not even a store.
        with suppress(ValueError, RuntimeError, OSError, KeyError), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            shown = lanes(copy, "/devices/**")
            table = {rc: second_by_second(shown[f"/devices/{rc}"]) for rc in RCS}
            if (
                table == TABLE2
                and shown == lanes(path, "/devices/**")
                and colours(copy, "/devices/**") == colours(path, "/devices/**")
            ):
                return True
        time.sleep(0.02)
    return False


def test_a_port_that_is_taken_is_a_clear_error(path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(TimelineError) as caught:
            Timeline("lab", path=path, port=port)
    assert str(caught.value) == (
        f"can't listen on 127.0.0.1, port {port} (Address already in use); "
        "choose another port, or stop the program that uses it"
    )
    assert not path.exists()


def test_bad_addresses_and_paths_are_clear_errors(tmp_path: Path) -> None:
    with pytest.raises(TimelineError, match=r"can't listen on 192.0.2.1, port 0 \(Cannot assign"):
        Timeline("lab", path=None, bind="192.0.2.1", port=0)
    for path, words in ((tmp_path, "Is a directory"), (tmp_path / "no" / "run.rrd", "No such file or directory")):
        with pytest.raises(TimelineError) as caught:
            Timeline("lab", path=path)
        assert f"can't write the recording {path} ({words})" in str(caught.value)
    with pytest.raises(TimelineError, match=r"can't write to /dev/full .*No space left on device"):
        Timeline("lab", path=Path("/dev/full"))


def test_loopback_unless_told_otherwise() -> None:
    with Timeline("lab", path=None, port=0) as timeline:
        assert timeline.url is not None
        port = int(timeline.url.split(":")[2].split("/")[0])
        socket.create_connection(("127.0.0.1", port), timeout=5).close()
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.2", port), timeout=5)


def test_closing_twice_and_writing_afterwards_do_nothing(path: Path) -> None:
    timeline = Timeline("lab", path=path)
    timeline.event(1, "first")
    timeline.close()
    timeline.event(2, "late")
    timeline.holders(2, SCOUT33, [])
    timeline.arc(2, "arc0", "done")
    timeline.hosts.load(2, "anvil", 1.0)
    timeline.close()
    assert events(path) == ["first"]


def test_a_recording_is_named_by_fleet_and_start(path: Path) -> None:
    Timeline("lab", path=path).close()
    (entry,) = RrdReader(path).recordings()
    assert entry.application_id == "zscout"
    assert entry.recording_id.startswith("lab-2")
