"""The phases of hiding: look around for a dark place, roam if there is none, get free when stuck; approach and enter
the place; there turn to the light, check that it hides, and keep still."""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np

from zscout.behaviors.perception.darkness import DarkPlace, View
from zscout.behaviors.perception.hiding.state import HidingState, Opening, Sighting, Spot, Step, distance, wrapped
from zscout.behaviors.perception.lens import COLUMNS

HOP: Final = math.radians(36)
FULL_TURN: Final = math.tau - math.radians(20)  # radians of hops that show all sides
MOST_HOPS: Final = 24  # of a scan: turns not visible in the picture must end too
AIMED: Final = math.radians(7)
LEG: Final = 1.4  # most metres to drive before the next scan
FORGETS: Final = 6  # scans after which bad spots are forgotten, as dead reckoning has lost them
MAX_VISITED: Final = 24
BAD_NEAR: Final = 0.45  # metres around a spot where hiding failed
MOST_BLOCKED: Final = 4  # sides tried after one scan
AT_EDGE: Final = 0.17  # metres to the dark from which the robot drives in blind
DEEP: Final = 0.30  # metres to drive beyond the edge of the dark
OUTSIDE: Final = 3.0  # brightness of the floor ahead, over the picture's median, outside
DARK_AHEAD: Final = 0.3  # share of the lit floor's light below which a lost place must lie ahead
TO_MIDDLE: Final = 0.15
LOST: Final = 1.6  # seconds without sight of the place
LONGEST: Final = 25  # seconds of an approach
FACE_HOPS: Final = 22
DARK: Final = 0.12
"""Most light here over the lit floor: a quarter of the room's median, as that floor may be twice as bright."""
DARK_ENOUGH: Final = 0.19  # the same if it gets no darker further in
DARKISH: Final = 0.4  # the same if it may be darker further in
ROOFED: Final = 0.28
"""Share below which the top counts as dark: 0.03 to 0.2 beneath furniture, 0.45 and more on a dark rug."""
DEEPER: Final = 0.18  # metres of one step further in
NEARER: Final = 0.1
MOST_FACES: Final = 3  # full turns in one place, each further in
AS_LIGHT: Final = 0.6  # share of the lightest side's light that counts as the same side
CHECKED: Final = 5  # pictures of a check
STILL_DARK: Final = 0.3
STILL_SEES: Final = 0.15
SEES_OUT: Final = 0.45  # share of columns that must show lit floor


def begin_scan(robot: HidingState) -> None:
    robot.turned, robot.opened, robot.faces = 0.0, 1.0, 0
    robot.sightings, robot.openings = [], []
    robot.scans += 1
    robot.visited = [*robot.visited, Spot(robot.x, robot.y)][-MAX_VISITED:]
    if robot.scans % FORGETS == 0:
        robot.bad = []
    robot.tries, robot.target, robot.blocked = 0, None, []


def scan(robot: HidingState, view: View) -> Step:
    """Make a full turn in hops, then choose the best dark place."""
    robot.sight(view)
    if abs(robot.turned) < FULL_TURN and robot.hops < MOST_HOPS:
        degrees, seen = math.degrees(abs(robot.turned)), len(robot.sightings)
        return robot.hop(HOP, f"looks around, {degrees:.0f} degrees, {seen} dark seen")
    share, roof = shelter(robot.openings)
    if roof and share <= DARKISH:
        # The robot is beneath something already, but maybe not deep enough.
        robot.faces = 1
        return to_light(robot)
    target = robot.target = best(robot)
    if target is None:
        return "roam"
    robot.goal, robot.next_phase = target.heading, "approach"
    left = math.degrees(wrapped(target.heading - robot.heading))
    side = "left" if left > 0 else "right"
    robot.note = f"{len(robot.sightings)} dark places seen, best {abs(left):.0f} degrees {side}"
    return "aim"


def worth(sighting: Sighting, memory: HidingState) -> float:
    """Rate a dark place, 0 for useless. Wide, low, dark and near is best."""
    if sighting.darkness > 0.5 or sighting.width < 0.2:
        return 0.0
    if any(distance(spot, sighting) < BAD_NEAR + 0.15 * sighting.distance for spot in memory.bad):
        return 0.0
    wide = min(sighting.width, 0.8) / 0.8
    dark = min(1.0, 0.12 / max(sighting.darkness, 0.02))
    low = 1.0 if 0.07 <= sighting.height <= 0.24 else 0.5
    return wide * dark * low / (0.8 + sighting.distance)


def best(memory: HidingState) -> Sighting | None:
    """The most promising sighting of the scan; repeated sightings count more."""

    def value(sighting: Sighting) -> float:
        near = 0.3 + 0.15 * sighting.distance
        again = sum(distance(other, sighting) < near for other in memory.sightings)
        return worth(sighting, memory) * (1.3 if again > 1 else 1.0)

    chosen = max(memory.sightings, key=value, default=None)
    return chosen if chosen is not None and value(chosen) > 0.04 / (1 + memory.scans) else None


def aim(robot: HidingState, _: View) -> Step:
    """Turn to `goal` in measured hops, then continue with `next_phase`."""
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
    """Drive to the most open side, or the next if that is blocked."""
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
    """Return the most open side of the scan, away from blocked sides, slightly randomized."""
    best, most = Opening(robot.heading + math.pi, 0.5, 0, 0, 0, 0, 0), -99.0
    for side in robot.openings:
        value = min(side.open_for, 2.5) + 0.6 * robot.roll()
        near = [abs(wrapped(side.heading - other)) < math.radians(50) for other in robot.blocked]
        for spot in robot.bad:
            to = math.atan2(spot.y - robot.y, spot.x - robot.x)
            if abs(wrapped(to - side.heading)) < 0.6:
                value -= 0.5
        ahead = Spot(*robot.point(side.heading, 0.9))
        value -= 0.7 * sum(distance(ahead, spot) < 0.7 for spot in robot.visited[:-1])
        if value > most and not any(near):
            best, most = side, value
    return best


def stuck(robot: HidingState, _: View) -> Step:
    robot.note, robot.at_edge = "bumped", False
    return "back"


def back(robot: HidingState, _: View) -> Step:
    if robot.hops == 0:
        robot.bumps += 1
        return robot.step_straight(-0.14, f"{robot.note or 'bumped'}: backs off")
    if robot.target is None and robot.blocked and len(robot.blocked) <= MOST_BLOCKED:
        robot.next_phase = "scan"
        return "roam"
    return "dodge"


def dodge(robot: HidingState, view: View) -> Step:
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
    """Return 1 for left, -1 for right: at an edge the darker side, else both alternately."""
    left, right = view.sides
    if robot.at_edge and max(left, right) > 1.5 * min(left, right):
        return 1 if left < right else -1
    return 1 if robot.bumps % 2 else -1


def leave(robot: HidingState, _: View) -> Step:
    """Drive out of a bad place, towards the light."""
    if robot.cruised(0.6):
        return "scan"
    return robot.cruise(robot.pace, 0.0, f"{robot.note}: leaves")


def approach(robot: HidingState, view: View) -> Step:
    target = robot.target
    if target is None:
        return "scan"
    rough = distance(target, robot)
    expected = wrapped(target.heading - robot.heading)
    place = match(view, expected, rough)
    if place is None:
        in_half_light = target.distance < 1 and view.ahead < DARK_AHEAD * view.lit
        if rough < 0.3 or target.distance < 0.45 or in_half_light:
            # The place fills the picture, has its edge below it, or surrounds the robot with half-light.
            return "enter"
        if robot.clock - robot.seen_target > LOST:
            robot.note = "lost sight of the dark place"
            return "scan"
        return robot.cruise(0.4 * robot.pace, expected, "looks for the dark place it came for")
    turn = aim_at(place, expected)
    heading = robot.heading + turn
    x, y = robot.point(heading, place.distance)
    robot.seen_target = robot.clock
    robot.target = msgspec.structs.replace(target, heading=heading, distance=place.distance, x=x, y=y)
    if place.distance <= AT_EDGE:
        return "enter"
    if robot.here_for > LONGEST:
        robot.note_bad(*robot.point(robot.heading, place.distance))
        robot.note = "does not get there"
        return "back"
    why = f"dark place {place.distance:.1f} m ahead, {place.width:.1f} m wide"
    slow = 0.5 if abs(turn) > 0.35 else 1.0
    return robot.cruise(robot.pace * slow, max(-1.2, min(1.2, 1.6 * turn)), why)


def match(view: View, expected: float, distance: float) -> DarkPlace | None:
    """Return the place in this picture that matches the expected bearing and distance best."""
    found, least = None, 1.0
    for place in view.places:
        # Radians from the bearing to the nearest part of the place.
        near = max(0.0, abs(place.bearing - expected) - math.atan2(place.width / 2, place.distance))
        off = near / 0.25 + 0.6 * abs(math.log(place.distance / max(distance, 0.08)))
        if off < least:
            found, least = place, off
    return found


def aim_at(place: DarkPlace, expected: float) -> float:
    """Return the bearing to the part of the place nearest to the course, away from its ends with their feet."""
    margin = min(0.45 * place.width, 0.28)
    # The place continues where the picture cuts it off.
    left = place.width / 2 - (margin if place.left > 1 else 0.05)
    right = place.width / 2 - (margin if place.right < COLUMNS - 2 else 0.05)
    most = place.bearing + math.atan2(left, place.distance)
    least = place.bearing - math.atan2(right, place.distance)
    kept = max(least, min(most, expected))
    # A little towards the middle each time, to counter a slipping wheel.
    return kept + TO_MIDDLE * (place.bearing - kept)


def begin_enter(robot: HidingState) -> None:
    ahead = robot.target.distance if robot.target is not None else AT_EDGE
    robot.left_to_go, robot.faces = min(ahead, 0.8) + DEEP, 0


def enter(robot: HidingState, view: View) -> Step:
    if robot.cruised(robot.left_to_go):
        return enter_stuck(robot, view)
    return robot.cruise(robot.pace, 0.0, "drives in")


def enter_stuck(robot: HidingState, view: View) -> Step:
    if view.near > OUTSIDE * view.middling:
        # The floor just ahead is lit and the rest dark: it is in front of the dark.
        robot.note, robot.at_edge = "bumped at the edge of the dark", True
        return "back"
    return "face"


def begin_face(robot: HidingState) -> None:
    robot.turned, robot.opened = 0.0, 1.0
    robot.openings = []
    robot.faces += 1


def face(robot: HidingState, view: View) -> Step:
    """Make a full turn in the dark, then face the side with most lit floor."""
    robot.sight(view)
    if abs(robot.turned) < FULL_TURN and robot.hops < FACE_HOPS:
        return robot.hop(HOP, "in the dark, looks for the light")
    return to_light(robot)


def to_light(robot: HidingState) -> Step:
    robot.goal, robot.next_phase = lightest(robot.openings).heading, "settle"
    robot.note = "turns to the light"
    return "aim"


def shelter(openings: list[Opening]) -> tuple[float, bool]:
    """The ratio of near to lit floor over a full turn; True if the top is dark on most sides, as beneath a sofa."""
    lit = max(side.outside for side in openings)
    near, above = np.percentile([(side.near, side.above) for side in openings], 75, axis=0).tolist()
    return near / max(lit, 1e-4), above <= ROOFED * lit


def lightest(openings: list[Opening]) -> Opening:
    """Return the direction with most lit floor, averaged with its neighbours."""

    def value(side: Opening) -> float:
        beside = [max(0.0, 1 - abs(wrapped(other.heading - side.heading)) / 0.9) for other in openings]
        return side.bright + sum(w * o.bright for w, o in zip(beside, openings, strict=True)) / sum(beside)

    return max(openings, key=value)


def settle(robot: HidingState, view: View) -> Step:
    """Facing the light, check that the robot's place is dark and its view lit."""
    if robot.shifted:
        # It moved: check again.
        return "face"
    here = robot.opening(view)
    if here.bright < AS_LIGHT * lightest(robot.openings).bright and robot.hops < FACE_HOPS:
        # Commands were lost, or the turn could not be measured.
        return robot.hop(HOP, "turns on to the light")
    share, roof = shelter(robot.openings)
    dark = share <= DARK or (share <= DARK_ENOUGH and robot.faces > 1)
    if roof and dark and here.sees_out >= SEES_OUT:
        robot.note = f"hidden: {100 * share:.0f} % of the light outside"
        return "hidden"
    if roof and share <= DARKISH and robot.faces < MOST_FACES:
        robot.shifted = True
        if share <= DARK:
            return robot.step_straight(NEARER, "sees too little: comes nearer to the light")
        return robot.step_straight(-DEEPER, "not dark enough yet: backs further in")
    robot.note_bad(robot.x, robot.y)
    robot.note = "not dark enough here"
    if share <= DARK_ENOUGH:
        robot.note = "sees nothing lit from here" if roof else "a dark floor in the light"
    return "leave"


def hidden(robot: HidingState, _: View) -> Step:
    return robot.stand(robot.note)


def begin_check(robot: HidingState) -> None:
    robot.openings = []


def check(robot: HidingState, view: View) -> Step:
    """After a lost hold, check less strictly than before, so that only a changed place makes it move."""
    robot.openings = [*robot.openings, robot.opening(view)]
    if len(robot.openings) < CHECKED:
        return robot.stand("back: is it still hidden?")
    ratio = np.median([side.near / max(side.outside, 1e-4) for side in robot.openings])
    if ratio <= STILL_DARK and np.median([side.sees_out for side in robot.openings]) >= STILL_SEES:
        return "hidden"
    robot.note = "no longer hidden"
    return "scan"
