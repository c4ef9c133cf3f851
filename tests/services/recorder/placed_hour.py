"""A made-up hour of a fleet with components: what three hosts report and the placer says, as messages."""

from __future__ import annotations

import math
from typing import Final

import msgspec

from zscout.messages import ComponentUse, LoadReport, Placement, Placements
from zscout.services.recorder.drawing import HolderRow
from zscout.services.recorder.timeline import Timeline
from zscout.types import Term

HOUR: Final = 3600
HOSTS: Final = ("anvil", "basil", "crucible")
TERM: Final = Term(1, "rcm")
REPORT_EVERY: Final = 5
"""Seconds; fewer than a real host's, which reports every second."""

USE: Final = {"counter": (0.3, 80e6), "mapper": (1.1, 900e6), "watch": (0.5, 260e6), "shaky": (0.2, 40e6)}
"""Cores and bytes of each kind."""


def placement(name: str, state: str, host: str | None, incarnation: int, **more: object) -> Placement:
    """As JSON brings it: nothing is taken that a real message could not hold."""
    told = {"component": name, "spec": {"kind": name.split("-")[0]}, "state": state, "host": host}
    return msgspec.convert(told | {"incarnation": incarnation} | more, Placement)


def story() -> list[tuple[float, Placements]]:
    """What the placer publishes, by second."""
    says: list[tuple[float, Placements]] = []

    def say(at: float, *told: Placement, cordoned: tuple[str, ...] = ()) -> None:
        says.append((at, Placements(TERM, list(told), list(cordoned))))

    def start(at: float, name: str, host: str, incarnation: int, reason: str) -> None:
        say(at, placement(name, "starting", host, incarnation, reason=reason))
        say(at + 4, placement(name, "running", host, incarnation, reason=reason, movable=True))

    start(120, "counter", "anvil", 1001, "load 0.31 on 4 cores is the least")
    start(300, "mapper", "anvil", 1001, "load 0.50 on 4 cores is the least")
    start(420, "watch-1", "basil", 1001, "load 0.28 on 4 cores is the least")
    start(420, "watch-2", "crucible", 1001, "load 0.29 on 4 cores is the least")
    start(480, "watch-3", "basil", 1001, "load 0.71 on 4 cores is the least")
    # basil is emptied
    say(1260, cordoned=("basil",))
    for at, name, to, dead in ((1270, "watch-1", "crucible", 0.034), (1290, "watch-3", "anvil", 0.041)):
        say(at, placement(name, "moving", "basil", 1001, to=to, movable=True), cordoned=("basil",))
        say(at + 8, placement(name, "running", to, 1002, moves=1, dead=dead, movable=True), cordoned=("basil",))
    say(1800)
    # anvil is crowded, and one moves off by hand
    say(1900, placement("counter", "moving", "anvil", 1001, to="basil", movable=True))
    say(1906, placement("counter", "running", "basil", 1002, moves=1, dead=0.034, movable=True))
    # one that fails until it is given up
    start(2100, "shaky", "basil", 1001, "load 0.35 on 4 cores is the least")
    why = "exit code 1: ValueError: no camera at /dev/video7"
    for number, at in enumerate((2220, 2340, 2460)):
        say(at, placement("shaky", "backing_off", None, 1001 + number, reason=why, restarts=number))
        say(at + 20, placement("shaky", "running", "basil", 1002 + number, restarts=number + 1))
    say(2600, placement("shaky", "given_up", None, 1004, reason=f"3 restarts in a row; {why}", restarts=3))
    # crucible dies, and what ran there goes on elsewhere
    why = "crucible is gone"
    say(3000, *(placement(f"watch-{n}", "starting", None, 1003, reason=why, moves=2 - n) for n in (1, 2)))
    say(3006, placement("watch-1", "running", "basil", 1003, reason=why, restarts=1, moves=1))
    say(3007, placement("watch-2", "running", "anvil", 1003, reason=why, restarts=1))
    say(3400, placement("mapper", "ended", None, 1001, reason="it completed", wanted=False))
    return says


def play(timeline: Timeline, every: int = REPORT_EVERY) -> None:
    """The hour, as the recorder would write it. `every`: seconds between reports of a host."""
    written = timeline.hosts
    written.placements(0, Placements(TERM), set())
    says = story()
    runs: dict[str, str] = {}
    loads = dict.fromkeys(HOSTS, 0.2)
    for at in range(0, HOUR + 1, every):
        while says and says[0][0] <= at:
            moment, told = says.pop(0)
            written.placements(moment, told)
            for one in told.components:
                runs.pop(one.component, None)
                if one.state in ("running", "moving") and one.host is not None:
                    runs[one.component] = one.host
        for host in HOSTS:
            if host == "crucible" and 3000 <= at < 3300:
                continue
            report = report_of(host, at, loads, [name for name, where in runs.items() if where == host])
            timeline.hosts.load(at, host, report.load_average[0], report.cpu / 100)
            timeline.hosts.uses(at, host, report.components)
    for arc, begin, end in (("counter", 600, 1500), ("survey", 1700, 2800)):
        timeline.holders(begin, "robot/scout33", [HolderRow(arc)])
        timeline.arc(begin, arc, "running", "priority 1")
        timeline.holders(end, "robot/scout33", [])
        timeline.arc(end, arc, "done")


def report_of(host: str, at: int, loads: dict[str, float], names: list[str]) -> LoadReport:
    """A host's report, its load average growing into what runs there."""
    uses = []
    for name in names:
        cpu, memory = USE[name.split("-")[0]]
        swing = 1 + 0.15 * math.sin(at / 90 + len(name) + ord(name[-1]))
        uses.append(ComponentUse(name, name.split("-")[0], 1, cpu * swing, round(memory * (1 + at / 36000))))
    busy = 0.2 + 0.05 * math.sin(at / 200 + ord(host[0])) + sum(one.cpu for one in uses)
    loads[host] += (busy - loads[host]) * (1 - math.exp(-REPORT_EVERY / 60))
    return LoadReport(host, at, 4, (loads[host],) * 3, min(100.0, busy * 25), 3 << 30, 4 << 30, components=tuple(uses))
