"""What a program sees of its hold: pictures of its devices, and words for a notebook."""

from __future__ import annotations

import asyncio
from decimal import Decimal

import pytest

from tests.behaviors.client.small_fleet import RC, held, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.arc import Held
from zscout.behaviors.client.lab_status import LabStatus
from zscout.mesh.frames import Frame
from zscout.messages import FrameHead, HoldView, RcmState, RcView, WaitView, Who
from zscout.types import Grant, Place, Term

OTHER = Grant(Term(1, "other"), 3)
PLACE = Place(Term(1, "a"), 1)


async def test_pictures_of_a_hold_are_its_own_and_end_with_it() -> None:
    async with small_fleet("one") as (fleet, (one,)):
        arc, grant = await held(one, "first")
        mine, seen = Held(one, arc, grant), list[Frame]()
        camera = fleet.devices.frame_publisher(fleet.devices.keys.frame(RC))

        async def look() -> None:
            async for frame in mine.frames(RC):
                seen.append(frame)

        looking = asyncio.create_task(look())
        await asyncio.sleep(0.1)
        for number, taken in enumerate((OTHER, grant, None)):
            camera.put(FrameHead(number, number / 4, 160, 120, taken), b"jpeg %d" % number)
            await asyncio.sleep(0.1)
        assert [(frame.head.number, frame.jpeg) for frame in seen] == [(1, b"jpeg 1"), (2, b"jpeg 2")]
        assert repr(seen[0]) == "<Frame 1: 160x120, 6 bytes, taken at 0.250 s>"
        assert seen[0]._repr_jpeg_() == b"jpeg 1"
        with pytest.raises(KeyError, match="is not a need of first"):
            await anext(mine.frames("framegrabber/*"))
        await one.end(arc)
        await until(looking.done)
        assert looking.exception() is None


async def test_a_hold_says_what_it_is() -> None:
    async with small_fleet("one") as (_, (one,)):
        arc, grant = await held(one, "first")
        mine = Held(one, arc, grant)
        assert repr(mine).startswith(f"<Held first: {RC}; ")
        assert repr(mine).endswith(" s left>")
        await one.end(arc)
        assert repr(mine) == f"<Held first: {RC}; over: given up by this client>"


def test_the_status_of_a_lab_is_a_table_whatever_others_call_themselves() -> None:
    hold = HoldView(
        id="1",
        arc="survey<b>",
        client="ws1/c1",
        who=Who("alice"),
        priority=1,
        grant=OTHER,
        place=PLACE,
        needs={"robot/a": {}},
        min_runtime=Decimal(60),
        held=1.0,
        remaining=41.6,
    )
    wait = WaitView(
        id="2",
        arc="drive\x1b[2J",
        client="ws1/c2",
        priority=0,
        place=PLACE,
        needs={"robot/a": {}},
        min_runtime=Decimal(1),
        waited=2.0,
        reason="survey & all",
    )
    rcs = [RcView(f"robot/{name}", name != "c", sharable=False, host="ws1") for name in "abc"]
    shown = LabStatus("lab", RcmState(term=Term(1, "a"), seq=4, host="ws2", rcs=rcs, holds=[hold], queue=[wait]))
    assert str(shown).splitlines() == [
        "lab, led by ws2",
        "",
        "DEVICE   HOST  HELD BY",
        "robot/a  ws1   survey<b> (alice@ws1), 42 s left",
        "robot/b  ws1   free",
        "robot/c  ws1   absent",
        "",
        "WAITS               WHY",
        "drive [2J (ws1/c2)  survey & all",
    ]
    html = shown._repr_html_()
    assert "<td>survey&lt;b&gt; (alice@ws1), 42 s left</td>" in html
    assert "\x1b" not in html
    assert "<td>survey &amp; all</td>" in html
