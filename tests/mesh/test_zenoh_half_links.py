"""What Zenoh does with a link that only one of its two ends has lost. Two bare sessions; nothing of zscout.

`b` made its link with `a`, through a relay that ends a's half alone. Then a third session tells each of the other."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress

import pytest
import zenoh

from tests.hang import HANG
from tests.ports import free_port

HOST = "127.0.0.1"


def _open(stack: ExitStack, listen: list[str], connect: list[str]) -> zenoh.Session:
    settings = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "transport/link/tx/lease": 60_000,
    }.items():
        settings.insert_json5(key, json.dumps(value))
    return stack.enter_context(zenoh.open(settings))


class _Relay:
    """From a port of its own to `port`, for one link."""

    def __init__(self, stack: ExitStack, port: int) -> None:
        self._listener = stack.enter_context(socket.create_server((HOST, 0)))
        self.endpoint = f"tcp/{HOST}:{self._listener.getsockname()[1]}"
        self._ends: list[socket.socket] = []
        self._port = port
        threading.Thread(target=self._serve, daemon=True).start()
        stack.callback(self._close)

    def _serve(self) -> None:
        near, _ = self._listener.accept()
        self._ends = [near, socket.create_connection((HOST, self._port))]
        for one, other in (self._ends, self._ends[::-1]):
            threading.Thread(target=self._pump, args=(one, other), daemon=True).start()

    def _close(self) -> None:
        for end in self._ends:
            end.close()

    @staticmethod
    def _pump(one: socket.socket, other: socket.socket) -> None:
        with suppress(OSError):
            while data := one.recv(65_536):
                other.sendall(data)

    def end_far_half(self) -> None:
        self._ends[1].shutdown(socket.SHUT_RDWR)


def _until(condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + HANG
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def test_what_was_declared_stays_unknown_where_one_end_alone_lost_the_link(stack: ExitStack) -> None:
    ports = {"a": free_port(), "b": free_port()}
    own = {name: f"tcp/{HOST}:{port}" for name, port in ports.items()}
    a, relay = _open(stack, [own["a"]], []), _Relay(stack, ports["a"])
    b = _open(stack, [own["b"]], [relay.endpoint])
    first = _token(b, "alive/b")
    _until(lambda: _tokens(a) == ["alive/b"])
    relay.end_far_half()
    _until(lambda: a.info.links() == [] and len(b.info.links()) == 1)
    _open(stack, [], list(own.values()))
    # Now a has made a link with b, which has two with a then. Each lists it in its own time.
    _until(lambda: (_links(a, b), _links(b, a)) == (1, 2))
    assert _tokens(a) == []
    del first


def _links(one: zenoh.Session, other: zenoh.Session) -> int:
    return [link.zid for link in one.info.links()].count(other.zid())


def _token(session: zenoh.Session, key: str) -> object:
    return session.liveliness().declare_token(key)


def _tokens(session: zenoh.Session) -> list[str]:
    replies = session.liveliness().get("alive/*", timeout=1.0)
    return [str(reply.ok.key_expr) for reply in replies if reply.ok]
