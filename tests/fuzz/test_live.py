"""A burst of hostile messages, raw, at a real node with RCs and a recorder, beside a client that holds."""

from __future__ import annotations

import asyncio
import random
from pathlib import Path

import psutil
import pytest

from tests.fuzz.fleet import ROWS
from tests.fuzz.hostile import Hostile, Names, is_one
from tests.hang import HANG
from tests.live.lab import TTL, Lab
from tests.live.stranger import LIMITS, Stranger
from tests.live.test_recorder import recorder
from tests.thorough import times
from zscout import messages
from zscout.behaviors.client.arc import Held, hold
from zscout.keyexpr import Role

pytestmark = [pytest.mark.live, pytest.mark.slow]

ABSURD = ((10**12, "f"), (2**52 - 1, "f"), (2**60, "f"), (-1, ""))
"""Terms that nobody believes who hears an RCM."""
FIELDS = {
    "rc": ("robot/a", "radio/a", "robot/b", "robot/x"),
    "client": ("test/victim", "t/good", "t/stranger"),
    "host": ("n", "t", "test"),
}
SAYS_A_TERM = (messages.Grants, messages.Placements, messages.RcState, messages.Notice)
SAID = times(150)


def burst(stranger: Stranger, seed: int) -> int:
    """Sends what is no message of the key that it is sent on, or is of an absurd term; how much that was."""
    rng, count = random.Random(seed), 0  # noqa: S311 - what failed once must fail again
    hostile = Hostile(rng, Names(ABSURD, FIELDS))
    while count < SAID:
        row = rng.choice([row for row in ROWS if row.asked or row.published])
        kinds = (*row.asked, *row.published)
        absurd = rng.randrange(4) == 0 and row.published and issubclass(row.published[0], SAYS_A_TERM)
        key, payload = hostile.key(row, 2), hostile.payload(row.published if absurd else kinds, 0 if absurd else 2)
        if not absurd and any(is_one(payload, kind, messages.MAX_STATE) for kind in kinds):
            continue
        count += 1
        stranger.put(key, payload)
        if row.asked and not absurd:
            # Of a message that is none nobody says that it is done.
            assert all(kind == "err" for kind, _ in stranger.get(key, payload)), (key, payload[:500])
        if row.published:
            stranger.session.delete(f"{stranger.base}/{key}")
        if rng.randrange(10) == 0:
            alive = next(row for row in ROWS if not row.asked and not row.published)
            stranger.token(hostile.key(alive, 9).removeprefix("alive/") + "/odd").undeclare()
    return count


def test_a_node_serves_on_after_a_burst_of_what_is_no_message(tmp_path: Path) -> None:
    async def story() -> None:
        async with Lab(tmp_path, extra=LIMITS) as lab:
            node = lab.node("n", "robot/a", "robot/b", "radio/a:rate=10", extra=recorder())
            client = await lab.client("victim")
            before = await lab.ready(client, "robot/a", "robot/b", "radio/a")
            await lab.living(client, Role.RECORDER, lambda found: found == ["n"])
            stranger = await asyncio.to_thread(Stranger, lab)
            try:
                async with hold(client, "victim", {"robot/b": {}}, min_runtime=10 * HANG) as held:
                    first = standing(held)
                    for seed in range(3):
                        if seed == 1:  # what any first burst takes is no growth
                            memory, log = used(node.pid), len(lab.log("n"))
                        await asyncio.to_thread(burst, stranger, seed)
                        await asyncio.to_thread(stranger.serves)
                    assert used(node.pid) - memory < 60_000_000
                    assert len(lab.log("n")) - log < 300_000
                    after = await lab.state(client, lambda _: True)
                    assert (after.term, client.internals.term) == (before.term, before.term)
                    assert held.active
                    assert standing(held) == first
                    assert (await held.command("robot/b", {"name": "echo", "value": 7}, ttl=TTL)).result == 7
            finally:
                await asyncio.to_thread(stranger.close)
            assert node.poll() is None
            assert "Traceback" not in lab.log("n")
            assert "ERROR" not in lab.log("n")

    asyncio.run(story())


def standing(held: Held) -> object:
    return held.grant, held.arc._place, held.arc.state


def used(pid: int) -> int:
    """Bytes, by a node and what it has started."""
    node = psutil.Process(pid)
    return sum(process.memory_info().rss for process in (node, *node.children(recursive=True)))
