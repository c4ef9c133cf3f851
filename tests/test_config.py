"""Fleet and node files: what good ones mean, and the exact line that each kind of bad one ends in."""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import pytest

from zscout import config, strict
from zscout.scheduling.model import SECOND
from zscout.scheduling.policy import Policy
from zscout.strict import BadInput, Where

NAME_RULE = 'write 1 to 64 letters A to Z, digits, "_", "." or "-"'
RC_RULE = 'write kind/name, as in "robot/scout33", each of 1 to 64 letters A to Z, digits, "_", "." or "-"'
ENDPOINT_RULE = 'write protocol/host:port, as in "tcp/127.0.0.1:7447"; protocols: tcp, tls, udp, quic, ws'
MULTICAST_RULE = 'write ip:port, as in "224.0.0.224:7446"'
SYNTAX = "mend the TOML there or just before"

BAD_FLEETS = {
    # TOML itself
    "x = ": f"line 1, column 5, the end: Invalid value; {SYNTAX}",
    "x = 1\nx = 2": f"line 2, column 6, the end: Cannot overwrite a value; {SYNTAX}",
    "\n[fleet\nname = 1": f"line 2, column 7: Expected ']' at the end of a table declaration; {SYNTAX}",
    "x = " + "1" * 5000: "a whole number has thousands of digits; shorten it",
    "x = " + "[" * 5000: "is nested too deep; no key goes deeper than a few tables",
    "\n" + ".".join(["a"] * 300_000) + " = 1": "line 2 has a dotted key of more than 32 parts; shorten it",
    "["
    + " . ".join(['"\\""', "'b'"] * 60_000)
    + "]": "line 1 has a dotted key of more than 32 parts; shorten it",
    # Keys and tables
    "[flet]": "flet: unknown key; did you mean fleet?",
    "[fleet]\ncandiates = []": "fleet.candiates: unknown key; did you mean candidates?",
    "[limits]\nmax_needed = 1": "limits.max_needed: unknown key; did you mean max_needs or max_queued?",
    "[fleet]\nzzz = 1": "fleet.zzz: unknown key; known here: candidates, name, operator_priority, "
    "patience, preempt, promise, strategy",
    '"a\\u001b\\nb" = 1': r'"a\x1b\nb": unknown key; known here: fleet, limits, mesh, placement, timing',
    'fleet = "lab"': 'fleet: is the text "lab"; write a table, under [fleet]',
    "[[fleet]]": "fleet: is a list; write a table, under [fleet]",
    # [fleet]
    '[fleet]\nname = "a b"': f'fleet.name: "a b" is not a name; {NAME_RULE}',
    '[fleet]\nname = ""': f'fleet.name: "" is not a name; {NAME_RULE}',
    "[fleet]\nname = '''a\n'''": rf'fleet.name: "a\n" is not a name; {NAME_RULE}',
    f'[fleet]\nname = "{"x" * 65}"': f'fleet.name: "{"x" * 60}..." is not a name; {NAME_RULE}',
    '[fleet]\ncandidates = "anvil"': 'fleet.candidates: is the text "anvil"; write a list',
    '[fleet]\ncandidates = ["a", 1]': "fleet.candidates[1]: is 1; write a text in quotes",
    '[fleet]\ncandidates = ["a", ""]': f'fleet.candidates[1]: "" is not a name; {NAME_RULE}',
    '[fleet]\ncandidates = ["a", "b", "a"]': (
        'fleet.candidates[2]: "a" stands at fleet.candidates[0] already; rename or remove one of the two'
    ),
    f"[fleet]\ncandidates = {['a'] * 1001}": "fleet.candidates: has 1,001 entries; at most 1,000 are allowed",
    '[fleet]\nstrategy = "fifo"': (
        'fleet.strategy: is the text "fifo"; write "adaptive", "optimal" or "priority"'
    ),
    '[fleet]\npreempt = "never"': 'fleet.preempt: is the text "never"; write "after_min_runtime" or "always"',
    "[fleet]\npatience = -1": "fleet.patience: is -1 s; write 0 to 31622400 seconds",
    "[fleet]\npatience = nan": "fleet.patience: is not a finite number; write a number",
    '[fleet]\npromise = "all"\npatience = 0': (
        'fleet.promise: is "all", but only "adaptive" with some patience promises anything; '
        'write strategy = "adaptive" and a patience above 0, or promise = "equals"'
    ),
    '[fleet]\npromise = "all"\nstrategy = "optimal"': (
        'fleet.promise: is "all", but only "adaptive" with some patience promises anything; '
        'write strategy = "adaptive" and a patience above 0, or promise = "equals"'
    ),
    "[limits]\nmax_running_per_host = -1": (
        "limits.max_running_per_host: is -1; write a whole number from 0 to 100000"
    ),
    "[fleet]\noperator_priority = -1": (
        "fleet.operator_priority: is -1; write a whole number from 0 to 1000000000"
    ),
    "[fleet]\noperator_priority = 1.0": (
        "fleet.operator_priority: is 1.0; write a whole number from 0 to 1000000000"
    ),
    "[fleet]\noperator_priority = true": (
        "fleet.operator_priority: is true; write a whole number from 0 to 1000000000"
    ),
    # [mesh]
    "[mesh]\nlease = 0.1": "mesh.lease: is 0.1; write a number from 0.2 to 30",
    "[mesh]\nlease = nan": "mesh.lease: is not a finite number; write a number from 0.2 to 30",
    "[mesh]\nlease = 1979-05-27": "mesh.lease: is a date or a time; write a number from 0.2 to 30",
    '[mesh]\nlease = "1"': 'mesh.lease: is the text "1"; write a number from 0.2 to 30',
    '[mesh]\nlisten = ["tcp/127.0.0.1"]': (
        f'mesh.listen[0]: "tcp/127.0.0.1" is not an endpoint; {ENDPOINT_RULE}'
    ),
    '[mesh]\nlisten = ["tcp/a:0", "ipx/a:1"]': (
        f'mesh.listen[1]: "ipx/a:1" is not an endpoint; {ENDPOINT_RULE}'
    ),
    '[mesh]\nconnect = ["tcp/1.2.3:7"]': (
        f'mesh.connect[0]: "tcp/1.2.3:7" is not an endpoint; {ENDPOINT_RULE}'
    ),
    '[mesh]\nconnect = ["tcp/[::g]:7"]': (
        f'mesh.connect[0]: "tcp/[::g]:7" is not an endpoint; {ENDPOINT_RULE}'
    ),
    '[mesh]\nconnect = ["tcp/[::fff1:1:2:3:4:5:6:7:8]:7"]': (
        f'mesh.connect[0]: "tcp/[::fff1:1:2:3:4:5:6:7:8]:7" is not an endpoint; {ENDPOINT_RULE}'
    ),
    '[mesh]\nconnect = ["tcp/anvil:0"]': (
        'mesh.connect[0]: "tcp/anvil:0" has no valid port; write one from 1 to 65535'
    ),
    '[mesh]\nlisten = ["tcp/anvil:70000"]': (
        'mesh.listen[0]: "tcp/anvil:70000" has no valid port; write one from 0 to 65535'
    ),
    '[mesh]\nconnect = ["tcp/a:1", "tcp/a:1"]': (
        'mesh.connect[1]: "tcp/a:1" stands at mesh.connect[0] already; rename or remove one of the two'
    ),
    "[mesh]\nmulticast = 1": "mesh.multicast: is 1; write true or false",
    '[mesh]\nmulticast_address = "10.0.0.1:7446"': (
        f'mesh.multicast_address: "10.0.0.1:7446" is not a multicast address; {MULTICAST_RULE}'
    ),
    '[mesh]\nmulticast_address = "224.0.0.224"': (
        f'mesh.multicast_address: "224.0.0.224" is not a multicast address; {MULTICAST_RULE}'
    ),
    '[mesh]\ninterface = ""': 'mesh.interface: "" names no interface; write "auto", or as in "eth0"',
    # [limits]
    "[limits]\nmax_needs = 0": "limits.max_needs: is 0; write a whole number from 1 to 1000",
    "[limits]\nmax_payload = 1e400": (
        "limits.max_payload: is 1E+400; write a whole number from 1024 to 16777216"
    ),
    # [timing]
    "[timing]\nheartbeat = 0": "timing.heartbeat: is 0 s; write 0.05 to 10 seconds",
    "[timing]\nrebuild = -0.1": "timing.rebuild: is -0.1 s; write 0.01 to 10 seconds",
    "[timing]\nrebuild = inf": "timing.rebuild: is not a finite number; write a number",
    "[timing]\nrebuild = 1e99999999999999999999": "timing.rebuild: is not a finite number; write a number",
    "[timing]\nrebuild = 1e30": "timing.rebuild: is too large; write a number below 1e18",
    "[timing]\nrebuild = 1e-200": "timing.rebuild: has more than 100 decimal places; round it",
    "[timing]\nheartbeat = 1.5": (
        "timing.hold_lease: is 3 s; write more than 2 * timing.heartbeat, which is 3 s"
    ),
    "[timing]\nhold_lease = 1.2": (
        "timing.hold_lease: is 1.2 s; write more than mesh.lease + timing.rebuild, which is 1.2 s"
    ),
    "[mesh]\nlease = 2.9": (
        "timing.hold_lease: is 3 s; write more than mesh.lease + timing.rebuild, which is 3.1 s"
    ),
}

ROBOT = '[[rc]]\nname = "robot/a"\ndriver = "exclusive"\n'
RADIO = '[[rc]]\nname = "radio/r"\ndriver = "capacity"\n'

BAD_PLACEMENTS = {
    "[placement]\nback_off = 0": "placement.back_off: is 0 s; write 0.05 to 3600 seconds",
    "[placement]\ngain = 0": "placement.gain: is 0; write a number from 0.05 to 100",
    '[placement]\nrebalance = "yes"': 'placement.rebalance: is the text "yes"; write true or false',
}
BAD_FLEETS |= BAD_PLACEMENTS
BAD_NODES = {
    '[node]\nhots = "a"': "node.hots: unknown key; did you mean host?",
    '[node]\nhost = "a/b"': f'node.host: "a/b" is not a name; {NAME_RULE}',
    '[node]\nhost = ""': f'node.host: "" is not a name; {NAME_RULE}',
    '[node]\nload = "yes"': 'node.load: is the text "yes"; write true, false or "tree"',
    "[node]\nload = 1": 'node.load: is 1; write true, false or "tree"',
    '[components]\nkinds = ["a b"]': f'components.kinds[0]: "a b" is not a name; {NAME_RULE}',
    "[components]\nmax = 0": "components.max: is 0; write a whole number from 1 to 256",
    "[node]\nfleet = 1": "node.fleet: is 1; write a text in quotes",
    '[node]\nlabels = "gpu"': 'node.labels: is the text "gpu"; write a list',
    '[node]\nlabels = ["gpu", "a b"]': f'node.labels[1]: "a b" is not a name; {NAME_RULE}',
    '[node]\nlabels = ["gpu", "gpu"]': (
        'node.labels[1]: "gpu" stands at node.labels[0] already; rename or remove one of the two'
    ),
    f"[node]\nlabels = {['a'] * 33}": "node.labels: has 33 entries; at most 32 are allowed",
    "[mesh]\nlease = 1": "mesh.lease: unknown key; known here: connect, interface, listen",
    '[mesh]\nconnect = ["anvil"]': f'mesh.connect[0]: "anvil" is not an endpoint; {ENDPOINT_RULE}',
    '[mesh]\ninterface = "a b"': 'mesh.interface: "a b" names no interface; write "auto", or as in "eth0"',
    '[rc]\nname = "robot/a"': "rc: is a table; write tables, each under [[rc]]",
    "rc = [1]": "rc[0]: is 1; write a table",
    '[[rc]]\ndriver = "exclusive"': "rc[0].name: is missing; add it",
    '[[rc]]\nname = "robot/a"': "rc[0].driver (robot/a): is missing; add it",
    '[[rc]]\nname = "robot"\ndriver = "exclusive"': (
        f'rc[0].name: "robot" is not the name of an RC; {RC_RULE}'
    ),
    '[[rc]]\nname = "a/b/c"\ndriver = "exclusive"': (
        f'rc[0].name: "a/b/c" is not the name of an RC; {RC_RULE}'
    ),
    '[[rc]]\nname = "robot/a"\ndriver = "fast"': (
        'rc[0].driver (robot/a): is the text "fast"; write "capacity" or "exclusive"'
    ),
    ROBOT + RADIO + "capacity = { a = 1 }\n" + ROBOT: (
        'rc[2].name: "robot/a" stands at rc[0] already; rename or remove one of the two'
    ),
    ROBOT + "capacity = {}": (
        'rc[0].capacity (robot/a): the driver "exclusive" has none; remove it, or write driver = "capacity"'
    ),
    ROBOT + RADIO: (
        "rc[1].capacity (radio/r): is missing or empty; add one, as in capacity = { command_rate = 10 }"
    ),
    RADIO + "capacity = {}": (
        "rc[0].capacity (radio/r): is missing or empty; add one, as in capacity = { command_rate = 10 }"
    ),
    RADIO + "capacity = { rate = -1 }": "rc[0].capacity.rate (radio/r): is -1; write 0 or more",
    RADIO + "capacity = { rate = nan }": (
        "rc[0].capacity.rate (radio/r): is not a finite number; write a number"
    ),
    RADIO + 'capacity = { rate = "10" }': 'rc[0].capacity.rate (radio/r): is the text "10"; write a number',
    RADIO + 'capacity = { "a b" = 1 }': f'rc[0].capacity (radio/r): "a b" is not a name; {NAME_RULE}',
    ROBOT + "activation = -1": "rc[0].activation (robot/a): is -1 s; write 0 to 3600 seconds",
    ROBOT + "activation = 3601": "rc[0].activation (robot/a): is 3601 s; write 0 to 3600 seconds",
    ROBOT + "actvation = 1": "rc[0].actvation (robot/a): unknown key; did you mean activation?",
    '[recorder]\nbind = "0.0.0.0"': (
        'recorder.bind: "0.0.0.0" shows the recording to other hosts; '
        'write "127.0.0.1", or add allow_remote = true if that is meant'
    ),
    '[recorder]\nbind = "anvil"': (
        'recorder.bind: "anvil" is not an IP address; write one, as in "127.0.0.1"'
    ),
    "[recorder]\nport = 0": "recorder.port: is 0; write a whole number from 1 to 65535",
    '[recorder]\npath = ""': 'recorder.path: "" is no folder; name one, as in path = "runs"',
}


@pytest.fixture(autouse=True)
def _in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(config.FLEET_VARIABLE, raising=False)


def write(name: str, text: str) -> Path:
    path = Path(name)
    path.write_text(text)
    return path


def fleet(text: str) -> config.Fleet:
    return config.load_fleet(write("lab.toml", text))


def node(text: str) -> config.Node:
    return config.load_node(write("node.toml", text))


def short(text: str) -> str:
    return re.sub(r"\s+", " ", text)[:50]


@pytest.mark.parametrize(("text", "line"), BAD_FLEETS.items(), ids=map(short, BAD_FLEETS))
def test_bad_fleet_file(text: str, line: str) -> None:
    with pytest.raises(BadInput) as caught:
        fleet(text)
    assert str(caught.value) == f"lab.toml: {line}"


@pytest.mark.parametrize(("text", "line"), BAD_NODES.items(), ids=map(short, BAD_NODES))
def test_bad_node_file(text: str, line: str) -> None:
    with pytest.raises(BadInput) as caught:
        node(text)
    assert str(caught.value) == f"node.toml: {line}"


def test_an_empty_fleet_file_means_the_defaults() -> None:
    made = fleet("")
    assert made == config.default_fleet()
    assert (made.name, made.candidates, made.strategy, made.operator_priority) == (
        "zscout",
        (),
        "adaptive",
        10,
    )
    assert made.policy == Policy()
    assert made.mesh == config.Mesh(
        listen=(),
        connect=(),
        multicast=True,
        multicast_address="224.0.0.224:7446",
        interface="auto",
        lease=1.0,
    )
    assert made.limits == config.Limits(10_000, 64, 256, 65_536)
    assert made.timing == config.Timing(500_000_000, 3_000_000_000, 250_000_000, 200_000_000)


def test_every_key_of_a_fleet_file() -> None:
    made = fleet(
        """
        [fleet]
        name = "lab"
        candidates = ["anvil", "bench"]
        strategy = "adaptive"
        operator_priority = 7
        preempt = "after_min_runtime"
        patience = 2.5
        promise = "all"
        [mesh]
        listen = ["tcp/0.0.0.0:0", "tls/[::]:7447", "tcp/anvil.lab:7447#iface=eth0"]
        connect = ["quic/10.0.0.2:7447", "udp/[fe80::1]:1", "ws/bench:65535"]
        multicast = false
        multicast_address = "[ff02::1]:7446"
        interface = "eth0,wlan0"
        lease = 2
        [limits]
        max_queued = 1
        max_needs = 2
        max_requests_per_client = 3
        max_payload = 4096
        max_running_per_host = 5
        [timing]
        heartbeat = 0.1
        hold_lease = 5
        vote_timeout = 0.3
        rebuild = 1.25
        """
    )
    assert made == config.Fleet(
        name="lab",
        candidates=("anvil", "bench"),
        strategy="adaptive",
        policy=Policy("after_min_runtime", 7, 5 * SECOND // 2, "all", 5),
        mesh=config.Mesh(
            listen=("tcp/0.0.0.0:0", "tls/[::]:7447", "tcp/anvil.lab:7447#iface=eth0"),
            connect=("quic/10.0.0.2:7447", "udp/[fe80::1]:1", "ws/bench:65535"),
            multicast=False,
            multicast_address="[ff02::1]:7446",
            interface="eth0,wlan0",
            lease=2.0,
        ),
        limits=config.Limits(1, 2, 3, 4096, 5),
        timing=config.Timing(SECOND // 10, 5 * SECOND, 3 * SECOND // 10, 5 * SECOND // 4),
    )
    assert isinstance(made.mesh.lease, float)


def test_every_key_of_a_node_file() -> None:
    write(
        "lab.toml", '[fleet]\nname = "lab"\n[mesh]\nlisten = ["tcp/a:1"]\nconnect = ["tcp/a:2"]\nlease = 0.5'
    )
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
    made = config.load_node(path)
    assert made.fleet.name == "lab"
    assert made.fleet.mesh == config.Mesh(
        listen=("tcp/a:1",), connect=("tcp/b:3",), interface="eth1", lease=0.5
    )
    assert (made.host, made.candidate, made.load) == ("anvil", False, False)
    assert made.labels == ("gpu", "arm64")
    assert made.rcs == (
        config.RcSpec("robot/scout33", "exclusive", {}, 2_500_000_000),
        config.RcSpec("radio/rf0", "capacity", {"command_rate": Fraction(10), "share": Fraction(1, 10)}, 0),
    )
    assert made.recorder == config.Recorder(Path("hosts/tapes"), "0.0.0.0", 1234)  # noqa: S104


def test_an_empty_node_file_means_the_defaults() -> None:
    made = node("")
    assert made == config.default_node()
    assert (made.fleet, made.candidate, made.load, made.rcs) == (config.default_fleet(), True, True, ())
    assert (made.recorder, made.labels) == (None, ())
    assert strict.check_name(made.host, Where("host")) == made.host


def test_an_empty_recorder_table_records_on_loopback() -> None:
    recorder = node("[recorder]").recorder
    assert recorder == config.Recorder(Path("runs"), "127.0.0.1", 9876)
    assert node('[recorder]\nbind = "localhost"').recorder == recorder
    other = node('[recorder]\nbind = "::1"').recorder
    assert other is not None
    assert ipaddress.ip_address(other.bind).is_loopback


@pytest.mark.parametrize(
    ("hostname", "host"),
    [("anvil.lab", "anvil.lab"), ("my host!", "my-host-"), ("x" * 70, "x" * 64), ("", "unnamed")],
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


def test_the_fleet_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    assert config.fleet_from_env() == config.default_fleet()
    monkeypatch.setenv(config.FLEET_VARIABLE, "")
    assert config.fleet_from_env() == config.default_fleet()
    monkeypatch.setenv(config.FLEET_VARIABLE, str(write("lab.toml", '[fleet]\nname = "lab"')))
    assert config.fleet_from_env().name == "lab"
    monkeypatch.setenv(config.FLEET_VARIABLE, "no.toml")
    with pytest.raises(BadInput, match=r"^no\.toml: there is no such file; .* \(named by \$ZSCOUT_FLEET\)$"):
        config.fleet_from_env()


# Files as such


@contextmanager
def nobody() -> Iterator[None]:
    """Not root for a while: root may read everything."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    def line(path: Path) -> str:
        with pytest.raises(BadInput) as caught:
            strict.read_text(path, max_bytes=10)
        return str(caught.value)

    assert line(Path("none")) == "none: there is no such file; check the path"
    Path("folder").mkdir()
    assert line(Path("folder")) == "folder: is a directory; name a file in it"
    os.mkfifo("fifo")
    assert line(Path("fifo")) == "fifo: is not a regular file; name a file on disk"
    assert line(Path("/dev/null")) == "/dev/null: is not a regular file; name a file on disk"
    write("full", "0123456789")
    assert strict.read_text(Path("full"), max_bytes=10) == "0123456789"
    assert line(Path("full/x")) == "full/x: can't be read: Not a directory; check the path"
    write("big", "0123456789a")
    assert line(Path("big")) == "big: has more than 10 bytes; shorten or split it"
    Path("latin").write_bytes(b"a\n\nb\xe4")
    assert line(Path("latin")) == "latin: line 3 is not UTF-8; save the file as UTF-8"
    write("closed", "").chmod(0)
    with nobody():
        found = line(tmp_path / "closed")
    assert found == f"{tmp_path}/closed: may not be read by this user; change its permissions, or the user"


def test_a_byte_order_mark_is_no_error() -> None:
    Path("lab.toml").write_bytes(b"\xef\xbb\xbf[fleet]\r\nname = 'lab'\r\n")
    assert config.load_fleet(Path("lab.toml")).name == "lab"


def test_an_error_is_one_printable_line_whatever_the_file_says() -> None:
    path = write("l\x1b[31m\nab.toml", '"\\u001b[2J\\u202e\\n" = 1')
    with pytest.raises(BadInput) as caught:
        config.load_fleet(path)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("seconds", "ns"),
    [("0", 0), ("1.5", 1_500_000_000), ("0.0000000005", 0), ("0.0000000015", 2), ("0.00000000050000001", 1)],
)
def test_seconds_are_rounded_to_whole_ns_with_halves_to_even(seconds: str, ns: int) -> None:
    assert strict.seconds_to_ns(Decimal(seconds), Where("f")) == ns


@pytest.mark.parametrize("seconds", ["-0.000000001", "nan", "inf", "-inf", "1000000000.1", "1e999999"])
def test_seconds_out_of_range(seconds: str) -> None:
    where = Where("f") / "at"
    with pytest.raises(BadInput) as caught:
        strict.seconds_to_ns(Decimal(seconds), where)
    assert str(caught.value) == f"f: at: is {Decimal(seconds)} s; write 0 to 1000000000 seconds"


def test_exact_loses_nothing() -> None:
    assert strict.exact(Decimal("0.1")) + strict.exact(Decimal("0.2")) == strict.exact(Decimal("0.3"))


def test_a_place_is_written_as_toml_writes_keys() -> None:
    where = ((Where("f") / "arc").item(2, "arc2") / "needs" / "robot/scout33" / 'a"b\\c') / "rate"
    assert where.key == r'arc[2].needs."robot/scout33"."a\"b\\c".rate'
    assert str(where.bad("what", "remedy")) == f"f: {where.key} (arc2): what; remedy"
    assert str(Where("f").bad("what", "remedy")) == "f: what; remedy"
