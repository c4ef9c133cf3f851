"""Every key of the fleet file and of the node file, with values that are taken and some that are not.

That a key has its default is seen by this: a file with the key at that value means what a file without it means, and
with another value it does not. Types and bounds as they are declared: `tests/surface`. The exact lines of errors:
`test_fleet_file.py`, `test_node_file.py` and `test_devices.py`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest

from tests.config.kit import write
from zscout.config import notify
from zscout.config.fleet import load_fleet
from zscout.config.node import load_node
from zscout.config.strict import BadInput

UNKNOWN: Final = "zz_no_such_key"


class Key(NamedTuple):
    """One key: its default as TOML (None: it has none), values that are taken, and some that are not."""

    default: str | None
    good: tuple[str, ...]
    bad: tuple[str, ...]


def _number(default: str, low: str, high: str, below: str, above: str) -> Key:
    return Key(default, (low, high), (below, above, '"one"', "nan" if "." in default else "1.5"))


def _served(port: str) -> dict[str, Key]:
    return {
        "bind": Key('"127.0.0.1"', ('"::1"', '"localhost"\nport = 9'), ('"0.0.0.0"', '"anvil"')),
        "port": _number(port, "1", "65_535", "0", "65_536"),
        "allow_remote": Key("false", ('true\nbind = "0.0.0.0"',), TRUTH),
    }


TRUTH: Final = ('"yes"', "1")
ROLES: Final = ("viewer", "client", "operator", "manager", "relay")
NAMES: Final = ('"a/b"', '""', "5")

FLEET: Final[Mapping[str, Mapping[str, Key]]] = {
    "fleet": {
        "name": Key('"zscout"', ('"lab.2_b-c"',), NAMES),
        "candidates": Key("[]", ('["anvil"]',), ('["a/b"]', '["a", "a"]', '"anvil"', "[1]")),
        "strategy": Key('"adaptive"', ('"priority"', '"optimal"'), ('"best"', "1")),
        "operator_priority": _number("10", "0", "1_000_000_000", "-1", "1_000_000_001"),
        "command_min_runtime": _number("3600.0", "0", "31_622_400", "-1", "31_622_401"),
        "min_runtime": _number("60.0", "0.001", "31_622_400", "0", "31_622_401"),
        "preempt": Key('"always"', ('"after_min_runtime"',), ('"never"', "true")),
        "preempt_budget": _number("0.25", "0", "1_000_000", "-0.1", "1_000_001"),
        "patience": Key(None, ("0", "31_622_400", '"2h"'), ("-1", "31_622_401", '"runtimes"', "nan")),
        "promise": Key('"equals"', ('"all"',), ('"none"', "1")),
    },
    "mesh": {
        "listen": Key(
            "[]",
            ('["tcp/0.0.0.0:7447"]', '["udp/[::1]:0"]'),
            ('["tcp/7447"]', '["http/a:1"]', '["tcp/a:1", "tcp/a:1"]'),
        ),
        "connect": Key(
            "[]", ('["tls/anvil:7447"]',), ('["tcp/a:0"]', '["tcp/a:70000"]', '["tcp/1.2.3:7"]', '"tcp/a:1"')
        ),
        "multicast": Key("true", ("false",), TRUTH),
        "multicast_address": Key('"224.0.0.224:7446"', ('"239.1.2.3:99"',), ('"10.0.0.1:7446"', '"224.0.0.224"', "1")),
        "interface": Key('"auto"', ('"eth0,lo"',), ('""', '"eth 0"', "0")),
        "lease": _number("1.0", "0.2", "2.5", "0.1", "31"),
        "site": Key(None, ('"north"',), NAMES),
    },
    "limits": {
        "max_queued": _number("10_000", "1", "1_000_000", "0", "1_000_001"),
        "max_needs": _number("64", "1", "1_000", "0", "1_001"),
        "max_requests_per_client": _number("256", "1", "100_000", "0", "100_001"),
        "max_bookings_per_host": _number("100", "0", "1_000", "-1", "1_001"),
        "max_requests_per_host": _number("2_500", "1", "1_000_000", "0", "1_000_001"),
        "max_payload": _number("65_536", "1_024", "16_777_216", "1_023", "16_777_217"),
        "max_running_per_host": _number("0", "1", "100_000", "-1", "100_001"),
        "max_runtime": _number("0.0", "1", "31_622_400", "-1", "31_622_401"),
        "max_booking": _number("0.0", "1", "31_622_400", "-1", "31_622_401"),
    },
    "timing": {
        "heartbeat": _number("0.5", "0.05", "1.4", "0.04", "11"),
        "hold_lease": _number("3.0", "1.3", "300", "0.4", "301"),
        "vote_timeout": _number("0.25", "0.01", "10", "0.001", "10.1"),
        "rebuild": _number("0.2", "0.01", "1.9", "0.001", "10.1"),
    },
    "placement": {
        "start_timeout": _number("15.0", "0.05", "600", "0.04", "601"),
        "restarts": _number("5", "0", "1_000", "-1", "1_001"),
        "back_off": _number("0.5", "0.05", "3600", "0.04", "3601"),
        "longest_back_off": _number("30.0", "0.05", "86_400", "0.04", "86_401"),
        "settled": _number("30.0", "0.05", "86_400", "0.04", "86_401"),
        "rebalance": Key("false", ("true",), TRUTH),
        "gain": _number("0.3", "0.05", "100", "0.04", "101"),
        "steady": _number("10.0", "0.05", "3600", "0.04", "3601"),
        "rest": _number("60.0", "0.05", "86_400", "0.04", "86_401"),
    },
    "roles": {
        **{role: Key("[]", ('["ada"]',), ('["a/b"]', '["ada", "ada"]', '"ada"')) for role in ROLES},
        "node": Key(
            "{}", ('{ anvil = ["robot/scout33", "radio/*"] }',), ('{ anvil = ["robot"] }', '{ "a/b" = [] }', "1")
        ),
    },
    "ceilings.client": {
        "priority": Key(None, ("5",), ("1_000_001", '"5"')),
        "runtime": Key(None, ("0", "31_622_400"), ("-1", "31_622_401", "true")),
    },
    "fair_shares": {
        "half_life": _number("86_400.0", "60", "31_622_400", "59", "31_622_401"),
        "weights": Key("{}", ("{ bob = 2 }",), ("{ bob = 0 }", '{ "a/b" = 1 }', "1")),
        "patience": _number("3600.0", "142", "31_622_400", "141", "31_622_401"),
    },
    "quotas.bob": {
        "arcs": Key(None, ("5",), ("-1", "100_001", '"5"')),
        "rcs": Key(None, ("5",), ("-1", "100_001", '"5"')),
    },
}
NODE: Final[Mapping[str, Mapping[str, Key]]] = {
    "node": {
        "host": Key(None, ('"anvil"',), NAMES),
        "fleet": Key(None, ('"fleet.toml"',), ('"none.toml"', '"bad.toml"', "1")),
        "candidate": Key("true", ("false",), TRUTH),
        "load": Key("true", ("false", '"tree"'), ('"all"', "1")),
        "labels": Key("[]", ('["gpu", "camera"]',), ('["a b"]', '["a", "a"]', '"gpu"')),
        "state": Key(None, ('"state"', '"/var/lib/zscout"'), ('""', "1")),
    },
    "mesh": {
        "listen": Key(None, ('["tcp/0.0.0.0:7447"]',), ('["tcp/7447"]',)),
        "connect": Key(None, ('["tcp/anvil:7447"]',), ('["tcp/a:0"]',)),
        "interface": Key(None, ('"eth0"',), ('""',)),
        "site": Key(None, ('"north"',), NAMES),
        "relay": Key(None, ('["north", "south"]',), ('["north"]', '["a/b", "c"]', '["a", "a"]', '"north"')),
    },
    "recorder": {
        "path": Key('"runs"', ('"elsewhere"', '"/var/runs"'), ('""', "1")),
        **_served("9876"),
        "frames": _number("2.0", "0", "30", "-1", "31"),
        "limit": _number("5000", "300", "1_000_000", "299", "1_000_001"),
        "past": _number("86400.0", "0", "2_678_400", "-1", "2_678_401"),
    },
    "metrics": _served("9464"),
    "calendar": _served("9465"),
    "notify": {
        "urls": Key("[]", ('["json://localhost"]',), ('"json://localhost"', '["none://a:secret@b"]', '["a:secret@b"]')),
        "events": Key(
            '["yours_now", "preempted", "device_unwell", "booking_in_danger", "certificate_ends"]',
            ('["preempted"]',),
            ('["ended"]', '"preempted"'),
        ),
        "users": Key(None, ('{ ada = ["json://localhost"] }',), ('{ ada = "json://localhost" }', '["ada"]')),
        "after": _number("60.0", "0", "86_400", "-1", "86_401"),
        "per_minute": _number("20", "1", "600", "0", "601"),
    },
    "components": {
        "allow": Key("true", ("false",), TRUTH),
        "kinds": Key(None, ("[]", '["counter"]'), ('["a/b"]', '"counter"')),
        "max": _number("64", "1", "256", "0", "257"),
    },
    "journal": {
        "off": Key("false", ("true",), TRUTH),
        "max_age": _number("7776000.0", "3600", "315_360_000", "3599", "315_360_001"),
        "max_size": _number("64", "1", "10_000", "0", "10_001"),
    },
}
CHANNELS: Final = '{ "video/ch1" = 1 }'
SOURCES: Final = '{ "video/ch1" = "/dev/video0" }'
ACTIVATION: Final = _number("0.0", "0.5", "3600", "-1", "3601")
SETTLE: Final = _number("5.0", "0.5", "60", "0.4", "61")
BEGIN_WITHIN: Final = Key(None, ("0", "86_400", '"2m"'), ("-1", "86_401", "nan"))
COMMON: Final[Mapping[str, Key]] = {
    "settle": SETTLE,
    "begin_within": BEGIN_WITHIN,
    "tolerate": BEGIN_WITHIN,
    "tolerate_free": Key("0.0", ("1", "86_400", '"2m"'), ("-1", "86_401", "nan")),
    "tolerate_max": BEGIN_WITHIN,
}
RC: Final[Mapping[str, tuple[str, Mapping[str, Key]]]] = {
    "exclusive": ('name = "robot/a"', {"activation": ACTIVATION, **COMMON}),
    "capacity": (
        'name = "radio/a"\ncapacity = { rate = 10 }',
        {
            "capacity": Key(None, ("{ rate = 0.1, width = 2 }",), ("{}", "{ rate = -1 }", '{ "a b" = 1 }', "10")),
            **COMMON,
            "activation": ACTIVATION,
        },
    ),
    "command": (
        'name = "psu/a"\nsafe = ["psu", "off"]',
        {
            "start": Key("[]", ('["psu", "on"]',), ('"psu"', '[""]', "[1]")),
            "stop": Key("[]", ('["psu", "save"]',), ('"psu"', '[""]')),
            "safe": Key(None, ('["psu"]',), ('"psu"', '[""]', "[]")),
            "health": Key("[]", ('["psu", "ping"]',), ('"psu"', '[""]')),
            "parameters": Key("{}", ("{ voltage = 30 }",), ("{ voltage = -1 }", '{ "a b" = 1 }', '{ voltage = "1" }')),
            "every": _number("10.0", "0.5", "3600", "0.4", "3601"),
            "timeout": _number("5.0", "0.1", "600", "0.09", "601"),
            **COMMON,
            "activation": ACTIVATION,
        },
    ),
    "radio": (
        'name = "radio/a"\nport = "/dev/ttyUSB0"',
        {
            "port": Key(None, ('"loop://"',), ('""', "1")),
            "baud": _number("9600", "300", "1_000_000", "299", "1_000_001"),
            **COMMON,
            "bound": _number("0.25", "0.01", "10", "0.009", "11"),
            "dtr": Key(None, ("true", "false"), ("1", '"on"')),
            "rts": Key(None, ("true", "false"), ("1", '"on"')),
        },
    ),
    "robot": (
        'name = "robot/a"\nid = 33\nradio = "radio/a"',
        {
            "id": Key(None, ("0", "254"), ("-1", "255", '"a"')),
            "radio": Key(None, ('"radio/b"',), ('"robot/b"', '"b"')),
            "channels": Key(
                "{}", (CHANNELS,), ('{ "robot/b" = 1 }', '{ "video/ch1" = 0 }', '{ "video/a" = 1, "video/b" = 1 }')
            ),
            **COMMON,
            "warm_up": _number("2.0", "0", "60", "-1", "61"),
            "dead_man": _number("0.5", "0.05", "5", "0.04", "5.1"),
        },
    ),
    "video": ('name = "video/a"', COMMON),
    "framegrabber": (
        'name = "framegrabber/a"\nsource = "/dev/video0"',
        {
            "source": Key(None, ('"/dev/video1"',), ('""', "1", f'"a"\nsources = {SOURCES}')),
            "sources": Key(None, (), ("{}", '{ "robot/a" = "b" }')),
            "rate": _number("10.0", "0.1", "60", "0.09", "61"),
            **COMMON,
            "quality": _number("80", "1", "100", "0", "101"),
            "picture_within": _number("1.5", "0.5", "600", "0.4", "601"),
            "still_after": Key(None, ("0", "86_400", '"30s"'), ("-1", "86_401", '"never"')),
            "transport": Key('"tcp"', ('"udp"',), ('"http"', "1")),
            "ignore": Key(
                "[]",
                ('["0,0,0.4,0.1"]', '["0, 0, 1, .5, 0.25, 1"]'),
                ('["0,0,1"]', '["0,0,2,1"]', '["0,0,0,1"]', '["a"]', '[""]', '"0,0,1,1"', "[[0, 0, 1, 1]]"),
            ),
            "min_area": _number("0.0", "0.001", "0.5", "-0.1", "0.6"),
            "min_duration": _number("0.0", "0.1", "60", "-1", "61"),
        },
    ),
}
"""By driver: the least that a table needs, and what may stand in it besides `name` and `driver`."""


LEAST: Final = {
    "notify": '[notify]\nusers = { bob = ["json://localhost/bob"] }',
    "quotas.bob": '[roles]\nclient = ["bob"]\n[quotas.bob]',
}
"""What a table can't be without."""
TABLES: Final = [
    *((load_fleet, LEAST.get(table, f"[{table}]"), keys) for table, keys in FLEET.items()),
    *((load_node, LEAST.get(table, f"[{table}]"), keys) for table, keys in NODE.items()),
    *((load_node, f'[[rc]]\ndriver = "{driver}"\n{least}', keys) for driver, (least, keys) in RC.items()),
]
Load = Callable[[Path], Any]


@pytest.fixture(autouse=True)
def _named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The files that some values name; Apprise itself, a process of a second each time, has a test of its own."""
    write("fleet.toml", '[fleet]\nname = "other"\n')
    write("bad.toml", "[fleet]\nnam = 1\n")
    monkeypatch.setattr(notify, "usable", lambda urls: [url.startswith("json://") for url in urls])


def means(load: Load, text: str) -> Any:
    return load(write("file.toml", text))


def refused(load: Load, text: str) -> str:
    """The line; "" if the file is taken."""
    try:
        means(load, text)
    except BadInput as error:
        return str(error)
    return ""


def known(load: Load, head: str) -> set[str]:
    """The keys of a table, by what is said of one that it has not."""
    line = refused(load, f"{head}\n{UNKNOWN} = 1")
    return set(line.partition("known here: ")[2].split(", "))


def without(head: str, key: str) -> str:
    # An RC that knows `sources` has no `source`.
    gone = {"sources": "source"}.get(key, key)
    return "\n".join(line for line in head.splitlines() if not line.startswith(f"{gone} = "))


@pytest.mark.parametrize(("load", "head", "keys"), TABLES, ids=[head.splitlines()[-1] for _, head, _ in TABLES])
def test_a_table_has_these_keys_with_these_defaults_and_values(load: Load, head: str, keys: Mapping[str, Key]) -> None:
    assert known(load, head) - {"driver"} == keys.keys() | ({"name"} if "[[rc]]" in head else set())
    for key, (default, good, bad) in keys.items():
        rest = without(head, key)
        line = refused(load, rest)
        assert bool(line) == (rest != head), f"without {key}: {line}"
        plain = None if line else means(load, rest)
        assert default is None or means(load, f"{rest}\n{key} = {default}") == plain, f"{key} is not {default}"
        for value in good:
            assert means(load, f"{rest}\n{key} = {value}") != plain, f"{key} = {value} changes nothing"
        for value in bad:
            assert key in refused(load, f"{rest}\n{key} = {value}"), f"{key} = {value}"
