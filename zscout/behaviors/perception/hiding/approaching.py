"""Driving to a dark place under sight, and in."""

from __future__ import annotations

import math
from typing import Final

import msgspec

from zscout.behaviors.perception.darkness import DarkPlace, View
from zscout.behaviors.perception.hiding.controller import HidingController, HidingPhase
from zscout.behaviors.perception.hiding.state import wrapped
from zscout.behaviors.perception.hiding.wheels import WheelCommand
from zscout.behaviors.perception.lens import COLUMNS

AT_EDGE: Final = 0.17
"""Metres to the dark, from where on the way in is driven blind."""
DEEP: Final = 0.30
"""Metres to go beyond the edge of the dark."""
OUTSIDE: Final = 3.0
"""How many times brighter than the median of the picture the floor ahead is, outside."""
DARK_AHEAD: Final = 0.3
"""Share of the lit floor's light, below which a place that was lost must lie ahead."""
TO_MIDDLE: Final = 0.15
LOST: Final = 1.6
"""Seconds without sight of the place."""


class Approach(HidingPhase):
    """Keeps the place ahead and drives; re-centred at every picture."""

    def begin(self, controller: HidingController) -> None:
        controller.memory.seen_target = controller.memory.clock

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        memory = controller.memory
        target = memory.target
        if target is None:
            return controller.then("scan", view)
        rough = math.hypot(target.x - memory.x, target.y - memory.y)
        expected = wrapped(target.heading - memory.heading)
        place = match(view, expected, rough)
        if place is None:
            unseen = memory.clock - memory.seen_target
            if (
                rough < 0.3
                or target.distance < 0.45
                or (target.distance < 1 and view.ahead < DARK_AHEAD * view.lit)
            ):
                # So near that the place fills the picture, or its edge is below it, or in its own half-light.
                return controller.then("enter", view)
            if unseen > LOST:
                memory.note = "lost sight of the dark place"
                return controller.then("scan", view)
            return controller.cruise(0.4 * controller.pace, expected, "looks for the dark place it came for")
        aim = aim_at(place, expected)
        heading = memory.heading + aim
        memory.seen_target = memory.clock
        memory.target = msgspec.structs.replace(
            target,
            heading=heading,
            distance=place.distance,
            x=memory.x + place.distance * math.cos(heading),
            y=memory.y + place.distance * math.sin(heading),
        )
        if place.distance <= AT_EDGE:
            return controller.then("enter", view)
        if controller.here_for > 25:
            controller.note_bad(place.distance)
            memory.note = "does not get there"
            return controller.then("back", view)
        why = f"dark place {place.distance:.1f} m ahead, {place.width:.1f} m wide"
        slow = 0.5 if abs(aim) > 0.35 else 1.0
        return controller.cruise(controller.pace * slow, max(-1.2, min(1.2, 1.6 * aim)), why)


def match(view: View, expected: float, distance: float) -> DarkPlace | None:
    """The place of this picture that is most like the one expected there."""
    found, least = None, 1.0
    for place in view.places:
        near = angle_to(place, expected)
        off = near / 0.25 + 0.6 * abs(math.log(place.distance / max(distance, 0.08)))
        if off < least:
            found, least = place, off
    return found


def angle_to(place: DarkPlace, expected: float) -> float:
    """Radians from a bearing to the nearest part of the place."""
    half = math.atan2(place.width / 2, place.distance)
    return max(0.0, abs(place.bearing - expected) - half)


def aim_at(place: DarkPlace, expected: float) -> float:
    """The part of the place nearest to where it was headed for, well away from its ends: feet stand there."""
    margin = min(0.45 * place.width, 0.28)
    # Where the picture cuts it off, it goes on.
    left = place.width / 2 - (margin if place.left > 1 else 0.05)
    right = place.width / 2 - (margin if place.right < COLUMNS - 2 else 0.05)
    most = place.bearing + math.atan2(left, place.distance)
    least = place.bearing - math.atan2(right, place.distance)
    kept = max(least, min(most, expected))
    # A little towards the middle each time, or a wheel that slips more leads to the end in the end.
    return kept + TO_MIDDLE * (place.bearing - kept)


class Enter(HidingPhase):
    """Straight on into the dark: a few lengths of the body from where the floor ahead is dark."""

    def begin(self, controller: HidingController) -> None:
        memory = controller.memory
        ahead = memory.target.distance if memory.target is not None else AT_EDGE
        memory.left_to_go, memory.faces = min(ahead, 0.8) + DEEP, 0

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        gone = controller.pace * controller.here_for
        if gone >= controller.memory.left_to_go:
            return self.stuck(controller, view)
        return controller.cruise(controller.pace, 0.0, "drives in")

    def stuck(self, controller: HidingController, view: View) -> WheelCommand:
        if still_outside(view):
            controller.memory.note, controller.memory.at_edge = "bumped at the edge of the dark", True
            return controller.then("back", view)
        return controller.then("face", view)


def still_outside(view: View) -> bool:
    """Whether the floor just ahead is lit and all the rest dark: in front of the dark, not in it."""
    return view.near > OUTSIDE * view.middling
