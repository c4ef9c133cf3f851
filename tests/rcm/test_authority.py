"""What a role allows beyond what keys tell, and how a refusal is told."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from zscout.config.fleet import load_fleet
from zscout.config.scheduling_policy import DEFAULT, FairShares, SchedulingPolicy
from zscout.keyexpr import Sender
from zscout.mesh import Refused
from zscout.messages import (
    ActivateComponent,
    CheckpointComponent,
    ComponentOperation,
    ComponentSpec,
    ListComponents,
    MoveComponent,
    Placement,
    ReadOutput,
    RestoreComponent,
    StartComponent,
    StopComponent,
)
from zscout.rcm.authority import Authority
from zscout.scheduling.model import ArcRequest, ArcStatus, Hold
from zscout.types import NO_TERM, SECOND, Grant, Place

FILE = """
[security]
folder = "keys"
[roles]
manager = ["anvil"]
operator = ["ada"]
client = ["bob", "eve"]
viewer = ["wall"]
[roles.node]
bellows = ["robot/*"]
[groups]
arms = ["ada", "eve"]
[access]
"robot/arm*" = ["arms"]
[quotas]
bob = { arcs = 2 }
arms = { rcs = 3 }
[ceilings.client]
runtime = 60
"""


TOO_MANY_RCS = "arms may hold 3 devices at one time, and this request needs more; name fewer"
OTHERS_MAY = "; ada, anvil, bellows, bob and 1 more may"


def authority(folder: Path, text: str = FILE) -> Authority:
    (folder / "fleet.toml").write_text(text)
    return Authority(load_fleet(folder / "fleet.toml"))


def ask(*needs: str, priority: int = 1, keep: bool = False, min_runtime: int = 5) -> ArcRequest:
    return ArcRequest("h/c1/q1", "h/c1", {need: {} for need in needs}, priority, min_runtime * SECOND, keep)


def refusal(check: Callable[[], None]) -> str:
    """Why something is not allowed; "" if it is."""
    try:
        check()
    except Refused as refused:
        problem = refused.problem
        return problem.message if problem.code == "not_allowed" else problem.code
    return ""


def test_who_is_in_several_groups_counts_in_the_first(tmp_path: Path) -> None:
    legs = FILE.replace("[access]", 'legs = ["bob", "eve"]\n[access]')
    policy = SchedulingPolicy(fair_shares=FairShares(SECOND))
    for text in (legs, legs.replace('[security]\nfolder = "keys"', "")):
        fair = authority(tmp_path, text).bound(policy).fair_shares
        assert fair is not None
        assert fair.groups == {"ada": "arms", "eve": "arms", "bob": "legs"}
    assert authority(tmp_path, legs).bound(DEFAULT).fair_shares is None


@pytest.mark.parametrize(
    ("name", "asked", "why"),
    [
        ("bob", ask("robot/scout1", priority=9), ""),
        ("bob", ask("robot/scout1", priority=10), "bob (client) may not request priority 10; at most 9; ada may"),
        ("ada", ask("robot/scout1", priority=10, keep=True, min_runtime=600), ""),
        ("anvil", ask("robot/scout1", priority=10), "anvil (manager) may not request priority 10; at most 9; ada may"),
        ("wall", ask("robot/scout1"), "wall (viewer) may not request devices" + OTHERS_MAY),
        ("mallory", ask("robot/scout1"), "mallory, which has no role here, may not request devices" + OTHERS_MAY),
        ("bob", ask("robot/arm1"), "bob (client) may not hold robot/arm1; ada, eve may"),
        ("eve", ask("robot/arm1"), ""),
        ("bob", ask("robot/*"), ""),
        ("bob", ask("robot/scout1", keep=True), ""),
        ("bob", ask("robot/scout1", min_runtime=61), "bob (client) may not request 61 s; at most 60 s; ada may"),
        ("eve", ask("a/1", "a/2", "a/3", "a/4"), TOO_MANY_RCS),
    ],
)
def test_what_a_name_may_ask_for(tmp_path: Path, name: str, asked: ArcRequest, why: str) -> None:
    told = authority(tmp_path)
    assert refusal(lambda: told.check_ask(name, asked, lambda _: 0)) == why


def test_a_name_has_no_more_arcs_open_than_its_quota(tmp_path: Path) -> None:
    told = authority(tmp_path)
    told.check_ask("bob", ask("robot/scout1"), lambda names: len(names))
    with pytest.raises(Refused, match="bob has 2 open requests, its quota; cancel one"):
        told.check_ask("bob", ask("robot/scout1"), lambda names: 2 * len(names))


def given(*needs: str, priority: int = 1, keep: bool = False, runs: bool = False) -> ArcStatus:
    """An ARC that somebody hands over."""
    request = ArcRequest("ada/c1/q1", "ada/c1", {need: {} for need in needs}, priority, 5 * SECOND, keep)
    hold = Hold(Grant(NO_TERM, 1), 0, 5 * SECOND) if runs else None
    return ArcStatus(request, Place(NO_TERM, 1), hold, request.needs, {}, 0, 0, None, None, None)


@pytest.mark.parametrize(
    ("to", "arcs", "why"),
    [
        ("bob", [given("robot/s1")], ""),
        (
            "bob",
            [given("robot/s1"), given("robot/s2")],
            "bob may have 2 open requests, and would have more; cancel some first",
        ),
        ("bob", [given("robot/arm1")], "bob (client) may not hold robot/arm1; ada, eve may"),
        ("bob", [given("robot/s1", priority=10)], "bob (client) may not request priority 10; at most 9; ada may"),
        ("bob", [given("robot/s1", keep=True)], ""),
        ("wall", [given("robot/s1")], "wall (viewer) may not take over a request" + OTHERS_MAY),
        # Of one group: it has no more than before.
        ("eve", [given("a/1", "a/2", runs=True)], ""),
        ("eve", [given("a/1", "a/2", "a/3", "a/4", runs=True)], TOO_MANY_RCS),
    ],
)
def test_who_is_handed_an_arc_has_no_more_than_it_may_ask_for(
    tmp_path: Path, to: str, arcs: list[ArcStatus], why: str
) -> None:
    told, ada, new = authority(tmp_path), Sender("ada", "c1"), Sender(to, "c1")
    assert refusal(lambda: told.check_hand_over(ada, new, arcs, lambda names: len(names), lambda _: 3)) == why


def test_who_is_handed_a_hold_has_no_more_rcs_than_its_quota(tmp_path: Path) -> None:
    told, to, arcs = authority(tmp_path), Sender("eve", "c1"), [given("a/1", runs=True)]
    told.check_hand_over(Sender("bob", "c1"), to, arcs, lambda _: 0, lambda _: 2)
    told.check_hand_over(Sender("bob", "c1"), to, [given("a/1")], lambda _: 0, lambda _: 3)
    with pytest.raises(Refused, match="arms may hold 3 devices at one time, and would hold more; release some first"):
        told.check_hand_over(Sender("bob", "c1"), to, arcs, lambda _: 0, lambda _: 3)


def test_the_scheduler_is_told_of_quotas_and_of_what_a_pattern_is_not_bound_to(tmp_path: Path) -> None:
    policy = authority(tmp_path).bound(DEFAULT)
    assert {
        name: [(one.name, sorted(one.owners), one.rcs) for one in quotas] for name, quotas in policy.rc_quotas.items()
    } == {"ada": [("arms", ["ada", "eve"], 3)], "eve": [("arms", ["ada", "eve"], 3)]}
    assert policy.barred == dict.fromkeys(("anvil", "bellows", "bob", "wall"), ("robot/arm$*",))


def test_who_is_named_no_more_has_no_rights_once_the_file_is_read_again(tmp_path: Path) -> None:
    told = authority(tmp_path)
    assert not told.is_removed("bob/c1")
    (tmp_path / "fleet.toml").write_text(FILE.replace('"bob", "eve"', '"eve"').replace("bob = { arcs = 2 }", ""))
    told.reload(load_fleet(tmp_path / "fleet.toml"))
    assert told.is_removed("bob/c1")
    with pytest.raises(Refused, match="bob, which has no role here, may not request devices"):
        told.check_ask("bob", ask("robot/scout1"), lambda _: 0)


def test_without_certificates_nothing_is_refused(tmp_path: Path) -> None:
    told = authority(tmp_path, FILE.replace('[security]\nfolder = "keys"', ""))
    told.check_ask("mallory", ask("robot/arm1", priority=1_000_000, keep=True), lambda _: 1_000)
    told.check_operator(Sender("mallory", "c1"), "drain hosts")
    assert told.bound(DEFAULT) == DEFAULT
    assert not told.is_removed("mallory/c1")


DAY = 86_400


@pytest.mark.parametrize(
    ("ceiling", "name", "longest"),
    [
        ("", "bob", DAY),
        ("", "anvil", DAY),
        ("", "ada", 0),
        ("[ceilings.client]\npriority = 3", "bob", DAY),
        ("[ceilings.operator]\npriority = 30", "ada", 0),
        ('[ceilings.client]\nruntime = "7d"', "bob", 7 * DAY),
        ("[ceilings.client]\nruntime = 0", "bob", 0),
    ],
)
def test_a_client_is_protected_for_a_day_at_most_unless_the_file_says_more(
    tmp_path: Path, ceiling: str, name: str, longest: int
) -> None:
    text = FILE.replace("[ceilings.client]\nruntime = 60", ceiling)
    assert authority(tmp_path, text).longest_runtime(name) == longest * SECOND
    assert authority(tmp_path, text.replace('[security]\nfolder = "keys"', "")).longest_runtime(name) == 0


def test_a_component_counts_against_the_quotas_of_its_starter(tmp_path: Path) -> None:
    """Where the placer has put it: a node can't charge to others what they did not place there."""
    told = authority(tmp_path)
    spec = ComponentSpec("counter", owner="bob")
    told.placed = {"c": Placement("c", spec, "running", 7, "anvil", to="bellows")}
    assert [told.starter(f"{host}/c.8") for host in ("anvil", "bellows", "ada")] == ["bob", "bob", ""]
    assert told.starter("anvil/other.1") == ""
    told.placed = {"c": Placement("c", ComponentSpec("counter", owner="mallory"), "running", 7, "anvil")}
    assert told.starter("anvil/c.8") == ""
    its = ArcRequest("anvil/c.8/q", "anvil/c.8", {"robot/s1": {}}, 1, SECOND, charged_to="bob")
    assert its.owner == "bob"
    with pytest.raises(Refused, match="bob has 2 open requests, its quota; cancel one"):
        told.check_ask("anvil", its, lambda names: 2 if "bob" in names else 0)


COMPONENT: dict[str, ComponentOperation] = {
    "start": StartComponent("c", 8, ComponentSpec("counter")),
    "stop": StopComponent("c", 8),
    "stop any": StopComponent("c"),
    "checkpoint": CheckpointComponent("c"),
    "move": MoveComponent("c", 7, "bellows", 8),
    "restore": RestoreComponent("c", 8, b"", []),
    "activate": ActivateComponent("c", 8),
    "list": ListComponents(),
    "output": ReadOutput("c"),
}


@pytest.mark.parametrize(
    ("sender", "may"),
    [
        (Sender("wall", "x"), {"list", "output"}),
        (Sender("bob", "c.7"), {"list", "output"}),
        (Sender("ada", "x"), {"list", "output", "stop", "stop any"}),
        (Sender("bellows", "x"), {"list", "output"}),
        (Sender("bellows", "c.7"), {"list", "output", "stop", "restore", "activate"}),
        (Sender("bellows", "c.8"), {"list", "output"}),
        (Sender("bellows", "d.7"), {"list", "output"}),
        (Sender("anvil", "rcm"), set(COMPONENT)),
    ],
)
def test_what_a_name_may_order_a_node_to_do(tmp_path: Path, sender: Sender, may: set[str]) -> None:
    told = authority(tmp_path)
    assert {
        name for name, order in COMPONENT.items() if not refusal(partial(told.check_component, sender, order))
    } == may


@pytest.mark.parametrize(
    ("text", "min_runtime", "until_done"),
    [
        ("", 60, 3600),
        ("", 59, 0),  # it would rank before others and still hold for an hour
        ('[fleet]\nmin_runtime = 20\ncommand_min_runtime = "2h"', 20, 7200),
        ("[limits]\nmax_runtime = 600", 60, 600),
        (FILE, 60, 60),
    ],
)
def test_a_command_is_protected_as_the_fleet_and_its_role_allow(
    tmp_path: Path, text: str, min_runtime: int, until_done: int
) -> None:
    assert authority(tmp_path, text).until_done("bob", min_runtime * SECOND) == until_done * SECOND


def test_a_reload_changes_how_long_commands_are_protected(tmp_path: Path) -> None:
    known = authority(tmp_path, "")
    (tmp_path / "fleet.toml").write_text("[fleet]\ncommand_min_runtime = 600")
    known.reload(load_fleet(tmp_path / "fleet.toml"))
    assert known.until_done("bob", 60 * SECOND) == 600 * SECOND
