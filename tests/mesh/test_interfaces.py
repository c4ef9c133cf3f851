"""Which addresses of this host a session uses, and that it is reopened for one that appears."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
from msgspec.structs import replace

from tests.mesh.kit import until
from zscout.config.fleet import MeshConfig, default_fleet
from zscout.keyexpr import Sender
from zscout.mesh import ZenohMesh, interfaces, zenoh_mesh
from zscout.mesh.interfaces import HostAddress, change, listening, scouting
from zscout.mesh.zenoh_mesh import zenoh_config

LAN, OTHER, VPN = (
    HostAddress("eth0", "10.1.0.2", True),
    HostAddress("eth0", "10.1.0.9", True),
    HostAddress("tun0", "10.8.0.1", False),
)
V6 = HostAddress("eth0", "fd00::2", True)


def host(monkeypatch: pytest.MonkeyPatch, names: dict[str, tuple[str, Iterable[str]]], v6: str = "") -> None:
    """This host has these interfaces: by name the flags, and the IPv4 addresses."""
    stats = {name: SimpleNamespace(flags=flags) for name, (flags, _) in names.items()}
    found = {name: [SimpleNamespace(family=2, address=ip) for ip in ips] for name, (_, ips) in names.items()}
    monkeypatch.setattr(psutil, "net_if_stats", lambda: stats)
    monkeypatch.setattr(psutil, "net_if_addrs", lambda: found)
    monkeypatch.setattr(interfaces, "_V6", SimpleNamespace(read_text=lambda: v6))


def test_addresses_are_those_of_interfaces_that_run(monkeypatch: pytest.MonkeyPatch) -> None:
    host(
        monkeypatch,
        {
            "lo": ("up,loopback,running", ["127.0.0.1"]),
            "eth0": ("up,broadcast,running,multicast", ["10.1.0.2"]),
            "eth1": ("up,broadcast,multicast", ["10.2.0.2"]),  # without a cable
            "tun0": ("up,running", ["10.8.0.1"]),
        },
        "fd000000000000000000000000000002 04 40 00 82     eth0\n"
        "fd000000000000000000000000000003 04 40 00 01     eth0\n"  # temporary
        "fd000000000000000000000000000004 04 40 00 40     eth0\n"  # tentative
        "fe8000000000000000fc00fffe000001 04 40 20 80     eth0\n"
        "00000000000000000000000000000001 01 80 10 80       lo\n",
    )
    assert interfaces.addresses() == {LAN, VPN, V6}


def test_a_host_without_a_network_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    host(monkeypatch, {"lo": ("up,loopback,running", ["127.0.0.1"]), "eth0": ("broadcast,multicast", [])})
    assert interfaces.addresses() == frozenset()


def test_there_is_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    many = [f"10.{number // 200}.0.{number % 200}" for number in range(1_000)]
    host(monkeypatch, {"eth0": ("up,running,multicast", many)})
    assert len(interfaces.addresses()) == interfaces.MAX_ADDRESSES


@pytest.mark.parametrize(
    ("interface", "found", "uses"),
    [
        ("auto", (), "127.0.0.1"),
        ("auto", (OTHER, LAN, VPN, V6), "127.0.0.1,10.1.0.2"),
        ("eth0", (LAN, VPN), "127.0.0.1,10.1.0.2"),
        ("tun0, eth0", (LAN, VPN), "127.0.0.1,10.8.0.1,10.1.0.2"),
        ("lo", (LAN, VPN), "127.0.0.1"),
        ("eth7", (LAN, VPN), "127.0.0.1"),
        ("10.8.0.1", (), "127.0.0.1,10.8.0.1"),
    ],
)
def test_multicast_uses_loopback_and_an_address_of_each_interface(
    interface: str, found: tuple[HostAddress, ...], uses: str
) -> None:
    assert scouting(interface, found) == uses


@pytest.mark.parametrize(
    ("endpoints", "listens"),
    [
        (["tcp/[::]:0"], ["tcp/127.0.0.1:0", "tcp/[::1]:0", "tcp/10.1.0.2:0", "tcp/[fd00::2]:0"]),
        (["tls/0.0.0.0:7447"], ["tls/127.0.0.1:7447", "tls/10.1.0.2:7447"]),
        (["tcp/0.0.0.0:1?rel=1", "tcp/127.0.0.1:1?rel=1"], ["tcp/127.0.0.1:1?rel=1", "tcp/10.1.0.2:1?rel=1"]),
        (["tcp/0.0.0.0:1#iface=eth0", "tcp/anvil:2"], ["tcp/0.0.0.0:1#iface=eth0", "tcp/anvil:2"]),
    ],
)
def test_all_addresses_are_named_where_zenoh_does_not_know_them(endpoints: list[str], listens: list[str]) -> None:
    assert listening(endpoints, (LAN, V6)) == listens


def test_a_change_in_words() -> None:
    assert change(frozenset({LAN}), frozenset({LAN})) == ""
    assert change(frozenset({LAN}), frozenset({OTHER})) == "10.1.0.9 appeared on eth0, 10.1.0.2 disappeared from eth0"


def test_zenoh_is_given_addresses_only_when_it_does_not_know_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_mesh, "known_to_zenoh", lambda: frozenset({LAN}))
    for now, listens in (LAN, False), (OTHER, True):
        monkeypatch.setattr(interfaces, "addresses", lambda now=now: frozenset({now}))
        config = zenoh_config(MeshConfig())
        assert config.get_json("scouting/multicast/interface") == f'"127.0.0.1,{now.ip}"'
        assert (f"tcp/{now.ip}:0" in config.get_json("listen/endpoints")) is listens


@pytest.mark.real_time
async def test_an_address_that_appears_reopens_the_session(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    monkeypatch.setattr(interfaces, "LOOK_EVERY", 0.01)
    mesh = MeshConfig(multicast=False, listen=("tcp/127.0.0.1:0",))
    there: dict[str, Any] = {"is": frozenset({LAN})}
    monkeypatch.setattr(interfaces, "addresses", lambda: there["is"])
    async with await ZenohMesh.open(replace(default_fleet(), mesh=mesh), Sender("a", "test")) as joined:
        renewed: list[None] = []
        monkeypatch.setattr(joined._transport, "renew", lambda: renewed.append(None))
        there["is"] = frozenset()
        await until(lambda: "10.1.0.2 disappeared from eth0" in caplog.text)
        assert not renewed
        there["is"] = frozenset({OTHER})
        await until(lambda: bool(renewed))
        assert "10.1.0.9 appeared on eth0: reopening the mesh session" in caplog.text
