"""`python -m studies cdnet FOLDER`: the motion detector compared with OpenCV's MOG2 and KNN, by CDnet 2014's protocol.

FOLDER holds unpacked sequences of that data set, each with `input/`, `groundtruth/`, `temporalROI.txt` and `ROI.bmp`,
at any depth. The data set is not part of zscout (changedetection.net; Wang et al., "CDnet 2014: An Expanded Change
Detection Benchmark Dataset").

Per pixel: within the region of interest and the counted frames. Shadows are background; pixels marked unknown or
outside do not count. MOG2 and KNN have OpenCV's defaults, without their shadows, and the usual median filter of 5
pixels. Per event: reports within a second after a person or thing enters the region, and reports without any motion.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from studies.robots.watch import CLEAR, IN_TIME
from zscout import terminal
from zscout.behaviors.perception.motion import GAP, RECENT, SMALLEST, SURE, MotionDetector

OUTSIDE, UNKNOWN, MOVING = 85, 170, 255
"""Pixel values of the ground truth; 0 is background and 50 a shadow."""
FOREGROUND: Final = 200
"""Threshold for the masks of MOG2 and KNN: 255 moves, 127 is a shadow."""
MEDIAN: Final = 5

Picture = NDArray[np.uint8]
Watch = Callable[[float, Picture], tuple[Picture, bool]]
"""A function of time and picture. Returns a mask of moving pixels (above 0), and True if it reports motion."""


def ours() -> Watch:
    detector = MotionDetector(outlines=True)

    def see(at: float, picture: Picture) -> tuple[Picture, bool]:
        seen = detector.see(at, picture)
        return (np.zeros(picture.shape[:2], np.uint8) if seen.mask is None else seen.mask), seen.moving

    return see


def opencv(subtractor: Any) -> Watch:
    recent: deque[bool] = deque(maxlen=RECENT)

    def see(_: float, picture: Picture) -> tuple[Picture, bool]:
        mask = cv2.medianBlur(subtractor.apply(picture), MEDIAN)
        moving = np.asarray(cv2.threshold(mask, FOREGROUND, 255, cv2.THRESH_BINARY)[1], np.uint8)
        areas = cv2.connectedComponentsWithStats(moving)[2][1:, cv2.CC_STAT_AREA]
        recent.append(bool(areas.size) and bool(areas.max() >= SMALLEST * moving.size))
        return moving, sum(recent) >= SURE

    return see


METHODS: Final[Mapping[str, Callable[[], Watch]]] = {
    "zscout": ours,
    "MOG2": lambda: opencv(cv2.createBackgroundSubtractorMOG2()),
    "KNN": lambda: opencv(cv2.createBackgroundSubtractorKNN()),
}


@dataclass(frozen=True, slots=True)
class Score:
    """The score of a method in a sequence."""

    sequence: str
    method: str
    recall: float
    precision: float
    f: float
    milliseconds: float
    """Processor time per picture."""
    events: int
    in_time: int
    false: int
    """Spells of reported motion in which nothing moved."""


@dataclass(frozen=True, slots=True)
class Sequence:
    folder: Path

    def frames(self) -> Iterator[tuple[int, Picture, Picture]]:
        for path in sorted((self.folder / "input").glob("in*.jpg")):
            number = path.stem.removeprefix("in")
            picture = cv2.imread(str(path))
            truth = cv2.imread(str(self.folder / "groundtruth" / f"gt{number}.png"), cv2.IMREAD_GRAYSCALE)
            if picture is None or truth is None:
                raise SystemExit(f"{path}: no picture with its groundtruth; unpack the sequence again")
            yield int(number), np.asarray(picture, np.uint8), np.asarray(truth, np.uint8)

    @property
    def counted(self) -> tuple[int, int]:
        first, last = (self.folder / "temporalROI.txt").read_text(encoding="ascii").split()
        return int(first), int(last)

    def region(self) -> NDArray[np.bool_]:
        found = cv2.imread(str(self.folder / "ROI.bmp"), cv2.IMREAD_GRAYSCALE)
        if found is None:
            raise SystemExit(f"{self.folder / 'ROI.bmp'}: no picture; unpack the sequence again")
        return np.asarray(found) > 0


def score(sequence: Sequence, method: str, rate: float) -> Score:
    watch, region, (first, last) = METHODS[method](), sequence.region(), sequence.counted
    hits = misses = wrong = pictures = 0
    took = 0.0
    reported, there = list[tuple[float, bool]](), list[tuple[float, bool]]()
    for number, picture, truth in sequence.frames():
        began = time.process_time()
        mask, moves = watch(number / rate, picture)
        took += time.process_time() - began
        pictures += 1
        if not first <= number <= last:
            continue
        counts = region & (truth != OUTSIDE) & (truth != UNKNOWN)
        moving, found = counts & (truth == MOVING), mask > 0
        hits += int(np.count_nonzero(found & moving))
        misses += int(np.count_nonzero(moving & ~found))
        wrong += int(np.count_nonzero(counts & found & ~moving))
        reported.append((number / rate, moves))
        there.append((number / rate, np.count_nonzero(moving) >= SMALLEST * region.sum()))
    recall, precision = hits / max(1, hits + misses), hits / max(1, hits + wrong)
    f = 2 * recall * precision / max(1e-9, recall + precision)
    events, alarms = spells(there), spells(reported)
    in_time = sum(any(begin <= at <= begin + IN_TIME and moves for at, moves in reported) for begin, _ in events)
    false = sum(not any(begin <= end + CLEAR and stop >= start for start, end in events) for begin, stop in alarms)
    return Score(
        sequence.folder.name, method, recall, precision, f, 1e3 * took / max(1, pictures), len(events), in_time, false
    )


def spells(seen: list[tuple[float, bool]]) -> list[tuple[float, float]]:
    """Begin and end of each spell of motion, which may have pauses of at most GAP."""
    found = list[tuple[float, float]]()
    for at, moves in seen:
        if moves and found and at - found[-1][1] <= GAP:
            found[-1] = found[-1][0], at
        elif moves:
            found.append((at, at))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies cdnet", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="with sequences of CDnet 2014")
    parser.add_argument("--rate", type=float, default=25.0, help="pictures a second (default: 25)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    args = parser.parse_args()
    sequences = [Sequence(path.parent) for path in sorted(args.folder.rglob("temporalROI.txt"))]
    if not sequences or args.rate <= 0:
        parser.error(f"{args.folder} has no sequence of CDnet 2014 (temporalROI.txt), or the rate is not above 0")
    # Measure the cost of a picture on one processor.
    cv2.setNumThreads(1)
    scores = [score(sequence, method, args.rate) for sequence in sequences for method in METHODS]
    if args.json:
        print(json.dumps([asdict(score) for score in scores]))
        return
    cells = [
        [
            row.sequence,
            row.method,
            *(f"{value:.3f}" for value in (row.recall, row.precision, row.f)),
            f"{row.milliseconds:.2f} ms",
            f"{row.in_time} of {row.events}",
            str(row.false),
        ]
        for row in scores
    ]
    heads = ["sequence", "method", "recall", "precision", "F", "a picture", "reported in 1 s", "false"]
    terminal.print_table(heads, cells)
