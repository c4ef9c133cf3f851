"""Kinds of components that come with zscout: for trying things out, and for measuring."""

from __future__ import annotations

import asyncio
import json
import time
from typing import Any, Final

from zscout.behaviors.client.arc import Held, Revoked, holds
from zscout.behaviors.client.client import CommandRefused
from zscout.behaviors.components.component import Component, ComponentContext
from zscout.keyexpr import BadName, check_need

SLICE: Final = 0.02
"""Seconds of a turn of `spin`: in between the event loop has its own."""
MEGABYTE: Final = 1_000_000
MAX_MEMORY: Final = 1_000_000
PAGE: Final = 4_096
PAUSE: Final = 0.1


def figure(params: dict[str, Any], name: str, default: float, *, low: float, high: float) -> float:
    """A number among parameters. Raises ValueError."""
    value = params.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{name} is {value!r:.60}; write a number from {low:g} to {high:g}")
    return float(value)


def check_known(params: dict[str, Any], *names: str) -> None:
    """Raises ValueError for a parameter of another name."""
    for name in params:
        if name not in names:
            raise ValueError(f"there is no parameter {name!r:.60}; there are {', '.join(names)}")


class Counter(Component):
    """Counts, and prints each count.

    Parameters: `period`, seconds from one to the next (1); `rc`, an RC that it holds, and that echoes each
    count; `priority` of that (0); `min_runtime` of it in seconds (3600)."""

    def __init__(self, params: dict[str, Any]) -> None:
        check_known(params, "period", "rc", "priority", "min_runtime")
        self.period = figure(params, "period", 1.0, low=0.001, high=3600)
        self.priority = int(figure(params, "priority", 0, low=-1000, high=1000))
        self.min_runtime = figure(params, "min_runtime", 3600, low=0.001, high=1e9)
        self.rc = params.get("rc")
        try:
            if self.rc is not None:
                check_need(self.rc if isinstance(self.rc, str) else repr(self.rc))
        except BadName as error:
            raise ValueError(str(error)) from None
        self.count = 0

    async def run(self, context: ComponentContext) -> None:
        while self.rc is None:
            await self._step(context)
        while True:
            try:
                async for attempt in holds(
                    context.client,
                    context.component,
                    {self.rc: {}},
                    priority=self.priority,
                    min_runtime=self.min_runtime,
                ):
                    async with attempt as held:
                        while True:
                            await self._step(context, held)
            except (Revoked, CommandRefused) as error:
                print(f"{self.rc} is lost at {self.count}: {error}")  # noqa: T201 - its output
                await asyncio.sleep(PAUSE)

    async def _step(self, context: ComponentContext, held: Held | None = None) -> None:
        number = self.count + 1
        if held is not None and self.rc is not None:
            await held.command(self.rc, {"name": "echo", "value": number})
        self.count = number
        print(self.count)  # noqa: T201 - its output
        await context.safe_point()
        await asyncio.sleep(self.period)

    def checkpoint(self) -> bytes:
        return json.dumps({"count": self.count}).encode()

    def restore(self, state: bytes) -> None:
        self.count = int(json.loads(state)["count"])


class Spin(Component):
    """Computes, and prints how far it is once a second.

    Parameters: `cpu`, the share of one core that it wants (0.5); `memory` in MB that it fills (0)."""

    def __init__(self, params: dict[str, Any]) -> None:
        check_known(params, "cpu", "memory")
        self.cpu = figure(params, "cpu", 0.5, low=0, high=1)
        self.memory = bytearray(int(figure(params, "memory", 0, low=0, high=MAX_MEMORY) * MEGABYTE))
        # Memory is only used once it is written to.
        self.memory[::PAGE] = b"\1" * len(self.memory[::PAGE])
        self.loops = 0

    async def run(self, context: ComponentContext) -> None:
        due = said = time.monotonic()
        while True:
            self._turn(SLICE * self.cpu)
            due += SLICE
            now = time.monotonic()
            if now - said >= 1:
                said = now
                print(f"{self.loops} loops")  # noqa: T201 - its output
            await context.safe_point()
            # What it was not given is not made up for.
            due = max(due, now)
            await asyncio.sleep(due - now)

    def _turn(self, seconds: float) -> None:
        """Computes for so long on the processor."""
        until = time.thread_time() + seconds
        while time.thread_time() < until:
            self.loops += 1

    def checkpoint(self) -> bytes:
        return json.dumps({"loops": self.loops}).encode()

    def restore(self, state: bytes) -> None:
        self.loops = int(json.loads(state)["loops"])
