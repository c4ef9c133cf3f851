"""What a simulated fleet has for bookings: its disks and clocks, and that programs do all that there is to do."""

from __future__ import annotations

import asyncio
from collections import Counter
from decimal import Decimal

import pytest

from studies.faults.bookers import EPOCH, Hosts, MemoryDisk
from studies.faults.simulation import simulate
from tests.mesh.kit import run
from zscout.messages import BookingRecord
from zscout.testing.virtual_time import START, Process

ONE = BookingRecord("one", "one", {"robot/a": {"rate": Decimal("0.1")}}, 0, 1_800_000_000, Decimal(60), Decimal(60))


def test_what_was_not_written_to_the_end_is_not_on_the_disk() -> None:
    async def story() -> None:
        disk = MemoryDisk()
        await disk.write([ONE])
        assert disk.read() == [ONE]
        process = Process("h0/node")
        process.run(asyncio.create_task, disk.write([]))
        await asyncio.sleep(0)
        process.kill()
        await asyncio.sleep(1)
        assert disk.read() == [ONE]
        disk.failing = True
        with pytest.raises(OSError, match="no space"):
            await disk.write([])
        assert disk.read() == [ONE]

    run(story())


def test_a_disk_that_is_restored_has_what_it_had_as_it_was_copied() -> None:
    async def story() -> None:
        loop = asyncio.get_running_loop()
        hosts = Hosts(1, ["h0", "h1"], loop.time, booked=False)
        await hosts.disks["h0"].write([ONE])
        hosts.copy_disks()
        await hosts.disks["h0"].write([])
        await hosts.disks["h1"].write([ONE])
        for host in ("h0", "h1"):
            hosts.restore_disk(host)
        assert (hosts.disks["h0"].read(), hosts.disks["h1"].read()) == ([ONE], [])

    run(story())


def test_clocks_of_hosts_are_seconds_off_or_in_some_runs_hours() -> None:
    off = Counter(
        max(abs(Hosts(seed, ["h0", "h1"], lambda: START, booked=True).wall(host) - EPOCH) for host in ("h0", "h1")) > 3
        for seed in range(100)
    )
    assert 20 < off[True] < 60


@pytest.mark.slow
def test_programs_do_all_that_there_is_to_do_with_bookings() -> None:
    counts = Counter[str]()
    for seed in (3, 4, 13):
        counts += simulate(seed).counts
    done = ("booked", "unbooked", "dates unbooked", "slots looked for", "taken up", "dates open at the end")
    assert {what: counts[what] > 5 for what in done} == dict.fromkeys(done, True)
