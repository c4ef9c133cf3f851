"""Every key of both files, on a plain and a secured fleet: what `--check` takes a node starts with and takes at SIGHUP,
and what a node takes its components and its recorder can read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from tests.config.test_keys import FLEET, LEAST, NODE, RC, Key
from zscout.behaviors.components import channel
from zscout.behaviors.components.channel import ComponentJob
from zscout.config import notify
from zscout.config.fleet import FleetFile
from zscout.config.node import Node, NodeFile, RecorderConfig, load_node
from zscout.messages import ComponentSpec, StartComponent
from zscout.services.node.reload import Reload
from zscout.services.recorder.process import RecorderJob, decode_job, encode_job

SECURED = """
[security]
folder = "keys"
[roles]
manager = ["anvil"]
client = ["bob"]
[roles.node]
anvil = ["*/*"]
"""
NAMED = {"groups": ("arms", '["bob"]'), "access": ('"robot/*"', '["bob"]'), "devices": ("anvil", '["robot/a"]')}
"""Tables of the fleet file whose keys are names: one of them, and its value."""
UNSECURED = {("mesh", "listen"), ("mesh", "connect"), ("roles", "client"), ("roles", "manager"), ("roles", "node")}
"""Keys whose samples belong to a plain fleet."""
HOST = "anvil"


def samples(tables: Mapping[str, Mapping[str, Key]]) -> Iterator[tuple[str, str, str, str]]:
    """Tables, how they begin at least, and a key with its value."""
    for table, keys in tables.items():
        for key, (_, good, _) in keys.items():
            for value in good[:1]:
                yield table, LEAST.get(table, f"[{table}]"), key, value


def files() -> Iterator[tuple[str, str, str, str, str]]:
    """Of which file each is, besides."""
    yield from (("fleet", *sample) for sample in samples(FLEET))
    yield from (("node", *sample) for sample in samples(NODE))
    for table, (name, value) in NAMED.items():
        yield "fleet", table, f'[roles]\nclient = ["bob"]\n[{table}]', name, value
    for driver, (least, keys) in RC.items():
        head = f'[[rc]]\ndriver = "{driver}"\n{least}'
        for _, _, key, value in samples({driver: keys}):
            yield "node", "rc", head, key, value


def driver_of(least: str) -> str:
    return least.partition('driver = "')[2].partition('"')[0]


CASES = [
    (*case, secured)
    for case in files()
    for secured in (False, True)
    if not (secured and (case[1], case[3]) in UNSECURED) and case[3] not in ("fleet", "host")
]


def test_no_table_is_forgotten() -> None:
    named = {table.partition(".")[0] for _, table, *_ in CASES}
    assert {*FleetFile.__struct_fields__, *NodeFile.__struct_fields__} - named == {"security"}


def merged(*texts: str) -> str:
    """TOML whose tables stand in several texts."""
    tables: dict[str, list[str]] = {}
    for line in "\n".join(texts).splitlines():
        if line.startswith("["):
            head = line
            tables.setdefault(head, [])
        elif line:
            name = line.partition(" = ")[0]
            tables[head] = [*(one for one in tables[head] if not one.startswith(f"{name} = ")), line]
    return "\n".join("\n".join((head, *lines)) for head, lines in tables.items())


@pytest.mark.parametrize(
    ("of", "table", "least", "key", "value", "secured"),
    CASES,
    ids=[
        f"{of}-{driver_of(least) or table}.{key}-{'secured' if secured else 'plain'}"
        for of, table, least, key, _, secured in CASES
    ],
)
async def test_a_key_is_taken_at_the_start_and_at_sighup_alike(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    of: str,
    table: str,
    least: str,
    key: str,
    value: str,
    *,
    secured: bool,
) -> None:
    monkeypatch.setattr(notify, "usable", lambda urls: [True for _ in urls])
    node, fleet = tmp_path / "node.toml", tmp_path / "fleet.toml"
    files = {
        node: f'[node]\nhost = "{HOST}"\nfleet = "fleet.toml"',
        fleet: merged('[fleet]\nname = "lab"', SECURED if secured else ""),
    }
    for file, text in files.items():
        file.write_text(text)
    running = Reload(lambda: load_node(node))
    changed = node if of == "node" else fleet
    changed.write_text(merged(files[changed], f"{least}\n{key} = {value}"))
    line = await running.now()
    assert running.in_force.fault == ""
    assert "restart this node to apply" in line
    assert table in line
    started = Reload(lambda: load_node(node))
    assert await started.now() == "SIGHUP: nothing changed"
    assert_readable(started.node)


def assert_readable(node: Node) -> None:
    """By the processes that a node starts."""
    job = ComponentJob(StartComponent("c", 1, ComponentSpec("counter")), "a:b", node.host, node.fleet, "tag")
    assert channel._unpack(channel.pack(job).rstrip(b"\n"), ComponentJob) == job
    recorder = RecorderJob(node.recorder or RecorderConfig(Path("runs"), "127.0.0.1", 1), node.fleet, node.host)
    assert decode_job(encode_job(recorder)) == recorder
