"""Calendars with another program's reading and writing of them: khal, which is none of zscout's packages."""

from __future__ import annotations

import os
import shutil
import subprocess
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest

from tests.hang import HANG
from tests.services.bookings.test_calendar_text import at, booking, fleet
from zscout.cli.bookings.calendar_file import read_calendar
from zscout.cli.bookings.calendar_plan import ImportOptions, plan_import
from zscout.messages import BookingRecord, BookingView
from zscout.services.bookings.calendar_text import calendar_text
from zscout.services.bookings.dates import dates

pytestmark = [
    pytest.mark.live,
    pytest.mark.skipif(shutil.which("khal") is None, reason="khal is missing: install the package khal"),
]

CONFIG = """
[calendars]
[[lab]]
path = {folder}/lab
[locale]
local_timezone = {zone}
default_timezone = {zone}
timeformat = %H:%M:%S
dateformat = %Y-%m-%d
longdateformat = %Y-%m-%d
datetimeformat = %Y-%m-%d %H:%M:%S
longdatetimeformat = %Y-%m-%d %H:%M:%S
[sqlite]
path = {folder}/khal.db
[default]
default_calendar = lab
"""
LINE = "{uid}|{start-long-full}|{end-long-full}|{title}|{location}|{status}"


class Khal:
    def __init__(self, folder: Path, zone: str) -> None:
        self._folder = folder
        (folder / "lab").mkdir()
        (folder / "khal.conf").write_text(CONFIG.format(folder=folder, zone=zone))

    def __call__(self, *args: str) -> str:
        # Debian's own Python, without what this one has set.
        env = {"PATH": os.environ["PATH"], "HOME": str(self._folder), "LC_ALL": "C.UTF-8"}
        command = ["khal", "-c", str(self._folder / "khal.conf"), *args]
        return subprocess.run(command, env=env, capture_output=True, text=True, timeout=HANG, check=True).stdout

    def events(self, since: str) -> set[tuple[str, ...]]:
        """All of 420 days, in the columns of LINE."""
        lines = self("list", "--format", LINE, "--day-format", "", since, "420d").splitlines()
        return {tuple(line.split("|")) for line in lines if line}


def record(view: BookingView) -> BookingRecord:
    terms = (view.start, view.runtime, view.patience, view.zone, view.every, view.until)
    return BookingRecord(view.id, view.name, view.needs, view.priority, *terms)


def test_what_is_exported_khal_shows_at_its_dates(tmp_path: Path) -> None:
    told = [
        *(one for one in fleet() if one.id not in ("gone", "once")),
        booking("umlauts", at(2026, 12, 9, 23), name="long", owner="ö" * 100, runtime=Decimal(10_800)),
        # Over the beginning of summer time, and the end.
        booking("hour", at(2027, 2, 28, 9), every=7, zone="Europe/Berlin", until=at(2027, 11, 20)),
    ]
    (tmp_path / "fleet.ics").write_bytes(calendar_text("lab", told))
    khal = Khal(tmp_path, "UTC")
    khal("import", "--batch", "-a", "lab", str(tmp_path / "fleet.ics"))
    found = khal.events("2026-11-20")
    expected = {
        (f"{one.id}@lab", *(f"{datetime.fromtimestamp(when, UTC):%Y-%m-%d %H:%M:%S}" for when in (start, end)))
        for one in told
        for start in dates(record(one), 0, at(2028, 1, 14))
        for end in (start + int(one.runtime),)
        if start not in one.dropped
    }
    assert {event[:3] for event in found} == expected
    texts = {event[0]: event[3:] for event in found}
    assert texts["umlauts@lab"][0] == f"long ({'ö' * 100})"
    assert texts["service@lab"][0] == "maintenance: grease (anvil)"
    [other] = [event for event in found if event[:2] == ("weekly@lab", "2026-12-15 13:00:00")]
    assert other[5] == "TENTATIVE "


def test_what_khal_writes_is_booked(tmp_path: Path) -> None:
    khal = Khal(tmp_path, "Europe/Berlin")
    khal("new", "-l", "Arm 1", "2027-05-03 10:00:00", "12:00:00", f"Prüfung, {'ö' * 80}; last")
    khal("new", "-l", "Arm 1", "-r", "weekly", "-u", "2027-06-20", "2027-05-05 09:00:00", "10:00:00", "Course")
    khal("new", "-l", "Arm 1", "2027-06-12", "2027-06-13", "Whole days")
    berlin = ZoneInfo("Europe/Berlin")
    options = ImportOptions("lab", "khal", berlin, mapped={"arm 1": (("robot/arm1", {}),)})
    booked = {}
    for file in (tmp_path / "lab").glob("*.ics"):
        plan = plan_import(read_calendar(file.read_bytes(), file.name), options, at(2026, 11, 26))
        assert not plan.skipped
        [wanted] = plan.wanted
        assert wanted.book is not None
        begin = datetime.fromtimestamp(wanted.book.start, berlin)
        booked[wanted.title] = f"{begin:%Y-%m-%d %H:%M}", int(wanted.book.runtime), wanted.book.every
    assert booked == {
        f"Prüfung, {'ö' * 80}; last": ("2027-05-03 10:00", 7200, 0),
        "Course": ("2027-05-05 09:00", 3600, 7),
        "Whole days": ("2027-06-12 00:00", 2 * 86_400, 0),
    }
