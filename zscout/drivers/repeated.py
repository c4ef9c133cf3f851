"""Carries out repeated commands once: they arrive again over a second relay, or if their sender got no answer."""

from __future__ import annotations

from collections import OrderedDict
from typing import Final

from zscout.keyexpr import Sender
from zscout.mesh import Answered, IncomingQuery, Refused
from zscout.messages import Command

MAX_HOSTS: Final = 64
"""Hosts whose commands are remembered, the most recent ones."""
MAX_PER_HOST: Final = 256
"""Remembered commands of a host, the most recent ones."""
MAX_WAITING: Final = 8
"""Repetitions of a command that wait for its answer."""


class CommandMemory:
    """The outcomes of the latest commands of each host, by sender and id."""

    def __init__(self) -> None:
        self._hosts: OrderedDict[str, OrderedDict[tuple[str, str], Answered]] = OrderedDict()

    def is_new(self, sender: Sender, query: IncomingQuery[Command]) -> bool:
        """Return False for a repeated command, which gets the same answer; never without an id. Raises Refused."""
        if query.message.id is None:
            return True
        known, name = self._of(sender.host), (sender.client, query.message.id)
        if (before := known.get(name)) is not None:
            if len(before.waiting) >= MAX_WAITING:
                raise Refused("busy", "this command is already being carried out; wait for its answer")
            before.join(query)
            return False
        query.outcome = known[name] = Answered()
        if len(known) > MAX_PER_HOST:
            known.popitem(last=False)
        return True

    def _of(self, host: str) -> OrderedDict[tuple[str, str], Answered]:
        known = self._hosts.setdefault(host, OrderedDict())
        self._hosts.move_to_end(host)
        if len(self._hosts) > MAX_HOSTS:
            self._hosts.popitem(last=False)
        return known
