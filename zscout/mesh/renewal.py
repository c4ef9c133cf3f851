"""A session that can be reopened, and the contradictions that demand it.

Zenoh's links can come back without all declarations of the other side (docs/zenoh.md). When such a contradiction
lasts, the process opens another session with all its declarations and closes the first; no caller notices."""

from __future__ import annotations

import asyncio
import itertools
import logging
import threading
from collections.abc import Awaitable, Callable, Collection, Sequence
from typing import Final, TypeAlias
from weakref import WeakValueDictionary

from zscout.mesh.exchange import MeshError
from zscout.mesh.transport import Collector, OnSample, Quality, Transport, TransportPublisher, TransportQuery, Undeclare
from zscout.types import SECOND, Ns

log = logging.getLogger(__name__)

PATIENCE: Final = 2.0  # seconds for which a contradiction must last
SILENT_RCM_PATIENCE: Final = 0.5  # seconds that a live RCM may be silent beyond half a hold lease: holds must not lapse
FORGET_AFTER: Final = 60.0  # seconds after which a contradiction is forgotten unless reported again
OVERLAP: Final = 0.5  # seconds with both sessions open, for others to learn the declarations of the new one
MAX_OVERLAPS: Final = 3  # overlaps to wait for each peer of the old session to have a link to the new one
LINK_TIMEOUT: Final = 2.0  # seconds for the new session to link to the peers of the old one
LEAVE_TIMEOUT: Final = 1.0  # seconds to wait for the old session to close; its links end sooner
LOOK_EVERY: Final = 0.02
MIN_PAUSE, MAX_PAUSE = 10.0, 320.0  # seconds between renewals, doubled while a contradiction outlives them

OnToken: TypeAlias = Callable[[str, bool], None]
Opening: TypeAlias = Callable[[], Awaitable[Transport]]


class Suspicions:
    """Contradictions seen by this process, by subject. `renew` is called when a contradiction lasts."""

    def __init__(self, now: Callable[[], Ns], renew: Callable[[], object]) -> None:
        self._now, self._renew = now, renew
        self._since: dict[str, tuple[Ns, Ns]] = {}  # first and last report of each
        self._last: Ns | None = None
        self._pause = MIN_PAUSE
        self._acted: dict[str, Ns] = {}  # last renewal for each unresolved contradiction

    @property
    def any(self) -> bool:
        """True while a contradiction is suspected or unresolved."""
        return bool(self._since or self._acted)

    def suspect(self, what: str, *, so: bool = True, patience: float = PATIENCE) -> None:
        """Report a contradiction repeatedly while it lasts, or its end (`so=False`); `patience` is in seconds."""
        if not so:
            self._since.pop(what, None)
            self._acted.pop(what, None)
            return
        now = self._now()
        self._since = {key: seen for key, seen in self._since.items() if now - seen[1] < FORGET_AFTER * SECOND}
        first, _ = self._since.get(what, (now, now))
        self._since[what] = first, now
        if now - first < patience * SECOND:
            return
        self._acted = {key: at for key, at in self._acted.items() if now - at < 10 * MAX_PAUSE * SECOND}
        if self._last is not None:
            helped = what not in self._acted
            if now - self._last < (MIN_PAUSE if helped else self._pause) * SECOND:
                return
            calm = now - self._last > 10 * self._pause * SECOND
            self._pause = MIN_PAUSE if helped or calm else min(MAX_PAUSE, 2 * self._pause)
        self._last = self._acted[what] = now
        self._since.clear()
        log.warning("%s: reopening the mesh session", what)
        self._renew()

    def keep(self, current: Collection[str], prefix: str) -> None:
        """Drop all contradictions that begin with `prefix` and are not in `current`."""
        for known in (self._since, self._acted):
            for what in [what for what in known if what.startswith(prefix) and what not in current]:
                del known[what]


class RenewableTransport(Transport):
    """A session that can be replaced: `openings` each open a session, in turn, and the last session stays."""

    def __init__(self, transport: Transport, openings: Sequence[Opening]) -> None:
        self.current, self._openings = transport, openings
        self._declared: dict[int, _Declared] = {}
        self._tokens: WeakValueDictionary[int, _Token] = WeakValueDictionary()  # die with their undeclare function
        self._numbers = itertools.count()
        self._renewing: asyncio.Task[None] | None = None
        self._leaving: set[asyncio.Task[None]] = set()
        self._closed = False
        self.behind = False
        """True if the present session lacks the latest settings: a renewal began before they changed, or failed."""

    def renew(self) -> None:
        """Start a renewal, unless one runs. A failure is logged, and keeps the present session."""
        if self._renewing is None and not self._closed:
            self._renewing = asyncio.create_task(self._renew())

    def take_settings(self) -> None:
        """Renew with changed settings; repeat a running renewal, which may have begun with older settings."""
        self.behind = True
        self.renew()

    async def _renew(self) -> None:
        wanted, self.behind, failed = self.behind, False, True
        try:
            for opening in self._openings:
                fresh = await opening()
                try:
                    await self._linked(self.current, fresh)
                    old, self.current = self.current, fresh
                except BaseException:
                    await fresh.close()
                    raise
                try:
                    # Declare first, so that no token of this process disappears in between.
                    for declared in self._all():
                        declared.declare(fresh)
                    # A peer may meanwhile link to the old one: after a new network, or a renewal of the peer.
                    for _ in range(MAX_OVERLAPS):
                        known = {*fresh.peers(), fresh.id()}
                        await asyncio.sleep(OVERLAP)
                        await self._linked(old, fresh)
                        if set(old.peers()) <= known:
                            break
                finally:
                    await self._leave(old)
                    for declared in self._all():
                        declared.forget_old()
            failed = False
        except MeshError as error:
            log.warning("%s", error)
        except Exception:
            log.exception("the mesh session could not be reopened")
        finally:
            self._renewing = None
        if failed:
            self.behind |= wanted
        elif self.behind:
            self.renew()

    async def _leave(self, old: Transport) -> None:
        """Close `old`, without waiting for the end of an attempt to connect: new settings may be due."""
        leaving = asyncio.create_task(old.close())
        self._leaving.add(leaving)
        leaving.add_done_callback(self._leaving.discard)
        await asyncio.wait({leaving}, timeout=LEAVE_TIMEOUT)

    async def _linked(self, old: Transport, fresh: Transport) -> None:
        """Wait until `fresh` has links to all peers of `old`, at most LINK_TIMEOUT seconds."""
        # Polled: Zenoh reports no new links, and listing them is cheap.
        tries = round(LINK_TIMEOUT / LOOK_EVERY)
        while tries and not set(old.peers()) <= {*fresh.peers(), fresh.id()}:
            tries -= 1
            await asyncio.sleep(LOOK_EVERY)

    def _all(self) -> list[_Declared]:
        return [declared for _, declared in sorted([*self._declared.items(), *self._tokens.items()])]

    def _keep(self, declare: Callable[[Transport], Undeclare]) -> Undeclare:
        number, declared = next(self._numbers), _Other(declare)
        self._declared[number] = declared
        declared.declare(self.current)

        def undeclare() -> None:
            self._declared.pop(number, None)
            declared.close()

        return undeclare

    def _keep_token(self, key_of: Callable[[str], str]) -> Undeclare:
        token = self._tokens[next(self._numbers)] = _Token(key_of)
        token.declare(self.current)
        return token.close

    def _owns(self, key: str) -> bool:
        return any(token.key == key for token in list(self._tokens.values()))

    def id(self) -> str:
        return self.current.id()

    def peers(self) -> list[str]:
        return self.current.peers()

    def links(self) -> int:
        return self.current.links()

    def relays(self) -> int:
        return self.current.relays()

    async def close(self) -> None:
        self._closed = True
        if self._renewing is not None:
            self._renewing.cancel()
            await asyncio.wait({self._renewing})
        await asyncio.gather(self.current.close(), *self._leaving)

    def get(self, key: str, payload: bytes | None, kind: type | None, timeout: float, to: Collector) -> None:
        self.current.get(key, payload, kind, timeout, to)

    def put(self, key: str, payload: bytes, kind: type) -> None:
        self.current.put(key, payload, kind)

    def tokens(self, key: str, timeout: float, to: Collector) -> None:
        self.current.tokens(key, timeout, to)

    def queryable(self, key: str, on_query: Callable[[TransportQuery], None]) -> Undeclare:
        def declare(transport: Transport) -> Undeclare:
            def once(query: TransportQuery) -> None:
                # While there are two sessions a query may arrive on both.
                if transport is self.current:
                    on_query(query)
                else:
                    query.drop()

            return transport.queryable(key, once)

        return self._keep(declare)

    def subscriber(self, key: str, on_sample: OnSample) -> Undeclare:
        return self._keep(lambda transport: transport.subscriber(key, on_sample))

    def token(self, key: str) -> Undeclare:
        return self._keep_token(lambda _session: key)

    def own_token(self, key_of: Callable[[str], str]) -> Undeclare:
        """A token whose key names the session that declares it."""
        return self._keep_token(key_of)

    def ring(self, key: str, depth: int, most: int) -> tuple[Callable[[], tuple[str, bytes] | None], Undeclare]:
        taking: list[Callable[[], tuple[str, bytes] | None]] = []

        def declare(transport: Transport) -> Undeclare:
            take, undeclare = transport.ring(key, depth, most)
            taking.append(take)
            return undeclare

        undeclare = self._keep(declare)

        def take() -> tuple[str, bytes] | None:
            # First drain the old session.
            while len(taking) > 1:
                if (found := taking[0]()) is not None:
                    return found
                del taking[0]
            return taking[0]()

        return take, undeclare

    def publisher(self, key: str, kind: type | None, quality: Quality) -> TransportPublisher:
        publisher = _RenewablePublisher(lambda transport: transport.publisher(key, kind, quality))
        publisher.close = self._keep(publisher.declare)
        return publisher

    def token_subscriber(self, key: str, on_token: OnToken) -> Undeclare:
        return self._keep(_TokenView(key, on_token, self._owns).declare)


class _Declared:
    """One declaration: on the present session, and on the previous session until that is closed."""

    def __init__(self) -> None:
        self._undeclare: list[Undeclare] = []
        self._closed = False

    def declare(self, transport: Transport) -> None:
        if not self._closed:
            self._undeclare.append(self._on(transport))

    def forget_old(self) -> None:
        del self._undeclare[:-1]

    def close(self) -> None:
        self._closed = True
        while self._undeclare:
            self._undeclare.pop(0)()

    def _on(self, transport: Transport) -> Undeclare:
        raise NotImplementedError


class _Other(_Declared):
    def __init__(self, declare: Callable[[Transport], Undeclare]) -> None:
        super().__init__()
        self._declare = declare

    def _on(self, transport: Transport) -> Undeclare:
        return self._declare(transport)


class _Token(_Declared):
    """`key_of` returns the key for a session id."""

    def __init__(self, key_of: Callable[[str], str]) -> None:
        super().__init__()
        self._key_of = key_of
        self.key = ""

    def _on(self, transport: Transport) -> Undeclare:
        self.key = self._key_of(transport.id())
        return transport.token(self.key)

    def close(self) -> None:
        self.key = ""
        super().close()


class _RenewablePublisher(TransportPublisher):
    close: Undeclare

    def __init__(self, declare: Callable[[Transport], TransportPublisher]) -> None:
        self._declare = declare
        self._on_matching: Callable[[bool], None] | None = None

    def declare(self, transport: Transport) -> Undeclare:
        self._publisher = self._declare(transport)
        if self._on_matching is not None:
            self._on_matching(self._publisher.match(self._on_matching))
        return self._publisher.undeclare

    def put(self, payload: bytes, attachment: bytes | None = None) -> None:
        self._publisher.put(payload, attachment)

    def match(self, on_matching: Callable[[bool], None]) -> bool:
        self._on_matching = on_matching
        return self._publisher.match(on_matching)

    def undeclare(self) -> None:
        self.close()


class _TokenView:
    """Tracks the tokens on a key for a watcher, so that a new session reports only differences."""

    def __init__(self, key: str, on_token: OnToken, owns: Callable[[str], bool]) -> None:
        self._key, self._on_token, self._owns = key, on_token, owns
        self._session = 0
        # A token that dies during the iteration may be reported on the same thread.
        self._lock = threading.RLock()
        self._alive: dict[str, int] = {}  # number of the last session that reported each token

    def declare(self, transport: Transport) -> Undeclare:
        self._session += 1
        session = self._session

        def on_token(token: str, alive: bool) -> None:
            with self._lock:
                if session != self._session:  # reported by the old session, which closes soon
                    return
                # Zenoh reports a session's own token as gone while another session still declares the same token.
                if not alive and self._owns(token):
                    return
                known = token in self._alive
                if alive:
                    self._alive[token] = session
                else:
                    self._alive.pop(token, None)
                if known != alive:
                    self._on_token(token, alive)

        undeclare = transport.token_subscriber(self._key, on_token)
        if session > 1:
            asyncio.get_running_loop().call_later(2 * OVERLAP, self._forget, session)
        return undeclare

    def _forget(self, session: int) -> None:
        """Report as gone the tokens that session number `session` has not shown."""
        with self._lock:
            for token in [token for token, shown in self._alive.items() if shown < session]:
                del self._alive[token]
                self._on_token(token, False)
