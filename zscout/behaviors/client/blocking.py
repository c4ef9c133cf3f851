"""The synchronous form, for scripts and notebooks.

    with zscout.connect() as lab, lab.hold("survey", {"robot/scout33": {}}, min_runtime=60) as held:
        held.command("robot/scout33", {"name": "echo", "value": 1})

A body that is plain Python can't be stopped from outside: look at `held.active`, wait with `held.wait(...)`,
or let `held.check()` raise. An RC obeys nothing under a hold that is over, whatever the body does.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Self, TypeVar

import uvloop

from zscout.behaviors.client.arc import Held, Revoked, hold
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import Needs
from zscout.config.fleet import Fleet
from zscout.mesh.supervision import done_within

T = TypeVar("T")


class BlockingHeld:
    """A hold in force, as a plain object."""

    def __init__(self, lab: Lab, held: Held) -> None:
        self._lab, self._held = lab, held

    @property
    def active(self) -> bool:
        return self._held.active and (self._held.arc.keep or self._held.remaining > 0)

    @property
    def remaining(self) -> float:
        """Seconds of the minimum runtime that are left."""
        return self._held.remaining

    def check(self) -> None:
        """Raises Revoked once the hold is over."""
        if not self.active:
            raise Revoked(self._held.arc)

    def wait(self, timeout: float) -> bool:
        """Waits until the hold is over, at most `timeout` seconds. True: it is over."""
        return self._lab.run(done_within(timeout, self._held.over()))

    @property
    def rcs(self) -> list[str]:
        """All that it holds, sorted."""
        return list(self._held.rcs)

    def rc(self, need: str) -> str:
        """The RC that meets a need, as `arc.Held.rc` has it. Raises KeyError."""
        return self._held.rc(need)

    def command(self, need: str, do: Mapping[str, Any], *, ttl: float = 1.0) -> Any:
        """Has one of the held RCs do something and returns its result: the one of this name, or that meets
        this pattern. Raises CommandRefused, and KeyError for a pattern that was not asked for."""
        return self._lab.run(self._held.command(need, do, ttl=ttl)).result


class Lab:
    """A client whose event loop runs in a thread of its own."""

    def __init__(self, name: str | None = None, *, fleet: Fleet | None = None, host: str | None = None) -> None:
        self._loop = uvloop.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="zscout", daemon=True)
        self._thread.start()
        try:
            self.client = self.run(Client.connect(name, fleet=fleet, host=host))
        except BaseException:
            self._stop()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    def close(self) -> None:
        if self._thread.is_alive():
            self.run(self.client.close())
            self._stop()

    @contextmanager
    def hold(
        self, name: str, needs: Needs, *, priority: int = 0, min_runtime: float = 1.0, keep: bool = False
    ) -> Iterator[BlockingHeld]:
        """Waits for all of `needs`; gives them back at the end of the body."""
        attempt = hold(self.client, name, needs, priority=priority, min_runtime=min_runtime, keep=keep)
        held = self.run(attempt.granted())
        try:
            yield BlockingHeld(self, held)
        finally:
            if held.arc.open:
                self.run(self.client.end(held.arc))

    def _stop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=5)


def connect(name: str | None = None, *, fleet: Fleet | None = None, host: str | None = None) -> Lab:
    """Joins the mesh from a plain script. Raises MeshError, BadInput."""
    return Lab(name, fleet=fleet, host=host)
