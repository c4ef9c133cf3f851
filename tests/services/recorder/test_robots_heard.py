"""The recorder on a real mesh hears of robots; how many pictures it asks for."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.hang import HANG
from tests.live.lab import Lab
from tests.live.test_recorder import recording, run_recorder
from tests.services.recorder.paper_run import events, rows
from tests.services.recorder.robot_run import CAMERA, captions, jpeg, png
from zscout.behaviors.client.arc import hold
from zscout.config.fleet import default_fleet
from zscout.config.node import RecorderConfig, load_node
from zscout.config.strict import BadInput
from zscout.keyexpr import Sender
from zscout.mesh import ZenohMesh
from zscout.messages import BehaviorSaid, BuildingPlan, BuildingPoses, FrameHead, Placed, PlanAsk
from zscout.services.recorder.process import RecorderJob, decode_job, encode_job
from zscout.services.recorder.recorder import Recorder
from zscout.services.recorder.timeline import Timeline

pytestmark = pytest.mark.real_time


def test_how_many_pictures_a_recorder_takes_is_set_in_the_node_file(tmp_path: Path) -> None:
    def frames(text: str) -> float:
        (tmp_path / "node.toml").write_text(f"[recorder]\n{text}\n")
        made = load_node(tmp_path / "node.toml").recorder
        assert made is not None
        return made.frames

    assert [frames(""), frames("frames = 0"), frames("frames = 0.5"), frames("frames = 30")] == [2, 0, 0.5, 30]
    asked = RecorderJob(RecorderConfig(tmp_path, "127.0.0.1", 0, 0.5), default_fleet(), "here")
    assert decode_job(encode_job(asked)).recorder.frames == 0.5
    for bad, words in (("31", "write a number from 0 to 30"), ("-1", "write"), ('"2"', "write a number")):
        with pytest.raises(BadInput, match=rf"node.toml: recorder.frames: .*{words}"):
            frames(f"frames = {bad}")


@pytest.mark.live
@pytest.mark.slow
async def test_a_recorder_sees_what_robots_do(path: Path, tmp_path: Path) -> None:
    """The RCs are a real node's; what framegrabber, building and behavior say, their holder says.

    A recorder beside it that takes no pictures leaves the framegrabber in peace."""
    picture = jpeg(0, "scout33", None)
    async with Lab(tmp_path) as lab:
        lab.node("a", "robot/scout33", CAMERA)
        client = await lab.client("net")
        mesh, keys = client.mesh, client.mesh.keys
        frames, looked = mesh.frame_publisher(keys.frame(CAMERA)), asyncio.Event()
        frames.follow(lambda watched: looked.set() if watched else None)
        served = mesh.serve(
            keys.building_plan(mesh.me), PlanAsk, lambda request: request.answer(BuildingPlan("room", 6.0, 4.5, png()))
        )
        walks = mesh.publisher(keys.building_poses(mesh.me), BuildingPoses)
        says = mesh.publisher(keys.behavior(mesh.me), BehaviorSaid)
        job = RecorderJob(RecorderConfig(tmp_path / "runs", "127.0.0.1", 0, frames=0), lab.fleet, "blind")
        blind = run_recorder(lab, encode_job(job))
        await lab.ready(client, "robot/scout33", CAMERA)
        await recording(lab)
        assert not frames.watched
        assert blind.stdin is not None
        blind.stdin.close()
        assert await asyncio.to_thread(blind.wait, HANG) == 0
        async with await ZenohMesh.open(lab.fleet, Sender("here", "recorder")) as ears:
            with Timeline("lab", path=path) as timeline:
                stop = asyncio.Event()
                running = asyncio.create_task(Recorder(ears, lab.fleet, timeline, 20).run(stop))
                await recording(lab)
                needs: dict[str, dict[str, float]] = {"robot/scout33": {}, CAMERA: {}}
                async with asyncio.timeout(HANG), hold(client, "hide", needs, keep=True) as held:
                    await looked.wait()
                    number = 0
                    # Until a plan and a picture have been shown.
                    while number < 8 or not (timeline.robots.shown.floor and timeline.robots.shown.cameras):
                        number += 1
                        frames.put(FrameHead(number, number / 10, 160, 120, held.grant), picture)
                        walks.put(BuildingPoses(number, robots=[Placed("scout33", 3, 2, camera=1)]))
                        said = f"motion ({number})"
                        says.put(BehaviorSaid("net/scout33", "alert", said, "robot/scout33", alert=True))
                        await asyncio.sleep(0.1)
                stop.set()
                await running
        served.close()
    assert "scout33 · alert" in [text for _, text, _ in captions(path, "fgrab1")]
    assert "scout33 sees motion (1)" in events(path)
    assert any(value == [[450, 375]] for _, _, value in rows(path, "/floor/robots", "Points2D:positions"))
