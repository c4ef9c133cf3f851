"""What a resource controller has to carry out, and in which order. Pure but for the waiting of `get`.

Changes of holders go before all commands, so that a safe state waits for no command. A command under a grant
that its RC does not know yet is set aside, outside the queue, until the RC knows more; then it stands
before all other commands, so that none of the same grant overtakes it.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable
from typing import Final, TypeAlias

from zscout.drivers.holds import HoldChange
from zscout.mesh import IncomingQuery
from zscout.messages import Command

EARLY_PER_HOST: Final = 16
"""Commands of one host that may be set aside."""

CommandQuery: TypeAlias = IncomingQuery[Command]


class WorkQueue:
    """Changes of holders and commands that wait for their turn."""

    def __init__(self) -> None:
        self._changes: deque[HoldChange] = deque()
        self._commands: deque[CommandQuery] = deque()
        self._early: list[tuple[str, CommandQuery]] = []
        """With the sender's host, in the order in which they came."""
        self._news = asyncio.Event()

    @property
    def commands(self) -> int:
        """Commands that wait, those that are set aside included."""
        return len(self._commands) + len(self._early)

    def put_change(self, change: HoldChange) -> None:
        self._changes.append(change)
        self._news.set()

    def put_command(self, command: CommandQuery) -> None:
        self._commands.append(command)
        self._news.set()

    def set_aside(self, command: CommandQuery, host: str) -> bool:
        """Keeps a command for `resume`. False: too many of this host are kept already."""
        if Counter(of for of, _ in self._early)[host] >= EARLY_PER_HOST:
            return False
        self._early.append((host, command))
        return True

    def resume(self, ready: Callable[[CommandQuery], bool]) -> None:
        """Puts those that are `ready` before all other commands, in the order in which they came."""
        found = [early for early in self._early if ready(early[1])]
        self._early = [early for early in self._early if early not in found]
        self._commands.extendleft(command for _, command in reversed(found))
        if found:
            self._news.set()

    def drop_early(self) -> list[CommandQuery]:
        """Those that are set aside still, which are no longer kept."""
        dropped, self._early = self._early, []
        return [command for _, command in dropped]

    async def get(self) -> HoldChange | CommandQuery:
        """The next change or command, once there is one."""
        while not (self._changes or self._commands):
            self._news.clear()
            await self._news.wait()
        return self._changes.popleft() if self._changes else self._commands.popleft()
