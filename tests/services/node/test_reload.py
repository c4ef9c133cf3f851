"""A node that reads its files again: what is taken, what waits for a restart, and what is no settings at all."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.mesh.kit import run
from zscout.config.node import Node, load_node
from zscout.services.node.reload import Reload, settings

NODE = """
[node]
host = "anvil"
fleet = "fleet.toml"
[components]
max = 3
[[rc]]
name = "robot/a"
driver = "exclusive"
"""
FLEET = """
[fleet]
name = "lab"
[mesh]
lease = 1.5
[devices]
anvil = ["robot/a"]
"""


class Files:
    """A node file and its fleet file, rewritten at will."""

    def __init__(self, folder: Path) -> None:
        self.file, self._fleet = folder / "anvil.toml", folder / "fleet.toml"
        self.write(NODE, FLEET)
        self.reload = Reload(lambda: load_node(self.file))

    def write(self, node: str, fleet: str = FLEET) -> None:
        self.file.write_text(node)
        self._fleet.write_text(fleet)

    def again(self, node: str, fleet: str = FLEET) -> str:
        self.write(node, fleet)
        return run(self.reload.now())


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return Files(tmp_path)


def test_what_somebody_takes_is_given_to_it_once(files: Files) -> None:
    given: list[int] = []
    files.reload.takes(lambda node: given.append(node.components.max), "components")
    assert files.again(NODE) == "SIGHUP: nothing changed"
    new = NODE.replace("max = 3", 'max = 4\nkinds = ["counter"]')
    assert files.again(new) == "SIGHUP: applied components.kinds, components.max"
    assert files.again(new) == "SIGHUP: nothing changed"
    assert given == [4]


def test_what_nobody_takes_waits_for_a_restart_and_is_told(files: Files, caplog: pytest.LogCaptureFixture) -> None:
    files.reload.takes(lambda _node: None, "components")
    node = NODE.replace("max = 3", "max = 4").replace("robot/a", "robot/b")
    fleet = FLEET.replace("1.5", "2.0") + 'bellows = ["robot/c"]\n[limits]\nmax_runtime = 60\n'
    later = "restart this node to apply devices.bellows, limits.max_runtime, mesh.lease, rc.robot/a, rc.robot/b"
    caplog.set_level(logging.INFO)
    assert files.again(node, fleet) == f"SIGHUP: applied components.max; {later}"
    assert files.again(node, fleet) == f"SIGHUP: {later}"
    assert [(one.levelname, one.message) for one in caplog.records] == [
        ("WARNING", f"SIGHUP: applied components.max; {later}"),
        ("WARNING", f"SIGHUP: {later}"),
    ]


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda text: text.replace("max = 3", "max = 0"), "components.max: is 0; write a whole number from 1 to 256"),
        (lambda text: text + "oops = [", "fix the TOML there"),
        (lambda text: text.replace('"exclusive"', '"laser"'), 'no driver "laser" is installed here'),
        (lambda text: text.replace("fleet.toml", "none.toml"), "none.toml"),
    ],
)
def test_a_bad_file_changes_nothing_and_is_told(files: Files, spoil: Callable[[str], str], said: str) -> None:
    given: list[Node] = []
    files.reload.takes(given.append, "components")
    line = files.again(spoil(NODE.replace("robot/a", "robot/b")))
    assert line.startswith("SIGHUP: ")
    assert said in line
    assert line.endswith("; keeping the previous settings")
    assert "\n" not in line
    assert said in files.reload.in_force.fault
    assert files.again(NODE) == "SIGHUP: nothing changed"
    assert given == []
    assert files.reload.in_force.fault == ""


def test_one_that_fails_to_take_it_keeps_nobody_else_from_it(files: Files, caplog: pytest.LogCaptureFixture) -> None:
    def fail(_node: Node) -> None:
        raise KeyError("a fault of its own")

    given: list[Node] = []
    files.reload.takes(fail, "mesh")
    files.reload.takes(given.append, "components")
    line = files.again(NODE.replace("max = 3", "max = 4"), FLEET.replace("1.5", "2.0"))
    assert line == "SIGHUP: applied components.max; restart this node to apply mesh.lease"
    assert len(given) == 1
    assert "the new [mesh] can't be applied" in caplog.messages
    assert files.reload.in_force.fault == (
        "mesh.lease: can't be applied: KeyError('a fault of its own'); restart this node"
    )


def test_every_setting_of_both_files_has_the_name_that_it_has_there(files: Files) -> None:
    tables = {key.partition(".")[0] for key in settings(load_node(files.file))}
    ours = {"node", "components", "journal", "rc"}
    assert tables == ours | {"fleet", "mesh", "limits", "timing", "placement", "devices", "roles"}


RIGHTS = """
[security]
folder = "keys"
[roles]
manager = ["anvil"]
client = ["ada", "bob"]
[roles.node]
anvil = ["robot/*"]
[groups]
rcs = ["ada", "bob"]
[quotas.rcs]
rcs = 4
"""


@pytest.mark.parametrize(
    ("quota", "said"),
    [
        ("[quotas.eve]\nrcs = 1", 'fleet.toml: quotas.eve: "eve" has no role'),
        ("[quotas.bob]\nrcs = -1", "fleet.toml: quotas.bob.rcs: is -1"),
        ('[quotas.bob]\nrcs = "many"', "fleet.toml: quotas.bob.rcs: is the text"),
        ("[quotas.bob]\nrc = 1", "fleet.toml: quotas.bob.rc: "),
        ("[quotas]\nbob = 1", "fleet.toml: quotas.bob: "),
    ],
)
def test_a_wrong_quota_keeps_the_rights_in_force_and_is_told_until_it_is_mended(
    files: Files, quota: str, said: str
) -> None:
    """A name is removed in the same edit: it is removed once the mistake is mended."""
    given: list[Node] = []
    files.reload.takes(given.append, "roles", "quotas")
    assert "took groups.rcs" not in files.again(NODE, FLEET + RIGHTS)
    before, removed = files.reload.in_force.rights, RIGHTS.replace('client = ["ada", "bob"]', 'client = ["ada"]')
    removed = removed.replace('rcs = ["ada", "bob"]', 'rcs = ["ada"]')
    files.again(NODE, FLEET + RIGHTS.replace("rcs = 4", "rcs = 4\n" + quota))
    assert said in files.reload.in_force.fault
    assert files.reload.in_force.rights == before
    assert [node.fleet.access.ranks_of("bob") for node in given] == [{"client"}]
    files.again(NODE, FLEET + removed)
    assert files.reload.in_force.fault == ""
    assert files.reload.in_force.rights != before
    assert [node.fleet.access.ranks_of("bob") for node in given] == [{"client"}, set()]


def test_rights_are_taken_once_for_all_tables(files: Files) -> None:
    given: list[Node] = []
    files.reload.takes(given.append, "roles", "groups", "quotas")
    line = files.again(NODE, FLEET + RIGHTS)
    assert line.startswith(
        "SIGHUP: applied groups.rcs, quotas.rcs.rcs, roles.client, roles.manager, roles.node.anvil; "
    )
    assert len(given) == 1


def test_the_digest_is_that_of_the_rights_in_whatever_order(files: Files) -> None:
    def digest(fleet: str) -> str:
        files.write(NODE, FLEET + fleet)
        return Reload(lambda: load_node(files.file)).in_force.rights

    assert digest("") == ""
    assert digest(RIGHTS) == digest(RIGHTS.replace('"ada", "bob"', '"bob", "ada"'))
    assert digest(RIGHTS) != digest(RIGHTS.replace("rcs = 4", "rcs = 3"))
    assert digest(RIGHTS) != digest(RIGHTS.replace('client = ["ada", "bob"]', 'operator = ["ada", "bob"]'))


async def test_a_fault_of_zscout_ends_no_reload(files: Files, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever goes wrong, the next SIGHUP is heard."""
    monkeypatch.setattr("zscout.services.node.reload.settings", lambda _node: [][0])
    line = await files.reload.now()
    assert "the files can't be used: IndexError" in line
    monkeypatch.undo()
    assert await files.reload.now() == "SIGHUP: nothing changed"
