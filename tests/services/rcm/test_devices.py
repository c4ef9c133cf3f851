"""Devices that a fleet expects: what is remembered of them, and how they are shown when they have gone."""

from __future__ import annotations

from zscout.keyexpr import Role, Token
from zscout.messages import Parameter, RcState, RcView
from zscout.rcm.devices import REMEMBERED, ExpectedDevices, SeenHome, homes_in
from zscout.types import SECOND, Ns

ARM = "robot/arm"
BOUND = [Parameter("rate")]
"""What it knows."""


def token(host: str, instance: str = "i", rc: str = ARM) -> Token:
    return Token(host, Role.RC, rc, instance)


def shown(devices: ExpectedDevices, now: Ns, *, named: str | None = None, present: bool = False) -> RcView:
    return devices.view(RcView(ARM, present, sharable=False), now, named)


def test_one_that_went_is_expected_for_a_day_with_where_it_was() -> None:
    devices = ExpectedDevices({})
    devices.token_came(token("ws1"))
    devices.token_went(token("ws1"), 100 * SECOND)
    view = shown(devices, 160 * SECOND)
    assert (view.host, view.reason, view.gone) == ("ws1", "the node of ws1 is gone", 60.0)
    devices.forget_old(100 * SECOND + REMEMBERED)
    assert ARM in devices.names
    devices.forget_old(101 * SECOND + REMEMBERED)
    assert ARM not in devices.names


def test_the_reason_tells_a_host_that_is_gone_from_one_that_has_it_no_more() -> None:
    devices = ExpectedDevices({})
    devices.token_came(token("ws1"))
    devices.token_came(token("ws1", "other", "robot/b"))
    devices.token_went(token("ws1"), 0)
    assert shown(devices, 0).reason == "it is gone from ws1"
    devices.token_went(token("ws1", "other", "robot/b"), SECOND)
    assert shown(devices, SECOND).reason == "the node of ws1 is gone"
    devices.stopped(ARM, "ws1")
    assert shown(devices, SECOND).reason == "it is stopped at ws1"
    devices.token_came(token("ws1", "new"))
    view = shown(devices, SECOND, named="ws1", present=True)
    assert (view.host, view.reason, view.gone) == ("ws1", "", None)


def test_one_that_the_fleet_file_names_is_expected_though_it_was_never_there() -> None:
    devices = ExpectedDevices({"ws1": (ARM,)})
    view = shown(devices, 0)
    assert (view.host, view.reason, view.gone) == ("ws1", "it has not been seen at ws1 yet", None)
    assert devices.home_of(ARM) == "ws1"
    devices.forget_old(10 * REMEMBERED)
    assert ARM in devices.names


def test_of_several_homes_the_others_are_told_those_that_live_and_those_that_are_not_seen() -> None:
    devices = ExpectedDevices({})
    for host in ("ws1", "ws2", "ws3"):
        devices.token_came(token(host, host))
    devices.token_went(token("ws3", "ws3"), 5 * SECOND)
    view = shown(devices, 7 * SECOND, named="ws2", present=True)
    assert (view.host, view.duplicates, view.unseen) == ("ws2", ["ws1"], {"ws3": 2.0})
    # One that was stopped on purpose is no other owner.
    devices.stopped(ARM, "ws3")
    assert shown(devices, 7 * SECOND, named="ws2", present=True).unseen == {}
    devices.forget_old(8 * SECOND)
    assert [home.host for home in devices.homes(8 * SECOND)] == ["ws1", "ws2"]


def test_two_instances_of_one_host_hide_no_death() -> None:
    devices = ExpectedDevices({})
    devices.token_came(token("ws1", "old"))
    devices.token_came(token("ws1", "new"))
    devices.token_went(token("ws1", "old"), SECOND)
    assert shown(devices, SECOND).gone is None
    devices.token_went(token("ws1", "new"), 2 * SECOND)
    assert shown(devices, 3 * SECOND).gone == 1.0


def test_what_another_knows_is_taken_where_nothing_better_is_known() -> None:
    now = 5_000 * SECOND
    leader, late = ExpectedDevices({}), ExpectedDevices({})
    leader.token_came(token("ws1"))
    leader.report(RcState(ARM, "ws1", "i", sharable=True, parameters=BOUND))
    leader.token_went(token("ws1"), now - 60 * SECOND)
    leader.stopped(ARM, "ws1")
    views = [shown(leader, now)]
    late.remember(homes_in(views), now + 10 * SECOND)
    view = shown(late, now + 10 * SECOND)
    assert (view.host, view.gone, view.reason) == ("ws1", 60.0, "it is stopped at ws1")
    assert (view.sharable, view.parameters) == (True, BOUND)
    # It sees the token: that is better than anybody's word.
    late.token_came(token("ws1", "back"))
    late.remember(homes_in(views), now + 20 * SECOND)
    assert shown(late, now + 20 * SECOND, named="ws1", present=True).gone is None
    # Older news than its own.
    late.token_went(token("ws1", "back"), now + 30 * SECOND)
    late.remember([SeenHome(ARM, "ws1", 100.0, "long ago")], now + 31 * SECOND)
    assert (shown(late, now + 31 * SECOND).gone, shown(late, now).reason) == (1.0, "the node of ws1 is gone")


def test_a_list_of_devices_has_all_homes_of_each() -> None:
    devices, other = ExpectedDevices({}), ExpectedDevices({})
    for host in ("ws1", "ws2", "ws3"):
        devices.token_came(token(host, host))
    devices.token_went(token("ws3", "ws3"), 0)
    other.remember(homes_in([shown(devices, 4 * SECOND, named="ws1", present=True)]), 4 * SECOND)
    assert {home.host: home.ago for home in other.homes(4 * SECOND)} == {"ws1": 0.0, "ws2": 0.0, "ws3": 4.0}


def test_what_is_no_name_or_too_old_is_not_remembered() -> None:
    devices = ExpectedDevices({})
    devices.remember(
        [SeenHome("robot", "ws1"), SeenHome(ARM, "w s"), SeenHome("\x1b/a", "ws1"), SeenHome(ARM, "ws1", 86_401.0)], 0
    )
    assert not devices.names


def test_who_follows_no_tokens_any_more_knows_of_nobody_that_it_lives() -> None:
    devices = ExpectedDevices({})
    devices.token_came(token("ws1"))
    devices.forget_tokens(10 * SECOND)
    assert (shown(devices, 12 * SECOND).gone, shown(devices, 12 * SECOND).reason) == (2.0, "the node of ws1 is gone")
