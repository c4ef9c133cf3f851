"""The other end of queries through zscout's asyncio interface: a `Mesh.serve` that answers at once.

`python -m benchmarks.face FLEET_FILE` is a child process (see child.py).
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from benchmarks.child import ready
from benchmarks.loop import run
from zscout.config.fleet import load_fleet
from zscout.keyexpr import Keys, Sender
from zscout.mesh import IncomingQuery, ZenohMesh
from zscout.messages import Notice, StateAsk
from zscout.types import Grant, Place, Term

RC = "bench/face"
TERM = Term(1, "0123456789ab")
NOTICE = Notice(
    id="0123456789ab",
    arc="bench",
    client="bench/bench",
    state="running",
    term=TERM,
    step=1,
    place=Place(TERM, 1),
    grant=Grant(TERM, 1),
    rcs=["robot/r0"],
    remaining=60.0,
)
"""The answer to a granted request."""


def key(keys: Keys) -> str:
    """The key on which it answers: a key of the fleet that is otherwise unused."""
    return keys.vote(RC)


async def serve(fleet_file: Path) -> None:
    fleet = load_fleet(fleet_file)

    def answer(request: IncomingQuery[StateAsk]) -> None:
        request.answer(NOTICE)

    async with await ZenohMesh.open(fleet, Sender("bench", "face")) as mesh:
        mesh.serve(key(mesh.keys), StateAsk, answer)
        ready()
        await asyncio.to_thread(sys.stdin.read)


if __name__ == "__main__":
    run(serve(Path(sys.argv[1])))
