"""The timeline after an hour of a busy lab with eight devices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.services.recorder import busy_hour
from tests.services.recorder.paper_run import lanes
from zscout.services.recorder.blueprint import blueprint
from zscout.services.recorder.timeline import Timeline

HEIGHT = 740
"""Pixels that panes have in a window of 1600x800."""


@pytest.mark.slow
def test_after_an_hour_those_who_wait_come_first_and_eight_devices_have_room(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        timeline.bookings.take(0, busy_hour.booked(0, busy_hour.HOUR))
        busy_hour.play(timeline)
        layout = timeline.layout(live=True)
        panes: Any = next(iter(blueprint(layout).root_container.contents))
    waiting, devices, booked = panes.contents
    assert [view.name for view in waiting.contents] == ["Who waits, and for whom", "What each request is doing"]
    assert devices.name == "Who holds each device"
    assert booked.contents[0].name.startswith("Booked")
    assert sum(panes.row_shares) <= HEIGHT
    texts = {
        text
        for content in ("/who/**", "/devices/**")
        for lane in lanes(path, content).values()
        for _, row in lane
        for text in row
    }
    assert "burn-in (alice)" in texts
    assert any(" waits again for " in text for text in texts)
    assert not any("sh -c" in text for text in texts)
