"""`python -m studies detectors`: scenes with known truth, and how events are scored against it."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from studies import detectors
from studies.detectors import METHODS, TRUTH, Clip, score, scores
from studies.scenes import SCENES, SECONDS, WALK, pictures
from tests.studies.tools import study_here


@pytest.mark.parametrize(
    ("events", "in_time", "false", "false_seconds"),
    [
        ([(5.2, 8.0)], 1, 0, 0.0),
        ([(5.2, 11.0)], 1, 0, 1.0),
        ([(6.5, 8.0)], 0, 0, 0.0),
        ([(1.0, 2.5), (5.0, 8.0)], 1, 1, 1.5),
        ([(2.0, 12.0)], 0, 1, 5.0),
        ([], 0, 0, 0.0),
    ],
)
def test_events_are_scored_against_the_truth(
    events: list[tuple[float, float]], in_time: int, false: int, false_seconds: float
) -> None:
    """Motion from 5 to 8 s."""
    found = score(Clip("walk", "", iter(()), ((5.0, 8.0),)), "any", events, 1.0)
    assert (found.motions, found.in_time, found.false) == (1, in_time, false)
    assert found.false_seconds == pytest.approx(false_seconds)


def test_without_motion_every_event_is_false() -> None:
    found = score(Clip("empty", "", iter(()), ()), "any", [(3.0, 4.0), (9.0, 9.5)], 1.0)
    assert (found.motions, found.false, found.false_seconds) == (0, 2, 1.5)
    assert found.words == "-; false 2, 1.5 s"


def test_every_scene_has_the_same_pictures_again() -> None:
    for scene in SCENES.values():
        assert all(0 <= begin < end <= SECONDS for begin, end in scene.moves)
        (_, first), (_, again) = next(pictures(scene)), next(pictures(scene))
        assert np.array_equal(first, again)


def test_the_walker_of_a_scene_is_reported_in_time() -> None:
    scene = SCENES["still"]
    found = {score.method: score for score in scores(Clip("still", "", pictures(scene, 5.0), scene.moves))}
    assert found.keys() == METHODS.keys()
    assert (found["zscout"].in_time, found["zscout"].false) == (1, 0)
    assert WALK[0] <= found["zscout"].events[0][0] <= WALK[0] + 1


def test_clips_are_read_with_their_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = tmp_path / "truth.toml"
    truth.write_text('[door]\nfile = "door.avi"\ncontent = "a door"\nmoves = [[2.0, 3.0]]\n')
    monkeypatch.setattr(detectors, "TRUTH", truth)
    writer = cv2.VideoWriter(str(tmp_path / "door.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (400, 240))
    for number in range(80):
        picture = np.full((240, 400, 3), 120, np.uint8)
        if 40 <= number < 60:
            picture[80:220, 10 * (number - 40) : 10 * (number - 40) + 60] = 20
        writer.write(picture)
    writer.release()
    assert study_here("detectors", "--clips", tmp_path) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[1].split()[:4] == ["door", "1", "of", "1"]
    assert study_here("detectors", "--clips", tmp_path, "--json") == 0
    assert [score["method"] for score in json.loads(capsys.readouterr().out)["scores"]] == list(METHODS)
    ((clip),) = detectors.clips(tmp_path)
    seen = list(clip.pictures)
    assert seen[0][1].shape == (192, 320, 3)
    assert [at for at, _ in seen[:3]] == [0.0, 0.1, 0.2]


def test_the_truth_of_each_clip_is_in_order() -> None:
    for clip in tomllib.loads(TRUTH.read_text()).values():
        ends = [0.0, *(at for span in clip["moves"] for at in span)]
        assert ends == sorted(ends)
        assert clip.keys() - {"either"} == {"file", "content", "source", "licence", "moves"}
