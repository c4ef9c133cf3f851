"""The network interfaces and addresses of this host, as sessions use them.

Zenoh reads the interfaces once in a process's life (docs/zenoh.md). So each session gets the addresses that exist when
it is opened, and a process reopens its session when its host gains an address. Multicast always includes loopback:
processes of one host find each other without a network."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

import psutil

LOOPBACK: Final = "127.0.0.1"
MAX_ADDRESSES: Final = 32
"""Addresses used at most: each is a listener of every process."""
LOOK_EVERY: Final = 1.0
"""Seconds between two readings; a change counts when two readings agree."""
_V6: Final = Path("/proc/net/if_inet6")
_GLOBAL, _FLEETING = 0x00, 0x01 | 0x08 | 0x20 | 0x40  # scope; temporary, failed, deprecated, tentative (rtnetlink(7))
_WILDCARD: Final = re.compile(r"(?P<protocol>[a-z]+)/(?P<host>0\.0\.0\.0|\[::\]):(?P<port>[0-9]+)(?P<more>[?].*)?")


class HostAddress(NamedTuple):
    interface: str
    ip: str
    multicast: bool


def addresses() -> frozenset[HostAddress]:
    """All IPv4 and permanent global IPv6 addresses of the running interfaces, without loopback."""
    try:
        stats, found = psutil.net_if_stats(), psutil.net_if_addrs()
    except OSError:  # interfaces can't be read on this host
        return frozenset()
    flags = {name: stat.flags.split(",") for name, stat in stats.items()}
    v4 = ((name, known.address) for name, several in found.items() for known in several if known.family == 2)
    return frozenset(
        sorted(
            HostAddress(name, ip, "multicast" in flags[name])
            for name, ip in (*v4, *_v6())
            if "running" in flags.get(name, ()) and not ipaddress.ip_address(ip).is_loopback
        )[:MAX_ADDRESSES]
    )


def _v6() -> Iterable[tuple[str, str]]:
    with suppress(OSError):
        for line in _V6.read_text().splitlines():
            ip, _, _, scope, flags, name = line.split()
            if int(scope, 16) == _GLOBAL and not int(flags, 16) & _FLEETING:
                yield name, str(ipaddress.IPv6Address(bytes.fromhex(ip)))


def scouting(interface: str, found: Iterable[HostAddress]) -> str:
    """Addresses for multicast, joined by commas: loopback, then one of each interface that `interface` of the fleet
    file selects ("auto", or names and addresses)."""
    of: dict[str, str] = {}
    for name, ip, multicast in sorted(found):
        if ":" not in ip and (multicast or interface != "auto"):
            of.setdefault(name, ip)
    named = of.values() if interface == "auto" else (_ip(of, name.strip()) for name in interface.split(","))
    return ",".join(dict.fromkeys([LOOPBACK, *filter(None, named)]))


def _ip(of: dict[str, str], name: str) -> str:
    with suppress(ValueError):
        return str(ipaddress.ip_address(name))
    return of.get(name, "")


def listening(endpoints: Sequence[str], found: Iterable[HostAddress]) -> list[str]:
    """Replace "all addresses" in endpoints by each address of `found`: Zenoh may not know them all."""
    result = []
    for endpoint in endpoints:
        if (match := _WILDCARD.fullmatch(endpoint)) is None:
            result.append(endpoint)
            continue
        for ip in (LOOPBACK, "::1", *sorted(address.ip for address in found)):
            if ":" not in ip or match["host"] == "[::]":
                host = f"[{ip}]" if ":" in ip else ip
                result.append(f"{match['protocol']}/{host}:{match['port']}{match['more'] or ''}")
    return list(dict.fromkeys(result))


def change(before: frozenset[HostAddress], now: frozenset[HostAddress]) -> str:
    """Describe the difference; empty if there is none."""
    words = [f"{ip} appeared on {name}" for name, ip, _ in sorted(now - before)]
    words += [f"{ip} disappeared from {name}" for name, ip, _ in sorted(before - now)]
    return ", ".join(words)
