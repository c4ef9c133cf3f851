"""Looking around for a dark place, driving elsewhere if there is none, and getting free again."""

from __future__ import annotations

import math
from typing import Final

from zscout.behaviors.perception.darkness import View
from zscout.behaviors.perception.hiding.entering import sheltered, to_light
from zscout.behaviors.perception.hiding.state import (
    FULL_TURN,
    HOP,
    MAX_SIGHTINGS,
    HidingState,
    Opening,
    Sighting,
    Spot,
    Step,
    distance,
    wrapped,
)

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
MOST_BLOCKED: Final = 4
"""Sides of a scan that may be tried."""


def begin_scan(robot: HidingState) -> None:
    robot.turned, robot.opened, robot.faces = 0.0, 1.0, 0
    robot.sightings, robot.openings = [], []
    robot.scans += 1
    robot.visited = [*robot.visited, Spot(robot.x, robot.y)][-MAX_VISITED:]
    if robot.scans % FORGETS == 0:
        robot.bad = []
    robot.tries, robot.target, robot.blocked = 0, None, []


def scan(robot: HidingState, view: View) -> Step:
    """A full turn in steps; at its end the best dark place is chosen."""
    robot.sight(view)
    robot.sightings = robot.sightings[-MAX_SIGHTINGS:]
    if abs(robot.turned) < FULL_TURN and robot.hops < MOST_HOPS:
        degrees, seen = math.degrees(abs(robot.turned)), len(robot.sightings)
        return robot.hop(HOP, f"looks around, {degrees:.0f} degrees, {seen} dark seen")
    if sheltered(robot.openings):
        robot.faces = 1
        return to_light(robot)
    target = best(robot)
    if target is None:
        return "roam"
    robot.target = target
    robot.goal, robot.next_phase = target.heading, "approach"
    left = math.degrees(wrapped(target.heading - robot.heading))
    side = "left" if left > 0 else "right"
    robot.note = f"{len(robot.sightings)} dark places seen, best {abs(left):.0f} degrees {side}"
    return "aim"


def worth(sighting: Sighting, memory: HidingState) -> float:
    """How promising a dark place is; 0: not at all. Wide, low, dark and near is best."""
    if sighting.darkness > 0.5 or sighting.width < 0.2:
        return 0.0
    if any(distance(spot, sighting) < BAD_NEAR + 0.15 * sighting.distance for spot in memory.bad):
        return 0.0
    wide = min(sighting.width, 0.8) / 0.8
    dark = min(1.0, 0.12 / max(sighting.darkness, 0.02))
    low = 1.0 if 0.07 <= sighting.height <= 0.24 else 0.5
    return wide * dark * low / (0.8 + sighting.distance)


def best(memory: HidingState) -> Sighting | None:
    """The most promising sighting of the scan; one seen in several pictures counts more."""
    chosen, most = None, 0.04 / (1 + memory.scans)
    for sighting in memory.sightings:
        near = 0.3 + 0.15 * sighting.distance
        again = sum(distance(other, sighting) < near for other in memory.sightings)
        value = worth(sighting, memory) * (1.3 if again > 1 else 1.0)
        if value > most:
            chosen, most = sighting, value
    return chosen


def aim(robot: HidingState, _: View) -> Step:
    """Turns to `goal` in measured hops, then goes on to `next_phase`."""
    off = wrapped(robot.goal - robot.heading)
    if abs(off) > AIMED and robot.hops < 10:
        return robot.hop(off, robot.note)
    return robot.next_phase


def begin_roam(robot: HidingState) -> None:
    if robot.next_phase == "roam":
        robot.next_phase = "scan"
        return
    side = most_open(robot)
    robot.goal, robot.next_phase = side.heading, "roam"
    robot.left_to_go = max(0.5, min(LEG, 1.2 * side.open_for))
    robot.note = f"no dark place in view, drives {robot.left_to_go:.1f} m to where it is open"


def roam(robot: HidingState, _: View) -> Step:
    """No dark place in view: drives to the most open side. Where that is blocked, to the next."""
    if robot.next_phase == "roam":
        return "aim"
    if robot.cruised(robot.left_to_go):
        return "scan"
    return robot.cruise(robot.pace, 0.0, robot.note)


def roam_stuck(robot: HidingState, _: View) -> Step:
    robot.blocked = [*robot.blocked, robot.heading]
    robot.note = "bumped on the way to where it is open"
    return "back"


def most_open(robot: HidingState) -> Opening:
    """One of the scan's sides, none near one that was blocked, by a little luck."""
    best, most = Opening(robot.heading + math.pi, 0.5, 0, 0, 0, 0, 0), -99.0
    for one in robot.openings:
        value = min(one.open_for, 2.5) + 0.6 * robot.roll()
        near = [abs(wrapped(one.heading - other)) < math.radians(50) for other in robot.blocked]
        for spot in robot.bad:
            to = math.atan2(spot.y - robot.y, spot.x - robot.x)
            if abs(wrapped(to - one.heading)) < 0.6:
                value -= 0.5
        ahead = Spot(*robot.point(one.heading, 0.9))
        value -= 0.7 * sum(distance(ahead, spot) < 0.7 for spot in robot.visited[:-1])
        if value > most and not any(near):
            best, most = one, value
    return best


# Out of a bump, and out of a place that is no good


def stuck(robot: HidingState, _: View) -> Step:
    """It drove, and nothing moved."""
    robot.note, robot.at_edge = "bumped", False
    return "back"


def begin_back(robot: HidingState) -> None:
    robot.bumps += 1


def back(robot: HidingState, _: View) -> Step:
    """Backs off from what it pushed against, then turns aside."""
    if robot.hops == 0:
        return robot.step_straight(-0.14, f"{robot.note or 'bumped'}: backs off")
    if robot.target is None and robot.blocked and len(robot.blocked) <= MOST_BLOCKED:
        robot.next_phase = "scan"
        return "roam"
    return "dodge"


def dodge(robot: HidingState, view: View) -> Step:
    """Turns aside and looks around anew."""
    target = robot.target
    if robot.hops == 0:
        robot.goal = side_of(robot, view) * math.radians(40 + 20 * robot.roll())
        return robot.hop(robot.goal, "turns aside")
    if robot.hops == 1:
        return robot.step_straight(0.18 + 0.1 * robot.tries, "goes around")
    if target is not None and robot.tries < 3:
        robot.tries += 1
        robot.goal = math.atan2(target.y - robot.y, target.x - robot.x)
        robot.next_phase = "approach"
        robot.note = "turns back to the dark place"
        return "aim"
    if target is not None:
        # There is no way from here.
        robot.note_bad(target.x, target.y)
    return "scan"


def side_of(robot: HidingState, view: View) -> int:
    """1 left, -1 right: at the edge of the dark where it goes on, else by turns."""
    left, right = view.sides
    if robot.at_edge and max(left, right) > 1.5 * min(left, right):
        return 1 if left < right else -1
    return 1 if robot.bumps % 2 else -1


def begin_leave(robot: HidingState) -> None:
    robot.left_to_go = 0.6


def leave(robot: HidingState, _: View) -> Step:
    """Out of a place that is no hiding place, towards the light."""
    if robot.cruised(robot.left_to_go):
        return "scan"
    return robot.cruise(robot.pace, 0.0, f"{robot.note}: leaves")
