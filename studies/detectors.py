"""`python -m studies detectors`: the motion detector beside OpenCV's MOG2 and KNN, on drawn scenes or on clips.

All methods get the same pictures in turn and reduce them to 160 columns. MOG2 and KNN have OpenCV's defaults, no
shadows, a median filter of 5 pixels, and the detector's rules for the least region and for two of three pictures.
Motion is reported in time if an event begins within a second of its beginning, the first second of learning aside. An
event is false if it begins while nothing moves, and more than two seconds after.

With `--clips FOLDER` the clips of `clips.toml` that are in FOLDER replace the scenes. Their truth was determined by
eye. The clips are not part of zscout; the file names their sources.
"""

from __future__ import annotations

import argparse
import json
import os
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np

from studies import cdnet
from studies.robots.watch import CLEAR, IN_TIME
from studies.scenes import SCENES, SECONDS, Picture, Spans, pictures
from zscout import terminal
from zscout.behaviors.perception.motion import WARM, MotionDetector, reduced

TRUTH: Final = Path(__file__).with_name("clips.toml")
WIDE: Final = 320
CLIP_RATE: Final = 10.0
"""Clips are reduced to about as many pictures a second, and to WIDE columns."""
BY_EYE: Final = 0.5
"""Seconds by which an event may begin before the motion of a clip: a truth by eye is no better."""

BRIEF: Final = 0.75
"""Share of the seconds with motion below which a table names the share covered by events."""

Moves = Callable[[float, Picture], bool]
"""A function of time and picture. Returns True if motion is reported."""


def ours() -> Moves:
    detector = MotionDetector()
    return lambda at, picture: detector.see(at, picture).moving


def opencv(subtractor: Any) -> Moves:
    watch = cdnet.opencv(subtractor)
    return lambda at, picture: watch(at, reduced(picture)[0].astype(np.uint8))[1]


METHODS: Final[Mapping[str, Callable[[], Moves]]] = {
    "zscout": ours,
    "MOG2": lambda: opencv(cv2.createBackgroundSubtractorMOG2(detectShadows=False)),
    "KNN": lambda: opencv(cv2.createBackgroundSubtractorKNN(detectShadows=False)),
}


class Clip(NamedTuple):
    """Pictures and their truth."""

    name: str
    words: str
    pictures: Iterator[tuple[float, Picture]]
    moves: Spans
    either: Spans = ()
    """Seconds in which an event is neither right nor false."""
    early: float = 0.0
    """Seconds by which an event may begin before its motion."""


@dataclass(frozen=True, slots=True)
class Score:
    """The score of a method in a scene or clip."""

    scene: str
    method: str
    motions: int
    in_time: int
    covered: float
    """Share of the seconds with motion for which an event lasts."""
    false: int
    false_seconds: float
    """Seconds of events while nothing moves, and more than CLEAR after."""
    milliseconds: float
    """Processor time per picture."""
    events: list[tuple[float, float]]

    @property
    def words(self) -> str:
        found = f"{self.in_time} of {self.motions}" if self.motions else "-"
        if self.covered < BRIEF:
            found += f" ({self.covered:.0%} of the time)"
        wrong = self.false or self.false_seconds >= 0.05
        return f"{found}; false {self.false}, {self.false_seconds:.1f} s" if wrong else found


def scores(clip: Clip, methods: Mapping[str, Callable[[], Moves]] = METHODS) -> Iterator[Score]:
    """Show all methods each picture in turn: load slows all alike."""
    watches = {name: method() for name, method in methods.items()}
    took, reported = dict.fromkeys(methods, 0.0), {name: list[tuple[float, bool]]() for name in methods}
    count = 0
    for at, picture in clip.pictures:
        count += 1
        for name, watch in watches.items():
            began = time.process_time()
            moves = watch(at, picture)
            took[name] += time.process_time() - began
            reported[name].append((at, moves and at >= WARM))
    for name in methods:
        yield score(clip, name, cdnet.spells(reported[name]), 1e3 * took[name] / max(1, count))


def score(clip: Clip, method: str, events: list[tuple[float, float]], milliseconds: float) -> Score:
    due = [(begin - clip.early, max(begin, WARM) + IN_TIME + 1e-6) for begin, _ in clip.moves]
    in_time = sum(any(since <= start <= until for start, _ in events) for since, until in due)
    there = sum(end - begin for begin, end in clip.moves)
    covered = sum(_common(event, span) for event in events for span in clip.moves)
    after = [(begin - clip.early, end + CLEAR) for begin, end in (*clip.moves, *clip.either)]
    false = sum(not any(begin <= start <= end for begin, end in after) for start, _ in events)
    lasts = sum(stop - start for start, stop in events)
    false_seconds = lasts - sum(_common(event, span) for event in events for span in _joined(after))
    return Score(
        clip.name, method, len(clip.moves), in_time, covered / there if there else 1.0, false, false_seconds,
        milliseconds, events,
    )  # fmt: skip


def _common(event: tuple[float, float], span: tuple[float, float]) -> float:
    return max(0.0, min(event[1], span[1]) - max(event[0], span[0]))


def _joined(spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return sorted spans, those that overlap as one."""
    joined = list[tuple[float, float]]()
    for begin, end in sorted(spans):
        if joined and begin <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(joined[-1][1], end)
        else:
            joined.append((begin, end))
    return joined


def drawn(names: list[str]) -> Iterator[Clip]:
    for name in names:
        scene = SCENES[name]
        yield Clip(name, scene.words, pictures(scene), scene.moves)


def clips(folder: Path) -> Iterator[Clip]:
    """Yield the clips of TRUTH that are in `folder`."""
    for name, clip in tomllib.loads(TRUTH.read_text(encoding="utf-8")).items():
        path = folder / clip["file"]
        if path.exists():
            moves, either = (tuple((begin, end) for begin, end in clip.get(key, [])) for key in ("moves", "either"))
            yield Clip(name, clip["content"], read(path), moves, either, BY_EYE)


def read(path: Path) -> Iterator[tuple[float, Picture]]:
    """Yield seconds and picture, at most WIDE columns wide, at about CLIP_RATE."""
    video = cv2.VideoCapture(str(path))
    try:
        rate = video.get(cv2.CAP_PROP_FPS)
        step, number = max(1, round(rate / CLIP_RATE)), 0
        while video.grab():
            if number % step == 0:
                good, picture = video.retrieve()
                if not good:
                    return
                high, wide = picture.shape[:2]
                if wide > WIDE:
                    size = WIDE, round(high * WIDE / wide)
                    picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
                yield number / rate, np.asarray(picture, np.uint8)
            number += 1
    finally:
        video.release()


def rows(names: list[str], found: list[Score]) -> Iterator[list[str]]:
    """Yield a row per scene, then sums and times."""
    by = {(score.scene, score.method): score for score in found}
    for scene in names:
        yield [scene, *(by[scene, method].words for method in METHODS)]
    sums, times = list[str](), list[float]()
    for method in METHODS:
        mine = [score for score in found if score.method == method]
        in_time, motions = sum(score.in_time for score in mine), sum(score.motions for score in mine)
        false, seconds = sum(score.false for score in mine), sum(score.false_seconds for score in mine)
        sums.append(f"{in_time} of {motions}; false {false}, {seconds:.1f} s")
        times.append(sum(score.milliseconds for score in mine) / max(1, len(mine)))
    yield ["together", *sums]
    yield ["processor time, of MOG2's", *(f"{mean / max(1e-9, times[1]):.1f}" for mean in times)]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies detectors", description=__doc__)
    parser.add_argument("--scene", action="append", choices=SCENES, metavar="NAME", help="only this scene (repeat it)")
    parser.add_argument("--clips", type=Path, metavar="FOLDER", help="clips of clips.toml instead of drawn scenes")
    parser.add_argument("--list", action="store_true", help="print names and contents of the scenes")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    args = parser.parse_args()
    if args.list:
        terminal.print_table(
            ["scene", f"content, {SECONDS:g} s"], [[name, scene.words] for name, scene in SCENES.items()]
        )
        return
    todo = list(clips(args.clips) if args.clips else drawn(args.scene or list(SCENES)))
    if not todo:
        parser.error(f"{args.clips} has none of the clips in {TRUTH.name}")
    # Measure the cost of a picture on one processor.
    cv2.setNumThreads(1)
    load = os.getloadavg()[0]
    found = [score for clip in todo for score in scores(clip)]
    if args.json:
        print(json.dumps({"load": load, "scores": [asdict(score) for score in found]}))
        return
    names = [clip.name for clip in todo]
    terminal.print_table(["in time; false events", *METHODS], list(rows(names, found)))
