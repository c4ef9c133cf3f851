"""Looking around for a dark place, turning to the best one, and driving elsewhere if there is none."""

from __future__ import annotations

import math
from typing import Final

from zscout.behaviors.perception.darkness import View
from zscout.behaviors.perception.hiding.controller import HOP, HidingController, HidingPhase
from zscout.behaviors.perception.hiding.facing import sheltered, to_light
from zscout.behaviors.perception.hiding.state import (
    MAX_SIGHTINGS,
    HidingState,
    Opening,
    Sighting,
    Spot,
    wrapped,
)
from zscout.behaviors.perception.hiding.wheels import WheelCommand

FULL_TURN: Final = math.tau - math.radians(20)
MOST_HOPS: Final = 24
"""Of a scan: turns that the picture does not show do not count for ever."""
AIMED: Final = math.radians(7)
LEG: Final = 1.4
"""Metres to drive at most before the next scan."""
FORGETS: Final = 6
"""Scans after which bad spots are forgotten: by then dead reckoning does not know where they are."""
MAX_VISITED: Final = 24
BAD_NEAR: Final = 0.45
"""Metres around a spot where hiding failed."""


class Scan(HidingPhase):
    """A full turn in steps; at its end the best dark place is chosen."""

    def begin(self, controller: HidingController) -> None:
        memory = controller.memory
        memory.turned, memory.hops, memory.opened, memory.faces = 0.0, 0, 1.0, 0
        memory.sightings, memory.openings = [], []
        memory.scans += 1
        memory.visited = [*memory.visited, Spot(memory.x, memory.y)][-MAX_VISITED:]
        if memory.scans % FORGETS == 0:
            memory.bad = []
        memory.tries, memory.target, memory.blocked = 0, None, []

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        memory = controller.memory
        controller.sight(view)
        memory.sightings = memory.sightings[-MAX_SIGHTINGS:]
        if abs(memory.turned) < FULL_TURN and memory.hops < MOST_HOPS:
            seen = len(memory.sightings)
            return controller.hop(
                HOP, f"looks around, {math.degrees(abs(memory.turned)):.0f} degrees, {seen} dark seen"
            )
        if sheltered(memory.openings):
            memory.faces = 1

            return to_light(controller, view)
        target = best(memory)
        if target is None:
            return controller.then("roam", view)
        memory.target, memory.seen_target = target, memory.clock
        memory.goal, memory.next_phase = target.heading, "approach"
        left = math.degrees(wrapped(target.heading - memory.heading))
        side = "left" if left > 0 else "right"
        memory.note = f"{len(memory.sightings)} dark places seen, best {abs(left):.0f} degrees {side}"
        return controller.then("aim", view)


def worth(sighting: Sighting, memory: HidingState) -> float:
    """How promising a dark place is; 0: not at all. Wide, low, dark and near is best."""
    if sighting.darkness > 0.5 or sighting.width < 0.2:
        return 0.0
    for spot in memory.bad:
        if math.hypot(spot.x - sighting.x, spot.y - sighting.y) < BAD_NEAR + 0.15 * sighting.distance:
            return 0.0
    wide = min(sighting.width, 0.8) / 0.8
    dark = min(1.0, 0.12 / max(sighting.darkness, 0.02))
    low = 1.0 if 0.07 <= sighting.height <= 0.24 else 0.5
    return wide * dark * low / (0.8 + sighting.distance)


def best(memory: HidingState) -> Sighting | None:
    """The most promising sighting of the scan; one seen in several pictures counts more."""
    chosen, most = None, 0.04 / (1 + memory.scans)
    for sighting in memory.sightings:
        again = sum(
            math.hypot(other.x - sighting.x, other.y - sighting.y) < 0.3 + 0.15 * sighting.distance
            for other in memory.sightings
        )
        value = worth(sighting, memory) * (1.3 if again > 1 else 1.0)
        if value > most:
            chosen, most = sighting, value
    return chosen


class Aim(HidingPhase):
    """Turns to `goal` in measured hops, then goes on to `next_phase`."""

    def begin(self, controller: HidingController) -> None:
        controller.memory.hops = 0

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        memory = controller.memory
        off = wrapped(memory.goal - memory.heading)
        if abs(off) > AIMED and memory.hops < 10:
            return controller.hop(off, memory.note)
        return controller.then(memory.next_phase, view)


class Roam(HidingPhase):
    """No dark place in view: drives to the most open side. Where that is blocked, to the next."""

    def begin(self, controller: HidingController) -> None:
        memory = controller.memory
        memory.hops = 0
        if memory.next_phase == "roam":
            memory.next_phase = "scan"
            return
        side = most_open(controller)
        memory.goal, memory.next_phase = side.heading, "roam"
        memory.left_to_go = max(0.5, min(LEG, 1.2 * side.open_for))
        memory.note = f"no dark place in view, drives {memory.left_to_go:.1f} m to where it is open"

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        memory = controller.memory
        if memory.next_phase == "roam":
            return controller.then("aim", view)
        if controller.pace * controller.here_for >= memory.left_to_go:
            return controller.then("scan", view)
        return controller.cruise(controller.pace, 0.0, memory.note)

    def stuck(self, controller: HidingController, view: View) -> WheelCommand:
        memory = controller.memory
        memory.blocked = [*memory.blocked, memory.heading]
        memory.note = "bumped on the way to where it is open"
        return controller.then("back", view)


def most_open(controller: HidingController) -> Opening:
    """One of the scan's sides, none near one that was blocked, by a little luck."""
    memory = controller.memory
    best, most = Opening(memory.heading + math.pi, 0.5, 0, 0, 0, 0, 0), -99.0
    for one in memory.openings:
        value = min(one.open_for, 2.5) + 0.6 * controller.roll()
        near = [abs(wrapped(one.heading - other)) < math.radians(50) for other in memory.blocked]
        for spot in memory.bad:
            to = math.atan2(spot.y - memory.y, spot.x - memory.x)
            if abs(wrapped(to - one.heading)) < 0.6:
                value -= 0.5
        x, y = memory.x + 0.9 * math.cos(one.heading), memory.y + 0.9 * math.sin(one.heading)
        value -= 0.7 * sum(math.hypot(x - spot.x, y - spot.y) < 0.7 for spot in memory.visited[:-1])
        if value > most and not any(near):
            best, most = one, value
    return best
