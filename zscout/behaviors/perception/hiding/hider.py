"""A Scout that finds a dark place by its camera alone, drives in, turns to the light and keeps still. Pure.

    hider = Hider(seed=33)
    command = hider.see(now, picture)      # at every picture, or None when there is no new one

The paper's Place Sensor Net, per robot: locate the dark place, servo to it, handle collisions, turn to the
light. There is no odometry and no answer from the robot: turns are measured in the pictures (`compass`),
drives are dead-reckoned and corrected by what comes into view. The phases stand in `PHASES`, each a class
of its own; everything they remember is one `HidingState`.
"""

from __future__ import annotations

from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.darkness import analyse
from zscout.behaviors.perception.garble import garbled
from zscout.behaviors.perception.hiding.approaching import Approach, Enter
from zscout.behaviors.perception.hiding.compass import (
    BANDS,
    Strip,
    Tones,
    strip,
    tones,
)
from zscout.behaviors.perception.hiding.controller import (
    HidingController,
    HidingPhase,
    print_of,
    thumb_of,
)
from zscout.behaviors.perception.hiding.facing import (
    Check,
    Face,
    Hidden,
    Settle,
)
from zscout.behaviors.perception.hiding.freeing import Back, Dodge, Leave
from zscout.behaviors.perception.hiding.searching import Aim, Roam, Scan
from zscout.behaviors.perception.hiding.state import (
    FORM,
    MAX_CHECKPOINT,
    HidingState,
    Phase,
)
from zscout.behaviors.perception.hiding.wheels import SCOUT, BodyModel, WheelCommand
from zscout.behaviors.perception.lens import COLUMNS, Picture, is_picture

PHASES: Final[dict[Phase, HidingPhase]] = {
    "scan": Scan(),
    "aim": Aim(),
    "roam": Roam(),
    "approach": Approach(),
    "enter": Enter(),
    "face": Face(),
    "settle": Settle(),
    "back": Back(),
    "dodge": Dodge(),
    "leave": Leave(),
    "hidden": Hidden(),
    "check": Check(),
}
RESUMES: Final[dict[Phase, Phase]] = {"hidden": "check", "check": "check", "face": "face", "settle": "face"}
"""Where those go on that were in the dark when the hold was lost; others search anew."""
CRUISES: Final = {"roam", "approach", "enter", "leave"}
"""Phases that drive without waiting for a still picture."""
LONGEST_GAP: Final = 5.0
"""Seconds that count between two pictures at most: longer ones, and clocks that go back, are another
host's."""
BLIND: Final = 0.8
"""Seconds without a good picture after which the robot stands."""
TELLS: Final = 2.0
"""Seconds of spoiled pictures after which it reports that."""


class BadCheckpoint(ValueError):
    """Bytes that are no checkpoint of a hider."""


class Hider:
    """Hides one robot."""

    def __init__(self, body: BodyModel = SCOUT, *, seed: int = 0) -> None:
        self._controller = HidingController(body, HidingState(dice=seed & 0xFFFFFFFFFFFFFFFF), PHASES)

    @property
    def state(self) -> str:
        """search, approach, unstick, enter, turn or hidden."""
        return self._controller.word

    def see(self, now: float, picture: Picture | None, defect: str | None = "") -> WheelCommand:
        """What to do now. `now` in seconds of any clock that runs; `picture` of shape (120, 160), or None if
        there is no newer one; `defect`: what `garbled` gave for it, if the caller knows. Raises ValueError
        for an array of another form."""
        if picture is not None and not is_picture(picture):
            raise ValueError(
                f"a picture is uint8 of shape (120, 160), not {picture.dtype} of {picture.shape}"
            )
        controller = self._controller
        memory = controller.memory
        passed = self._passed(now)
        if memory.stopped:
            return controller.stand("waits for its robot")
        how = self._spoiled(picture, defect)
        if picture is None or how:
            return self._blind(how)
        memory.interval += 0.2 * (min(1.0, memory.clock - memory.last_good) - memory.interval)
        memory.last_good, memory.spoiled_since = memory.clock, None
        print_, bands, shades, thumb = print_of(picture), strip(picture), tones(picture), thumb_of(picture)
        act = self._decide(passed, picture, bands, shades, thumb)
        memory.print, memory.previous, memory.tones = print_, bands.tobytes(), shades.tobytes()
        return act

    def _decide(
        self, passed: float, picture: Picture, bands: Strip, shades: Tones, thumb: NDArray[np.uint8]
    ) -> WheelCommand:
        controller = self._controller
        memory = controller.memory
        phase = PHASES[memory.phase]
        if memory.phase == "hidden":
            return controller.stand(memory.note)
        if memory.hopping:
            over = controller.settled(bands, shades, thumb)
            controller.keep(thumb)
            if not over:
                return controller.rest(memory.why)
            memory.previous, memory.tones = bands.tobytes(), shades.tobytes()
            return phase.step(controller, analyse(picture))
        if memory.phase in CRUISES:
            controller.advanced(passed, bands)
            memory.previous, memory.tones = bands.tobytes(), shades.tobytes()
            view = analyse(picture)
            if memory.ends > memory.clock - passed and controller.blocked(picture):
                return phase.stuck(controller, view)
            return phase.step(controller, view)
        memory.previous, memory.tones = bands.tobytes(), shades.tobytes()
        return phase.step(controller, analyse(picture))

    def _passed(self, now: float) -> float:
        memory = self._controller.memory
        last = memory.last_now if memory.last_now is not None else now
        passed = min(LONGEST_GAP, max(0.0, now - last))
        memory.last_now = now
        memory.clock += passed
        return passed

    def _spoiled(self, picture: Picture | None, defect: str | None) -> str:
        """What is wrong with the picture, "" if nothing is."""
        if picture is None:
            return ""
        if print_of(picture) == self._controller.memory.print:
            return "frozen"
        return (garbled(picture) if defect == "" else defect) or ""

    def _blind(self, how: str) -> WheelCommand:
        """Nothing to see: what was commanded may run out, then the robot stands."""
        controller = self._controller
        memory = controller.memory
        if how:
            memory.spoiled_how = how
            if memory.spoiled_since is None:
                memory.spoiled_since = memory.clock
        unseen = memory.clock - memory.last_good
        if memory.phase == "hidden":
            return controller.stand(memory.note)
        why = memory.why
        if unseen > TELLS:
            why = (
                f"pictures are {memory.spoiled_how}: waits"
                if memory.spoiled_since is not None
                else "no picture: waits"
            )
        if memory.hopping:
            return controller.rest(why)
        if how not in ("", "frozen") or unseen > BLIND:
            return controller.stand(why)
        return controller.rest(why)

    def interrupted(self, now: float) -> None:
        """The hold was lost: the robot has stopped, and a human may move it."""
        self._passed(now)
        self._controller.memory.stopped = True

    def resumed(self, now: float) -> None:
        """The hold is back. Whoever was hidden, or about to, looks whether it still is; others search
        anew."""
        self._passed(now)
        controller = self._controller
        memory = controller.memory
        memory.stopped = False
        memory.last_good = memory.clock
        memory.bad, memory.target = [], None
        memory.previous, memory.tones = b"", b""
        controller.go(RESUMES.get(memory.phase, "scan"))

    def checkpoint(self) -> bytes:
        """All that it remembers; `restore` gives one that does exactly the same from here on."""
        return msgspec.msgpack.encode(self._controller.memory)

    @classmethod
    def restore(cls, data: bytes, body: BodyModel = SCOUT) -> Hider:
        """Raises BadCheckpoint."""
        if len(data) > MAX_CHECKPOINT:
            raise BadCheckpoint(f"a checkpoint of {len(data)} bytes is more than {MAX_CHECKPOINT}")
        try:
            memory = msgspec.msgpack.decode(data, type=HidingState)
        except (msgspec.MsgspecError, UnicodeDecodeError) as problem:
            raise BadCheckpoint(f"is no checkpoint of a hider: {problem}") from problem
        if memory.form != FORM:
            raise BadCheckpoint(f"a checkpoint of form {memory.form}, not {FORM}: start anew")
        if {len(memory.tones), len(memory.anchor_tones)} - {0, BANDS * COLUMNS}:
            raise BadCheckpoint("a checkpoint whose pictures have another size: start anew")
        hider = cls(body)
        hider._controller.memory = memory
        return hider
