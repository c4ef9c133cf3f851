"""A behavior of `zscout demo table1` in its own process: it requests its ARC at a signal.

Standard input: an `ArcSpec` as a line of JSON, then an empty line as the signal. Standard output: `ArcReport`s,
a line of JSON each. It ends when its ARC is done, or when standard input closes.
"""

from __future__ import annotations

import asyncio
import os
import sys
from decimal import Decimal
from typing import Any, Literal, TypeAlias

import msgspec

from zscout.mesh import clock
from zscout.messages import ReasonInfo

Milestone: TypeAlias = Literal["ready", "asked", "answered", "entered", "left", "done"]


class ArcSpec(msgspec.Struct, frozen=True):
    host: str
    arc: str
    needs: tuple[str, ...]
    priority: int
    min_runtime: Decimal  # s


class ArcReport(msgspec.Struct, frozen=True):
    """`at` in ns on the host's clock; `entered` and `left` are about the ARC's body."""

    arc: str
    what: Milestone
    at: int
    detail: str = ""
    why: ReasonInfo | None = None


async def behave(spec: ArcSpec, signal: asyncio.Event) -> None:
    """Report when the RCM and all needed RCs are present, and request the ARC at the signal."""
    # Imported late: the demo needs only the types above.
    from zscout.behaviors.client.arc import holds
    from zscout.behaviors.client.client import Client
    from zscout.behaviors.client.request import OpenArc
    from zscout.keyexpr import Role, Token
    from zscout.messages import Who

    def report(what: Milestone, detail: str = "", why: ReasonInfo | None = None) -> None:
        sys.stdout.write(msgspec.json.encode(ArcReport(spec.arc, what, clock.now(), detail, why)).decode() + "\n")
        sys.stdout.flush()

    async with await Client.connect(spec.arc, host=spec.host) as client:
        client.who = msgspec.structs.replace(client.who or Who(), command=spec.arc)
        missing, complete = {Role.RCM, *spec.needs}, asyncio.Event()

        def seen(token: Token, alive: bool) -> None:
            if alive:
                missing.discard(token.name if token.role == Role.RC else token.role)
            if not missing:
                complete.set()

        watch = client.mesh.watch(client.mesh.keys.alive_any(), seen)
        await complete.wait()
        watch.close()
        report("ready")
        await signal.wait()
        report("asked")
        answered = False

        def on_state(arc: OpenArc) -> None:
            nonlocal answered
            if not answered and arc.state in ("queued", "running"):
                answered = True
                report("answered", arc.reason, arc.why)

        client.internals.watch(on_state)
        needs: dict[str, dict[str, Decimal]] = {rc: {} for rc in spec.needs}
        how: dict[str, Any] = {"priority": spec.priority, "min_runtime": spec.min_runtime, "keep": False}
        async for attempt in holds(client, spec.arc, needs, **how):
            async with attempt:
                report("entered")
                try:
                    await asyncio.Event().wait()
                finally:
                    report("left")
        report("done")


async def _main(spec: ArcSpec) -> None:
    loop, signal = asyncio.get_running_loop(), asyncio.Event()
    task = asyncio.ensure_future(behave(spec, signal))

    def read() -> None:
        if os.read(0, 4096):
            signal.set()
        else:
            loop.remove_reader(0)
            task.cancel()

    loop.add_reader(0, read)
    try:
        await task
    except asyncio.CancelledError:
        sys.exit(1)


def read_line() -> bytes:
    """Read the first line of standard input, and not a byte more."""
    line = b""
    while not line.endswith(b"\n") and len(line) < 65_536 and (byte := os.read(0, 1)):
        line += byte
    return line


if __name__ == "__main__":
    asyncio.run(_main(msgspec.json.decode(read_line(), type=ArcSpec)))
