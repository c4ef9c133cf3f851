"""Kinds of components that behave badly, or say what they do, for the tests."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from typing import Any

from zscout.behaviors.components.component import Component, ComponentContext
from zscout.messages import MAX_CHECKPOINT

MEGABYTE = 1_000_000


class Still(Component):
    """Does nothing, and can't be moved."""

    async def run(self, context: ComponentContext) -> None:
        print(f"{context.component} {context.incarnation} on {context.client.mesh.me.host}", flush=True)
        await asyncio.Event().wait()


class Brief(Component):
    """Ends at once: by returning, raising, leaving, or a signal, as `how` says."""

    def __init__(self, params: dict[str, Any]) -> None:
        self.how = params["how"]

    async def run(self, context: ComponentContext) -> None:
        print("last words", flush=True)
        match self.how:
            case "raise":
                raise RuntimeError("the camera fell off")
            case "exit":
                sys.exit(3)
            case "vanish":
                os._exit(0)
            case "abort":
                os.kill(os.getpid(), signal.SIGABRT)
            case "children":
                await asyncio.create_subprocess_exec("sleep", "600", start_new_session=True)


class Deaf(Component):
    """Does not let itself be cancelled."""

    async def run(self, context: ComponentContext) -> None:
        while True:
            with suppress(asyncio.CancelledError):
                await asyncio.sleep(600)


class Flood(Component):
    """Writes as fast as it can; now and then what is no UTF-8."""

    async def run(self, context: ComponentContext) -> None:
        line = b"\xff" + b"f" * 62 + b"\n"
        while True:
            sys.stdout.buffer.write(line * 1024)
            await asyncio.sleep(0)


class Eater(Component):
    """Uses `memory` MB, in a child if `child` is true: how that ended it prints."""

    def __init__(self, params: dict[str, Any]) -> None:
        self.memory = params["memory"] * MEGABYTE

    async def run(self, context: ComponentContext) -> None:
        held = [b"x" * MEGABYTE for _ in range(self.memory // MEGABYTE)]
        print(len(held), flush=True)
        await asyncio.Event().wait()


class Parent(Component):
    """Starts a child, one in a session of its own, and one of that; prints their process ids."""

    def __init__(self, params: dict[str, Any]) -> None:
        self.busy = params.get("busy", False)

    async def run(self, context: ComponentContext) -> None:
        self._start_children()
        if self.busy:
            self._hog()
        await asyncio.Event().wait()

    def _start_children(self) -> None:
        apart = ["sh", "-c", "sleep 600 & echo $!; wait"]
        children = [subprocess.Popen(["sleep", "600"]), subprocess.Popen(apart, start_new_session=True)]
        # In one piece: the others write as well.
        print(f"{children[0].pid} {children[1].pid}\n", end="", flush=True)

    def _hog(self) -> None:
        while True:
            pass


class Never(Component):
    """Does not get ready."""

    def __init__(self, params: dict[str, Any]) -> None:
        print("warming up", flush=True)
        time.sleep(600)


class Restless(Component):
    """Can be moved, but comes to no safe point; with `size` it does, and its state has so many bytes."""

    def __init__(self, params: dict[str, Any]) -> None:
        self.size = params.get("size")
        self.broken = params.get("broken", False)

    async def run(self, context: ComponentContext) -> None:
        while True:
            await asyncio.sleep(0.01)
            if self.size is not None:
                await context.safe_point()

    def checkpoint(self) -> bytes:
        return b"x" * (self.size or 0)

    def restore(self, state: bytes) -> None:
        if self.broken:
            raise ValueError("this state is rotten")


class Garbler(Component):
    """Says to its node what is no message."""

    async def run(self, context: ComponentContext) -> None:
        os.write(int(sys.argv[1]), b"GET / HTTP/1.1\r\n\r\n")
        await asyncio.Event().wait()


TOO_LARGE = MAX_CHECKPOINT + 1
NO_COMPONENT = 7
