"""`zscout why` on a real mesh: the story of an ARC in words, and who is in its way."""

from __future__ import annotations

import json
import re

import pytest

from tests.cli.cli_fleet import in_lab, patient_timing
from tests.cli.tools import CLOCK, mine, ours, own, zscout_soon
from tests.live.lab import PATIENT, Lab

pytestmark = pytest.mark.live
SURVEY, TAKE = (re.escape(mine(name)) for name in ("survey", "take"))
COMMAND = ours().partition(" (")[2][:-1]
SOON = r"\d+(\.\d)? s"


@pytest.mark.slow
@in_lab(lease=PATIENT, extra=patient_timing())
async def test_the_story_of_an_arc(lab: Lab) -> None:
    lab.node("anvil", "robot/a", "robot/b", "radio/rf0:rate=10")
    client, other = await lab.client("program"), await lab.client("other")
    await lab.ready(client, "robot/a", "robot/b", "radio/rf0")
    survey = await client.request("survey", {"robot/a": {}, "radio/rf0": {"rate": 4}}, min_runtime=600)
    # Each has what it asked for before the next one comes: the radio votes first.
    await lab.state(client, lambda state: [hold.arc for hold in state.holds] == ["survey"])
    await other.request("mapping", {"radio/rf0": {"rate": 5}}, min_runtime=600, keep=True)
    await lab.state(client, lambda state: len(state.holds) == 2)
    await other.request("take", {"robot/a": {}}, priority=10, min_runtime=600, keep=False)
    await other.request("late", {"robot/b": {}, "robot/nowhere": {}}, min_runtime=30, wait_for_device=True)
    await lab.state(client, lambda state: len(state.holds) == 2 and len(state.queue) == 2)

    plain = await zscout_soon("why", "survey", env=lab.env)
    assert (plain.returncode, plain.stderr) == (0, "")
    lines = plain.stdout.splitlines()
    assert re.fullmatch(rf"{SURVEY}, priority 0, has waited since {CLOCK} \({SOON}\)", lines[0])
    assert lines[1] == f"  id {survey.id}, client test/program, command {COMMAND}"
    assert re.fullmatch(rf"  waits for {own('take')}: robot/a, until {CLOCK} at the latest", lines[2])
    assert lines[3].endswith("in the queue of 2; it wants 10 min")
    spans = r"\(in (10 min|9 min \d+ s)\)"
    assert re.fullmatch(rf"  it may start at {CLOCK} {spans}, if nothing else comes", lines[4])
    assert lines[5:7] == ["  it was preempted once", "Needs"]
    since, until = rf"since {CLOCK} \({SOON}\)", rf"until {CLOCK} \((10 min|9 min \d+ s)\) at the latest"
    assert re.fullmatch(
        rf"  radio/rf0 \(rate=4\): shared with {own('mapping')} \(rate=5\), priority 0, {since}, {until}", lines[7]
    )
    assert re.fullmatch(rf"  robot/a: held by {own('take')}, priority 10, {since}, {until}", lines[8])
    assert lines[9] == "Story"
    told = [line.split(" ago)  ", 1)[1] for line in lines[10:]]
    assert re.match(rf" +{CLOCK} \(", lines[10])
    assert told[:2] == ["asked for radio/rf0, robot/a at priority 0", "granted radio/rf0, robot/a"]
    assert re.fullmatch(rf"preempted by {TAKE}, priority 10; queued again", told[2])
    assert re.fullmatch(rf"waits for {TAKE}: robot/a", told[3])

    by_id = json.loads((await zscout_soon("why", survey.id, "--json", env=lab.env)).stdout)
    (arc,) = by_id["arcs"]
    assert (arc["arc"], arc["state"], arc["preemptions"], arc["queued"]) == ("survey", "queued", 1, 2)
    assert [need["rc"] for need in arc["needs"]] == ["radio/rf0", "robot/a"]
    (holder,) = arc["needs"][1]["holders"]
    assert (holder["arc"], holder["client"], holder["priority"]) == ("take", "test/other", 10)
    assert [line["text"] for line in arc["story"]][:2] == told[:2]
    assert arc["story"][0]["ago"] >= arc["story"][1]["ago"] >= 0

    missing = (await zscout_soon("why", "late", env=lab.env)).stdout
    assert "  robot/nowhere: not on the mesh\n" in missing
    assert "  robot/b: no other request holds it\n" in missing

    # Two of one name are told of one by one; ended ones from memory; unknown ones with what is near.
    twin = await client.request("take", {"robot/nowhere": {}}, min_runtime=1, wait_for_device=True)
    runs, waits = (await zscout_soon("why", "take", env=lab.env)).stdout.split("\n\n")
    assert re.match(rf"{TAKE}, priority 10, has run since ", runs)
    protected = f"only operators preempt it from {CLOCK} on"
    assert re.search(rf"\n  until {CLOCK} \(.*\), its minimum runtime of 10 min\n  {protected}\nHolds\n", runs)
    assert " asked for robot/a at priority 10\n" in runs
    assert f"  id {twin.id}, client test/program, command {COMMAND}\n" in waits
    assert " asked for robot/nowhere at priority 0\n" in waits
    assert "robot/a" not in waits
    await client.end(survey)
    ended = await zscout_soon("why", "survey", env=lab.env)
    assert ended.returncode == 0
    assert ended.stdout.startswith("survey is no longer open\nStory\n")
    assert "cancelled" in ended.stdout.splitlines()[-1]
    unknown = await zscout_soon("why", "mappin", env=lab.env)
    assert (unknown.returncode, unknown.stdout) == (1, "")
    assert unknown.stderr == 'zscout: unknown request "mappin"; did you mean mapping?\n'
    device = (await zscout_soon("why", "robot/a", env=lab.env)).stderr
    assert device == "zscout: robot/a is a device: zscout status robot/a shows which requests hold it or wait\n"


@in_lab()
async def test_how_long_such_holds_usually_last_is_told(lab: Lab) -> None:
    lab.node("anvil", "robot/a")
    client = await lab.client("program")
    await lab.ready(client, "robot/a")
    for _ in range(4):
        arc = await client.request("survey", {"robot/a": {}}, min_runtime=600)
        await lab.state(client, lambda state: len(state.holds) == 1)
        await client.end(arc)
        await lab.state(client, lambda state: not state.holds)
    await client.request("survey", {"robot/a": {}}, min_runtime=600)
    await lab.state(client, lambda state: len(state.holds) == 1)
    why = await zscout_soon("why", "survey", env=lab.env)
    assert re.search(rf"^  likely to end at {CLOCK} \(in ", why.stdout, re.MULTILINE)
    status = await zscout_soon("status", env=lab.env)
    assert re.search(rf", keeps, likely {CLOCK}", status.stdout)
