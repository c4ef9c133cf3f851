"""How behaviors are heard on the mesh: what each of a tree says, at a rate that a mesh can bear."""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import replace
from typing import Final

from zscout import clock
from zscout.behaviors.client import Client
from zscout.behaviors.tree import Saying
from zscout.messages import MAX_BOXES, MAX_DETAIL, BehaviorSaid
from zscout.scheduling.model import SECOND, Ns

MAX_RATE: Final = 20
"""Sayings of one client in a second; alerts and ends are always told."""
AGAIN: Final = 5.0
"""Seconds after which all that stands is told again."""
MAX_PATH: Final = 200
MAX_WORD: Final = 64


class Voice:
    """Publishes what a client's behaviors say. Call it with each `Saying`."""

    def __init__(self, client: Client) -> None:
        keys, me = client.mesh.keys, client.mesh.me
        self._publisher = client.mesh.publisher(keys.behavior(me), BehaviorSaid)
        self._told: deque[Ns] = deque(maxlen=MAX_RATE)
        self.withheld = 0
        """Sayings beyond MAX_RATE: told later, if they still stand then."""
        self._standing: dict[str, Saying] = {}

    def __call__(self, saying: Saying) -> None:
        plain = replace(saying, alert=False, boxes=(), camera="")
        if saying.doing:
            self._standing[saying.path] = plain
        else:
            self._standing.pop(saying.path, None)
        now = clock.now()
        crowded = len(self._told) == MAX_RATE and now - self._told[0] < SECOND
        if crowded and saying.doing and not saying.alert:
            self.withheld += 1
            return
        self._told.append(now)
        self._publish(saying)

    def _publish(self, saying: Saying) -> None:
        self._publisher.put(
            BehaviorSaid(
                path=saying.path[:MAX_PATH],
                doing=saying.doing[:MAX_WORD],
                detail=saying.detail[:MAX_DETAIL],
                robot=saying.robot[:MAX_WORD],
                camera=saying.camera[:MAX_WORD],
                alert=saying.alert,
                boxes=list(saying.boxes[:MAX_BOXES]),
            )
        )

    async def keep_telling(self) -> None:
        """Tells now and then what each behavior does, for those who have just begun to listen."""
        while True:
            await asyncio.sleep(AGAIN)
            for saying in list(self._standing.values()):
                self._publish(saying)

    def close(self) -> None:
        self._publisher.close()
