"""What a holder learns of those to whom its hold yields, on a mesh in memory."""

from __future__ import annotations

import asyncio

from tests.behaviors.client.small_fleet import OTHER, RC, held, small_fleet
from tests.mesh.kit import until
from zscout.behaviors.client.arc import Held
from zscout.behaviors.client.hold_notices import WITHDRAWN_AFTER, HoldNotice, NoticeTracker
from zscout.messages import ReasonParty, Upcoming
from zscout.types import SECOND


def notice(name: str = "next", safe: float = 60, code: str = "waits", begins: float | None = None) -> HoldNotice:
    return HoldNotice.of(Upcoming(code, ReasonParty(name, name, "h/c", 1), [RC], safe, begins), 0)


def test_a_notice_comes_once_and_is_withdrawn_when_it_is_missing_for_a_while() -> None:
    tracker, known = NoticeTracker(), notice()
    assert tracker.take([known], 0) == [known]
    assert tracker.take([known], SECOND) == []
    assert tracker.take([], 2 * SECOND) == []
    assert tracker.next == 2 * SECOND + WITHDRAWN_AFTER
    assert tracker.take([known], 3 * SECOND) == []
    assert tracker.take([], 4 * SECOND) == []
    assert tracker.take([], 4 * SECOND + WITHDRAWN_AFTER) == [known._replace(withdrawn=True)]
    assert tracker.next is None


def test_another_request_and_another_time_are_news_and_its_passing_is_none() -> None:
    tracker = NoticeTracker()
    assert tracker.take([notice()], 0) == [notice()]
    assert tracker.take([notice("other")], 0) == [notice("other")]
    assert tracker.take([notice("other", safe=30)], 0) == [notice("other", safe=30)]
    assert tracker.take([notice("other", safe=0)], 40 * SECOND) == []


def test_the_words_have_the_times() -> None:
    assert notice().text(0) == f"next (h/c) waits for {RC}: yours for 60 s"
    assert notice(safe=0).text(0) == f"next (h/c) waits for {RC}: the hold may end at any time"
    booked = notice("survey", code="booked", begins=30)
    with_clock = booked.text(0, lambda seconds: f"T{seconds:.0f}")
    assert with_clock == f"survey (h/c) has booked {RC} from T30: the hold may end from T60 on"
    assert booked.text(0) == f"survey (h/c) has booked {RC} in 30 s: the hold may end in 60 s"
    assert notice()._replace(withdrawn=True).text(0) == f"no request waits for {RC} any more"


async def test_the_holder_learns_who_waits_over_a_change_of_leader_and_that_it_waits_no_more() -> None:
    async with small_fleet("one", "two") as (fleet, (one, two)):
        arc, grant = await held(one, "mine")
        hold, called = Held(one, arc, grant), list[HoldNotice]()
        hold.on_notice(called.append)
        first = asyncio.create_task(hold.noticed())
        elsewhere = await two.request("elsewhere", {OTHER: {}}, min_runtime=60)
        await asyncio.sleep(1)
        assert not called
        waiting = await two.request("next", {RC: {}, OTHER: {}}, min_runtime=60)
        await until(lambda: called)
        told = await first
        assert told is not None
        assert (told.code, told.by.arc, told.rcs, told.withdrawn) == ("waits", "next", [RC], False)
        assert abs(told.safe_until - arc.end) < SECOND
        await fleet.standby()
        await fleet.lose_leader()
        await until(lambda: fleet.candidates["h1"].rcm is not None)
        await asyncio.sleep(8)
        assert hold.active
        assert [end.by.arc for end in hold.upcoming] == ["next"]
        assert called == [told]
        await two.end(waiting)
        withdrawn = await hold.noticed()
        assert withdrawn is not None
        assert withdrawn.withdrawn
        await until(lambda: len(called) == 2)
        await two.end(elsewhere)
        await one.end(arc)
        assert await hold.noticed() is None
