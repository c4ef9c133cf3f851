"""Tests of drivers, behaviors and components, without a device, a process or a real second.

    from zscout.testing import MemoryFleet, in_virtual_time

    @in_virtual_time
    async def test_the_lamp_goes_out(tmp_path):
        lamp = Lamp.configured(Lamp.Options(path=str(tmp_path / "brightness")))
        async with MemoryFleet({"lamp/desk": lamp}) as fleet:
            async with fleet.hold("blink", {"lamp/desk": {"level": 200}}) as held:
                await held.command("lamp/desk", {"name": "set", "level": 50})
        assert lamp.level == 0

The services are the real ones, on a mesh in memory: the leader schedules, resource controllers check grants, clients
confirm. Time is virtual: it jumps to the next timer, so a minute takes some hundredths of a second.
docs/how-to/test-your-code.md shows more."""

from __future__ import annotations

from zscout.testing.device import FakeDevice
from zscout.testing.fleet import ComponentRun, MemoryFleet, until
from zscout.testing.memory import MemoryMesh, MemoryNetwork
from zscout.testing.virtual_time import Deadlock, in_virtual_time, run

__all__ = [
    "ComponentRun",
    "Deadlock",
    "FakeDevice",
    "MemoryFleet",
    "MemoryMesh",
    "MemoryNetwork",
    "in_virtual_time",
    "run",
    "until",
]
