"""Questions to a node about its components."""

from __future__ import annotations

import asyncio

from zscout.config.fleet import default_fleet
from zscout.config.node import ComponentsConfig
from zscout.keyexpr import Sender
from zscout.messages import ComponentList, ListComponents
from zscout.services.node.component_host import ComponentHost
from zscout.testing.memory import MemoryNetwork


async def test_those_who_ask_at_one_time_what_is_there_share_one_look() -> None:
    """It reads the metadata of all packages: else few questions keep a node from starting and stopping anything."""
    looks = 0

    def kinds() -> dict[str, str]:
        nonlocal looks
        looks += 1
        return {"counter": "shipped:Counter"}

    network = MemoryNetwork()
    mesh, other = (network.open("test", Sender(name, "node")) for name in ("n", "other"))
    host = ComponentHost(mesh, default_fleet(), ComponentsConfig(), lambda _: None, kinds=kinds)
    await host.start()
    asked = (
        other.ask_one(other.keys.component("n", other.me), ListComponents(), ComponentList, timeout=5)
        for _ in range(100)
    )
    answers = await asyncio.gather(*asked)
    assert all(answer is not None and answer.message == ComponentList("n", [], ["counter"]) for answer in answers)
    assert looks < len(answers) / 2
    await host.stop()
