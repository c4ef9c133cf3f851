"""Kinds of components that come with zscout, for trials and measurements."""

from __future__ import annotations

import asyncio
import json
import time
from typing import Annotated, Any, Final, TypeVar

from msgspec import Struct

from zscout.behaviors.client.arc import Held, Revoked, holds
from zscout.behaviors.client.client import CommandRefused
from zscout.behaviors.components.component import Component, ComponentContext
from zscout.config.strict import BadInput, Where, convert, key
from zscout.keyexpr import check_need

T = TypeVar("T", bound=Struct)

PARAMS: Final = Where("")
SLICE: Final = 0.02
"""Seconds per round of `spin`; the event loop runs between rounds."""
MEGABYTE: Final = 1_000_000
PAGE: Final = 4_096
PAUSE: Final = 0.1


def read_params(params: dict[str, Any], kind: type[T]) -> T:
    """Raises ValueError."""
    try:
        return convert(params, kind, PARAMS)
    except BadInput as error:
        raise ValueError(str(error)) from None


class CounterParams(Struct):
    period: Annotated[float, key("Seconds from one count to the next.", 0.001, 3600)] = 1.0
    rc: Annotated[str | None, key("RC that it holds, and that echoes each count.")] = None
    priority: Annotated[float, key("Priority of its ARC.", -1000, 1000)] = 0.0
    min_runtime: Annotated[float, key("Minimum runtime of its ARC, in seconds.", 0.001, 1e9)] = 3600.0


class Counter(Component):
    def __init__(self, params: dict[str, Any]) -> None:
        self.params = read_params(params, CounterParams)
        self.rc = None if self.params.rc is None else check_need(self.params.rc)
        self.count = 0

    async def run(self, context: ComponentContext) -> None:
        while self.rc is None:
            await self._step(context)
        terms: dict[str, Any] = {
            "priority": int(self.params.priority),
            "min_runtime": self.params.min_runtime,
            "keep": False,
        }
        while True:
            try:
                async for attempt in holds(context.client, context.component, {self.rc: {}}, **terms):
                    async with attempt as held:
                        while True:
                            await self._step(context, held)
            except (Revoked, CommandRefused) as error:
                print(f"{self.rc} is lost at {self.count}: {error}")  # noqa: T201 - its output
                await asyncio.sleep(PAUSE)

    async def _step(self, context: ComponentContext, held: Held | None = None) -> None:
        number = self.count + 1
        if held is not None and self.rc is not None:
            await _echo(held, self.rc, number)
        self.count = number
        print(self.count)  # noqa: T201 - its output
        await context.safe_point()
        await asyncio.sleep(self.params.period)

    def checkpoint(self) -> bytes:
        return json.dumps({"count": self.count}).encode()

    def restore(self, state: bytes) -> None:
        self.count = int(json.loads(state)["count"])


async def _echo(held: Held, rc: str, number: int) -> None:
    """Repeat the command until it is answered: an echo may run twice. Raises CommandRefused."""
    while True:
        try:
            await held.command(rc, {"name": "echo", "value": number})
        except CommandRefused as refused:
            if refused.code != "unknown":
                raise
            # Without a link the command fails immediately.
            await asyncio.sleep(PAUSE)
        else:
            return


class SpinParams(Struct):
    cpu: Annotated[float, key("Share of one core that it uses.", 0, 1)] = 0.5
    memory: Annotated[float, key("Memory that it fills, in MB.", 0, 1_000_000)] = 0.0


class Spin(Component):
    """Uses processor time and memory; prints the number of its loops once a second."""

    def __init__(self, params: dict[str, Any]) -> None:
        wanted = read_params(params, SpinParams)
        self.cpu, self.memory = wanted.cpu, bytearray(int(wanted.memory * MEGABYTE))
        # Memory is only used once it is written to.
        self.memory[::PAGE] = b"\1" * len(self.memory[::PAGE])
        self.loops = 0

    async def run(self, context: ComponentContext) -> None:
        due = said = time.monotonic()
        while True:
            until = time.thread_time() + SLICE * self.cpu
            while time.thread_time() < until:
                self.loops += 1
            due += SLICE
            now = time.monotonic()
            if now - said >= 1:
                said = now
                print(f"{self.loops} loops")  # noqa: T201 - its output
            await context.safe_point()
            # Don't catch up on rounds that the scheduler delayed.
            due = max(due, now)
            await asyncio.sleep(due - now)

    def checkpoint(self) -> bytes:
        return json.dumps({"loops": self.loops}).encode()

    def restore(self, state: bytes) -> None:
        self.loops = int(json.loads(state)["loops"])
