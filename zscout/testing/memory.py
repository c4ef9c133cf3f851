"""A mesh in memory: the sessions of many processes on one event loop, on a network that fails on request.

`tests/mesh/both_meshes.py` tests that it behaves as Zenoh does. When a link was blocked for `lease` seconds, both sides
drop it and see each other's tokens disappear until it works again; it may come back without some declarations
(`MemoryNetwork.forgetful`). `link.py` carries the messages."""

from __future__ import annotations

import asyncio
import itertools
import random
import weakref
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from functools import lru_cache
from typing import Any, Final, Generic, NamedTuple, TypeVar

import zenoh

from zscout.keyexpr import Keys, Sender
from zscout.mesh import Mesh, MeshError
from zscout.mesh.renewal import RenewableTransport
from zscout.mesh.transport import Collector, OnSample, Quality, Transport, TransportPublisher, TransportQuery, Undeclare
from zscout.testing.link import Disturbance, MemoryLink, Trace, kind_of, operation_of
from zscout.testing.virtual_time import PROCESS, VirtualTimeLoop
from zscout.types import SECOND, Ns

H = TypeVar("H")


@lru_cache(1 << 16)
def intersects(first: str, second: str) -> bool:
    return first == second or zenoh.KeyExpr(first).intersects(zenoh.KeyExpr(second))


MAX_KNOWN_KEYS: Final = 1_000
"""Keys for which a session caches its handlers."""


class MemoryMesh(Mesh):
    """The mesh of one process on a MemoryNetwork; `network.open(...)` makes it."""

    _transport: RenewableTransport


def _memory(mesh: Mesh) -> MemoryMesh:
    if not isinstance(mesh, MemoryMesh):
        raise TypeError(f"{mesh} is not in memory")
    return mesh


def _node(mesh: Mesh) -> MemoryTransport:
    node = _memory(mesh)._transport.current
    assert isinstance(node, MemoryTransport)  # noqa: S101
    return node


class Neighbour(NamedTuple):
    """A linked session, and the link in both directions."""

    node: MemoryTransport
    to: MemoryLink
    back: MemoryLink


class MemoryNetwork:
    """The processes of a fleet, and the links between them.

    All times are in seconds. `delay`: of every link. `lease`: how long a process waits for a silent peer, less a random
    part of it, `impatience` at most. `relink`: the longest time until a lost link that could work is restored."""

    def __init__(
        self,
        *,
        delay: float = 0.0002,
        lease: float = 1.0,
        impatience: float = 0.0,
        relink: float = 0.0,
        seed: int = 0,
        closed: bool = False,
    ) -> None:
        self.closed = closed  # keys as with certificates, but no sender is refused
        self.delay, self.lease, self.impatience, self.relink = delay, lease, impatience, relink
        self.random = random.Random(seed)  # noqa: S311 - what failed once must fail again
        self.nodes: list[MemoryTransport] = []
        self.trace: Trace | None = None
        self.forgetful = 0.0
        """Probability that a declaration stays unknown to a peer whose link comes back, until the link is lost
        again."""
        self.twice: Collection[str] = ()
        """Kinds of queries that arrive twice, as over two relays."""
        self.links: dict[tuple[MemoryTransport, MemoryTransport], MemoryLink] = {}
        """Links of all living sessions, each with itself included; made on first use."""
        self._linked: dict[MemoryTransport, list[Neighbour]] = {}
        """Cache of `linked`, cleared when any link changes."""
        self._ids = itertools.count(1)
        self._is_cut: Callable[[str, str], bool] = lambda _one, _other: False
        self._disturbed: Mapping[str, Disturbance] = {}

    def open(self, fleet: str, me: Sender) -> MemoryMesh:
        node = self._session()
        return MemoryMesh(RenewableTransport(node, [self._another]), Keys(fleet, closed=self.closed), me, node.now)

    def _session(self) -> MemoryTransport:
        node = MemoryTransport(self, next(self._ids))
        self.nodes.append(node)
        for other in self.nodes:
            self._connect(node, other)
        self._changed()
        return node

    def _sessions(self, mesh: Mesh) -> list[MemoryTransport]:
        """Return the sessions of its process: two while it reopens its session."""
        now = _node(mesh)
        mine = [node for node in self.nodes if node.process is now.process]
        return [now] if now.process is None else mine

    async def _another(self) -> MemoryTransport:
        return self._session()

    def cut_where(self, is_cut: Callable[[str, str], bool]) -> None:
        """Cut each link, also of later sessions, for which `is_cut(source, target)` is true of its processes' names."""
        self._is_cut = is_cut
        for link in self.links.values():
            link.cut = link.source is not link.target and is_cut(str(link.source), str(link.target))
        self._changed()

    def disturb(self, disturbed: Mapping[str, Disturbance]) -> None:
        """Disturb messages by kind from now on, on all links between different sessions."""
        self._disturbed = disturbed
        for link in self.links.values():
            link.disturbed = {} if link.source is link.target else disturbed
            link.answers.clear()

    def link(self, source: Mesh, target: Mesh) -> MemoryLink:
        """Return the link from `source` to `target`; its delay, jitter and loss may be set."""
        return self.between(_node(source), _node(target))

    def cut(self, source: Mesh, target: Mesh) -> None:
        """Block the link from `source` to `target` until `heal`."""
        self.link(source, target).cut = True
        self._changed()

    def isolate(self, mesh: Mesh) -> None:
        """Cut all links of `mesh` in both directions."""
        node = _node(mesh)
        for link in self.links.values():
            if node in (link.source, link.target) and link.source is not link.target:
                link.cut = True
        self._changed()

    def heal(self) -> None:
        """Unblock all links."""
        self._is_cut = lambda _one, _other: False
        for link in self.links.values():
            link.cut = False
        self._changed()

    def freeze(self, mesh: Mesh) -> None:
        """Freeze the process of `mesh` until `thaw`: nothing reaches or leaves it, messages wait."""
        for node in self._sessions(mesh):
            node.frozen = True
            if node.process is not None:
                node.process.stop()
        self._changed()

    def thaw(self, mesh: Mesh) -> None:
        for node in self._sessions(mesh):
            node.frozen = False
            if node.process is not None:
                node.process.resume()
        self._changed()

    def kill(self, mesh: Mesh, reached: MemoryTransport | None = None) -> None:
        """Kill the process of `mesh`. On each of its links a random number of the messages under way still arrives,
        then its tokens disappear. `reached`: all messages to that session arrive, and none to others."""
        self.thaw(mesh)
        _memory(mesh)._inbox.close()
        for node in self._sessions(mesh):
            for link in self.links.values():
                if link.source is node and link.target is not reached:
                    link.lose_unsent(None if reached is None else 0)
            node.leave()

    def after_sending(self, mesh: Mesh, kind: str, then: Callable[[MemoryTransport], None] | None) -> None:
        """Call `then` once with the receiving session, as soon as `mesh` has sent a message of that kind, an operation
        or its answer to another process."""
        _node(mesh).after = None if then is None else (kind, then)

    def remove(self, node: MemoryTransport) -> None:
        # Timers of the links keep the messages under way; a blocked link delivers nothing more.
        for link in self.links.values():
            if link.source is node and link.blocked:
                link.call_in(self.lease, link.target.call, link.target.disconnected, node)
        self.nodes.remove(node)
        self._linked.clear()
        self.links = {ends: link for ends, link in self.links.items() if node not in ends}
        self.match()

    def between(self, source: MemoryTransport, target: MemoryTransport) -> MemoryLink:
        link = self.links.get((source, target))
        if link is None:
            link = MemoryLink(source, target, self.delay, self.random, self.trace)
            if source is not target:
                link.cut, link.disturbed = self._is_cut(str(source), str(target)), self._disturbed
            if not (source.gone or target.gone):  # a late message may involve a closed session
                self.links[source, target] = link
        return link

    def linked(self, node: MemoryTransport) -> list[Neighbour]:
        """Return the sessions that `node` is linked to, itself included."""
        if (linked := self._linked.get(node)) is None:
            nodes = [Neighbour(other, self.between(node, other), self.between(other, node)) for other in self.nodes]
            linked = self._linked[node] = [neighbour for neighbour in nodes if not neighbour.to.lost]
        return linked

    def match(self) -> None:
        """Notify publishers that follow their subscribers of changes."""
        for node in self.nodes:
            for publisher in node.followed:
                publisher.update()

    def _relink(self, source: MemoryTransport, target: MemoryTransport, forgetful: float) -> None:
        if source.gone or target.gone:
            return
        link, back = self.between(source, target), self.between(target, source)
        link.relinking = None
        if link.lost and not (link.blocked or back.blocked):
            self._connect(source, target, forgetful)

    def _connect(self, first: MemoryTransport, second: MemoryTransport, forgetful: float = 0.0) -> None:
        self._linked.clear()
        for source, target in dict.fromkeys([(first, second), (second, first)]):
            link = self.between(source, target)
            back, link.lost = link.lost, False
            link.hidden = {item for item in source.declarations() if back and self.random.random() < forgetful}
            for token in source.declared:
                if token not in link.hidden:
                    link.send(target.on_token, source, token, True)
        self.match()

    def _changed(self) -> None:
        for (source, target), link in tuple(self.links.items()):
            if source is target:
                continue
            back = self.between(target, source)
            if link.blocked:
                if link.expiry is None and not link.lost:
                    patience = self.lease * (1 - self.impatience * self.random.random())
                    link.expiry = link.call_in(patience, self._expire, link, back)
            else:
                if link.expiry is not None:
                    link.expiry.cancel()
                    link.expiry = None
                if link.lost and not back.blocked and not (link.relinking or back.relinking):
                    if self.relink:
                        late = self.relink * self.random.random()
                        link.relinking = link.call_in(late, self._relink, source, target, self.forgetful)
                    else:
                        self._connect(source, target, self.forgetful)
                link.pump()

    def _expire(self, *links: MemoryLink) -> None:
        self._linked.clear()
        for link in links:
            link.lost = True
            if link.expiry is not None:
                link.expiry.cancel()
                link.expiry = None
            if link.target.frozen:  # delivered messages wait there, then the end of the link
                link.send(link.target.disconnected, link.source, last=True)
            else:
                link.queue.clear()
                link.target.call(link.target.disconnected, link.source)
        self.match()


class MemoryTransport(Transport):
    def __init__(self, network: MemoryNetwork, number: int) -> None:
        self.network, self.number = network, number
        loop = asyncio.get_running_loop()
        if not isinstance(loop, VirtualTimeLoop):
            raise TypeError("the mesh in memory needs virtual time")
        self.loop, self.process = loop, PROCESS.get()
        self.frozen = False
        self.gone = False
        self.after: tuple[str, Callable[[MemoryTransport], None]] | None = None
        self.declared: list[str] = []
        self.followed: list[MemoryPublisher] = []
        self.queryables: _Declared[Callable[[TransportQuery], None]] = _Declared()
        self.subscribers: _Declared[OnSample] = _Declared()
        self._watchers: _Declared[Callable[[str, bool], None]] = _Declared()
        self._gets: dict[_Get, None] = {}
        self._alive: dict[MemoryTransport, list[str]] = {}
        """Tokens known here, by the session that declared them."""
        self._lives: Counter[str] = Counter()
        """Number of declarations of each token."""
        self._id = f"{number:x}"

    def call(self, f: Callable[..., None], *args: Any) -> None:
        """Call `f` as code of this process."""
        if self.process is None:
            f(*args)
        elif not self.process.dead:
            self.process.run(f, *args)

    def __str__(self) -> str:
        return "nobody" if self.process is None else self.process.name

    def declarations(self) -> list[object]:
        return [*self.queryables.all, *self.subscribers.all, *self.declared]

    def now(self) -> Ns:
        return round(self.loop.time() * SECOND)

    def id(self) -> str:
        return self._id

    def peers(self) -> list[str]:
        return [node.id() for node, _, _ in self._linked() if node is not self]

    def links(self) -> int:
        return len(self.peers())

    def relays(self) -> int:
        return 0

    async def close(self) -> None:
        self.leave()

    def leave(self) -> None:
        if not self.gone:
            for node, to, _ in self._linked():
                to.send(node.disconnected, self)
            self.gone = True
            self.network.remove(self)
            self._alive.clear()
            self._lives.clear()

    def get(self, key: str, payload: bytes | None, kind: type | None, timeout: float, to: Collector) -> None:
        try:
            zenoh.KeyExpr(key)
            if self.gone:
                raise MeshError(f"{key} can't be queried: the session is closed")
        except zenoh.ZError as error:
            raise MeshError(f"{key} can't be queried: {error}") from None
        get = _Get(self, timeout, to)
        queries = [
            (there, _Query(get, there.back, key, payload), queryable[1])
            for there in self._linked()
            for queryable in there.node.queryables.matching(key)
            if queryable not in there.back.hidden
        ]
        get.waiting = {query.id: there.node for there, query, _ in queries}
        get.check()
        for there, query, on_query in queries:
            what = kind_of(key)
            if not there.to.send_message(what, on_query, query, operation=query.operation):
                query.lose()
            elif what in self.network.twice:
                there.to.send_message(what, on_query, query, operation=query.operation)

    def queryable(self, key: str, on_query: Callable[[TransportQuery], None]) -> Undeclare:
        return self.queryables.add(key, on_query)

    def publisher(self, key: str, kind: type | None, quality: Quality) -> TransportPublisher:
        return MemoryPublisher(self, key, quality)

    def put(self, key: str, payload: bytes, kind: type) -> None:
        self.publish(key, payload, None, Quality.CONTROL)

    def publish(self, key: str, payload: bytes, attachment: bytes | None, quality: Quality) -> None:
        kind = kind_of(key)
        for node, to, back in self._linked():
            if not (to.blocked and quality is not Quality.CONTROL) and node.subscribes(key, back):
                to.send_message(kind, node.on_put, self, key, payload, attachment)

    def on_put(self, source: MemoryTransport, key: str, payload: bytes, attachment: bytes | None) -> None:
        hidden = self.network.between(self, source).hidden
        for subscriber in self.subscribers.matching(key):
            if subscriber not in hidden:
                subscriber[1](key, payload, attachment)

    def subscribes(self, key: str, to: MemoryLink) -> bool:
        """Return True if the process at the end of this link knows of a subscriber to `key` here."""
        return any(subscriber not in to.hidden for subscriber in self.subscribers.matching(key))

    def subscriber(self, key: str, on_sample: OnSample) -> Undeclare:
        remove = self.subscribers.add(key, on_sample)
        self.network.match()

        def undeclare() -> None:
            remove()
            self.network.match()

        return undeclare

    def ring(self, key: str, depth: int, most: int) -> tuple[Callable[[], tuple[str, bytes] | None], Undeclare]:
        kept: deque[tuple[str, bytes]] = deque(maxlen=depth)
        undeclare = self.subscriber(key, lambda key, payload, _: kept.append((key, payload[: most + 1])))
        return (lambda: kept.popleft() if kept else None), undeclare

    def matching(self, key: str) -> bool:
        return any(node.subscribes(key, back) for node, _, back in self._linked())

    def token(self, key: str) -> Undeclare:
        self.declared.append(key)
        self._announce(key, True)

        def undeclare() -> None:
            finalizer()

        # As in Zenoh, a token dies with the declaration's last reference. The finalizer lives until then, so it must
        # not refer to this session.
        finalizer = weakref.finalize(undeclare, _call, weakref.WeakMethod(self._undeclare_token), key)
        return undeclare

    def _undeclare_token(self, key: str) -> None:
        self.declared.remove(key)
        self._announce(key, False)

    def token_subscriber(self, key: str, on_token: Callable[[str, bool], None]) -> Undeclare:
        for token in self._known(key):
            on_token(token, True)
        return self._watchers.add(key, on_token)

    def tokens(self, key: str, timeout: float, to: Collector) -> None:
        for token in self._known(key):
            to.on_reply(token, b"", True)
        to.on_final()

    def on_token(self, source: MemoryTransport, token: str, alive: bool) -> None:
        if self.gone:
            return
        before = token in self._lives
        known = self._alive.setdefault(source, [])
        if alive:
            known.append(token)
            self._lives[token] += 1
        elif token in known:
            known.remove(token)
            self._lives[token] -= 1
            if not self._lives[token]:
                del self._lives[token]
        if source.gone and not known:
            del self._alive[source]
        if (token in self._lives) != before:
            for _, on_token in self._watchers.matching(token):
                on_token(token, alive)

    def disconnected(self, peer: MemoryTransport) -> None:
        for token in tuple(self._alive.get(peer, ())):
            self.on_token(peer, token, False)
        for get in tuple(self._gets):
            get.lost(peer)

    def _known(self, key: str) -> dict[str, None]:
        known = itertools.chain.from_iterable(self._alive.values())
        return dict.fromkeys(token for token in known if intersects(key, token))

    def _announce(self, token: str, alive: bool) -> None:
        for node, to, _ in self._linked():
            to.send_message("alive", node.on_token, self, token, alive)

    def _linked(self) -> list[Neighbour]:
        return [] if self.gone else self.network.linked(self)


class MemoryPublisher(TransportPublisher):
    def __init__(self, node: MemoryTransport, key: str, quality: Quality) -> None:
        self._node, self._key, self._quality = node, key, quality
        self._matching = False
        self._on_matching: Callable[[bool], None] | None = None

    def put(self, payload: bytes, attachment: bytes | None = None) -> None:
        self._node.publish(self._key, payload, attachment, self._quality)

    def match(self, on_matching: Callable[[bool], None]) -> bool:
        self._matching = self._node.matching(self._key)
        self._on_matching = on_matching
        self._node.followed.append(self)
        return self._matching

    def update(self) -> None:
        matching = self._node.matching(self._key)
        if matching != self._matching and self._on_matching is not None:
            self._matching = matching
            self._node.call(self._on_matching, matching)

    def undeclare(self) -> None:
        if self in self._node.followed:
            self._node.followed.remove(self)


class _Get:
    """A running query of this process."""

    def __init__(self, node: MemoryTransport, timeout: float, to: Collector) -> None:
        self.node = node
        self.waiting: dict[int, MemoryTransport] = {}
        self._to = to
        self._timer = node.network.between(node, node).call_in(timeout, node.call, self._expire)
        node._gets[self] = None

    def reply(self, query: int, key: str, payload: bytes, ok: bool) -> None:
        if query in self.waiting:
            self._to.on_reply(key, payload, ok)

    def end(self, query: int) -> None:
        self.waiting.pop(query, None)
        self.check()

    def lost(self, peer: MemoryTransport) -> None:
        self.waiting = {query: node for query, node in self.waiting.items() if node is not peer}
        self.check()

    def check(self) -> None:
        if not self.waiting and self in self.node._gets:
            del self.node._gets[self]
            self._timer.cancel()
            self._to.on_final()

    def _expire(self) -> None:
        self._to.on_reply("", b"Timeout", False)
        self.waiting.clear()
        self.check()


class _Query(TransportQuery):
    _ids: Final = itertools.count()

    def __init__(self, get: _Get, back: MemoryLink, key: str, payload: bytes | None) -> None:
        self.id = next(self._ids)
        self._get: _Get | None = get
        self._back, self._kind = back, kind_of(key)
        self._key, self._payload = key, payload
        self.operation = operation_of(payload)

    @property
    def key(self) -> str:
        return self._key

    @property
    def payload(self) -> bytes | None:
        return self._payload

    def reply(self, key: str, payload: bytes, kind: type) -> None:
        self._reply(key, payload, True)

    def reply_error(self, payload: bytes, kind: type) -> None:
        self._reply("", payload, False)

    def _reply(self, key: str, payload: bytes, ok: bool) -> None:
        if self._get is not None:
            back = self._back
            if (fate := back.disturbed.get(self._kind)) is not None:
                before, back.answers[key] = back.answers.get(key, payload), payload
                payload = before if back.chance(fate.old) else payload
            back.send_message(self._kind, self._get.reply, self.id, key, payload, ok, operation=self.operation)
            self.drop()

    def lose(self) -> None:
        self._get = None

    def drop(self) -> None:
        get, self._get = self._get, None
        if get is not None:
            self._back.send(get.end, self.id)

    __del__ = drop
    """A handler that forgets its query drops it."""


def _call(method: weakref.WeakMethod[Callable[[str], None]], argument: str) -> None:
    if (alive := method()) is not None:
        alive(argument)


class _Declared(Generic[H]):
    """Handlers of one kind that a session has declared, each with its key expression."""

    def __init__(self) -> None:
        self.all: list[tuple[str, H]] = []
        self._matching: dict[str, list[tuple[str, H]]] = {}

    def add(self, key: str, handler: H) -> Undeclare:
        declared = key, handler
        self.all.append(declared)
        self._matching = {}

        def remove() -> None:
            self.all.remove(declared)
            self._matching = {}

        return remove

    def matching(self, key: str) -> list[tuple[str, H]]:
        """Return the handlers whose key expression intersects `key`; the list does not change."""
        if (found := self._matching.get(key)) is None:
            if len(self._matching) >= MAX_KNOWN_KEYS:  # most are keys of programs that have ended
                self._matching.clear()
            found = self._matching[key] = [declared for declared in self.all if intersects(declared[0], key)]
        return found
