"""A client in a process of its own that takes over: `python -m tests.live.heir NAME`.

It expects the requests that one line of its input names, says "ready", and, once they have come, the grants
under which it goes on, by name as JSON.
"""

from __future__ import annotations

import asyncio
import sys

import msgspec

from tests.live.handing_over import NEEDS, claimed
from zscout.behaviors.client.client import Client
from zscout.messages import OpenRequest


async def heir(name: str) -> None:
    async with await Client.connect(name, host="test") as client:
        line = await asyncio.to_thread(sys.stdin.readline)
        client.internals.expect(msgspec.json.decode(line, type=list[OpenRequest]))
        print("ready", flush=True)
        await client.internals.expected_came.wait()
        arcs = await claimed(client, list(NEEDS))
        grants = {name: await client.granted(arcs[name]) for name in ("drive", "talk")}
        print(msgspec.json.encode(grants).decode(), flush=True)
        await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    asyncio.run(heir(sys.argv[1]))
