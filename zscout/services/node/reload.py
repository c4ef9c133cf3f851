"""SIGHUP: a node reads its files again, and applies changes that need no restart.

Services register a table and a function (`Reload.takes`). A bad file changes nothing."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import Callable, Mapping
from typing import Any, Final

from msgspec import Struct, structs

from zscout.config.access import AccessPolicy
from zscout.config.fleet import RcmLimits
from zscout.config.node import Node
from zscout.config.scheduling_policy import SchedulingPolicy
from zscout.config.strict import BadInput
from zscout.drivers.registry import driver_for
from zscout.services.node.service_manager import ServiceManager

log = logging.getLogger("zscout.node")

MAX_NAMED: Final = 12  # keys named in one line


class Reload:
    """The settings in force, and the functions that apply new ones. `read` raises BadInput."""

    def __init__(self, node: Node, read: Callable[[], Node]) -> None:
        self._taken = settings(node)
        self._read = read
        self._takers: dict[str, Callable[[Node], object]] = {}
        self._asked = asyncio.Event()

    def takes(self, table: str, take: Callable[[Node], object]) -> None:
        """Call `take` in the event loop with settings changed in this table; its errors are logged, old ones stay."""
        self._takers[table] = take

    def on_hangup(self) -> None:
        """Reload at SIGHUP. For the main thread; asyncio would remove its own handler before the process ends."""
        loop = asyncio.get_running_loop()

        def ask(*_: object) -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(self._asked.set)

        signal.signal(signal.SIGHUP, ask)

    async def serve(self, manager: ServiceManager, status: str) -> None:
        """Reload at each request while the node runs; report `status` and the result to `manager`."""
        while True:
            await self._asked.wait()
            self._asked.clear()
            manager.reloading()
            manager.ready(f"{status}; {await self.now()}")

    async def now(self) -> str:
        """Read the files; return the line that is logged."""
        try:
            # They may be on another host.
            node = await asyncio.to_thread(self._read_again)
        except BadInput as error:
            line = f"SIGHUP: {error}; the settings of before stay"
            log.warning("%s", line)
            return line
        except Exception as error:
            log.exception("the files can't be read again")
            return f"SIGHUP: the files can't be read: {error!r}; the settings of before stay"
        said = settings(node)
        changed = {key for key in self._taken.keys() | said.keys() if self._taken.get(key) != said.get(key)}
        took = set[str]()
        for table, take in self._takers.items():
            keys = {key for key in changed if _table(key) == table}
            if keys and self._is_taken(table, take, node):
                took |= keys
                self._taken = {key: value for key, value in self._taken.items() if _table(key) != table}
                self._taken |= {key: value for key, value in said.items() if _table(key) == table}
        words = [f"took {_listed(took)}"] if took else []
        if later := changed - took:
            words.append(f"restart this node to take {_listed(later)}")
        line = f"SIGHUP: {'; '.join(words) or 'the files say what they said'}"
        log.log(logging.WARNING if later else logging.INFO, "%s", line)
        return line

    def _read_again(self) -> Node:
        node = self._read()
        for rc in node.rcs:
            driver_for(rc)  # raises the errors of the next start
        return node

    def _is_taken(self, table: str, take: Callable[[Node], object], node: Node) -> bool:
        try:
            take(node)
        except Exception:
            log.exception("the new [%s] can't be taken", table)
            return False
        return True


def settings(node: Node) -> dict[str, object]:
    """The settings of both files, by key; RCs by name."""
    found: dict[str, object] = {}

    def enter(table: str, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            below = name if table in ("node", "fleet") else f"{table}.{name}"
            match value:
                case SchedulingPolicy():
                    # Some keys are under [limits].
                    enter("fleet", {key: getattr(value, key) for key in value.__slots__ if key not in _LIMITS})
                case AccessPolicy():
                    enter("fleet", structs.asdict(value))  # its tables are top-level ones in the file
                case Struct():
                    enter(below, structs.asdict(value))
                case Mapping():
                    enter(below, value)
                case _ if name == "rcs":
                    found.update({f"rc.{rc.name}": rc for rc in value})
                case None:
                    pass
                case _:
                    found[f"{table}.{name}"] = value

    enter("node", structs.asdict(node))
    return found


_LIMITS: Final = frozenset(field.name for field in structs.fields(RcmLimits))


def _table(key: str) -> str:
    return key.partition(".")[0]


def _listed(keys: set[str]) -> str:
    first = ", ".join(sorted(keys)[:MAX_NAMED])
    return f"{first} and {len(keys) - MAX_NAMED} more" if len(keys) > MAX_NAMED else first
