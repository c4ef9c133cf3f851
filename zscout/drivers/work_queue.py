"""The queue of an RC's worker: changes of its holds, and commands."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Callable

from zscout.drivers.confirm_server import CommandQuery
from zscout.drivers.holds import HoldChange

COMMANDS_PER_HOST = 48
"""Waiting commands of a host."""
EARLY_PER_HOST = 16
"""Commands of a host that are set aside."""


class WorkQueue:
    """Changes of holders come first, so that a safe state never waits for a command. A command under a grant that the
    RC does not know yet is set aside until the RC knows more, and then precedes all other commands, so that no later
    command of the same grant overtakes it."""

    def __init__(self) -> None:
        self._changes: deque[HoldChange] = deque()
        self._commands: deque[tuple[str, CommandQuery]] = deque()
        """With the sender's host."""
        self._early: list[tuple[str, CommandQuery]] = []
        """Commands set aside, with the sender's host, in the order of arrival."""
        self._wakeup = asyncio.Event()

    @property
    def commands(self) -> int:
        """Number of waiting commands, also those set aside."""
        return len(self._commands) + len(self._early)

    @property
    def early(self) -> int:
        return len(self._early)

    def put_change(self, change: HoldChange) -> None:
        self._changes.append(change)
        self._wakeup.set()

    def put_command(self, command: CommandQuery, host: str) -> bool:
        """Return False if too many commands of this host wait already."""
        if self.commands >= COMMANDS_PER_HOST:
            waiting = Counter(of for queue in (self._commands, self._early) for of, _ in queue)
            if waiting[host] >= COMMANDS_PER_HOST:
                return False
        self._commands.append((host, command))
        self._wakeup.set()
        return True

    def set_aside(self, command: CommandQuery, host: str) -> bool:
        """Keep a command for `resume`. Return False if too many of this host are kept already."""
        if Counter(of for of, _ in self._early)[host] >= EARLY_PER_HOST:
            return False
        self._early.append((host, command))
        return True

    def resume(self, ready: Callable[[CommandQuery], bool]) -> None:
        """Move the `ready` commands among those set aside to the front of the queue, in the order of arrival."""
        found = [early for early in self._early if ready(early[1])]
        self._early = [early for early in self._early if early not in found]
        self._commands.extendleft(reversed(found))
        if found:
            self._wakeup.set()

    def drop_early(self) -> list[CommandQuery]:
        dropped, self._early = self._early, []
        return [command for _, command in dropped]

    async def get(self) -> HoldChange | CommandQuery:
        while not (self._changes or self._commands):
            self._wakeup.clear()
            await self._wakeup.wait()
        return self._changes.popleft() if self._changes else self._commands.popleft()[1]
