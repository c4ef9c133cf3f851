"""What waits for the worker of one RC: changes of its holds, and commands."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable

from zscout.drivers.confirm_server import CommandQuery
from zscout.drivers.holds import HoldChange

COMMANDS_PER_HOST = 48
"""Of those that wait, at most."""
EARLY_PER_HOST = 16
"""Commands of one host that may be set aside."""


class WorkQueue:
    """What an RC has to carry out: changes of holders first, so that a safe state waits for no command.

    A command under a grant that the RC does not know yet is set aside, outside the queue, until the RC knows more; then
    it goes before all other commands, so that none of the same grant overtakes it."""

    def __init__(self) -> None:
        self._changes: deque[HoldChange] = deque()
        self._commands: deque[tuple[str, CommandQuery]] = deque()
        """With the sender's host."""
        self._early: list[tuple[str, CommandQuery]] = []
        """Likewise, in the order of arrival."""
        self._wakeup = asyncio.Event()

    @property
    def commands(self) -> int:
        """Commands that wait, those that are set aside included."""
        return len(self._commands) + len(self._early)

    @property
    def early(self) -> int:
        """Those that are set aside."""
        return len(self._early)

    def put_change(self, change: HoldChange) -> None:
        self._changes.append(change)
        self._wakeup.set()

    def put_command(self, command: CommandQuery, host: str) -> bool:
        """False: too many of this host wait already."""
        if self.commands >= COMMANDS_PER_HOST:
            waiting = Counter(of for queue in (self._commands, self._early) for of, _ in queue)
            if waiting[host] >= COMMANDS_PER_HOST:
                return False
        self._commands.append((host, command))
        self._wakeup.set()
        return True

    def set_aside(self, command: CommandQuery, host: str) -> bool:
        """Keeps a command for `resume`. False: too many of this host are kept already."""
        if Counter(of for of, _ in self._early)[host] >= EARLY_PER_HOST:
            return False
        self._early.append((host, command))
        return True

    def resume(self, ready: Callable[[CommandQuery], bool]) -> None:
        """Puts early commands that are `ready` before all others, in the order of arrival."""
        found = [early for early in self._early if ready(early[1])]
        self._early = [early for early in self._early if early not in found]
        self._commands.extendleft(reversed(found))
        if found:
            self._wakeup.set()

    def drop_early(self) -> list[CommandQuery]:
        """Commands that are set aside still, which are no longer kept."""
        dropped, self._early = self._early, []
        return [command for _, command in dropped]

    async def get(self) -> HoldChange | CommandQuery:
        """The next change or command, once there is one."""
        while not (self._changes or self._commands):
            self._wakeup.clear()
            await self._wakeup.wait()
        return self._changes.popleft() if self._changes else self._commands.popleft()[1]
