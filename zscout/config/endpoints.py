"""Endpoints and addresses of a `[mesh]` table, checked before Zenoh sees them."""

from __future__ import annotations

import ipaddress
import re
from typing import Final

from zscout.config.strict import Where, check_unique, quoted

_ENDPOINT: Final = re.compile(
    r"(?P<protocol>[a-z]+)/(?P<host>\[[0-9A-Fa-f:.%]+\]|[A-Za-z0-9_.-]+):(?P<port>[0-9]{1,5})"
    r"(?P<more>[?#][A-Za-z0-9_.,:;=/#-]+)?"
)
_PROTOCOLS: Final = ("tcp", "tls", "udp", "quic", "ws")
_INTERFACE: Final = re.compile(r"[A-Za-z0-9_.:,@-]{1,64}")


def check_links(listen: tuple[str, ...], connect: tuple[str, ...], interface: str, at: Where) -> None:
    """Refuses endpoints and interfaces that Zenoh would not understand. Raises BadInput."""
    for number, endpoint in enumerate(listen):
        _check_endpoint(endpoint, (at / "listen").item(number), lowest_port=0)
    for number, endpoint in enumerate(connect):
        _check_endpoint(endpoint, (at / "connect").item(number), lowest_port=1)
    check_unique(listen, at / "listen")
    check_unique(connect, at / "connect")
    if not _INTERFACE.fullmatch(interface):
        raise (at / "interface").bad(
            f"{quoted(interface)} names no interface", 'write "auto", or as in "eth0"'
        )


def _check_endpoint(endpoint: str, where: Where, *, lowest_port: int) -> None:
    found = _ENDPOINT.fullmatch(endpoint)
    if not found or found["protocol"] not in _PROTOCOLS or not _is_host(found["host"]):
        remedy = f'write protocol/host:port, as in "tcp/127.0.0.1:7447"; protocols: {", ".join(_PROTOCOLS)}'
        raise where.bad(f"{quoted(endpoint)} is not an endpoint", remedy)
    if not lowest_port <= int(found["port"]) <= 65_535:
        raise where.bad(f"{quoted(endpoint)} has no valid port", f"write one from {lowest_port} to 65535")


def check_multicast(address: str, where: Where) -> None:
    """Refuses what is not a multicast `ip:port`. Raises BadInput."""
    host, _, port = address.rpartition(":")
    ip = ip_of(host.removeprefix("[").removesuffix("]"))
    if (
        ip is None
        or not ip.is_multicast
        or not re.fullmatch("[0-9]{1,5}", port)
        or not 0 < int(port) < 65_536
    ):
        raise where.bad(
            f"{quoted(address)} is not a multicast address", 'write ip:port, as in "224.0.0.224:7446"'
        )


def _is_host(host: str) -> bool:
    if host.startswith("["):
        return isinstance(ip_of(host[1:-1]), ipaddress.IPv6Address)
    # Digits and dots alone are meant as an IPv4 address.
    return ip_of(host) is not None if re.fullmatch("[0-9.]+", host) else True


def ip_of(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The IP address that a text is, or None."""
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None
