"""A mesh in memory: many processes' places on one event loop, on a network that fails to order.

What it does like Zenoh is what `tests/mesh/both_meshes.py` lets tests try on both. Links behave like TCP with a lease:
what is sent arrives in order; over a link that is cut, or to or from a frozen process, it waits; after
`lease` seconds of that both sides give the link up, and see each other's tokens die, until it works again."""

from __future__ import annotations

import asyncio
import itertools
import random
import weakref
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final

import zenoh

from zscout.keyexpr import Keys, Sender
from zscout.mesh import Mesh, MeshError
from zscout.mesh.transport import Collector, OnSample, Quality, Transport, TransportPublisher, TransportQuery, Undeclare
from zscout.types import SECOND, Ns


@lru_cache(1 << 16)
def intersects(one: str, other: str) -> bool:
    return one == other or zenoh.KeyExpr(one).intersects(zenoh.KeyExpr(other))


class MemoryMesh(Mesh):
    """One process's place on a MemoryNetwork; `network.open(...)` makes it."""

    _transport: MemoryTransport


def _memory(mesh: Mesh) -> MemoryMesh:
    if not isinstance(mesh, MemoryMesh):
        raise TypeError(f"{mesh} is not in memory")
    return mesh


def _node(mesh: Mesh) -> MemoryTransport:
    return _memory(mesh)._transport


class MemoryNetwork:
    """The processes of a fleet, and the links between them.

    All times are seconds. `delay` is that of every link, and `lease` how long a process waits for a silent peer."""

    def __init__(self, *, delay: float = 0.0002, lease: float = 1.0, seed: int = 0) -> None:
        self.delay, self.lease = delay, lease
        self.random = random.Random(seed)  # noqa: S311 - what failed once must fail again
        self.nodes: list[MemoryTransport] = []
        self._links: dict[tuple[MemoryTransport, MemoryTransport], MemoryLink] = {}

    def open(self, fleet: str, me: Sender) -> MemoryMesh:
        node = MemoryTransport(self)
        self.nodes.append(node)
        for other in self.nodes:
            self._connect(node, other)
        return MemoryMesh(node, Keys(fleet), me, node.now)

    def link(self, source: Mesh, target: Mesh) -> MemoryLink:
        """What carries messages from `source` to `target`: its delays and losses may be set."""
        return self.between(_node(source), _node(target))

    def cut(self, source: Mesh, target: Mesh) -> None:
        """Nothing passes from `source` to `target` any more, until `heal`."""
        self.link(source, target).cut = True
        self._changed()

    def isolate(self, mesh: Mesh) -> None:
        """Cuts all links of `mesh`, in both directions."""
        node = _node(mesh)
        for link in self._links.values():
            if node in (link.source, link.target) and link.source is not link.target:
                link.cut = True
        self._changed()

    def heal(self) -> None:
        """All links work again."""
        for link in self._links.values():
            link.cut = False
        self._changed()

    def freeze(self, mesh: Mesh) -> None:
        """Nothing reaches or leaves `mesh` until `thaw`: what arrives waits. (Its own tasks run on.)"""
        _node(mesh).frozen = True
        self._changed()

    def thaw(self, mesh: Mesh) -> None:
        _node(mesh).frozen = False
        self._changed()

    def kill(self, mesh: Mesh) -> None:
        """As though its process was killed: what it has sent arrives, then its tokens die."""
        self.thaw(mesh)
        _memory(mesh)._inbox.close()
        _node(mesh).leave()

    def remove(self, node: MemoryTransport) -> None:
        # What is under way is kept by the timers of its links.
        self.nodes.remove(node)
        self._links = {ends: link for ends, link in self._links.items() if node not in ends}
        self.match()

    def between(self, source: MemoryTransport, target: MemoryTransport) -> MemoryLink:
        link = self._links.get((source, target))
        if link is None:
            link = self._links[source, target] = MemoryLink(self, source, target)
        return link

    def match(self) -> None:
        """Tells publishers that follow their subscribers of changes."""
        for node in self.nodes:
            for publisher in node.followed:
                publisher.update()

    def _connect(self, one: MemoryTransport, other: MemoryTransport) -> None:
        for source, target in dict.fromkeys([(one, other), (other, one)]):
            link = self.between(source, target)
            link.lost = False
            for token in source.declared:
                link.send(target.on_token, source, token, True)
        self.match()

    def _changed(self) -> None:
        for link in tuple(self._links.values()):
            back = self.between(link.target, link.source)
            if link is back:
                continue
            if link.blocked:
                if link.expiry is None and not link.lost:
                    link.expiry = link.loop.call_later(self.lease, self._expire, link, back)
            else:
                if link.expiry is not None:
                    link.expiry.cancel()
                    link.expiry = None
                if link.lost and not back.blocked:
                    self._connect(link.source, link.target)
                link.pump()

    def _expire(self, *links: MemoryLink) -> None:
        for link in links:
            link.lost = True
            if link.expiry is not None:
                link.expiry.cancel()
                link.expiry = None
            if link.target.frozen:  # what has reached it waits there, with the end of the link behind
                link.send(link.target.disconnected, link.source, last=True)
            else:
                link.queue.clear()
                link.target.disconnected(link.source)
        self.match()


class MemoryLink:
    """One direction between two processes: what is sent arrives in order, or, with probability `loss`, not at
    all; after `delay` seconds and up to `jitter` more."""

    def __init__(self, network: MemoryNetwork, source: MemoryTransport, target: MemoryTransport) -> None:
        self.loop = source.loop
        self.source, self.target = source, target
        self.delay, self.jitter, self.loss = network.delay, 0.0, 0.0
        self.cut = False
        self.lost = False
        """Whether it was blocked for longer than the lease: there is no link then."""
        self.expiry: asyncio.TimerHandle | None = None
        self.queue: deque[tuple[float, Callable[..., None], tuple[Any, ...]]] = deque()
        self._random = network.random
        self._timer: asyncio.TimerHandle | None = None

    @property
    def blocked(self) -> bool:
        return self.cut or self.source.frozen or self.target.frozen

    def send(self, call: Callable[..., None], *args: Any, last: bool = False) -> None:
        if self.loop.is_closed():  # what is garbage then undeclares itself
            return
        if self.source is self.target:
            call(*args)
        elif last or not (self.lost or self.source.gone):
            due = self.loop.time() + self.delay + self._random.random() * self.jitter
            self.queue.append((max(due, self.queue[-1][0] if self.queue else 0.0), call, args))
            self.pump()

    def send_message(self, call: Callable[..., None], *args: Any) -> bool:
        """Like `send`, of what may get lost: whether it did not."""
        if self.loss and self._random.random() < self.loss:
            return False
        self.send(call, *args)
        return True

    def pump(self) -> None:
        """Delivers what is due, and calls itself when more is."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        while self.queue and not self.blocked:
            due, call, args = self.queue[0]
            if due > self.loop.time():
                self._timer = self.loop.call_at(due, self.pump)
                return
            self.queue.popleft()
            if not self.target.gone:
                call(*args)


class MemoryTransport(Transport):
    def __init__(self, network: MemoryNetwork) -> None:
        self.network = network
        self.loop = asyncio.get_running_loop()
        self.frozen = False
        self.gone = False
        self.declared: list[str] = []
        self.followed: list[MemoryPublisher] = []
        self._queryables: list[tuple[str, Callable[[TransportQuery], None]]] = []
        self._subscribers: list[tuple[str, OnSample]] = []
        self._watchers: list[tuple[str, Callable[[str, bool], None]]] = []
        self._gets: dict[_Get, None] = {}
        self._alive: dict[MemoryTransport, list[str]] = {}
        """Tokens that are known here, by the process that declared them."""

    def now(self) -> Ns:
        return round(self.loop.time() * SECOND)

    def links(self) -> int:
        return sum(1 for node in self._peers() if node is not self)

    async def close(self) -> None:
        self.leave()

    def leave(self) -> None:
        if not self.gone:
            for node in self._peers():
                self._to(node).send(node.disconnected, self)
            self.gone = True
            self.network.remove(self)

    def get(self, key: str, payload: bytes | None, kind: type | None, timeout: float, to: Collector) -> None:
        try:
            zenoh.KeyExpr(key)
            if self.gone:
                raise MeshError(f"{key} can't be asked: the session is closed")
        except zenoh.ZError as error:
            raise MeshError(f"{key} can't be asked: {error}") from None
        get = _Get(self, timeout, to)
        queries = [
            (node, _Query(get, node, key, payload), on_query)
            for node in self._peers()
            for declared, on_query in node._queryables
            if intersects(declared, key)
        ]
        get.waiting = {query.id: node for node, query, _ in queries}
        get.check()
        for node, query, on_query in queries:
            if not self._to(node).send_message(on_query, query):
                query.lose()

    def queryable(self, key: str, on_query: Callable[[TransportQuery], None]) -> Undeclare:
        return _add(self._queryables, (key, on_query))

    def publisher(self, key: str, kind: type | None, quality: Quality) -> TransportPublisher:
        return MemoryPublisher(self, key, quality)

    def put(self, key: str, payload: bytes, kind: type) -> None:
        self.publish(key, payload, None, Quality.CONTROL)

    def publish(self, key: str, payload: bytes, attachment: bytes | None, quality: Quality) -> None:
        for node in self._peers():
            link = self._to(node)
            if not (link.blocked and quality is not Quality.CONTROL) and node.subscribes(key):
                link.send_message(node.on_put, key, payload, attachment)

    def on_put(self, key: str, payload: bytes, attachment: bytes | None) -> None:
        for declared, on_sample in tuple(self._subscribers):
            if intersects(declared, key):
                on_sample(key, payload, attachment)

    def subscribes(self, key: str) -> bool:
        return any(intersects(declared, key) for declared, _ in self._subscribers)

    def subscriber(self, key: str, on_sample: OnSample) -> Undeclare:
        remove = _add(self._subscribers, (key, on_sample))
        self.network.match()

        def undeclare() -> None:
            remove()
            self.network.match()

        return undeclare

    def ring(self, key: str, depth: int) -> tuple[Callable[[], tuple[str, bytes] | None], Undeclare]:
        kept: deque[tuple[str, bytes]] = deque(maxlen=depth)
        undeclare = self.subscriber(key, lambda key, payload, _: kept.append((key, payload)))
        return (lambda: kept.popleft() if kept else None), undeclare

    def matching(self, key: str) -> bool:
        return any(node.subscribes(key) for node in self._peers())

    def token(self, key: str) -> Undeclare:
        self.declared.append(key)
        self._announce(key, True)

        def undeclare() -> None:
            finalizer()

        # Zenoh's, too, die with whoever should have kept them.
        finalizer = weakref.finalize(undeclare, self._undeclare_token, key)
        return undeclare

    def _undeclare_token(self, key: str) -> None:
        self.declared.remove(key)
        self._announce(key, False)

    def token_subscriber(self, key: str, on_token: Callable[[str, bool], None]) -> Undeclare:
        for token in self._known(key):
            on_token(token, True)
        return _add(self._watchers, (key, on_token))

    def tokens(self, key: str, timeout: float, to: Collector) -> None:
        for token in self._known(key):
            to.on_reply(token, b"", True)
        to.on_final()

    def on_token(self, source: MemoryTransport, token: str, alive: bool) -> None:
        before = self._lives(token)
        known = self._alive.setdefault(source, [])
        if alive:
            known.append(token)
        elif token in known:
            known.remove(token)
        if self._lives(token) != before:
            for key, on_token in tuple(self._watchers):
                if intersects(key, token):
                    on_token(token, alive)

    def disconnected(self, peer: MemoryTransport) -> None:
        for token in tuple(self._alive.get(peer, ())):
            self.on_token(peer, token, False)
        for get in tuple(self._gets):
            get.lost(peer)

    def _known(self, key: str) -> dict[str, None]:
        known = itertools.chain.from_iterable(self._alive.values())
        return dict.fromkeys(token for token in known if intersects(key, token))

    def _lives(self, token: str) -> bool:
        return any(token in tokens for tokens in self._alive.values())

    def _announce(self, token: str, alive: bool) -> None:
        for node in self._peers():
            self._to(node).send(node.on_token, self, token, alive)

    def _peers(self) -> list[MemoryTransport]:
        """The processes linked to this one, itself included."""
        return [] if self.gone else [node for node in self.network.nodes if not self._to(node).lost]

    def _to(self, node: MemoryTransport) -> MemoryLink:
        return self.network.between(self, node)


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
            self._on_matching(matching)

    def undeclare(self) -> None:
        if self in self._node.followed:
            self._node.followed.remove(self)


class _Get:
    """A query of this process that is not over yet."""

    def __init__(self, node: MemoryTransport, timeout: float, to: Collector) -> None:
        self.node = node
        self.waiting: dict[int, MemoryTransport] = {}
        self._to = to
        self._timer = node.loop.call_later(timeout, self._expire)
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

    def __init__(self, get: _Get, node: MemoryTransport, key: str, payload: bytes | None) -> None:
        self.id = next(self._ids)
        self._get: _Get | None = get
        self._back = node.network.between(node, get.node)
        self._key, self._payload = key, payload

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
            self._back.send_message(self._get.reply, self.id, key, payload, ok)
            self.drop()

    def lose(self) -> None:
        self._get = None

    def drop(self) -> None:
        get, self._get = self._get, None
        if get is not None:
            self._back.send_message(get.end, self.id)

    __del__ = drop
    """A handler that forgets a query drops it."""


def _add(items: list[Any], item: Any) -> Undeclare:
    items.append(item)
    return lambda: items.remove(item)
