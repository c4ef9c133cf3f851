"""A component that holds a robot and counts the commands it obeyed; a move takes hold and count along."""

from typing import Any

from zscout import holds
from zscout.components.component import Component, Stage


class Survey(Component):
    def __init__(self, params: dict[str, Any]) -> None:
        self.robot = params.get("robot", "robot/scout33")
        self.done = 0

    async def run(self, stage: Stage) -> None:
        async for attempt in holds(stage.client, stage.component, {self.robot: {}}, min_runtime=60):
            async with attempt as held:
                while True:
                    await held.command(self.robot, {"name": "echo", "value": self.done})
                    self.done += 1
                    await stage.safe_point()

    def checkpoint(self) -> bytes:
        return str(self.done).encode()

    def restore(self, state: bytes) -> None:
        self.done = int(state)
