"""Out of a bump, and out of a place that is no good."""

from __future__ import annotations

import math
from typing import Final

from zscout.hiding.body import Act
from zscout.hiding.mind import Mind, PhaseOf
from zscout.vision.darkness import View

MOST_BLOCKED: Final = 4
"""Sides of a scan that may be tried."""


class Back(PhaseOf):
    """Backs off from what it pushed against, then turns aside."""

    def begin(self, mind: Mind) -> None:
        memory = mind.memory
        memory.hops = 0
        memory.bumps += 1

    def step(self, mind: Mind, view: View) -> Act:
        memory = mind.memory
        if memory.hops == 0:
            return mind.step_straight(-0.14, f"{mind.memory.note or 'bumped'}: backs off")
        if memory.target is None and memory.blocked and len(memory.blocked) <= MOST_BLOCKED:
            memory.next_phase = "scan"
            return mind.then("roam", view)
        return mind.then("dodge", view)


class Dodge(PhaseOf):
    """Turns aside and looks around anew."""

    def begin(self, mind: Mind) -> None:
        mind.memory.hops = 0

    def step(self, mind: Mind, view: View) -> Act:
        memory = mind.memory
        target = memory.target
        if memory.hops == 0:
            memory.goal = side_of(mind, view) * math.radians(40 + 20 * mind.roll())
            return mind.hop(memory.goal, "turns aside")
        if memory.hops == 1:
            return mind.step_straight(0.18 + 0.1 * memory.tries, "goes around")
        if target is not None and memory.tries < 3:
            memory.tries += 1
            memory.goal = math.atan2(target.y - memory.y, target.x - memory.x)
            memory.next_phase = "approach"
            memory.note = "turns back to the dark place"
            return mind.then("aim", view)
        if target is not None:
            # There is no way from here.
            mind.bad_at(target.x, target.y)
        return mind.then("scan", view)


def side_of(mind: Mind, view: View) -> int:
    """1 left, -1 right: at the edge of the dark where it goes on, else by turns."""
    left, right = view.sides
    if mind.memory.at_edge and max(left, right) > 1.5 * min(left, right):
        return 1 if left < right else -1
    return 1 if mind.memory.bumps % 2 else -1


class Leave(PhaseOf):
    """Out of a place that is no hiding place, towards the light."""

    def begin(self, mind: Mind) -> None:
        mind.memory.left_to_go = 0.6

    def step(self, mind: Mind, view: View) -> Act:
        if mind.pace * mind.here_for >= mind.memory.left_to_go:
            return mind.then("scan", view)
        return mind.cruise(mind.pace, 0.0, f"{mind.memory.note}: leaves")
