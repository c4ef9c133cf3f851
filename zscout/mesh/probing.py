"""Diagnose a mesh without joining it: by multicast, and by TLS handshakes.

A host with wrong files or certificate gets no link, but processes answer all multicast, and a handshake shows why a
certificate is refused."""

from __future__ import annotations

import asyncio
import functools
import ipaddress
import json
import os
import re
import secrets
import socket
import ssl
import struct
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import psutil
import zenoh

from zscout.config.certificates import NO_CHECK_TIME, Certificates, Validity, common_name, validity
from zscout.config.fleet import MeshConfig, ip_of
from zscout.config.strict import BadInput, Where
from zscout.keyexpr import NAME, ROOT, Role
from zscout.mesh.exchange import MeshError
from zscout.mesh.links import SESSIONS
from zscout.mesh.relinking import TEMPORARY_ID
from zscout.mesh.zenoh_mesh import check_room, in_thread, open_session, zenoh_config
from zscout.types import clean

SCOUT: Final = 1.5  # seconds for all processes to answer
POLL: Final = 0.02
CONNECT: Final = 1.5
HANDSHAKE: Final = 2.0
OBJECTION: Final = 0.3  # seconds for the server to refuse our certificate, which it checks after sending its own
LINK: Final = 0.8
LIST: Final = 1.0  # seconds for links to a plain mesh, and for its tokens
MAX_HEARD: Final = 64  # processes listed
MAX_TOKENS: Final = 10_000
LOOPBACKS: Final = {"127.0.0.1", "::1"}
_ALERT: Final = re.compile(r"alert ([a-z ]*[a-z])")
_ADDRESS: Final = re.compile(r"(tcp|tls)/([^#?]+):(\d+)(?:[?#].*)?")


def multicast_problems(config: MeshConfig) -> dict[str, str]:
    """The interfaces for multicast, each with its problem; empty if a test packet could be sent."""
    host, _, port = config.multicast_address.rpartition(":")
    group = ip_of(host.strip("[]"))
    assert group is not None  # noqa: S101 - the fleet file was checked
    if config.interface == "auto":
        names = [name for _, name in socket.if_nameindex()]
        with suppress(OSError):  # /proc can't be read
            found = psutil.net_if_stats()
            names = [name for name, stats in found.items() if stats.isup and "multicast" in stats.flags.split(",")]
    else:
        names = config.interface.split(",")
    return {name: _multicast_problem(name, group, int(port)) for name in names}


def _multicast_problem(name: str, group: ipaddress.IPv4Address | ipaddress.IPv6Address, port: int) -> str:
    v6 = group.version == 6
    try:
        number = socket.if_nametoindex(name)
        with socket.socket(socket.AF_INET6 if v6 else socket.AF_INET, socket.SOCK_DGRAM) as own:
            if v6:
                member, level = group.packed + struct.pack("@i", number), socket.IPPROTO_IPV6
                own.setsockopt(level, socket.IPV6_JOIN_GROUP, member)
                own.setsockopt(level, socket.IPV6_MULTICAST_IF, number)
            else:
                member, level = group.packed + struct.pack("@4si", bytes(4), number), socket.IPPROTO_IP
                own.setsockopt(level, socket.IP_ADD_MEMBERSHIP, member)
                own.setsockopt(level, socket.IP_MULTICAST_IF, member)
            own.sendto(b"", (str(group), port))
    except OSError as error:
        return error.strerror or str(error)
    return ""


@dataclass(frozen=True, slots=True)
class Heard:
    """A process that answered by multicast, with its listening addresses; `here` is True if it is on this host."""

    zid: str
    addresses: tuple[str, ...]
    here: bool
    relay: bool = False


async def heard(config: MeshConfig) -> list[Heard]:
    """All processes that answer by multicast, of any fleet. Takes SCOUT seconds."""
    found: dict[str, Heard] = {}
    own = _own_addresses()
    until = time.monotonic() + SCOUT
    try:
        check_room()
        with zenoh.scout(what="peer|router", config=zenoh_config(config)) as scout:
            while time.monotonic() < until and len(found) < MAX_HEARD:
                if (hello := scout.try_recv()) is None:
                    await asyncio.sleep(POLL)
                elif not (zid := str(hello.zid)).startswith(TEMPORARY_ID):
                    hosts = {at: match[2].strip("[]") for at in hello.locators if (match := _ADDRESS.match(at))}
                    # Every host has loopback: it identifies and reaches a process only if that has no other address.
                    beyond = {at: host for at, host in hosts.items() if host not in LOOPBACKS} or hosts
                    here = bool(set(beyond.values()) & own)
                    addresses = tuple(at for at in (hosts if here else beyond) if "[fe80:" not in at)
                    found[zid] = Heard(zid, addresses, here, str(hello.whatami) == "router")
    except (zenoh.ZError, OSError, RuntimeError):  # no interface for multicast, or no room for a session
        pass
    return list(found.values())


def _own_addresses() -> set[str]:
    return {known.address.partition("%")[0] for several in psutil.net_if_addrs().values() for known in several}


@dataclass(frozen=True, slots=True)
class Called:
    """Result of calling an address. `speaks` is empty without an answer; `problem` gives the reason. For TLS: the
    server's certificate, its CA, `trusted` for a known CA, and its objection to our certificate, empty if none."""

    address: str
    speaks: Literal["tls", "plain", ""]
    problem: str = ""
    certificate: Validity | None = None
    issuer: str = ""
    trusted: bool = False
    objection: str = ""
    here: bool = False  # set only without an answer: True for an address of this host


async def call(
    named: Iterable[str], heard: Iterable[str] = (), cas: str = "", own: Certificates | None = None
) -> list[Called]:
    """Call all TCP and TLS addresses at once, within six seconds, with these CAs (PEM) and this certificate. `named`
    addresses, from a file, are tried by TLS whatever their prefix; the prefix of `heard` addresses is reliable."""
    tried = dict.fromkeys(heard, False) | dict.fromkeys(named, True)
    matches = [(match, doubted) for at, doubted in tried.items() if (match := _ADDRESS.fullmatch(at))]
    return list(await asyncio.gather(*(_call(match, doubted, cas, own) for match, doubted in matches)))


async def _call(match: re.Match[str], doubted: bool, cas: str, own: Certificates | None) -> Called:
    address, found = match[0], list[tuple[str, int]]()
    try:
        async with asyncio.timeout(CONNECT):
            found = await _looked_up(match[2].strip("[]"), int(match[3]))
            at = await _reached(found)
    except TimeoutError:
        return Called(address, "", "no answer")
    except OSError as error:
        here = any(host in _own_addresses() or host.startswith("127.") for host, _ in found)
        return Called(address, "", _reason(error), here=here)
    if match[1] == "tcp" and not doubted:
        return Called(address, "plain")
    if cas:
        with suppress(ssl.SSLCertVerificationError):
            return _answer(address, await _handshake(at, _trusting(cas, own)), trusted=True)
    # Trusted as its own CA, any certificate can be read.
    if (shaken := await _handshake(at, _trusting(None))) is not None and shaken.encoded:
        itself = ssl.DER_cert_to_PEM_cert(shaken.encoded)
        with suppress(ssl.SSLCertVerificationError):
            shaken = await _handshake(at, _trusting(itself))
    return _answer(address, shaken, trusted=False)


async def _looked_up(host: str, port: int) -> list[tuple[str, int]]:
    """A host's addresses. Raises OSError."""
    # In a thread that is not joined at exit: the lookup takes long without a name server.
    look_up = functools.partial(socket.getaddrinfo, host, port, type=socket.SOCK_STREAM)
    return [(str(at[0]), port) for *_, at in await asyncio.wrap_future(in_thread("looks up a name", look_up))]


async def _reached(found: Iterable[tuple[str, int]]) -> tuple[str, int]:
    """Return the first address that accepts a connection. Raises OSError."""
    error: OSError | None = None
    for at in found:
        try:
            _, writer = await asyncio.open_connection(*at)
        except OSError as failed:
            error = failed
        else:
            writer.transport.abort()
            return at
    raise error or OSError("it has no address")


class _Shaken(NamedTuple):
    details: Mapping[str, Any]  # the server's certificate, if verified
    encoded: bytes
    objection: str


async def _handshake(at: tuple[str, int], context: ssl.SSLContext) -> _Shaken | None:
    """Return None if the server speaks no TLS. Raises SSLCertVerificationError."""
    try:
        async with asyncio.timeout(HANDSHAKE):
            reader, writer = await asyncio.open_connection(*at, ssl=context)
    except ssl.SSLCertVerificationError:
        raise
    except (OSError, TimeoutError):
        return None
    end, objection = writer.get_extra_info("ssl_object"), ""
    details, encoded = end.getpeercert() or {}, end.getpeercert(binary_form=True) or b""
    try:
        async with asyncio.timeout(OBJECTION):
            await reader.read(1)
    except ssl.SSLError as error:
        alert = _ALERT.search(str(error))
        objection = alert[1] if alert is not None else "no"
    except (OSError, TimeoutError):
        pass
    finally:
        writer.transport.abort()
        # Otherwise asyncio logs the connection's error as never retrieved.
        with suppress(OSError):
            async with asyncio.timeout(OBJECTION):
                await writer.wait_closed()
    return _Shaken(details, encoded, objection)


def _trusting(cas: str | None, own: Certificates | None = None) -> ssl.SSLContext:
    """A context that trusts the CAs of a PEM text, or everything; dates are checked later."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    if cas is None:
        context.verify_mode = ssl.CERT_NONE
        return context
    context.load_verify_locations(cadata=cas)
    context.verify_flags |= ssl.VerifyFlags(NO_CHECK_TIME) | ssl.VerifyFlags.VERIFY_X509_PARTIAL_CHAIN
    if own is not None:
        context.load_cert_chain(own.cert, own.key)
    return context


def _answer(address: str, shaken: _Shaken | None, *, trusted: bool) -> Called:
    if shaken is None:
        return Called(address, "plain")
    objection = shaken.objection if trusted else ""
    try:
        certificate = validity(shaken.details, Where(address))
    except (BadInput, KeyError):
        return Called(address, "tls", objection=objection)
    issuer = clean(common_name(shaken.details["issuer"]))
    return Called(address, "tls", "", certificate, issuer, trusted, objection)


def _reason(error: OSError) -> str:
    """The cause without the address: all addresses of the name failed in the same way."""
    return os.strerror(error.errno) if error.errno and error.errno > 0 else error.strerror or "can't be called"


def plain_fleets(addresses: Sequence[str]) -> dict[str, set[str]]:
    """Fleets found at these addresses without TLS, each with its hosts that have a node. Blocks for at most 2 s."""
    settings: dict[str, object] = {
        "mode": "peer",
        "id": f"{TEMPORARY_ID}{secrets.token_hex(10)}",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": [],
        "connect/endpoints": list(addresses),
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    found: dict[str, set[str]] = {}
    with suppress(zenoh.ZError, MeshError):
        session = open_session(lambda: config)
        try:
            until = time.monotonic() + LINK
            while len(list(session.info.peers_zid())) < len(addresses) and time.monotonic() < until:
                time.sleep(POLL)
            for number, reply in enumerate(session.liveliness().get(f"{ROOT}/*/alive/*/{Role.NODE}/**", timeout=LIST)):
                if reply.ok is None or number > MAX_TOKENS:
                    continue
                _, fleet, _, host, *_ = str(reply.ok.key_expr).split("/")
                if NAME.fullmatch(fleet) and NAME.fullmatch(host):
                    found.setdefault(fleet, set()).add(host)
        finally:
            SESSIONS.close(session, addresses)
    return found
