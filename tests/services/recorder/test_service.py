"""The recorder as a service on a mesh in memory: it follows an RCM, and fails as a whole."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

import pytest

from tests.mesh.kit import until
from tests.services.recorder.kit import ears, recording
from tests.services.recorder.paper_run import SCOUT33, events, lanes, rows
from tests.services.recorder.robot_run import CAMERA
from zscout.config.fleet import default_fleet
from zscout.keyexpr import Role, Sender, Token
from zscout.messages import (
    Grants,
    Holder,
    HoldView,
    Notice,
    RcmState,
    RcState,
    RcView,
    ReasonInfo,
    ReasonParty,
    Revocation,
    StateAsk,
    WaitView,
    Who,
)
from zscout.services.recorder.recorder import DOUBT_EVERY, Recorder, RecorderFailed
from zscout.services.recorder.timeline import Timeline
from zscout.testing.memory import MemoryNetwork
from zscout.types import Grant, Place, Term

TERM = Term(1, "anvil")
REASON = f"waits for drive: {SCOUT33}"
GRANT = Grant(TERM, 1)
PLACE = Place(TERM, 1)


class Leader:
    """An RCM; without `state` one that has nothing yet."""

    def __init__(
        self, network: MemoryNetwork, state: Callable[[], RcmState] = lambda: RcmState(TERM, 0, "anvil")
    ) -> None:
        mesh = self.mesh = network.open("lab", Sender("anvil", "rcm"))
        # Who keeps no token has none.
        self.declared = [
            mesh.serve(mesh.keys.rcm_state, StateAsk, lambda query: query.answer(state())),
            mesh.alive(Token("anvil", Role.RCM, "rcm", "i1")),
        ]


def grants(seq: int, *holders: Holder) -> Grants:
    return Grants(TERM, seq, seq - 1, 1, {SCOUT33: list(holders)})


async def test_it_reads_the_state_and_follows_what_is_published(path: Path) -> None:
    network = MemoryNetwork()
    rcm = Leader(network)
    async with recording(path, ears(network), rcm.mesh):
        me = Sender("cart", "net")
        notice = Notice("a1", "hide", str(me), "queued", TERM, 1, reason="robot/scout33 is held by drive")
        rcm.mesh.put(rcm.mesh.keys.notice(me), notice)
        await asyncio.sleep(1)
        holder = Holder("a1", "hide", str(me), GRANT, PLACE, [SCOUT33], Decimal(5), 5, priority=1)
        rcm.mesh.put(rcm.mesh.keys.grants, grants(1, holder))
        await asyncio.sleep(1)
        rcm.mesh.put(rcm.mesh.keys.grants, grants(2))
        await asyncio.sleep(1)
    assert [state for _, state in lanes(path, "/devices/**")[f"/devices/{SCOUT33}"]] == [["hide"], [""]]
    doing = [state[0] for _, state in lanes(path, "/requests/**")["/requests/hide"]]
    assert doing == ["waiting · robot/scout33 is held by drive", "running · priority 1 · min 5 s"]
    assert "hide runs on robot/scout33" in events(path)


async def test_bars_say_who_is_in_the_way_and_events_nothing_of_comings_and_goings(path: Path) -> None:
    network = MemoryNetwork()
    queue: list[WaitView] = []
    rcm = Leader(network, lambda: RcmState(TERM, 0, "anvil", queue=queue))
    async with recording(path, ears(network), rcm.mesh) as timeline:
        node = network.open("lab", Sender("cart", "node"))
        tokens = [node.alive(Token("cart", Role.NODE, "node", "i2")), node.alive(Token("cart", Role.RC, SCOUT33, "i3"))]
        await asyncio.sleep(1)
        why = ReasonInfo("held", [SCOUT33], [ReasonParty("a0", "drive", "cart/teleop", priority=10)])
        me = Sender("cart", "net")
        notice = Notice("a1", "hide", str(me), "queued", TERM, 1, reason=REASON, why=why)
        queue.append(WaitView("a1", "hide", str(me), 1, PLACE, {SCOUT33: {}}, Decimal(5), 0.0, REASON, why=why))
        rcm.mesh.put(rcm.mesh.keys.notice(me), notice)
        await asyncio.sleep(1)
        assert list(timeline.layout(live=False).contended) == [f"/devices/{SCOUT33}"]
        for token in tokens:
            token.close()
        await asyncio.sleep(1)
        assert list(timeline.layout(live=False).absent) == [f"/devices/{SCOUT33}"]
    assert [state for _, (state,) in lanes(path, "/requests/hide")["/requests/hide"]] == [
        f"waiting · for drive: {SCOUT33}"
    ]
    assert [state for _, (state,) in lanes(path, f"/devices/{SCOUT33}")[f"/devices/{SCOUT33}"]] == ["", "not there"]
    assert events(path) == ["anvil leads", f"hide {REASON}"]
    assert [text for _, _, (text,) in rows(path, "/presence", "TextLog:text")] == [
        "node cart is there",
        f"{SCOUT33} is offered by cart",
        "node cart is gone",
        f"{SCOUT33} is gone from cart",
    ]


async def test_a_bar_names_first_who_holds_what_would_do(path: Path) -> None:
    """By the names of their lanes: which choices there are, and what their users run, is told at length elsewhere."""
    net, crew = Sender("cart", "net"), Sender("dray", "request-7e3c")
    by = [
        ReasonParty("a1", "hide", str(net), priority=1, who=Who("root", "cart", "component place_sensor_net")),
        ReasonParty("a2", "survey", str(crew), priority=1, who=Who("alice", "", "survey.py")),
        ReasonParty("a2", "survey", str(crew), priority=1, who=Who("alice", "", "survey.py")),
    ]
    choices = ["framegrabber/fg1", "framegrabber/fg2"]
    why = ReasonInfo("held", [*choices, SCOUT33], by, count=4, patterns=["framegrabber/*"] * 2 + [""])
    queue = [
        WaitView("a3", "watch", str(net), 1, PLACE, {}, Decimal(5), 0.0, "waits for one of many words", why=why),
        WaitView("a4", "film", str(net), 1, PLACE, {}, Decimal(5), 0.0, "votes are out", why=ReasonInfo("voting")),
    ]
    network = MemoryNetwork()
    rcm = Leader(network, lambda: RcmState(TERM, 0, "anvil", queue=queue))
    async with recording(path, ears(network), rcm.mesh):
        pass
    blocked = f"for hide, survey (alice): {SCOUT33}; one of framegrabber/fg1, fg2 and 1 more"
    assert {entity: [text for _, (text,) in lane] for entity, lane in lanes(path, "/requests/**").items()} == {
        "/requests/watch": [f"waiting · {blocked}"],
        "/requests/film": ["waiting · votes are out"],
    }
    assert events(path) == ["anvil leads", f"watch waits {blocked}", "film waits: votes are out"]


async def test_a_device_is_shown_as_there_as_soon_as_the_leader_says_so(path: Path) -> None:
    """After a cable was out its token may be seen before the leader has taken it in, which is not published."""
    network = MemoryNetwork()
    view = HoldView("a1", "hide", "cart/net", 1, GRANT, PLACE, {SCOUT33: {}}, Decimal(5), 0.0, 5.0)
    holds, present = [view], True
    rcm = Leader(network, lambda: RcmState(TERM, 1, "anvil", holds, rcs=[RcView(SCOUT33, present, False)]))
    node = network.open("lab", Sender("cart", "node"))
    token = node.alive(Token("cart", Role.RC, SCOUT33, "i3"))
    async with recording(path, ears(network), rcm.mesh):
        present = False
        holds.clear()
        token.close()
        await asyncio.sleep(1)
        again = node.alive(Token("cart", Role.RC, SCOUT33, "i3"))
        await asyncio.sleep(1)
        present = True
        await asyncio.sleep(2 * DOUBT_EVERY)
    again.close()
    shown = [state for _, (state,) in lanes(path, f"/devices/{SCOUT33}")[f"/devices/{SCOUT33}"]]
    assert shown[:2] == ["hide", "not there"]
    assert shown[-1] == ""


@pytest.mark.parametrize(("listed", "shown"), [([], ""), ([RcView(SCOUT33, False, False)], "not there")])
async def test_a_device_that_a_new_leader_does_not_know_yet_has_a_lane(
    listed: list[RcView], shown: str, path: Path
) -> None:
    """A leader may answer before its devices have answered it, and does not publish when it accepts them."""
    network = MemoryNetwork()
    rcm = Leader(network, lambda: RcmState(TERM, 0, "anvil", rcs=listed))
    node = network.open("lab", Sender("cart", "node"))
    token = node.alive(Token("cart", Role.RC, SCOUT33, "i3"))
    async with recording(path, ears(network), rcm.mesh):
        await asyncio.sleep(1)
        holder = Holder("a1", "hide", "cart/net", GRANT, PLACE, [SCOUT33], Decimal(5), 5)
        rcm.mesh.put(rcm.mesh.keys.grants, grants(1, holder))
        await asyncio.sleep(1)
        rcm.mesh.put(rcm.mesh.keys.grants, grants(2))
        await asyncio.sleep(1)
    token.close()
    assert [state for _, state in lanes(path, f"/devices/{SCOUT33}")[f"/devices/{SCOUT33}"]] == [
        [shown],
        ["hide"],
        [shown],
    ]


async def test_a_device_that_two_hosts_offer_is_there_without_one_of_them_and_its_hold_goes_on(path: Path) -> None:
    network = MemoryNetwork()
    view = HoldView("a1", "hide", "cart/net", 1, GRANT, PLACE, {SCOUT33: {}}, Decimal(5), 0.0, 5.0)
    rcm = Leader(network, lambda: RcmState(TERM, 1, "anvil", [view], rcs=[RcView(SCOUT33, True, False)]))
    nodes = [network.open("lab", Sender(host, "node")) for host in ("cart", "dray")]
    tokens = [node.alive(Token(node.me.host, Role.RC, SCOUT33, "i3")) for node in nodes]
    async with recording(path, ears(network), rcm.mesh):
        tokens[0].close()
        await asyncio.sleep(1)
        # Of the other, only this recorder loses sight: the leader still has the hold.
        tokens[1].close()
        tokens[1] = nodes[1].alive(Token("dray", Role.RC, SCOUT33, "i3"))
        await asyncio.sleep(1)
    shown = [state for _, (state,) in lanes(path, f"/devices/{SCOUT33}")[f"/devices/{SCOUT33}"]]
    assert shown == ["hide", "not there", "", "hide"]


async def test_who_is_preempted_is_shown_as_one_who_waits_again(path: Path) -> None:
    network = MemoryNetwork()
    rcm, me = Leader(network), Sender("cart", "net")
    who, drive = Who("alice", "cart", "sh -c ./hide"), ReasonParty("a2", "drive", "dray/c1", 10, Who("bob", "", "x"))
    async with recording(path, ears(network), rcm.mesh):
        holder = Holder("a1", "hide", str(me), GRANT, PLACE, [SCOUT33], Decimal(5), 5, priority=1, who=who)
        rcm.mesh.put(rcm.mesh.keys.grants, grants(1, holder))
        await asyncio.sleep(1)
        why = ReasonInfo("preempted", [SCOUT33], [drive])
        words = "preempted by bob@dray (x), priority 10"
        revoked = [Revocation("a1", "hide", str(me), GRANT, [SCOUT33], "preempted", words, "drive", why)]
        rcm.mesh.put(rcm.mesh.keys.grants, Grants(TERM, 2, 1, 1, {SCOUT33: []}, revoked))
        await asyncio.sleep(1)
        why = ReasonInfo("held", [SCOUT33], [drive])
        rcm.mesh.put(rcm.mesh.keys.notice(me), Notice("a1", "hide", str(me), "queued", TERM, 9, why=why, who=who))
        await asyncio.sleep(1)
        await asyncio.sleep(1)
    assert [state for _, (state,) in lanes(path, "/requests/alice/hide")["/requests/alice/hide"]][1:3] == [
        "waiting again · (preempted by drive (bob), priority 10)",
        f"waiting again · for drive (bob): {SCOUT33}",
    ]
    assert f"hide (alice) waits again for drive (bob): {SCOUT33}" in [
        state for _, (state,) in lanes(path, "/who/**")["/who/waits"]
    ]
    assert lanes(path, f"/devices/{SCOUT33}")[f"/devices/{SCOUT33}"][0][1] == ["hide (alice)"]


async def test_a_banner_says_why_the_panes_are_empty(path: Path) -> None:
    network = MemoryNetwork()
    stop = asyncio.Event()
    with Timeline("lab", path=path) as timeline:
        running = asyncio.create_task(Recorder(ears(network), default_fleet(), timeline).run(stop))
        await asyncio.sleep(1)
        assert not timeline.layout(live=True).banner
        await asyncio.sleep(2)
        assert timeline.layout(live=True).banner.startswith("Catching up: no leader is seen yet.")
        leader = Leader(network)
        await asyncio.sleep(1)
        assert not timeline.layout(live=True).banner
        for declared in leader.declared:
            declared.close()
        await asyncio.sleep(5)
        assert timeline.layout(live=True).banner.startswith("No leader since ")
        stop.set()
        await running


async def test_at_its_end_it_reads_what_was_published_and_missed(path: Path) -> None:
    network = MemoryNetwork()
    view = HoldView("a1", "hide", "cart/net", 1, GRANT, PLACE, {SCOUT33: {}}, Decimal(5), 0.0, 5.0)
    holds: list[HoldView] = []
    rcm = Leader(network, lambda: RcmState(TERM, len(holds), "anvil", holds))
    async with recording(path, ears(network), rcm.mesh):
        holds.append(view)
    assert [state for _, state in lanes(path, "/devices/**")[f"/devices/{SCOUT33}"]] == [["hide"]]


async def test_who_takes_no_pictures_does_not_look(path: Path, tmp_path: Path) -> None:
    """And who takes them looks only while the framegrabber is there."""
    network, watched = MemoryNetwork(), list[bool]()
    speaker = Leader(network).mesh
    publisher = speaker.frame_publisher(speaker.keys.frame(CAMERA))
    publisher.follow(watched.append)
    token = speaker.alive(Token("cart", Role.RC, CAMERA, "i1"))
    async with recording(path, ears(network), speaker, frames=0):
        await asyncio.sleep(10)
        assert watched == []
        async with recording(
            tmp_path / "other.rrd", network.open("lab", Sender("cook", "recorder")), speaker, frames=20
        ):
            await until(lambda: watched == [True])
            token.close()
            await until(lambda: watched == [True, False])
    publisher.close()


async def test_a_camera_of_any_kind_is_known_by_its_figures(path: Path) -> None:
    network, watched = MemoryNetwork(), dict[str, list[bool]]()
    speaker, keys = (mesh := Leader(network).mesh), mesh.keys
    for rc in ("camera/door", "psu/bench"):
        publisher = speaker.frame_publisher(keys.frame(rc))
        publisher.follow(watched.setdefault(rc, []).append)
    token = speaker.alive(Token("cart", Role.RC, "camera/door", "i1"))
    async with recording(path, ears(network), speaker, frames=2):
        for rc, figure in (("camera/door", "frames_per_second"), ("psu/bench", "volts")):
            state = RcState(rc, "cart", "i1", sharable=False, figures={figure: 5.0})
            speaker.put(keys.rc_state(rc), state)
        await until(lambda: watched["camera/door"] == [True])
        token.close()
        await until(lambda: watched["camera/door"] == [True, False])
    assert watched["psu/bench"] == []


async def test_a_part_that_raises_is_logged_and_ends_it(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    network = MemoryNetwork()
    rcm = Leader(network)
    with Timeline("lab", path=path) as timeline:
        running = asyncio.create_task(Recorder(ears(network), default_fleet(), timeline).run(asyncio.Event()))
        await asyncio.sleep(1)
        monkeypatch.setattr(timeline, "holders", lambda *_: 1 / 0)
        rcm.mesh.put(rcm.mesh.keys.grants, grants(1))
        with pytest.raises(RecorderFailed):
            await asyncio.wait_for(running, 60)
    assert "the recorder failed" in caplog.text
    assert "ZeroDivisionError" in caplog.text
