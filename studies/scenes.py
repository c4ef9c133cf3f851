"""Drawn scenes for the motion detector: conditions that people report from the field, with known truth.

A still garden of soft shapes, 640x360 in grey, 10 pictures a second for 24 s, with a noise of 3 grey levels. A dark
person of 28x90 pixels walks through it from 18 to 22 s. Each scene adds a condition, most of them from 6 s on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 640, 360
RATE: Final = 10.0
SECONDS: Final = 24.0
BEGIN, END = 6.0, 14.0
"""Seconds of a scene's own event."""
WALK: Final = (18.0, 22.0)
PERSON: Final = (28, 90)  # columns and rows
FEET: Final = HEIGHT - 40
NOISE: Final = 3.0
SPARE: Final = 200
"""Columns and rows by which the field of noise exceeds a picture: each picture shows another part of it."""

Picture = NDArray[np.uint8]
Plane = NDArray[np.float32]
Spans = tuple[tuple[float, float], ...]
Condition = Callable[[Plane, float, np.random.Generator], Plane]
"""A function of a picture, its time and a source of chance. Returns a picture, perhaps the given one with drawings."""

ROWS: Final = np.arange(HEIGHT, dtype=np.float32)[:, np.newaxis]
COLUMNS: Final = np.arange(WIDTH, dtype=np.float32)[np.newaxis]
GARDEN: Final[Plane] = np.asarray(
    cv2.resize(
        np.random.default_rng(5).integers(30, 200, (40, 70), dtype=np.uint8),
        (WIDTH, HEIGHT),
        interpolation=cv2.INTER_CUBIC,
    ),
    np.float32,
)
COAT: Final[Plane] = np.asarray(
    cv2.resize(
        np.random.default_rng(3).integers(10, 120, (20, 30), dtype=np.uint8),
        (WIDTH, HEIGHT),
        interpolation=cv2.INTER_CUBIC,
    ),
    np.float32,
)
FLAKES: Final = np.random.default_rng(4).uniform((0, 0, 1), (WIDTH, HEIGHT, 5), (80, 3))
"""Column, row and radius of sinking flakes."""


class Scene(NamedTuple):
    words: str
    condition: Condition
    moves: Spans = (WALK,)
    """Seconds with motion that must be reported. The person walks only if WALK is among them."""


def unchanged(plane: Plane, _time: float, _rng: np.random.Generator) -> Plane:
    return plane


def near(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    """A person steps up to the lens within 2 s, sways, and steps back."""
    if BEGIN <= time < END:
        share = 0.85 * min(1.0, (time - BEGIN) / 2, (END - time) / 2)
        high, wide = int(HEIGHT * share), int(0.9 * WIDTH * share)
        left = max(0, (WIDTH - wide) // 2 + int(6 * np.sin(5 * time)))
        plane[HEIGHT - high :, left : left + wide] = COAT[:high, :wide]
    return plane


def far(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    if BEGIN <= time < END:
        left = int(200 + 12 * (time - BEGIN))
        plane[150:170, left : left + 8] *= 0.3
    return plane


def creeping(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    if BEGIN <= time < END:
        left = int(200 + 4 * (time - BEGIN))
        plane[200:290, left : left + 28] = 0.35 * plane[200:290, left : left + 28] + 8
    return plane


def bands(depth: float, rolls: float) -> Condition:
    """As mains lighting makes them with a rolling shutter; `rolls` in pictures a second."""

    def light(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
        return np.asarray(plane * (1 + depth * np.sin(2 * np.pi * (ROWS / 180 + time * rolls))), np.float32)

    return light


def rain(streaks: int) -> Condition:
    def draw(plane: Plane, _time: float, rng: np.random.Generator) -> Plane:
        wet = plane.copy()
        for x, y, length in rng.integers((0, 0, 15), (WIDTH, HEIGHT, 40), (streaks, 3)).tolist():
            cv2.line(wet, (x, y), (x + length // 6, y + length), 210, 1)
        return np.asarray((plane + wet) / 2, np.float32)

    return draw


def snow(flakes: int) -> Condition:
    def draw(plane: Plane, _time: float, rng: np.random.Generator) -> Plane:
        for x, y, radius in rng.integers((0, 0, 1), (WIDTH, HEIGHT, 5), (flakes, 3)).tolist():
            cv2.circle(plane, (x, y), radius, 240, -1)
        return plane

    return draw


def sinking(speed: float) -> Condition:
    """Flakes that sink `speed` pixels a second; each is in many pictures."""

    def draw(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
        for x, y, radius in FLAKES.tolist():
            cv2.circle(plane, (int(x), int((y + speed * time) % HEIGHT)), int(radius), 240, -1)
        return plane

    return draw


def clock(words: str, scale: float) -> Condition:
    """White digits with a black rim; `words` may name seconds and time."""

    def draw(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
        text = words.format(seconds=int(time + 0.01), time=time)
        for shade, thick in ((0, 4), (255, 2)):
            layer = np.zeros(plane.shape, np.uint8)
            place, width = (8, int(36 * scale)), round(thick * scale)
            cv2.putText(layer, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, width)
            plane[layer > 0] = shade
        return plane

    return draw


def cloud(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    """Its edge passes in 3 s, and back."""
    covered = np.clip((time - BEGIN) / 3, 0, 1) - np.clip((time - END + 3) / 3, 0, 1)
    edge = 1 / (1 + np.exp(-(COLUMNS - (1.1 - 1.2 * covered) * WIDTH) / 25))
    return np.asarray(plane * (1 - 0.45 * edge), np.float32)


def hunting(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    return plane * np.float32(1 + 0.3 * np.sin(2 * np.pi * time / 4))


def lamp(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    return plane * np.float32(1.9) if BEGIN <= time < END else plane


def spot(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    return _lit(plane, 480, 200, (110, 90), 1.4) if BEGIN <= time < END else plane


def headlights(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    for begin in (BEGIN, BEGIN + 5):
        if begin <= time < begin + 2:
            plane = _lit(plane, WIDTH * (time - begin) / 2, 180, (60, 120), 1.3)
    return plane


def _lit(plane: Plane, x: float, y: float, size: tuple[int, int], gain: float) -> Plane:
    light = np.exp(-(((COLUMNS - x) / size[0]) ** 2 + ((ROWS - y) / size[1]) ** 2))
    return np.asarray(plane * (1 + gain * light), np.float32)


def infrared(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    """The filter of a camera at dusk: white for 0.4 s, then other contrasts while the exposure settles."""
    if time < BEGIN:
        return plane
    if time < BEGIN + 0.4:
        return np.full_like(plane, 240)
    seen = 204 * (plane / 255) ** np.float32(0.6) + 20
    return np.asarray(seen * (1 + 0.5 * np.exp(-(time - BEGIN - 0.4) / 0.8)), np.float32)


def turned(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    return np.roll(plane[:, ::-1], 120, axis=1) if BEGIN <= time < END else plane


def shaken(plane: Plane, _time: float, rng: np.random.Generator) -> Plane:
    return _moved(plane, rng.normal(0, 1.5), rng.normal(0, 1.0))


def gusts(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    """All sways for 2 s of 6, until shortly before the person comes."""
    return _moved(plane, 4 * np.sin(9 * time), 1.5 * np.cos(7 * time)) if time % 6 > 4 and time < END else plane


def _moved(plane: Plane, x: float, y: float) -> Plane:
    shift = np.array([[1, 0, x], [0, 1, y]], np.float32)
    return np.asarray(cv2.warpAffine(plane, shift, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT), np.float32)


def damaged(plane: Plane, time: float, _rng: np.random.Generator) -> Plane:
    """The lower half of a picture repeats a line, every 3 s."""
    if round(time * RATE) % 30 == 29:
        plane[HEIGHT // 2 :] = plane[HEIGHT // 2 - 1]
    return plane


def dim(plane: Plane, _time: float, _rng: np.random.Generator) -> Plane:
    return np.asarray(plane / 4, np.float32)


OWN: Final = (BEGIN, END)
SCENES: Final[Mapping[str, Scene]] = {
    "still": Scene("nothing else", unchanged),
    "near": Scene("a person at the lens for 8 s, then the walker", near, (OWN, WALK)),
    "far": Scene("a mover of 8x20 pixels, 12 pixels a second", far, (OWN, WALK)),
    "creeping": Scene("a person at 4 pixels a second", creeping, (OWN, WALK)),
    "bands-6": Scene("bands of 6 %, slow", bands(0.06, 0.05)),
    "bands-9": Scene("bands of 9 %, slow", bands(0.09, 0.05)),
    "bands-12": Scene("bands of 12 %, slow", bands(0.12, 0.05)),
    "bands-quick": Scene("bands of 12 %, 0.37 pictures a second", bands(0.12, 0.37)),
    "rain-empty": Scene("15 thin streaks a picture, no walker", rain(15), ()),
    "rain": Scene("15 thin streaks a picture", rain(15)),
    "drizzle": Scene("3 thin streaks a picture", rain(3)),
    "downpour": Scene("60 thin streaks a picture", rain(60)),
    "snow": Scene("40 flakes, elsewhere in each picture", snow(40)),
    "sinking": Scene("80 flakes that sink 60 pixels a second", sinking(60)),
    "clock": Scene("a clock of 24 rows", clock("20:07:{seconds:02}", 0.9)),
    "large-clock": Scene("a clock of 45 rows", clock("20:07:{seconds:02}", 1.8)),
    "tenths": Scene("a clock with tenths", clock("{time:06.1f}", 1.2)),
    "cloud": Scene("a cloud's edge passes, and back", cloud),
    "exposure": Scene("exposure to and fro by 30 % in 4 s", hunting),
    "lamp": Scene("a lamp on and off", lamp),
    "spot": Scene("a lamp that lights a part", spot),
    "headlights": Scene("headlights pass twice", headlights),
    "infrared": Scene("the infrared filter switches", infrared),
    "turned": Scene("the camera is turned away and back", turned),
    "shaken": Scene("the camera shakes by 1.5 pixels", shaken),
    "gusts": Scene("all sways for 2 s, twice", gusts),
    "damage": Scene("half of a picture spoiled, every 3 s", damaged),
    "dim": Scene("a quarter of the light", dim),
}


def pictures(scene: Scene, rate: float = RATE) -> Iterator[tuple[float, Picture]]:
    """Yield time and picture; the same ones each time."""
    rng = np.random.default_rng(7)
    noise = (NOISE * rng.standard_normal((HEIGHT + SPARE, WIDTH + SPARE))).astype(np.float32)
    for number in range(round(SECONDS * rate)):
        time = number / rate
        plane = GARDEN.copy()
        if WALK in scene.moves and WALK[0] <= time < WALK[1]:
            wide, high = PERSON
            left = int((WIDTH + wide) * (time - WALK[0]) / (WALK[1] - WALK[0])) - wide
            place = np.s_[FEET - high : FEET, max(0, left) : max(0, left + wide)]
            plane[place] = 0.35 * plane[place] + 8
        plane = scene.condition(plane, time, rng)
        top, left = rng.integers(0, SPARE, 2).tolist()
        yield time, np.clip(plane + noise[top : top + HEIGHT, left : left + WIDTH], 0, 255).astype(np.uint8)
