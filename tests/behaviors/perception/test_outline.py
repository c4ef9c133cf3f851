"""The pixels that move, in a picture larger than the detector looks at, and boxes close around them."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from studies import cdnet
from zscout.behaviors.perception.motion import MotionDetector, Seen

WIDTH, HEIGHT = 640, 480
WALKER = (40, 120)


def scene(rng: np.random.Generator, at: int | None, *, noise: float = 4.0, scale: int = 1) -> NDArray[np.uint8]:
    """A wall with a pattern in colours, and somebody whose left edge is at that column; of `scale` pixels one."""
    pattern = np.random.default_rng(1).uniform(60, 190, (12, 16, 3)).astype(np.float32)
    plane = cv2.resize(pattern, (WIDTH // scale, HEIGHT // scale), interpolation=cv2.INTER_LINEAR)
    if at is not None:
        plane[200 // scale : (200 + WALKER[1]) // scale, at // scale : (at + WALKER[0]) // scale] = (30, 20, 200)
    return np.asarray(np.clip(plane + rng.normal(0, noise, plane.shape), 0, 255), np.uint8)


def watched(noise: float) -> tuple[Seen, int]:
    """The last of a walk, and where he was then."""
    rng, detector, at = np.random.default_rng(2), MotionDetector(outlines=True), 0
    for number in range(20):
        seen = detector.see(number / 5, scene(rng, None, noise=noise))
        assert seen.mask is None or not seen.mask.any()
    for number in range(20, 26):
        at = 100 + 30 * (number - 20)
        seen = detector.see(number / 5, scene(rng, at, noise=noise))
    return seen, at


@pytest.mark.parametrize("noise", [0.5, 4.0, 9.0])
def test_the_mask_and_the_box_are_those_of_who_walks(noise: float) -> None:
    seen, at = watched(noise)
    assert seen.mask is not None
    assert seen.mask.shape == (HEIGHT, WIDTH)
    truth = np.zeros((HEIGHT, WIDTH), bool)
    truth[200 : 200 + WALKER[1], at : at + WALKER[0]] = True
    found = seen.mask > 0
    assert (found & truth).sum() >= 0.95 * truth.sum()
    assert (found & ~truth).sum() <= 0.1 * truth.sum()
    x, y, width, height = seen.boxes[0]
    assert max(abs(x - at), abs(y - 200)) <= 3
    assert max(abs(width - WALKER[0]), abs(height - WALKER[1])) <= 6


def test_without_outlines_there_is_no_mask() -> None:
    rng, detector = np.random.default_rng(3), MotionDetector()
    assert {detector.see(number / 5, scene(rng, None)).mask is None for number in range(12)} == {True}


def test_pictures_of_another_size_begin_anew() -> None:
    rng, detector = np.random.default_rng(4), MotionDetector(outlines=True)
    for number in range(12):
        detector.see(number / 5, scene(rng, None))
    small = np.asarray(cv2.resize(scene(rng, None), (320, 240)), np.uint8)
    assert detector.see(2.6, small).mask is None or not detector.see(2.8, small).moving
    grey = np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), np.uint8)
    assert not any(detector.see(3 + number / 5, grey).moving for number in range(12))
    seen = detector.see(6, grey)
    assert seen.mask is not None
    assert seen.mask.shape == grey.shape


@pytest.mark.slow
def test_the_table_of_a_sequence_of_cdnet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A sequence in the form of that data set, whose truth is known to the pixel."""
    for name in ("input", "groundtruth"):
        (tmp_path / "walk" / name).mkdir(parents=True)
    rng, coarse = np.random.default_rng(5), (320, 240)
    for number in range(1, 61):
        at = 100 + 8 * (number - 40) if number > 40 else None
        truth = np.zeros((HEIGHT, WIDTH), np.uint8)
        if at is not None:
            truth[200 : 200 + WALKER[1], at : at + WALKER[0]] = 255
        for folder, kind, plane in (("input", "in", scene(rng, at, scale=2)), ("groundtruth", "gt", truth)):
            suffix = "jpg" if kind == "in" else "png"
            small = cv2.resize(plane, coarse, interpolation=cv2.INTER_NEAREST)
            assert cv2.imwrite(str(tmp_path / "walk" / folder / f"{kind}{number:06d}.{suffix}"), small)
    (tmp_path / "walk" / "temporalROI.txt").write_text("30 60")
    assert cv2.imwrite(str(tmp_path / "walk" / "ROI.bmp"), np.full(coarse[::-1], 255, np.uint8))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["cdnet", str(tmp_path), "--rate", "10", "--json"])
        cdnet.main()
    scores = {one["method"]: one for one in json.loads(capsys.readouterr().out)}
    assert scores.keys() == {"zscout", "MOG2", "KNN"}
    assert scores["zscout"]["f"] > 0.85
    assert [(one["events"], one["in_time"]) for one in scores.values()] == [(1, 1)] * 3
