"""What the programs of a simulated fleet do: they ask for devices, at random, and command what they hold."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from zscout.behaviors.client.arc import Held, Revoked, hold, holds
from zscout.behaviors.client.client import Client, CommandRefused, RequestRefused
from zscout.keyexpr import RANDOM

LONG: Final = 4


@dataclass(slots=True)
class Work:
    """What all programs have to do: to ask for `devices` until `over`, with up to `pause` seconds in between."""

    devices: Mapping[str, Mapping[str, object] | None]
    """By RC: its capacity, where it is sharable."""
    pause: float
    counts: Counter[str]
    log: Callable[[str], None]
    broken: Callable[[str], None]
    over: bool = False

    async def run(self, client: Client, arc: str, busy: set[str]) -> None:
        """One ARC after the other, under one name, which is in `busy` while one is open."""
        rng = RANDOM.get()
        await asyncio.sleep(rng.uniform(0, 3))
        while not self.over:
            rcs = rng.sample(sorted(self.devices), rng.choice((1, 1, 2, 2, 3)))
            needs = {rc: {"rate": rng.choice((2, 4, 6))} if self.devices[rc] else {} for rc in rcs}
            # Some go on through any fault, and its end.
            times = LONG if rng.random() < 0.15 else 1
            how: dict[str, Any] = {
                "priority": rng.choice((0, 0, 0, 1, 5)),
                "min_runtime": round(rng.uniform(0.3, 3) * times, 3),
                "keep": rng.random() < 0.1,
            }
            self.counts["requests"] += 1
            self.log(f"{arc} asks for {' '.join(rcs)} {how}")
            busy.add(arc)
            try:
                if rng.random() < 0.5:
                    async with hold(client, arc, needs, **how) as held:
                        await self._body(held, times)
                else:
                    async for attempt in holds(client, arc, needs, **how):
                        async with attempt as held:
                            await self._body(held, times)
            except Revoked as revoked:
                self.counts[f"revoked {revoked.outcome}"] += 1
            except (RequestRefused, CommandRefused) as refused:
                self.broken(f"{arc} was thrown away: {refused.code}: {refused}")
            busy.discard(arc)
            await asyncio.sleep(rng.uniform(0.05, self.pause))

    async def _body(self, held: Held, times: int) -> None:
        rng = RANDOM.get()
        self.counts["grants"] += 1
        for _ in range(rng.randrange(1, 12) * times):
            try:
                await held.command(rng.choice(held.rcs), {"name": "echo", "value": 1})
                self.counts["commands"] += 1
            except CommandRefused as refused:
                self.counts[f"refused {refused.code}"] += 1
            await asyncio.sleep(rng.uniform(0.02, 0.3))
