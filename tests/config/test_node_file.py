"""Node files: what good ones mean, and the exact line that each kind of bad one ends in."""

from __future__ import annotations

import socket
from decimal import Decimal
from pathlib import Path

import pytest

from tests.config.kit import NAME_RULE, RC_RULE, short, write
from zscout.config import strict
from zscout.config.devices import CapacityRc, ExclusiveRc
from zscout.config.fleet import MeshConfig, default_fleet
from zscout.config.node import Node, RecorderConfig, default_node, load_node
from zscout.config.strict import BadInput, Where

ROBOT = '[[rc]]\nname = "robot/a"\ndriver = "exclusive"\n'
UNSHOWN = "has the wrong form (not shown, it may be a secret)"
RADIO = '[[rc]]\nname = "radio/r"\ndriver = "capacity"\n'

BAD_NODES = {
    '[node]\nhots = "a"': "node.hots: unknown key; did you mean host?",
    '[node]\nhost = "a/b"': f'node.host: "a/b" is not a name; {NAME_RULE}',
    '[node]\nload = "yes"': 'node.load: is the text "yes"; write true, false or "tree"',
    "[notify]": "notify: has neither urls nor users; add either, or remove the table",
    '[node]\ncandidate = false\n[notify]\nurls = ["json://a"]': "notify: only the leader sends notices, "
    "and this host never leads; move it to a candidate",
    # No secret is shown.
    '[notify]\nurls = "json://user:secret@a"': f"notify.urls: {UNSHOWN}; "
    'write texts in a list, as in ["mailtos://user:password@example.org"]',
    '[notify]\nusers = { ada = "json://user:secret@a" }': f"notify.users: {UNSHOWN}; "
    'write a table of lists, as in users = { ada = ["ntfys://ada-lab"] }',
    '[notify]\nusers = { ada = ["json:/user:secret@a"] }': "notify.users.ada[0]: is neither a URL nor the name of "
    "a file; write one, as in mailtos://user:password@example.org",
    f"[node]\nlabels = {['a'] * 33}": "node.labels: has 33 entries; at most 32 are allowed",
    "[mesh]\nlease = 1": "mesh.lease: unknown key; known here: connect, interface, listen, relay, site",
    '[mesh]\nrelay = ["a"]': 'mesh.relay: joins a to no other site; name the sites, as in ["north", "south"]',
    '[mesh]\nrelay = ["a", "b"]\n[recorder]': "recorder: a relay can't record; record on the node of a site",
    '[mesh]\nsite = "a"\nrelay = ["a", "b"]': "mesh.site: a relay belongs to no single site; remove site, or relay",
    '[mesh]\ninterface = "a b"': (
        'mesh.interface: "a b" is not an interface; write "auto", or the name of one, as in "eth0"'
    ),
    '[rc]\nname = "robot/a"': "rc: is a table; write tables, each under [[rc]]",
    "rc = [1]": "rc[0]: is 1; write a table",
    '[[rc]]\ndriver = "exclusive"': "rc[0].name: is missing; add it",
    '[[rc]]\nname = "robot/a"': "rc[0].driver (robot/a): is missing; add it",
    '[[rc]]\nname = "robot"\ndriver = "exclusive"': (f'rc[0].name: "robot" is not the name of a device; {RC_RULE}'),
    '[[rc]]\nname = "a/b/c"\ndriver = "exclusive"': (f'rc[0].name: "a/b/c" is not the name of a device; {RC_RULE}'),
    '[[rc]]\nname = "robot/a"\ndriver = "very fast"': f'rc[0].driver (robot/a): "very fast" is not a name; {NAME_RULE}',
    '[[rc]]\nname = "robot"\ndriver = "fast"': f'rc[0].name: "robot" is not the name of a device; {RC_RULE}',
    ROBOT + RADIO + "capacity = { a = 1 }\n" + ROBOT: (
        'rc[2].name: "robot/a" is already at rc[0]; rename or remove one of the two'
    ),
    ROBOT + "capacity = {}": (
        'rc[0].capacity (robot/a): driver "exclusive" does not take it; remove it, or write driver = "capacity"'
    ),
    ROBOT + RADIO: ("rc[1].capacity (radio/r): is missing or empty; add one, as in capacity = { command_rate = 10 }"),
    RADIO + "capacity = { rate = -1 }": "rc[0].capacity.rate (radio/r): is -1; write 0 or more",
    RADIO + 'capacity = { "a b" = 1 }': f'rc[0].capacity (radio/r): "a b" is not a name; {NAME_RULE}',
    ROBOT + "actvation = 1": "rc[0].actvation (robot/a): unknown key; did you mean activation?",
    '[recorder]\nbind = "0.0.0.0"': (
        'recorder.bind: "0.0.0.0" shows the recording to other hosts; '
        'write "127.0.0.1", or add allow_remote = true if that is meant'
    ),
    '[recorder]\nbind = "anvil"': ('recorder.bind: "anvil" is not an IP address; write one, as in "127.0.0.1"'),
    '[recorder]\npath = ""': 'recorder.path: "" is not a folder; name one, as in path = "runs"',
}


def node(text: str) -> Node:
    return load_node(write("node.toml", text))


@pytest.mark.parametrize(("text", "line"), BAD_NODES.items(), ids=map(short, BAD_NODES))
def test_bad_node_file(text: str, line: str) -> None:
    with pytest.raises(BadInput) as caught:
        node(text)
    assert str(caught.value) == f"node.toml: {line}"


@pytest.mark.live
@pytest.mark.slow
def test_a_url_that_apprise_can_not_use_is_not_shown() -> None:
    with pytest.raises(BadInput) as caught:
        node('[notify]\nurls = ["none://user:secret@a"]')
    assert str(caught.value) == (
        "node.toml: notify.urls[0]: is not a URL that Apprise supports (not shown: it may hold a secret); "
        "https://appriseit.com shows the form for each service"
    )


def test_every_key_of_a_node_file() -> None:
    write("lab.toml", '[fleet]\nname = "lab"\n[mesh]\nlisten = ["tcp/a:1"]\nconnect = ["tcp/a:2"]\nlease = 0.5')
    Path("hosts").mkdir()
    path = write(
        "hosts/node.toml",
        """
        [node]
        host = "anvil"
        fleet = "../lab.toml"
        candidate = false
        load = false
        labels = ["gpu", "arm64"]
        [mesh]
        connect = ["tcp/b:3"]
        interface = "eth1"
        [[rc]]
        name = "robot/scout33"
        driver = "exclusive"
        activation = 2.5
        [[rc]]
        name = "radio/rf0"
        driver = "capacity"
        capacity = { command_rate = 10, share = 0.1 }
        [recorder]
        path = "tapes"
        bind = "0.0.0.0"
        port = 1234
        allow_remote = true
        """,
    )
    made = load_node(path)
    assert made.fleet.name == "lab"
    assert made.fleet.mesh == MeshConfig(listen=("tcp/a:1",), connect=("tcp/b:3",), interface="eth1", lease=0.5)
    assert (made.host, made.candidate, made.load) == ("anvil", False, False)
    assert made.labels == ("gpu", "arm64")
    assert made.rcs == (
        ExclusiveRc(name="robot/scout33", activation=2_500_000_000),
        CapacityRc(name="radio/rf0", capacity={"command_rate": Decimal(10), "share": Decimal("0.1")}),
    )
    assert made.recorder == RecorderConfig(Path("hosts/tapes"), "0.0.0.0", 1234)  # noqa: S104


def test_a_relay_is_of_no_site_though_the_fleet_file_names_one(tmp_path: Path) -> None:
    (tmp_path / "fleet.toml").write_text('[mesh]\nsite = "north"\n')
    path = tmp_path / "relay.toml"
    path.write_text('[node]\nfleet = "fleet.toml"\n[mesh]\nrelay = ["north", "south"]\n')
    mesh = load_node(path).fleet.mesh
    assert (mesh.site, mesh.relay) == (None, ("north", "south"))


def test_an_empty_node_file_means_the_defaults() -> None:
    made = node("")
    assert made == default_node()
    assert (made.fleet, made.recorder) == (default_fleet(), None)
    strict.check_name(made.host, Where("host"))


def test_an_empty_recorder_table_records_on_loopback() -> None:
    recorder = node("[recorder]").recorder
    assert recorder == RecorderConfig(Path("runs"), "127.0.0.1", 9876)
    assert node('[recorder]\nbind = "localhost"').recorder == recorder


@pytest.mark.parametrize(
    ("hostname", "host"), [("anvil.lab", "anvil.lab"), ("my host!", "my-host-"), ("x" * 70, "x" * 64), ("", "unnamed")]
)
def test_the_host_is_named_by_its_hostname(hostname: str, host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: hostname)
    assert node("").host == host


def test_a_fleet_file_that_a_node_file_names() -> None:
    def line(text: str) -> str:
        with pytest.raises(BadInput) as caught:
            node(text)
        return str(caught.value)

    by = "(named by node.fleet in node.toml)"
    assert line('[node]\nfleet = "no.toml"') == f"no.toml: there is no such file; check the path {by}"
    assert line('[node]\nfleet = ""') == f".: is a directory; name a file in it {by}"
    assert line('[node]\nfleet = "a\\u0000b"') == rf"a\x00b: is not a file name; check the path {by}"
    write("lab.toml", "[fleet]\nname = 1")
    assert line('[node]\nfleet = "lab.toml"') == f"lab.toml: fleet.name: is 1; write a text in quotes {by}"
