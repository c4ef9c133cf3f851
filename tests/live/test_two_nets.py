"""Two sensor nets in one fleet: neither touches what the other had placed."""

from __future__ import annotations

import pytest

from tests.behaviors.components.kit import ComponentLab
from tests.live.placing import Placing
from zscout.behaviors.sensor_net.place_sensor_net import component_of
from zscout.messages import MAX_COMPONENT_NAME, EndComponent, Placement

pytestmark = pytest.mark.live


@pytest.mark.slow
async def test_a_component_that_others_placed_under_its_name_is_left_alone(lab: ComponentLab) -> None:
    lab.node("a", "robot/r1", "robot/r2")
    client = await lab.begun()
    placing = Placing(client)
    await placing.hosts(1)
    # Somebody's component stands in the way of the net's first robot.
    await placing.place("net-r1", "counter", {"period": 0.05})
    await placing.place("net", "place_sensor_net", {"robots": ["robot/r1", "robot/r2"], "wanted": 1})
    # So the net takes its second robot; the other component counts on.
    second = await placing.until("net-r2", lambda one: one.state == "running")
    assert second.spec.params["robot"] == "robot/r2"
    assert (await placing.placement("net-r1")).state == "running"
    # Whatever is stopped of the net, and the net itself, leave the stranger at work.
    await placing.get(EndComponent("net-r2", wait=10.0), Placement)
    await placing.get(EndComponent("net", wait=10.0), Placement)
    assert (await placing.placement("net-r1")).state == "running"


def test_components_of_long_names_are_told_apart() -> None:
    net = "n" * MAX_COMPONENT_NAME
    names = {component_of(net, f"robot/scout{number}") for number in range(100)}
    assert len(names) == 100
    assert all(len(name) <= MAX_COMPONENT_NAME for name in names)
    assert component_of("net", "robot/scout33") == "net-scout33"
