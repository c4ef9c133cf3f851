"""Fleet files: what good ones mean, and the exact line that each kind of bad one ends in."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.config.kit import ENDPOINT_RULE, NAME_RULE, short, write
from zscout.config.fleet import (
    FLEET_VARIABLE,
    Fleet,
    MeshConfig,
    RcmLimits,
    Timing,
    default_fleet,
    fleet_from_env,
    load_fleet,
)
from zscout.config.scheduling_policy import FairShares, SchedulingPolicy
from zscout.config.strict import BadInput
from zscout.types import SECOND

CLOSED = '[security]\nfolder = "k"\n[roles]\nmanager = ["a"]\n'
SYNTAX = "fix the TOML there or just before"

BAD_FLEETS = """
x =  | line 1, column 5, the end: Invalid value; fix the TOML there or just before
x = 1 / x = 2 | line 2, column 6, the end: Cannot overwrite a value; fix the TOML there or just before
[flet] | flet: unknown key; did you mean fleet?
[fleet] / candiates = [] | fleet.candiates: unknown key; did you mean candidates?
[limits] / max_needed = 1 | limits.max_needed: unknown key; did you mean max_needs or max_queued?
[fleet] / zzz = 1 | fleet.zzz: unknown key;
fleet = "lab" | fleet: is the text "lab"; write a table, under [fleet]
[[fleet]] | fleet: is a list; write a table, under [fleet]
[fleet] / name = "a b" | fleet.name: "a b" is not a name; write 1 to 64 letters A to Z, digits, "_", "." or "-"
[fleet] / candidates = "anvil" | fleet.candidates: is the text "anvil"; write a list
[fleet] / candidates = ["a", 1] | fleet.candidates[1]: is 1; write a text in quotes
[fleet] / candidates = ["a", "b", "a"] | fleet.candidates[2]: "a" is already at fleet.candidates[0];
[fleet] / strategy = "fifo" | fleet.strategy: is the text "fifo"; write "adaptive", "optimal" or "priority"
[fleet] / patience = -1 | fleet.patience: is -1 s; write 0 to 31622400 seconds
[fleet] / patience = nan | fleet.patience: is not a finite number; write a number
[fair_shares] / patience = 100 | fair_shares.patience: is 100 s, less than fleet.patience (142 s);
[fleet] / operator_priority = 1.0 | fleet.operator_priority: is 1.0; write a whole number from 0 to 1000000000
[fleet] / operator_priority = true | fleet.operator_priority: is true; write a whole number from 0 to 1000000000
[mesh] / lease = 0.1 | mesh.lease: is 0.1; write a number from 0.2 to 30
[mesh] / lease = 1979-05-27 | mesh.lease: is a date or a time; write a number from 0.2 to 30
[mesh] / lease = "soon" | mesh.lease: "soon" is not a duration;
[mesh] / lease = "100ms" | mesh.lease: is 0.100; write a number from 0.2 to 30
[fleet] / min_runtime = "0s" | fleet.min_runtime: is 0 s; write 0.001 to 31622400 seconds
[mesh] / listen = ["tcp/127.0.0.1"] | mesh.listen[0]: "tcp/127.0.0.1" is not an endpoint;
[mesh] / listen = ["tcp/a:0", "ipx/a:1"] | mesh.listen[1]: "ipx/a:1" is not an endpoint;
[mesh] / connect = ["tcp/1.2.3:7"] | mesh.connect[0]: "tcp/1.2.3:7" is not an endpoint;
[mesh] / connect = ["tcp/[::g]:7"] | mesh.connect[0]: "tcp/[::g]:7" is not an endpoint;
[mesh] / connect = ["tcp/anvil:0"] | mesh.connect[0]: "tcp/anvil:0" has no valid port; write one from 1 to 65535
[mesh] / listen = ["tcp/anvil:70000"] | mesh.listen[0]: "tcp/anvil:70000" has no valid port; write one from 0 to 65535
[mesh] / connect = ["tcp/a:1", "tcp/a:1"] | mesh.connect[1]: "tcp/a:1" is already at mesh.connect[0];
[mesh] / multicast = 1 | mesh.multicast: is 1; write true or false
[mesh] / multicast_address = "10.0.0.1:7446" | mesh.multicast_address: "10.0.0.1:7446" is not a multicast address;
[limits] / max_needs = 0 | limits.max_needs: is 0; write a whole number from 1 to 1000
[limits] / max_payload = 1e400 | limits.max_payload: is 1E+400; write a whole number from 1024 to 16777216
[timing] / rebuild = 1e99999999999999999999 | timing.rebuild: is not a finite number; write a number
[timing] / rebuild = 1e30 | timing.rebuild: is too large; write a number below 1e18
[timing] / rebuild = 1e-200 | timing.rebuild: has more than 100 decimal places; round it
[timing] / heartbeat = 1.5 | timing.hold_lease: is 3 s; write more than 2 * timing.heartbeat, which is 3 s
[timing] / hold_lease = 1.2 | timing.hold_lease: is 1.2 s; write more than mesh.lease + timing.rebuild, which is 1.2 s
[mesh] / lease = 2.9 | timing.hold_lease: is 3 s; write more than mesh.lease + timing.rebuild, which is 3.1 s
[mesh] / relay = ["a", "b"] | mesh.relay: unknown key;
[security] | security.folder: is missing; add it
[security] / folder = "" | security.folder: "" is not a folder; name one, as in folder = "/etc/zscout/keys"
[security] / folder = "k" | roles: [security] needs a host that may lead; write manager = ["anvil"] under [roles]
[roles] / viewer = ["a"] / client = ["a"] | roles.client: "a" already has the role viewer;
[roles] / operator = ["a"] / manager = ["a"] | roles.manager: "a" already has the role operator;
[roles.node] / a = ["robot"] | roles.node.a[0]: "robot" does not name a device;
[groups] / arms = ["a"] | groups.arms[0]: "a" has no role; name it under [roles], or correct the name
[roles] / client = ["a"] / [groups] / a = ["a"] | groups.a: "a" is also a name with a role; rename the group
[access] / "robot/x" = ["arms"] | access."robot/x"[0]: "arms" has no role; name it under [roles], or correct the name
[quotas] / a = { rcs = 1 } | quotas.a: "a" has no role; name it under [roles], or correct the name
[ceilings.viewer] / priority = 1 | ceilings.viewer: only clients and operators have a ceiling; write "client" or
"""
"""The file, and how the line begins."""
BAD_FLEETS_BY_TEXT = {
    "\n[fleet\nname = 1": f"line 2, column 7: Expected ']' at the end of a table declaration; {SYNTAX}",
    "x = " + "1" * 5000: "a whole number has thousands of digits; shorten it",
    "x = " + "[" * 5000: "is nested too deep; use fewer levels",
    "\n" + ".".join(["a"] * 300_000) + " = 1": "line 2 has a dotted key of more than 32 parts; shorten it",
    "[" + " . ".join(['"\\""', "'b'"] * 60_000) + "]": "line 1 has a dotted key of more than 32 parts; shorten it",
    '"a\\u001b\\nb" = 1': r'"a\x1b\nb": unknown key; known here: access, ceilings, devices, fair_shares, '
    "fleet, groups, limits, mesh, placement, quotas, roles, security, timing",
    "[fleet]\nname = '''a\n'''": rf'fleet.name: "a\n" is not a name; {NAME_RULE}',
    f'[fleet]\nname = "{"x" * 65}"': f'fleet.name: "{"x" * 60}..." is not a name; {NAME_RULE}',
    f"[fleet]\ncandidates = {['a'] * 1001}": "fleet.candidates: has 1,001 entries; at most 1,000 are allowed",
    '[fleet]\npromise = "all"\npatience = 0': (
        'fleet.promise: is "all", but needs the strategy "adaptive" with some patience; '
        'write strategy = "adaptive" and a patience above 0, or promise = "equals"'
    ),
    '[fleet]\npromise = "all"\nstrategy = "optimal"': (
        'fleet.promise: is "all", but needs the strategy "adaptive" with some patience; '
        'write strategy = "adaptive" and a patience above 0, or promise = "equals"'
    ),
    '[fair_shares]\n[fleet]\nstrategy = "priority"': (
        'fair_shares: needs the strategy "adaptive", not "priority"; '
        'write strategy = "adaptive" under [fleet], or remove the table'
    ),
    '[roles]\nclient = ["bob"]\n[groups]\narms = ["bob"]\n[fair_shares.weights]\nbob = 2': (
        'fair_shares.weights.bob: "bob" belongs to the group arms; give the group a weight'
    ),
    '[roles]\nclient = ["bob"]\n[fair_shares.weights]\nlegs = 2': (
        'fair_shares.weights.legs: "legs" is not a group and has no role; add it under [groups], or correct it'
    ),
    '[mesh]\nconnect = ["tcp/[::fff1:1:2:3:4:5:6:7:8]:7"]': (
        f'mesh.connect[0]: "tcp/[::fff1:1:2:3:4:5:6:7:8]:7" is not an endpoint; {ENDPOINT_RULE}'
    ),
    CLOSED + '[mesh]\nlisten = ["tcp/0.0.0.0:7447"]': (
        'mesh.listen[0]: "tcp/0.0.0.0:7447" is not TLS; write tls/host:port, or remove [security]'
    ),
    CLOSED + '[fleet]\ncandidates = ["b"]': "fleet.candidates[0]: b is not a manager; name it as one under [roles]",
    CLOSED + '[devices]\nb = ["robot/x"]': "devices.b: b may not serve robot/x; add it to b under [roles.node]",
}


def fleet(text: str) -> Fleet:
    return load_fleet(write("lab.toml", text))


ROWS = {text.replace(" / ", "\n"): line for text, line in (row.split(" | ") for row in BAD_FLEETS.strip().splitlines())}


@pytest.mark.parametrize(("text", "line"), (ROWS | BAD_FLEETS_BY_TEXT).items(), ids=short)
def test_bad_fleet_file(text: str, line: str) -> None:
    with pytest.raises(BadInput) as caught:
        fleet(text)
    assert str(caught.value).startswith(f"lab.toml: {line}")


def test_an_empty_fleet_file_means_the_defaults() -> None:
    assert fleet("") == default_fleet()
    assert fleet("").scheduling == SchedulingPolicy()


def test_every_key_of_a_fleet_file() -> None:
    made = fleet(
        """
        [fleet]
        name = "lab"
        candidates = ["anvil", "bench"]
        strategy = "adaptive"
        operator_priority = 7
        preempt = "after_min_runtime"
        preempt_budget = 0.5
        patience = 2.5
        promise = "all"
        min_runtime = "1m30s"
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
        max_requests_per_host = 4
        max_payload = 4096
        max_running_per_host = 5
        max_runtime = "1d12h"
        max_booking = "2d"
        max_bookings_per_host = 7
        [timing]
        heartbeat = 0.1
        hold_lease = 5
        vote_timeout = 0.3
        rebuild = 1.25
        """
    )
    assert made == Fleet(
        name="lab",
        candidates=("anvil", "bench"),
        strategy="adaptive",
        scheduling=SchedulingPolicy(
            "after_min_runtime", 7, 0.5, 5 * SECOND // 2, "all", 5, 129_600 * SECOND, 172_800 * SECOND
        ),
        mesh=MeshConfig(
            listen=("tcp/0.0.0.0:0", "tls/[::]:7447", "tcp/anvil.lab:7447#iface=eth0"),
            connect=("quic/10.0.0.2:7447", "udp/[fe80::1]:1", "ws/bench:65535"),
            multicast=False,
            multicast_address="[ff02::1]:7446",
            interface="eth0,wlan0",
            lease=2.0,
        ),
        limits=RcmLimits(1, 2, 3, 4, 4096, 5, 129_600 * SECOND, 172_800 * SECOND, 7),
        timing=Timing(SECOND // 10, 5 * SECOND, 3 * SECOND // 10, 5 * SECOND // 4),
        min_runtime=90 * SECOND,
    )
    assert isinstance(made.mesh.lease, float)


def test_durations_are_numbers_or_texts() -> None:
    made = fleet('[mesh]\nlease = "2s"\n[timing]\nhold_lease = "1m"\nheartbeat = "300ms"\nrebuild = 0.5')
    assert (made.mesh.lease, made.timing) == (2.0, Timing(3 * SECOND // 10, 60 * SECOND, SECOND // 4, SECOND // 2))


def test_fair_shares_are_off_unless_the_file_says_so() -> None:
    assert default_fleet().scheduling.fair_shares is None
    made = fleet('[fair_shares]\nhalf_life = "12h"\n[fair_shares.weights]\nws1 = 2')
    assert made.scheduling.fair_shares == FairShares(43_200 * SECOND, {"ws1": 2.0})
    assert fleet("[fair_shares]").scheduling.fair_shares == FairShares(86_400 * SECOND)


def test_nobody_is_protected_for_longer_than_a_hold_lasts() -> None:
    assert fleet('[limits]\nmax_runtime = "30s"').min_runtime == 30 * SECOND
    assert fleet('[limits]\nmax_runtime = "30s"').scheduling.max_booking == 30 * SECOND


def test_the_fleet_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    assert fleet_from_env() == default_fleet()
    monkeypatch.setenv(FLEET_VARIABLE, "")
    assert fleet_from_env() == default_fleet()
    monkeypatch.setenv(FLEET_VARIABLE, str(write("lab.toml", '[fleet]\nname = "lab"')))
    assert fleet_from_env().name == "lab"
    monkeypatch.setenv(FLEET_VARIABLE, "no.toml")
    with pytest.raises(BadInput, match=r"^no\.toml: there is no such file; .* \(named by \$ZSCOUT_FLEET\)$"):
        fleet_from_env()


def test_a_byte_order_mark_is_no_error() -> None:
    Path("lab.toml").write_bytes(b"\xef\xbb\xbf[fleet]\r\nname = 'lab'\r\n")
    assert load_fleet(Path("lab.toml")).name == "lab"


def test_an_error_is_one_printable_line_whatever_the_file_says() -> None:
    path = write("l\x1b[31m\nab.toml", '"\\u001b[2J\\u202e\\n" = 1')
    with pytest.raises(BadInput) as caught:
        load_fleet(path)
    assert str(caught.value).isprintable()
