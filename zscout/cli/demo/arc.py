"""One behavior of `zscout demo`, as a process of its own: asks for its ARC at the signal, tells what it got.

Standard input: a `Part` as one line of JSON; then an empty line is the signal. Standard output: `Word`s, one
line of JSON each. It ends when it had its time, or when standard input closes.
"""

from __future__ import annotations

import asyncio
import os
import sys
from decimal import Decimal
from typing import Literal, TypeAlias

import msgspec

from zscout import clock

Saying: TypeAlias = Literal["ready", "asked", "answered", "entered", "left", "done"]


class Part(msgspec.Struct, frozen=True):
    """What to ask for, and as whom."""

    host: str
    arc: str
    needs: tuple[str, ...]
    priority: int
    min_runtime: Decimal
    """Seconds."""


class Word(msgspec.Struct, frozen=True):
    """What happened, and when (ns on the host's clock). `entered` and `left` are the ARC's body."""

    arc: str
    what: Saying
    at: int
    detail: str = ""


async def behave(part: Part, signal: asyncio.Event) -> None:
    """Waits for all it needs to be there, says so, and asks at the signal."""
    # Imported late: the demo itself needs only the types above.
    from zscout.behaviors.arc import holds
    from zscout.behaviors.client import Client
    from zscout.behaviors.request import OpenArc
    from zscout.keyexpr import Role, Token

    def say(what: Saying, detail: str = "") -> None:
        sys.stdout.write(msgspec.json.encode(Word(part.arc, what, clock.now(), detail)).decode() + "\n")
        sys.stdout.flush()

    async with await Client.connect(part.arc, host=part.host) as client:
        missing, complete = {Role.RCM, *part.needs}, asyncio.Event()

        def seen(token: Token, alive: bool) -> None:
            if alive:
                missing.discard(token.name if token.role == Role.RC else token.role)
            if not missing:
                complete.set()

        watch = client.mesh.watch(client.mesh.keys.alive_any(), seen)
        await complete.wait()
        watch.close()
        say("ready")
        await signal.wait()
        say("asked")
        answered = False

        def word(arc: OpenArc) -> None:
            nonlocal answered
            if not answered and arc.state in ("queued", "running"):
                answered = True
                say("answered", arc.reason)

        client.watch(word)
        needs: dict[str, dict[str, Decimal]] = {rc: {} for rc in part.needs}
        asking = holds(client, part.arc, needs, priority=part.priority, min_runtime=part.min_runtime)
        async for attempt in asking:
            async with attempt:
                say("entered")
                try:
                    await asyncio.Event().wait()
                finally:
                    say("left")
        say("done")


async def _main(part: Part) -> None:
    loop, signal = asyncio.get_running_loop(), asyncio.Event()
    task = asyncio.ensure_future(behave(part, signal))

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
    """The first line of standard input, and not a byte more."""
    line = b""
    while not line.endswith(b"\n") and len(line) < 65_536 and (byte := os.read(0, 1)):
        line += byte
    return line


if __name__ == "__main__":
    asyncio.run(_main(msgspec.json.decode(read_line(), type=Part)))
