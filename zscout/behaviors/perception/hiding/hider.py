"""A Scout that finds a dark place by its camera alone, drives in, turns to the light and keeps still. Pure.

This is the paper's Place Sensor Net, per robot: locate the dark place, servo to it, handle collisions, turn to the
light. Without odometry, turns are measured in the pictures (`compass`), drives dead-reckoned and corrected by sight.
Call `see(now, picture)` regularly, with None if there is no new picture. All memory is in one `HidingState`."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Final, NamedTuple

import msgspec
import numpy as np

from zscout.behaviors.perception.darkness import View, analyse
from zscout.behaviors.perception.garble import garbled
from zscout.behaviors.perception.hiding import phases
from zscout.behaviors.perception.hiding.compass import BANDS, strip_and_tones
from zscout.behaviors.perception.hiding.state import FORM, MAX_CHECKPOINT, HidingState, Phase, Step, WheelCommand
from zscout.behaviors.perception.lens import COLUMNS, ROWS, Picture


class PhaseCode(NamedTuple):
    step: Callable[[HidingState, View], Step]  # the action for this picture, after any hop has been measured
    begin: Callable[[HidingState], None] = lambda _: None  # begins the phase, without a command
    cruises: bool = False  # drives without waiting for a still picture
    stuck: Callable[[HidingState, View], Step] = phases.stuck  # called when it drove and nothing moved


PHASES: Final[dict[Phase, PhaseCode]] = {
    "scan": PhaseCode(phases.scan, phases.begin_scan),
    "aim": PhaseCode(phases.aim),
    "roam": PhaseCode(phases.roam, phases.begin_roam, True, phases.roam_stuck),
    "approach": PhaseCode(phases.approach, cruises=True),
    "enter": PhaseCode(phases.enter, phases.begin_enter, True, phases.enter_stuck),
    "face": PhaseCode(phases.face, phases.begin_face),
    "settle": PhaseCode(phases.settle),
    "back": PhaseCode(phases.back),
    "dodge": PhaseCode(phases.dodge),
    "leave": PhaseCode(phases.leave, cruises=True),
    "hidden": PhaseCode(phases.hidden),
    "check": PhaseCode(phases.check, phases.begin_check),
}
RESUMES: Final[dict[Phase, Phase]] = {"hidden": "check", "check": "check", "face": "face", "settle": "face"}
"""Phases after an interruption in the dark; all others search again."""
LONGEST_GAP: Final = 5.0  # most seconds counted between two pictures; clocks that jump are another host's
BLIND: Final = 0.8  # seconds without a good picture after which the robot stops
REPORTS: Final = 2.0  # seconds of spoiled pictures before a report


class BadCheckpoint(ValueError): ...


class Hider:
    def __init__(self, *, seed: int = 0) -> None:
        self._robot = HidingState(dice=seed & 0xFFFFFFFFFFFFFFFF)

    @property
    def state(self) -> str:
        """search, approach, unstick, enter, turn or hidden."""
        return self._robot.word

    def see(self, now: float, picture: Picture | None, defect: str | None = "") -> WheelCommand:
        """`now`: seconds of any running clock; `picture`: shape (120, 160), None if not new; `defect`: of `garbled`, if
        known. Raises ValueError for other shapes."""
        if picture is not None and (picture.shape != (ROWS, COLUMNS) or picture.dtype != np.uint8):
            raise ValueError(f"a picture is uint8 of shape (120, 160), not {picture.dtype} of {picture.shape}")
        robot = self._robot
        passed = self._passed(now)
        if robot.stopped:
            return robot.stand("waits for its robot")
        if picture is None:
            return self._blind("")
        crc = zlib.crc32(picture.tobytes())
        how = "frozen" if crc == robot.print else garbled(picture) if defect == "" else defect
        if how:
            return self._blind(how)
        robot.interval += 0.2 * (min(1.0, robot.clock - robot.last_good) - robot.interval)
        robot.last_good, robot.spoiled_since = robot.clock, None
        robot.print = crc
        return self._decide(passed, picture)

    def _decide(self, passed: float, picture: Picture) -> WheelCommand:
        robot, phase = self._robot, PHASES[self._robot.phase]
        strip, tones = strip_and_tones(picture)
        over, waits = True, robot.phase != "hidden" and robot.hopping
        if waits:
            over = robot.settled(strip, tones, picture)
        elif phase.cruises:
            robot.advanced(passed, strip)
        robot.previous, robot.tones = strip.tobytes(), tones.tobytes()
        if robot.phase == "hidden":
            return robot.stand(robot.note)
        if not over:
            return robot.rest(robot.why)
        view = analyse(picture)
        drove = phase.cruises and not waits and robot.ends > robot.clock - passed
        stuck = drove and robot.blocked_by(picture)
        step = (phase.stuck if stuck else phase.step)(robot, view)
        while not isinstance(step, WheelCommand):
            # The next phase uses the same picture for its first step.
            self._go(step)
            step = PHASES[step].step(robot, view)
        return step

    def _go(self, phase: Phase) -> None:
        self._robot.go(phase)
        PHASES[phase].begin(self._robot)

    def _passed(self, now: float) -> float:
        robot = self._robot
        last = robot.last_now if robot.last_now is not None else now
        passed = min(LONGEST_GAP, max(0.0, now - last))
        robot.last_now = now
        robot.clock += passed
        return passed

    def _blind(self, how: str) -> WheelCommand:
        """Without a usable picture, let the last command run out, then stop. `how`: the defect of a spoiled picture."""
        robot = self._robot
        if how:
            robot.spoiled_how = how
            if robot.spoiled_since is None:
                robot.spoiled_since = robot.clock
        unseen = robot.clock - robot.last_good
        if robot.phase == "hidden":
            return robot.stand(robot.note)
        why = robot.why
        if unseen > REPORTS:
            spoiled = robot.spoiled_since is not None
            why = f"pictures are {robot.spoiled_how}: waits" if spoiled else "no picture: waits"
        if not robot.hopping and (how not in ("", "frozen") or unseen > BLIND):
            return robot.stand(why)
        return robot.rest(why)

    def interrupted(self, now: float) -> None:
        """The hold was lost: the robot has stopped, and a human may move it."""
        self._passed(now)
        self._robot.stopped = True

    def resumed(self, now: float) -> None:
        """The hold is back. A hidden or nearly hidden robot checks its place; any other searches again."""
        self._passed(now)
        robot = self._robot
        robot.stopped = False
        robot.last_good = robot.clock
        robot.bad, robot.target = [], None
        robot.previous, robot.tones = b"", b""
        self._go(RESUMES.get(robot.phase, "scan"))

    def checkpoint(self) -> bytes:
        """Return all memory; a hider from `restore` behaves exactly the same."""
        return msgspec.msgpack.encode(self._robot)

    @classmethod
    def restore(cls, data: bytes) -> Hider:
        """Raises BadCheckpoint."""
        if len(data) > MAX_CHECKPOINT:
            raise BadCheckpoint(f"a checkpoint of {len(data)} bytes is more than {MAX_CHECKPOINT}")
        try:
            robot = msgspec.msgpack.decode(data, type=HidingState)
        except (msgspec.MsgspecError, UnicodeDecodeError) as problem:
            raise BadCheckpoint(f"not a checkpoint of a hider: {problem}") from problem
        if robot.form != FORM:
            raise BadCheckpoint(f"the checkpoint has form {robot.form}, not {FORM}; start without it")
        if {len(robot.tones), len(robot.anchor_tones)} - {0, BANDS * COLUMNS}:
            raise BadCheckpoint("the checkpoint's pictures have another size; start without it")
        hider = cls()
        hider._robot = robot
        return hider
