"""What a host keeps of bookings: fleet time as it hears it, and its file."""

from __future__ import annotations

import asyncio
import json
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from zscout.keyexpr import Sender
from zscout.messages import BookingRecord, Grants
from zscout.services.bookings.keeper import ASIDE, FILE, BookingFile, BookingKeeper
from zscout.testing.memory import MemoryNetwork
from zscout.types import SECOND, Term

NOON = 1_800_000_000.0


def record(name: str, **more: Any) -> BookingRecord:
    return BookingRecord(name, name, {"robot/a": {}}, 0, round(NOON), Decimal(60), Decimal(60), **more)


async def test_a_publication_that_comes_late_turns_no_clock_back() -> None:
    keeper = BookingKeeper(MemoryNetwork().open("zscout", Sender("x", "node")))
    assert keeper.time is None
    begun = asyncio.get_running_loop().time()

    def hear(late: float, term: int = 1, ahead: float = 0.0, age: float = 100.0) -> float:
        """By how much fleet time here is behind what the leader means. `age`: of its time at the beginning."""
        gone = asyncio.get_running_loop().time() - begun
        true = NOON + ahead + gone
        held = max(0.0, age + gone - late)
        keeper.observe(Grants(Term(term, "x"), 1, 1, 0.5, {}, [], time=true - late, time_age=held))
        assert keeper.time is not None
        return true - keeper.time / SECOND

    assert hear(0.0) == pytest.approx(0, abs=1e-3)
    await asyncio.sleep(0.5)
    assert hear(2.0) == pytest.approx(0, abs=0.02)
    await asyncio.sleep(0.5)
    assert hear(5.0) == pytest.approx(0, abs=0.03)
    await asyncio.sleep(0.5)
    assert hear(0.0) == pytest.approx(0, abs=1e-3)
    # Clocks run apart. A leader of another half is believed if its time has gone on for longer.
    await asyncio.sleep(10)
    assert hear(0.0, ahead=-0.02) == pytest.approx(0, abs=1e-3)
    assert hear(0.0, term=2, ahead=-60, age=1) == pytest.approx(-60, abs=0.2)
    assert hear(0.0, term=2, ahead=1, age=1) == pytest.approx(1, abs=0.2)
    assert hear(0.0, term=3, ahead=-60, age=900) == pytest.approx(0, abs=1e-3)
    # What another leader said first may have waited here while this process stood still: in seed 523 for 1.1 s.
    await asyncio.sleep(1)
    assert hear(1.4, term=4, ahead=-60, age=900) == pytest.approx(0, abs=0.03)
    await asyncio.sleep(0.5)
    assert hear(0.8, term=5, ahead=-60, age=900) == pytest.approx(0, abs=0.04)
    # A correction is followed at once, forward and back, by this leader or the next; only the age is the same.
    for term, ahead in ((5, -2.5), (5, -259_200), (6, -60), (7, 3_600), (7, -60)):
        await asyncio.sleep(0.5)
        assert hear(0.6, term, ahead, age=900) == pytest.approx(0.6, abs=1e-3)
        assert hear(0.0, term, ahead, age=900) == pytest.approx(0, abs=1e-3)


async def test_a_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    records = [record("one", unbooked=True), record("two", every=1, until=round(NOON) + 86_400, dropped=[round(NOON)])]
    await BookingFile(tmp_path, "zscout").write(records)
    assert BookingFile(tmp_path, "zscout").read() == records
    assert (tmp_path / FILE).stat().st_mode & 0o777 == 0o600


def test_a_file_of_another_fleet_is_not_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    asyncio.run(BookingFile(tmp_path, "other").write([record("one")]))
    assert BookingFile(tmp_path, "zscout").read() == []
    assert "belongs to fleet other, and is not used" in caplog.text
    assert (tmp_path / ASIDE).exists()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_half_a_file_is_not_used(tmp_path: Path, share: float, caplog: pytest.LogCaptureFixture) -> None:
    asyncio.run(BookingFile(tmp_path, "zscout").write([record("one"), record("two")]))
    content = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).write_bytes(content[: int(share * len(content))])
    assert BookingFile(tmp_path, "zscout").read() == []
    assert "can't be read, and is not used" in caplog.text
    # What is written next does not end what is left of it.
    asyncio.run(BookingFile(tmp_path, "zscout").write([]))
    assert (tmp_path / ASIDE).read_bytes() == content[: int(share * len(content))]
    assert (tmp_path / ASIDE).stat().st_mode & 0o777 == 0o600


def test_a_damaged_record_is_left_out_and_all_others_are_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    asyncio.run(BookingFile(tmp_path, "zscout").write([record("one"), record("two"), record("three")]))
    kept = json.loads((tmp_path / FILE).read_bytes())
    kept["records"][1]["start"] = "noon"
    (tmp_path / FILE).write_text(json.dumps(kept))
    assert [one.id for one in BookingFile(tmp_path, "zscout").read()] == ["one", "three"]
    assert "a booking in" in caplog.text
    assert "is left out" in caplog.text
    assert (tmp_path / ASIDE).read_bytes() == (tmp_path / FILE).read_bytes()
