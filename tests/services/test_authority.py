"""What a role allows beyond what keys tell, and how a refusal is told."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import pytest

from zscout.config.fleet import load_fleet
from zscout.config.scheduling_policy import DEFAULT
from zscout.keyexpr import Sender
from zscout.mesh import Refused
from zscout.messages import Ask
from zscout.services.authority import Authority

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


def authority(folder: Path, text: str = FILE) -> Authority:
    (folder / "fleet.toml").write_text(text)
    return Authority(load_fleet(folder / "fleet.toml"))


def ask(*needs: str, priority: int = 1, keep: bool = False, min_runtime: int = 5) -> Ask:
    return Ask("q1", "survey", {need: {} for need in needs}, priority, Decimal(min_runtime), keep)


@pytest.mark.parametrize(
    ("name", "asked", "why"),
    [
        ("bob", ask("robot/scout1", priority=9), ""),
        ("bob", ask("robot/scout1", priority=10), "bob (client) may not ask for priority 10; at most 9; ada may"),
        ("ada", ask("robot/scout1", priority=10, keep=True, min_runtime=600), ""),
        ("anvil", ask("robot/scout1", priority=10), "anvil (manager) may not ask for priority 10; at most 9; ada may"),
        ("wall", ask("robot/scout1"), "wall (viewer) may not ask for an ARC; ada, anvil, bellows, bob and 1 more may"),
        (
            "mallory",
            ask("robot/scout1"),
            "mallory, who has no role here, may not ask for an ARC; ada, anvil, bellows, bob and 1 more may",
        ),
        ("bob", ask("robot/arm1"), "bob (client) may not hold robot/arm1; ada, eve may"),
        ("eve", ask("robot/arm1"), ""),
        ("bob", ask("robot/*"), ""),
        ("bob", ask("robot/scout1", keep=True), "bob (client) may not keep a hold; ada may"),
        ("bob", ask("robot/scout1", min_runtime=61), "bob (client) may not ask for 61 s; at most 60; ada may"),
        ("eve", ask("a/1", "a/2", "a/3", "a/4"), "arms may hold 3 RCs at one time, and this asks for more"),
    ],
)
def test_what_a_name_may_ask_for(tmp_path: Path, name: str, asked: Ask, why: str) -> None:
    told = authority(tmp_path)
    if not why:
        told.check_ask(Sender(name, "c1"), asked, lambda _: 0)
        return
    with pytest.raises(Refused) as refused:
        told.check_ask(Sender(name, "c1"), asked, lambda _: 0)
    assert (refused.value.problem.code, refused.value.problem.message) == ("not_allowed", why)


def test_a_name_has_no_more_arcs_open_than_its_quota(tmp_path: Path) -> None:
    told = authority(tmp_path)
    told.check_ask(Sender("bob", "c1"), ask("robot/scout1"), lambda names: len(names))
    with pytest.raises(Refused, match="bob has 2 ARCs open, its quota; release or cancel one"):
        told.check_ask(Sender("bob", "c1"), ask("robot/scout1"), lambda names: 2 * len(names))


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
    with pytest.raises(Refused, match="bob, who has no role here, may not ask for an ARC"):
        told.check_ask(Sender("bob", "c1"), ask("robot/scout1"), lambda _: 0)


def test_without_certificates_nothing_is_refused(tmp_path: Path) -> None:
    told = authority(tmp_path, FILE.replace('[security]\nfolder = "keys"', ""))
    told.check_ask(Sender("mallory", "c1"), ask("robot/arm1", priority=1_000_000, keep=True), lambda _: 1_000)
    told.check_operator(Sender("mallory", "c1"), "drain hosts")
    assert told.bound(DEFAULT) == DEFAULT
    assert not told.is_removed("mallory/c1")
