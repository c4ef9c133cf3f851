"""The mesh over Zenoh: its settings, and a session as a transport."""

from __future__ import annotations

import asyncio
import functools
import json
import logging
import os
import re
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, Self, TypeVar

import zenoh
from msgspec.structs import replace
from zenoh.handlers import Callback

from zscout import messages
from zscout.config.access import AccessPolicy
from zscout.config.certificates import Certificates, read_certificates
from zscout.config.fleet import Fleet, MeshConfig, load_fleet
from zscout.config.strict import BadInput
from zscout.keyexpr import FleetMember, Keys, Sender, access_control
from zscout.logs import shortage
from zscout.mesh import interfaces
from zscout.mesh.exchange import SPAWN, MeshError
from zscout.mesh.links import CLOSER, SESSIONS
from zscout.mesh.neighbours import Meeting, time_in_id
from zscout.mesh.relinking import TEMPORARY_ID, Relinking
from zscout.mesh.renewal import RenewableTransport
from zscout.mesh.session import Mesh
from zscout.mesh.supervision import clock
from zscout.mesh.transport import Collector, OnSample, Quality, Transport, TransportPublisher, TransportQuery, Undeclare

log = logging.getLogger(__name__)

CONTROL_BATCHES = 8  # control messages in flight per peer; with fewer, an answer waits for the previous message
SCOUTING_DELAY_MS = 200
SESSION_FILES, SESSION_THREADS = 40, 36  # used by one session and its links
THREADS = "ZENOH_RUNTIME"
# With few receiving threads one unreachable host stalls every link.
MANY_THREADS = (
    "(rx:(worker_threads:16),net:(worker_threads:4),acc:(worker_threads:4),tx:(worker_threads:4),"
    "app:(worker_threads:2))"
)
GREATER_CONNECTS = {"peer": {"to_router": "always", "to_peer": "greater-zid"}}
CLOSE_TIMEOUT = 3.0  # seconds that closing a session may take
OPEN_TIMEOUT, OPEN_TIMEOUT_DEFAULT = 2.0, 10.0  # seconds for an attempt to connect, unless two leases; Zenoh's default
BLOCK, DROP = zenoh.CongestionControl.BLOCK, zenoh.CongestionControl.DROP
CONTROL: Any = {"congestion_control": BLOCK, "priority": zenoh.Priority.INTERACTIVE_HIGH, "express": True}
QUALITIES: dict[Quality, dict[str, Any]] = {
    Quality.CONTROL: CONTROL,
    Quality.DATA: {"congestion_control": DROP, "priority": zenoh.Priority.DATA_LOW, "express": False},
    Quality.FRAME: {"congestion_control": DROP, "priority": zenoh.Priority.DATA, "express": True},
}
QUERY: Any = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE, **CONTROL}
MAX_QUERIERS = 256  # per session: Zenoh never frees a key's declaration
MAX_MESSAGE = 17_000_000  # bytes: a little more than zscout's largest message
FILE_CHECK_PERIOD = 2.0  # seconds between two checks for renewed certificates and changed rights
ANY, ANY_TLS = "tcp/[::]:0", "tls/0.0.0.0:0"
T = TypeVar("T")
_PORT = re.compile(r":\d+$")


class Security(NamedTuple):
    certificates: Certificates
    keys: Keys
    members: tuple[FleetMember, ...]


def zenoh_config(config: MeshConfig, security: Security | None = None, meeting: Meeting | None = None) -> zenoh.Config:
    """Zenoh settings for a `[mesh]` table, valid for a session that is opened now; `meeting` adds its neighbours."""
    known, found = known_to_zenoh(), interfaces.addresses()
    v6_group = config.multicast_address.startswith("[")
    settings: dict[str, Any] = {
        "mode": "router" if config.relay else "peer",
        "id": increasing_id(None if meeting is None else meeting.at),
        "scouting/multicast/enabled": config.multicast,
        "scouting/multicast/address": config.multicast_address,
        "scouting/multicast/interface": config.interface if v6_group else interfaces.scouting(config.interface, found),
        "scouting/delay": SCOUTING_DELAY_MS,
        # Of two peers always the same one makes the only link (docs/zenoh.md).
        "scouting/multicast/autoconnect_strategy": GREATER_CONNECTS,
        "scouting/gossip/autoconnect_strategy": GREATER_CONNECTS,
        "transport/link/tx/lease": round(config.lease * 1000),
        # The same as the lease: on a busy host Zenoh's sending threads stall too, and a burst must not close a good
        # link.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(config.lease * 1_000_000),
        # An attempt that gets no answer delays attempts at other addresses of its peer, and the close (links.py).
        "transport/unicast/open_timeout": round(1000 * min(OPEN_TIMEOUT_DEFAULT, max(OPEN_TIMEOUT, 2 * config.lease))),
        "transport/link/tx/queue/size": {"interactive_high": CONTROL_BATCHES},
        # Otherwise a sender could fill this process's memory.
        "transport/link/rx/max_message_size": MAX_MESSAGE,
        "transport/shared_memory/enabled": False,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 1.5},
    }
    if config.site is not None:
        settings["region_name"] = config.site
    if config.relay:
        regions = [{"filters": [{"region_names": [site]}]} for site in config.relay]
        settings["gateway"] = {"south": regions}
    listen, connect = list(config.listen), list(config.connect)
    if not listen and not (config.relay and security is None):  # Zenoh has another default for routers
        listen = [ANY if security is None else ANY_TLS]
    if found != known:
        listen = interfaces.listening(listen, found)
    if meeting is not None:
        listen.append(meeting.endpoint)
        connect += meeting.others
    if listen:
        settings["listen/endpoints"] = listen
    if connect:
        settings["connect/endpoints"] = connect
    if security is not None:
        settings |= _secured(security)
    result = zenoh.Config()
    for key, value in settings.items():
        result.insert_json5(key, json.dumps(value))
    return result


@functools.cache
def known_to_zenoh() -> frozenset[interfaces.HostAddress]:
    """The addresses of this host when settings were first made: Zenoh reads them about then, and never again."""
    return interfaces.addresses()


def _secured(security: Security) -> dict[str, Any]:
    """Settings that admit only members of the fleet, and limit what each may send. All are needed."""
    own = security.certificates
    return {
        # Otherwise a peer links to announced addresses without TLS.
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": str(own.ca),
            "listen_private_key": str(own.key),
            "listen_certificate": str(own.cert),
            "connect_private_key": str(own.key),
            "connect_certificate": str(own.cert),
            "enable_mtls": True,
            # Certificates name a machine or a person, not an address; the access rules below use the name.
            "verify_name_on_connect": False,
            # Certificates are renewed in place: a link may outlive the one it was made with.
            "close_link_on_expiration": False,
        },
        "access_control": access_control(security.keys, security.members),
    }


class RightsFile:
    """The rights in a fleet file, read again when the file changes."""

    def __init__(self, file: Path, access: AccessPolicy) -> None:
        self._file, self._access = file, access
        self._seen: tuple[int, ...] | None = None

    def changed(self) -> AccessPolicy | None:
        """Return the rights if they changed since the last call, else None. An error is logged once per version of the
        file, and keeps the previous rights."""
        try:
            stat = self._file.stat()
            seen = stat.st_mtime_ns, stat.st_size, stat.st_ino
        except OSError:  # the file is being replaced, or this program changed its user
            return None
        if seen == self._seen:
            return None
        self._seen = seen
        try:
            access = load_fleet(self._file).access
        except BadInput as error:
            log.warning("%s; keeping the previous rights", error)
            return None
        before, self._access = self._access, access
        return None if access == before else access


@dataclass(slots=True)
class _Admission:
    security: Security | None


class ZenohMesh(Mesh):
    _admission: _Admission
    _watching: tuple[asyncio.Task[NoReturn], ...] = ()

    @classmethod
    async def open(cls, fleet: Fleet, me: Sender, *, follow: bool = True) -> Self:
        """Join the mesh of `fleet`; `follow`: apply rights as soon as the fleet file changes (a node does at a reload).
        Raises MeshError if an address is not available, BadInput for bad certificates."""
        config, keys = fleet.mesh, Keys(fleet.name, closed=fleet.security is not None)
        security = None if fleet.security is None else _security(fleet, keys, me)
        admission, found = _Admission(security), interfaces.addresses()
        openings = [lambda: _open(fleet.name, config, admission.security)]
        if config.listen:
            # The old session has the ports until it closes; a session on other ports learns the peers from it first.
            own = tuple(at.replace("0.0.0.0", "127.0.0.1").replace("[::]", "[::1]") for at in config.listen)  # noqa: S104
            ports = tuple(_PORT.sub(":0", at) for at in config.listen)
            beside = replace(config, listen=ports, connect=(*config.connect, *own), shared=config.known_by)
            openings.insert(0, lambda: _open(fleet.name, beside, admission.security))
        mesh = cls(RenewableTransport(await _open(fleet.name, config, security), openings), keys, me, clock.now)
        mesh._admission = admission
        if security is not None:
            mesh.validity = security.certificates
            rights = RightsFile(fleet.file, fleet.access) if follow and fleet.file is not None else None
            mesh._watching = (asyncio.create_task(mesh._watch_files(security.certificates, rights)),)
        mesh._watching += (asyncio.create_task(mesh._watch_interfaces(found)),)
        return mesh

    async def close(self) -> None:
        for task in self._watching:
            task.cancel()
        await super().close()

    async def _watch_interfaces(self, used: frozenset[interfaces.HostAddress]) -> NoReturn:
        """Reopen the session when addresses appear: Zenoh uses only those with which the session was opened."""
        before = used
        while True:
            await asyncio.sleep(interfaces.LOOK_EVERY)
            if self._transport.behind:
                self._transport.renew()
            now = await asyncio.wrap_future(in_thread("reads addresses", interfaces.addresses))
            if now == before and now != used:
                appeared, words = now - used, interfaces.change(used, now)
                log.warning("%s%s", words, ": reopening the mesh session" if appeared else "")
                used = now
                if appeared:
                    self._transport.take_settings()
            before = now

    async def _watch_files(self, known: Certificates, rights: RightsFile | None) -> NoReturn:
        """Warn before certificates end, and reopen the session when certificates or rights changed: a session keeps
        those it was opened with."""
        logged: str | None = None
        warned = ""
        while True:
            await asyncio.sleep(FILE_CHECK_PERIOD)
            if rights is not None and (access := await asyncio.wrap_future(in_thread("reads rights", rights.changed))):
                if not access.ranks_of(self.me.host):
                    log.warning("%s has no role in the fleet file any more: its requests stay unanswered", self.me.host)
                self.admit(access.members())
            try:
                reading = in_thread("reads certificates", functools.partial(read_certificates, known.folder))
                fresh = await asyncio.wrap_future(reading)
                fresh.check(datetime.now(UTC), known.name)
            except BadInput as error:  # the files may be half written
                if logged != str(error):
                    log.warning("%s", error)
                logged = str(error)
                continue
            logged = None
            if fresh.ends != known.ends:
                log.info("%s was renewed: reopening the mesh session", fresh.cert)
                known = self.validity = fresh
                self._transport.take_settings()
            if (soon := fresh.expires_soon(datetime.now(UTC))) and soon != warned:
                log.warning("%s", warned := soon)

    def admit(self, members: Iterable[FleetMember]) -> None:
        # Zenoh can't change the rules of an open session.
        if self._admission.security is not None:
            self._admission.security = self._admission.security._replace(members=tuple(members))
            self._transport.take_settings()


def _security(fleet: Fleet, keys: Keys, me: Sender) -> Security:
    """Raises BadInput."""
    assert fleet.security is not None  # noqa: S101 - the caller has checked
    own = read_certificates(fleet.security)
    own.check(datetime.now(UTC), me.host)
    if not fleet.access.ranks_of(me.host):
        raise BadInput(f"{own.cert}: {me.host} has no role in fleet {fleet.name}; name it in the fleet file's [roles]")
    return Security(own, keys, tuple(fleet.access.members()))


def increasing_id(at: int | None = None) -> str:
    """A session id greater than all earlier ones, so that the newer session makes the links. `at`: its time, in ns
    since 1970; None: now. Zenoh compares ids from the last byte on, and prints them as a number."""
    time_ns = time.time_ns() if at is None else at
    return f"1{secrets.token_hex(9)}0{time_in_id(time_ns)}"


def check_room(files: int = SESSION_FILES, threads: int = SESSION_THREADS) -> None:
    """Raise OSError or RuntimeError if this process can't have so many more files and threads: Zenoh would end it."""
    opened, started, done = list[int](), list[threading.Thread](), threading.Event()
    try:
        while len(opened) < files:
            opened.append(os.eventfd(0))
        while len(started) < threads:
            thread = threading.Thread(target=done.wait, daemon=True)
            thread.start()
            started.append(thread)
    finally:
        done.set()
        for thread in started:
            thread.join()
        for fd in opened:
            os.close(fd)


def open_session(settings: Callable[[], zenoh.Config]) -> zenoh.Session:
    """Blocks. Raises MeshError."""
    global _opened_in
    if _opened_in not in (None, os.getpid()):
        raise MeshError(f"a forked process can't join the mesh after its parent has; {SPAWN}")
    _opened_in = os.getpid()
    try:
        check_room()
    except (OSError, RuntimeError) as error:
        raise MeshError(f"the mesh can't be joined: {shortage(error) or error}") from None
    # Zenoh reads this when it opens its first session. Programs that this process starts must not inherit it.
    if THREADS not in os.environ:
        os.putenv(THREADS, MANY_THREADS)
    try:
        return SESSIONS.open(settings())
    except zenoh.ZError as error:
        # Without positions in Zenoh's source.
        why = re.sub(r" at \S+\.rs:[0-9]+\.?", "", str(error))
        raise MeshError(f"the mesh can't be joined: {why}; check listen and connect under [mesh]") from None
    finally:
        if THREADS not in os.environ:
            os.unsetenv(THREADS)


async def _open(fleet: str, config: MeshConfig, security: Security | None) -> Transport:
    met: Meeting | None = None
    if config.known_by and not config.relay:
        with suppress(OSError):  # without it multicast and `connect` find the neighbours
            met = Meeting(fleet, config, "tcp" if security is None else "tls")

    def join() -> zenoh.Session:
        if met is not None:
            met.wait_for_others()
        opened = open_session(lambda: zenoh_config(config, security, met))
        if met is not None:
            try:
                met.relink(opened.info.links)
            except BaseException:
                SESSIONS.close(opened, met.others)
                raise
        return opened

    opening = in_thread("joins the mesh", join)
    try:
        session = await asyncio.wrap_future(opening)
    except BaseException:
        if met is not None:
            met.close()
        # Close in a thread: this callback may run on the event loop's.
        opening.add_done_callback(
            lambda opened: opened.exception() or in_thread(CLOSER, lambda: SESSIONS.close(opened.result()))
        )
        raise
    if met is not None:
        met.release_port()
    try:
        # A relay leaves relinking to its sites, which have its address.
        relinks = config.multicast and not config.relay
        relinking = _relinking(session, config, security, met) if relinks else None
        return ZenohTransport(session, relinking, met, config)
    except BaseException:
        in_thread(CLOSER, functools.partial(SESSIONS.close, session))
        raise


def _relinking(
    session: zenoh.Session, config: MeshConfig, security: Security | None = None, met: Meeting | None = None
) -> Relinking:
    def meeting(addresses: Sequence[str]) -> zenoh.Config:
        settings = zenoh_config(replace(config, multicast=False, connect=tuple(addresses)), security)
        settings.insert_json5("listen/endpoints", "[]")
        settings.insert_json5("scouting/gossip/autoconnect", '{"peer": []}')
        return settings

    is_neighbour: Callable[[str], bool] = (lambda _: False) if met is None else met.is_neighbour
    return Relinking(session, zenoh_config(config, security), meeting, is_neighbour)


_opened_in: int | None = None
"""Id of the process that opened a session. Zenoh's threads do not survive a fork: a session opened in the child hangs,
and can crash the parent."""


def in_thread(name: str, call: Callable[[], T]) -> Future[T]:
    """Call in a daemon thread. When the loop ends, asyncio would wait for its own threads without a limit."""
    future: Future[T] = Future()
    future.set_running_or_notify_cancel()

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as error:  # noqa: BLE001 - raised where the future is awaited
            future.set_exception(error)

    threading.Thread(target=run, name=name, daemon=True).start()
    return future


class ZenohTransport(Transport):
    # Callbacks run directly on Zenoh's threads: a plain function would get a thread per declaration and query.

    def __init__(
        self,
        session: zenoh.Session,
        relinking: Relinking | None = None,
        meeting: Meeting | None = None,
        config: MeshConfig | None = None,
    ) -> None:
        self._session, self._relinking, self._meeting = session, relinking, meeting
        self._sought, self._listening = ([], []) if config is None else ([*config.connect], [*config.listen])
        if meeting is not None:
            self._sought += meeting.others
            self._listening.append(meeting.endpoint)
        self._queriers: dict[tuple[str, float], zenoh.Querier] = {}  # by key and timeout
        self._asked_once: dict[tuple[str, float], None] = {}

    def id(self) -> str:
        return str(self._session.info.zid())

    def peers(self) -> list[str]:
        linked = (*self._session.info.peers_zid(), *self._session.info.routers_zid())
        return [zid for zid in map(str, linked) if not zid.startswith(TEMPORARY_ID)]

    def links(self) -> int:
        return sum(not str(link.zid).startswith(TEMPORARY_ID) for link in self._session.info.links())

    def relays(self) -> int:
        return len(list(self._session.info.routers_zid()))

    async def close(self) -> None:
        if self._meeting is not None:
            self._meeting.close()

        def close() -> None:
            if self._relinking is not None:
                self._relinking.close()
            SESSIONS.close(self._session, self._sought, self._listening)

        closing = in_thread(CLOSER, close)
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT):
                await asyncio.wrap_future(closing)
        except zenoh.ZError as error:
            log.warning("the mesh session did not close cleanly: %s", error)
        except TimeoutError:
            log.warning("the mesh session did not close within %g s", CLOSE_TIMEOUT)

    def get(self, key: str, payload: bytes | None, kind: type | None, timeout: float, to: Collector) -> None:
        encoding = None if kind is None else _encoding(kind)
        try:
            if (querier := self._querier(key, timeout)) is not None:
                querier.get(_collecting(to), payload=payload, encoding=encoding)
            else:
                self._session.get(key, _collecting(to), timeout=timeout, payload=payload, encoding=encoding, **QUERY)
        except zenoh.ZError as error:
            raise MeshError(f"{key} can't be queried: {error}") from None

    def _querier(self, key: str, timeout: float) -> zenoh.Querier | None:
        """Return a querier, faster than a get, for a key that was queried before; None for others."""
        asked = key, timeout
        if (known := self._queriers.get(asked)) is not None or "*" in key or len(self._queriers) >= MAX_QUERIERS:
            return known
        if asked not in self._asked_once:
            self._asked_once[asked] = None
            if len(self._asked_once) > MAX_QUERIERS:
                del self._asked_once[next(iter(self._asked_once))]
            return None
        del self._asked_once[asked]
        querier = self._queriers[asked] = self._session.declare_querier(key, timeout=timeout, **QUERY)
        return querier

    def queryable(self, key: str, on_query: Callable[[TransportQuery], None]) -> Undeclare:
        return _undeclare(self._session.declare_queryable(key, _direct(lambda query: on_query(ZenohQuery(query)))))

    def publisher(self, key: str, kind: type | None, quality: Quality) -> TransportPublisher:
        return ZenohPublisher(self._session.declare_publisher(key, encoding=_encoding(kind), **QUALITIES[quality]))

    def put(self, key: str, payload: bytes, kind: type) -> None:
        try:
            self._session.put(key, payload, encoding=_encoding(kind), **CONTROL)
        except zenoh.ZError as error:
            log.warning("a publication on %s was not sent: %s", key, error)

    def subscriber(self, key: str, on_sample: OnSample) -> Undeclare:
        def on_zenoh_sample(sample: zenoh.Sample) -> None:
            if not _is_publication(sample):
                return
            head = sample.attachment
            on_sample(str(sample.key_expr), sample.payload.to_bytes(), None if head is None else head.to_bytes())

        return _undeclare(self._session.declare_subscriber(key, _direct(on_zenoh_sample)))

    def ring(self, key: str, depth: int, most: int) -> tuple[Callable[[], tuple[str, bytes] | None], Undeclare]:
        kept: deque[zenoh.Sample] = deque(maxlen=depth)

        def keep(sample: zenoh.Sample) -> None:
            if _is_publication(sample) and len(sample.payload) <= most:
                kept.append(sample)

        def take() -> tuple[str, bytes] | None:
            # Copy the payload only now: most samples are replaced by newer ones before.
            sample = kept.popleft() if kept else None
            return None if sample is None else (str(sample.key_expr), sample.payload.to_bytes())

        subscriber = self._session.declare_subscriber(key, _direct(keep))
        return take, _undeclare(subscriber)

    def token(self, key: str) -> Undeclare:
        return _undeclare(self._session.liveliness().declare_token(key))

    def token_subscriber(self, key: str, on_token: Callable[[str, bool], None]) -> Undeclare:
        callback = _direct(lambda sample: on_token(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT))
        return _undeclare(self._session.liveliness().declare_subscriber(key, callback, history=True))

    def tokens(self, key: str, timeout: float, to: Collector) -> None:
        self._session.liveliness().get(key, _collecting(to), timeout=timeout)


class ZenohQuery(TransportQuery):
    __slots__ = ("_query",)

    def __init__(self, query: zenoh.Query) -> None:
        self._query = query

    @property
    def key(self) -> str:
        return str(self._query.key_expr)

    @property
    def payload(self) -> bytes | None:
        payload = self._query.payload
        return None if payload is None else payload.to_bytes()

    def reply(self, key: str, payload: bytes, kind: type) -> None:
        try:
            self._query.reply(key, payload, encoding=_encoding(kind))
        except zenoh.ZError as error:
            log.debug("a reply on %s was not sent: %s", key, error)
        self.drop()

    def reply_error(self, payload: bytes, kind: type) -> None:
        try:
            self._query.reply_err(payload, encoding=_encoding(kind))
        except zenoh.ZError as error:
            log.debug("an error reply was not sent: %s", error)
        self.drop()

    def drop(self) -> None:
        self._query.drop()  # type: ignore[no-untyped-call]


class ZenohPublisher(TransportPublisher):
    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._publisher = publisher
        self._listener: object = None

    def undeclare(self) -> None:
        _undeclare(self._publisher)()

    def put(self, payload: bytes, attachment: bytes | None = None) -> None:
        try:
            self._publisher.put(payload, attachment=attachment)
        except zenoh.ZError as error:
            log.warning("a publication on %s was not sent: %s", self._publisher.key_expr, error)

    def match(self, on_matching: Callable[[bool], None]) -> bool:
        callback = _direct(lambda status: on_matching(bool(status.matching)))
        self._listener = self._publisher.declare_matching_listener(callback)
        # Typed as a bool, but it returns an object that is true in either case.
        status: Any = self._publisher.matching_status
        return bool(status.matching)


@functools.cache
def _encoding(kind: type | None) -> zenoh.Encoding:
    if kind is None:
        return zenoh.Encoding.IMAGE_JPEG
    return zenoh.Encoding.APPLICATION_JSON.with_schema(messages.schema(kind))


def _is_publication(sample: zenoh.Sample) -> bool:
    """Return True for puts on concrete keys: a put on a wildcard would pass for a publication of every sender."""
    return sample.kind == zenoh.SampleKind.PUT and "*" not in str(sample.key_expr)


def _collecting(to: Collector) -> Callback[zenoh.Reply]:
    def on_reply(reply: zenoh.Reply) -> None:
        sample = reply.ok
        if sample is not None:
            to.on_reply(str(sample.key_expr), sample.payload.to_bytes(), True)
        elif reply.err is not None:
            to.on_reply("", reply.err.payload.to_bytes(), False)

    return Callback(on_reply, to.on_final, indirect=False)


def _direct(callback: Callable[[Any], None]) -> Callback[Any]:
    return Callback(callback, lambda: None, indirect=False)


def _undeclare(declared: Any) -> Undeclare:
    def undeclare() -> None:
        try:
            declared.undeclare()
        except zenoh.ZError as error:
            log.debug("undeclaring failed: %s", error)

    return undeclare
