"""In the dark: turns to the light, checks that it is a hiding place at all, and keeps still."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from zscout.behaviors.perception.darkness import View
from zscout.behaviors.perception.hiding.controller import (
    HOP,
    HidingController,
    HidingPhase,
    opening,
)
from zscout.behaviors.perception.hiding.state import Opening, wrapped
from zscout.behaviors.perception.hiding.wheels import WheelCommand

FULL_TURN: Final = math.tau - math.radians(20)
MOST_HOPS: Final = 22
DARK: Final = 0.12
"""Share of the lit floor's light that the floor here may have. The promise is a quarter of the room's
median, and the floor that is seen may be twice as bright as that."""
DARK_ENOUGH: Final = 0.19
"""The same where it gets no darker further in."""
DARKISH: Final = 0.4
"""Share up to which it may be darker further in."""
ROOFED: Final = 0.28
"""Share up to which what is above counts as dark: 0.03 to 0.2 beneath furniture, 0.45 and more on a dark
rug."""
DEEPER: Final = 0.18
"""Metres to back further in at once."""
NEARER: Final = 0.1
MOST_FACES: Final = 3
"""Full turns in one place, each further in."""
AS_LIGHT: Final = 0.6
"""Share of the lightest side's light that is taken for the same side."""
CHECKED: Final = 5
"""Pictures that tell whether it is still hidden."""
STILL_DARK: Final = 0.3
STILL_SEES: Final = 0.15
SEES_OUT: Final = 0.45
"""Share of columns that must show lit floor."""


class Face(HidingPhase):
    """A full turn in the dark; then to the side that shows most lit floor."""

    def begin(self, controller: HidingController) -> None:
        memory = controller.memory
        memory.turned, memory.hops, memory.opened = 0.0, 0, 1.0
        memory.openings = []
        memory.faces += 1

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        memory = controller.memory
        controller.sight(view)
        if abs(memory.turned) < FULL_TURN and memory.hops < MOST_HOPS:
            return controller.hop(HOP, "in the dark, looks for the light")
        return to_light(controller, view)


def to_light(controller: HidingController, view: View) -> WheelCommand:
    """Turns to the lightest side of the full turn just made."""
    controller.memory.goal, controller.memory.next_phase = (
        lightest(controller.memory.openings).heading,
        "settle",
    )
    controller.memory.note = "turns to the light"
    return controller.then("aim", view)


def darkness(openings: list[Opening]) -> float:
    """The floor all around over the lit floor, by the full turn. Most sides count: at the edge some are
    lit."""
    lit = max(one.outside for one in openings)
    return float(np.percentile([one.near for one in openings], 75)) / max(lit, 1e-4)


def roofed(openings: list[Opening]) -> bool:
    """Whether what is above is dark on most sides, as beneath a sofa."""
    lit = max(one.outside for one in openings)
    return float(np.percentile([one.above for one in openings], 75)) <= ROOFED * lit


def sheltered(openings: list[Opening]) -> bool:
    """Whether this is beneath something, if maybe not deep enough in."""
    return darkness(openings) <= DARKISH and roofed(openings)


def lightest(openings: list[Opening]) -> Opening:
    """The direction that shows most lit floor; what its neighbours show counts as well, each side once."""

    def value(one: Opening) -> float:
        beside = [max(0.0, 1 - abs(wrapped(other.heading - one.heading)) / 0.9) for other in openings]
        return one.bright + sum(w * o.bright for w, o in zip(beside, openings, strict=True)) / sum(beside)

    return max(openings, key=value)


class Settle(HidingPhase):
    """Turned to the light: is it dark here, and lit there?"""

    def begin(self, controller: HidingController) -> None:
        controller.memory.hops, controller.memory.shifted = 0, False

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        memory = controller.memory
        if memory.shifted:
            # It came nearer to the light, or went further in: how is it here?
            return controller.then("face", view)
        here = opening(memory, view)
        if here.bright < AS_LIGHT * lightest(memory.openings).bright and memory.hops < MOST_HOPS:
            # Commands were lost, or too little was seen to measure the turn.
            return controller.hop(HOP, "turns on to the light")
        share, roof = darkness(memory.openings), roofed(memory.openings)
        dark = share <= DARK or (share <= DARK_ENOUGH and memory.faces > 1)
        if roof and dark and here.sees_out >= SEES_OUT:
            memory.note = f"hidden: {100 * share:.0f} % of the light outside"
            return controller.then("hidden", view)
        if roof and share <= DARKISH and memory.faces < MOST_FACES:
            memory.shifted = True
            if share <= DARK:
                return controller.step_straight(NEARER, "sees too little: comes nearer to the light")
            return controller.step_straight(-DEEPER, "not dark enough yet: backs further in")
        controller.note_bad()
        memory.note = "not dark enough here"
        if share <= DARK_ENOUGH:
            memory.note = "sees nothing lit from here" if roof else "a dark floor in the light"
        return controller.then("leave", view)


class Hidden(HidingPhase):
    """Keeps still."""

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        return controller.stand(controller.memory.note)


class Check(HidingPhase):
    """Back after a loss of the hold: is it still hidden? By what it sees as it stands, and not as strictly as
    when it hid: nothing moves unless the place is another one."""

    def begin(self, controller: HidingController) -> None:
        controller.memory.openings = []

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        memory = controller.memory
        memory.openings = [*memory.openings, opening(memory, view)]
        if len(memory.openings) < CHECKED:
            return controller.stand("back: is it still hidden?")
        ratio = float(np.median([one.near / max(one.outside, 1e-4) for one in memory.openings]))
        sees = float(np.median([one.sees_out for one in memory.openings]))
        if ratio <= STILL_DARK and sees >= STILL_SEES:
            return controller.then("hidden", view)
        memory.note = "no longer hidden"
        return controller.then("scan", view)
