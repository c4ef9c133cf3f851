"""Files, durations and numbers read strictly, and how the place of a mistake is written."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from decimal import Decimal
from pathlib import Path

import pytest

from tests.config.kit import write
from zscout.config import strict
from zscout.config.strict import BadInput, Where


@contextmanager
def nobody() -> Iterator[None]:
    """Not root for a while: root may read everything."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    def line(path: Path) -> str:
        with pytest.raises(BadInput) as caught:
            strict.read_text(path, max_bytes=10)
        return str(caught.value)

    assert line(Path("none")) == "none: there is no such file; check the path"
    Path("folder").mkdir()
    assert line(Path("folder")) == "folder: is a directory; name a file in it"
    os.mkfifo("fifo")
    assert line(Path("fifo")) == "fifo: is not a regular file; name a file on disk"
    assert line(Path("/dev/null")) == "/dev/null: is not a regular file; name a file on disk"
    write("full", "0123456789")
    assert strict.read_text(Path("full"), max_bytes=10) == "0123456789"
    assert line(Path("full/x")) == "full/x: can't be read: Not a directory; check the path"
    write("big", "0123456789a")
    assert line(Path("big")) == "big: has more than 10 bytes; shorten or split it"
    Path("latin").write_bytes(b"a\n\nb\xe4")
    assert line(Path("latin")) == "latin: line 3 is not UTF-8; save the file as UTF-8"
    write("closed", "").chmod(0)
    with nobody():
        found = line(tmp_path / "closed")
    assert found == f"{tmp_path}/closed: may not be read by this user; change its permissions, or run as another user"


@pytest.mark.parametrize(
    ("seconds", "ns"),
    [("0", 0), ("1.5", 1_500_000_000), ("0.0000000005", 0), ("0.0000000015", 2), ("0.00000000050000001", 1)],
)
def test_seconds_are_rounded_to_whole_ns_with_halves_to_even(seconds: str, ns: int) -> None:
    assert strict.seconds_to_ns(Decimal(seconds), Where("f")) == ns


@pytest.mark.parametrize("seconds", ["-0.000000001", "nan", "inf", "-inf", "1000000000.1", "1e999999"])
def test_seconds_out_of_range(seconds: str) -> None:
    where = Where("f") / "at"
    with pytest.raises(BadInput) as caught:
        strict.seconds_to_ns(Decimal(seconds), where)
    assert str(caught.value) == f"f: at: is {Decimal(seconds)} s; write 0 to 1000000000 seconds"


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("5", "5"), ("1.5", "1.5"), (".5", "0.5"), ("90s", "90"), ("300ms", "0.3"), ("5m", "300"), ("2h", "7200"),
        ("1d12h", "129600"), ("1d", "86400"), ("2h30m", "9000"), ("1.5h", "5400"), ("1m3s", "63"), ("5m3ms", "300.003"),
        ("5min", "300"), ("5 m", "300"), ("1 d 2 h", "93600"), ("29 min 45 s", "1785"), ("2 ms", "0.002"),
    ],
)  # fmt: skip
def test_a_duration(text: str, seconds: str) -> None:
    assert strict.parse_duration(text) == Decimal(seconds)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "s",
        "soon",
        "5  m",
        "5minutes",
        "5 mi n",
        "5 ",
        " 5m",
        "1m1h",
        "1h1h",
        "1d12",
        "-1",
        "+1",
        "1e3",
        "inf",
        "m5",
        "٣s",
        "5m\n",
    ],
)
def test_no_duration(text: str) -> None:
    assert strict.parse_duration(text) is None


def test_a_place_is_written_as_toml_writes_keys() -> None:
    where = ((Where("f") / "arc").item(2, "arc2") / "needs" / "robot/scout33" / 'a"b\\c') / "rate"
    assert where.key == r'arc[2].needs."robot/scout33"."a\"b\\c".rate'
    assert str(where.bad("what", "remedy")) == f"f: {where.key} (arc2): what; remedy"
    assert str(Where("f").bad("what", "remedy")) == "f: what; remedy"
