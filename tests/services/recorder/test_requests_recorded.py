"""What the timeline shows of requests."""

from __future__ import annotations

from decimal import Decimal

from msgspec.structs import replace

from zscout.messages import Grants, Holder
from zscout.services.recorder.request_tracker import RequestTracker
from zscout.services.recorder.timeline import Timeline
from zscout.types import Grant, Place, Term

TERM = Term(1, "anvil")
HOLDER = Holder("j1", "job", "desk/one", Grant(TERM, 1), Place(TERM, 1), ["dut/slow"], Decimal(60), 60.0)


class Written(Timeline):
    """Keeps what is written."""

    def __init__(self) -> None:
        super().__init__("lab", path=None)
        self.lanes: list[tuple[str, str]] = []
        self.lines: list[str] = []

    def arc(self, at: float, arc: str, state: str, detail: str = "", *, operator: bool = False) -> None:
        self.lanes.append((state, detail))

    def event(self, at: float, text: str, level: str = "INFO", *, operator: bool = False) -> None:
        self.lines.append(text)


def test_a_hold_whose_devices_start_is_shown_as_starting_until_they_are_ready() -> None:
    timeline = Written()
    tracker = RequestTracker(timeline, 10)
    for seq, holder in enumerate((HOLDER, replace(HOLDER, waits=40.0), replace(HOLDER, waits=39.0), HOLDER), 1):
        tracker.grants(seq, Grants(TERM, seq, seq - 1, 1, {"dut/slow": [holder]}))
    assert timeline.lanes == [
        ("running", "priority 0 · min 60 s"),
        ("running", "starting, ready in about 40 s · priority 0 · min 60 s"),
        ("running", "priority 0 · min 60 s"),
    ]
    assert timeline.lines == ["job runs on dut/slow", "job is starting, ready in about 40 s", "job is ready"]
