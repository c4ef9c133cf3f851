"""The status of a tree's behaviors, published at a rate that a mesh can bear."""

from __future__ import annotations

import asyncio
from collections import deque
from dataclasses import replace
from typing import Final

from zscout.behaviors.client.client import Client
from zscout.behaviors.tree import BehaviorStatus
from zscout.messages import MAX_BOXES, MAX_DETAIL, BehaviorSaid
from zscout.types import SECOND, Ns

MAX_RATE: Final = 20
"""Publications of one client in a second; alerts and ends are always published."""
AGAIN: Final = 5.0
"""Seconds after which all that stands is published again."""
MAX_PATH: Final = 200
MAX_WORD: Final = 64


class StatusPublisher:
    """Publishes the status of a client's behaviors. Call it with each."""

    def __init__(self, client: Client) -> None:
        keys, me, self._now = client.mesh.keys, client.mesh.me, client.mesh.now
        self._publisher = client.mesh.publisher(keys.behavior(me), BehaviorSaid)
        self._published: deque[Ns] = deque(maxlen=MAX_RATE)
        self.withheld = 0
        """Those beyond MAX_RATE: published later, if they still stand then."""
        self._standing: dict[str, BehaviorStatus] = {}

    def __call__(self, status: BehaviorStatus) -> None:
        plain = replace(status, alert=False, boxes=(), camera="")
        if status.doing:
            self._standing[status.path] = plain
        else:
            self._standing.pop(status.path, None)
        now = self._now()
        crowded = len(self._published) == MAX_RATE and now - self._published[0] < SECOND
        if crowded and status.doing and not status.alert:
            self.withheld += 1
            return
        self._published.append(now)
        self._publish(status)

    def _publish(self, status: BehaviorStatus) -> None:
        self._publisher.put(
            BehaviorSaid(
                path=status.path[:MAX_PATH],
                doing=status.doing[:MAX_WORD],
                detail=status.detail[:MAX_DETAIL],
                robot=status.robot[:MAX_WORD],
                camera=status.camera[:MAX_WORD],
                alert=status.alert,
                boxes=list(status.boxes[:MAX_BOXES]),
            )
        )

    async def keep_publishing(self) -> None:
        """Publishes now and then what each behavior does, for new subscribers."""
        while True:
            await asyncio.sleep(AGAIN)
            for status in list(self._standing.values()):
                self._publish(status)

    def close(self) -> None:
        self._publisher.close()
