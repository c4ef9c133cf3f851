"""Out of a bump, and out of a place that is no good."""

from __future__ import annotations

import math
from typing import Final

from zscout.behaviors.perception.darkness import View
from zscout.behaviors.perception.hiding.controller import HidingController, HidingPhase
from zscout.behaviors.perception.hiding.wheels import WheelCommand

MOST_BLOCKED: Final = 4
"""Sides of a scan that may be tried."""


class Back(HidingPhase):
    """Backs off from what it pushed against, then turns aside."""

    def begin(self, controller: HidingController) -> None:
        memory = controller.memory
        memory.hops = 0
        memory.bumps += 1

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        memory = controller.memory
        if memory.hops == 0:
            return controller.step_straight(-0.14, f"{controller.memory.note or 'bumped'}: backs off")
        if memory.target is None and memory.blocked and len(memory.blocked) <= MOST_BLOCKED:
            memory.next_phase = "scan"
            return controller.then("roam", view)
        return controller.then("dodge", view)


class Dodge(HidingPhase):
    """Turns aside and looks around anew."""

    def begin(self, controller: HidingController) -> None:
        controller.memory.hops = 0

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        memory = controller.memory
        target = memory.target
        if memory.hops == 0:
            memory.goal = side_of(controller, view) * math.radians(40 + 20 * controller.roll())
            return controller.hop(memory.goal, "turns aside")
        if memory.hops == 1:
            return controller.step_straight(0.18 + 0.1 * memory.tries, "goes around")
        if target is not None and memory.tries < 3:
            memory.tries += 1
            memory.goal = math.atan2(target.y - memory.y, target.x - memory.x)
            memory.next_phase = "approach"
            memory.note = "turns back to the dark place"
            return controller.then("aim", view)
        if target is not None:
            # There is no way from here.
            controller.bad_at(target.x, target.y)
        return controller.then("scan", view)


def side_of(controller: HidingController, view: View) -> int:
    """1 left, -1 right: at the edge of the dark where it goes on, else by turns."""
    left, right = view.sides
    if controller.memory.at_edge and max(left, right) > 1.5 * min(left, right):
        return 1 if left < right else -1
    return 1 if controller.memory.bumps % 2 else -1


class Leave(HidingPhase):
    """Out of a place that is no hiding place, towards the light."""

    def begin(self, controller: HidingController) -> None:
        controller.memory.left_to_go = 0.6

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        if controller.pace * controller.here_for >= controller.memory.left_to_go:
            return controller.then("scan", view)
        return controller.cruise(controller.pace, 0.0, f"{controller.memory.note}: leaves")
