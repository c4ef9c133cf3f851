"""One path by which a node's files are read, checked and applied: at its start, by `--check`, and at SIGHUP.

Services register tables and a function (`Reload.takes`). A bad file changes nothing."""

from __future__ import annotations

import asyncio
import inspect
import logging
import signal
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

from msgspec import Struct, structs

from zscout.config.node import Node
from zscout.config.strict import BadInput
from zscout.drivers.registry import driver_for
from zscout.rcm.authority import Authority
from zscout.services.node.service_manager import ServiceManager

log = logging.getLogger("zscout.node")

MAX_NAMED: Final = 12  # keys named in one line


@dataclass(slots=True)
class FilesInForce:
    """The digest of the rights in force, and the fault that keeps newer files from being used (empty: none)."""

    rights: str
    fault: str = ""


class Reload:
    """The settings in force, and the functions that apply new ones. Calls `read` at once, which raises BadInput."""

    def __init__(self, read: Callable[[], Node]) -> None:
        self._read = read
        self.node, self._taken = self._checked()
        self.in_force = FilesInForce(rights_of(self.node))
        self._takers: list[tuple[frozenset[str], Callable[[Node], object]]] = []
        self._asked = asyncio.Event()

    def takes(self, take: Callable[[Node], object], *tables: str) -> None:
        """Call `take` in the event loop after a change of these tables or keys; it may return an awaitable. Its errors
        are logged, and the previous settings stay in force."""
        self._takers.append((frozenset(tables), take))

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
        """Read and apply the files; return the line that is logged."""
        try:
            # In a thread: the files may be on another host.
            node, found = await asyncio.to_thread(self._checked)
        except BadInput as error:
            self.in_force.fault = str(error)
            line = f"SIGHUP: {error}; keeping the previous settings"
            log.warning("%s", line)
            return line
        changed = {key for key in self._taken.keys() | found.keys() if self._taken.get(key) != found.get(key)}
        took, faults = set[str](), list[str]()
        for tables, take in self._takers:
            keys = {key for key in changed if key in tables or _table(key) in tables}
            try:
                if keys and inspect.isawaitable(taking := take(node)):
                    await taking
            except Exception as error:
                log.exception("the new [%s] can't be applied", "], [".join(sorted(set(map(_table, keys)))))
                faults.append(f"{_listed(keys)}: can't be applied: {error!r}; restart this node")
                continue
            took |= keys
        self._taken = {key: value for key, value in self._taken.items() if key not in took}
        self._taken |= {key: found[key] for key in took & found.keys()}
        self.in_force.fault = "; ".join(faults)
        if not faults:
            self.in_force.rights = rights_of(node)
        words = [f"applied {_listed(took)}"] if took else []
        if later := changed - took:
            words.append(f"restart this node to apply {_listed(later)}")
        line = f"SIGHUP: {'; '.join(words) or 'nothing changed'}"
        log.log(logging.WARNING if later else logging.INFO, "%s", line)
        return line

    def _checked(self) -> tuple[Node, dict[str, object]]:
        """The settings of the files, as a node and by key. Raises BadInput if a node could not start with them."""
        try:
            node = self._read()
            for rc in node.rcs:
                driver_for(rc)
            Authority(node.fleet).bound(node.fleet.scheduling)
            return node, settings(node)
        except BadInput:
            raise
        except Exception as error:
            log.exception("the files can't be used")
            raise BadInput(f"the files can't be used: {error!r}; report it with the log") from error


def rights_of(node: Node) -> str:
    """The digest of the rights that certificates prove; empty on a plain mesh."""
    return node.fleet.access.digest if node.fleet.security is not None else ""


def settings(node: Node) -> dict[str, object]:
    """The settings of both files, by key; RCs by name."""
    own, fleet = structs.asdict(node), structs.asdict(node.fleet)
    policy, access = node.fleet.scheduling, node.fleet.access
    for name in ("fleet", "rcs"):
        del own[name]
    for name in ("scheduling", "access", "file"):
        del fleet[name]
    of_policy = {field.name: getattr(policy, field.name) for field in fields(policy)}
    found = {f"rc.{rc.name}": rc for rc in node.rcs} | {"fair_shares": of_policy.pop("fair_shares")}
    # Some keys of the policy belong to [limits].
    fleet |= {name: value for name, value in of_policy.items() if not hasattr(node.fleet.limits, name)}
    found |= _by_key("node", own) | _by_key("fleet", fleet | structs.asdict(access))
    return {key: value for key, value in found.items() if value is not None}


def _by_key(table: str, values: Mapping[str, Any]) -> dict[str, object]:
    """The fields by key: tables among them have names of their own, other fields belong to `table`."""
    return {
        key: inner
        for name, value in values.items()
        for key, inner in _flat(name if isinstance(value, Struct | Mapping) else f"{table}.{name}", value)
    }


def _flat(key: str, value: object) -> Iterator[tuple[str, object]]:
    match value:
        case Struct():
            yield from _flat(key, structs.asdict(value))
        case Mapping():
            for name, inner in value.items():
                yield from _flat(f"{key}.{name}", inner)
        case _:
            yield key, value


def _table(key: str) -> str:
    return key.partition(".")[0]


def _listed(keys: set[str]) -> str:
    first = ", ".join(sorted(keys)[:MAX_NAMED])
    return f"{first} and {len(keys) - MAX_NAMED} more" if len(keys) > MAX_NAMED else first
