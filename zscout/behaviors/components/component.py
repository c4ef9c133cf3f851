"""The base class of components, found by its entry point in the group `zscout.components`, and the context in which
they run; docs/components.md has an example."""

from __future__ import annotations

import asyncio
import importlib
from contextlib import suppress
from importlib import metadata
from typing import TYPE_CHECKING, Any, Final

from zscout.config.packages import how_to_get
from zscout.keyexpr import BadName, check_name

if TYPE_CHECKING:  # a node looks at this module and needs no client
    from zscout.behaviors.client.client import Client

GROUP: Final = "zscout.components"
BAD_PARAMS: Final = 78
"""Exit code (EX_CONFIG) of a component with invalid parameters: it is not restarted, on any host."""


class Component:
    """Base class of components. Each has its own process, which makes the instance before it joins the mesh."""

    def __init__(self, params: dict[str, Any]) -> None:
        """Raise ValueError, with one line, for invalid `params`: the component is then given up, with that line as its
        reason. For problems found later, call `sys.exit(BAD_PARAMS)`."""

    async def run(self, context: ComponentContext) -> None:
        """Do the work until cancelled, which ends the component; `async with` then gives back its devices."""
        raise NotImplementedError(f"{type(self).__name__} has no run(); write one")

    def checkpoint(self) -> bytes:
        """Return the state, at most MAX_CHECKPOINT bytes (4 MB). Called while `run` waits at a safe point."""
        raise NotImplementedError

    def restore(self, state: bytes) -> None:
        """Take over the state that `checkpoint` returned in another process. Called before `run`."""
        raise NotImplementedError


def is_movable(component: Component) -> bool:
    kind = type(component)
    return kind.checkpoint is not Component.checkpoint and kind.restore is not Component.restore


class ComponentContext:
    def __init__(self, client: Client, component: str, incarnation: int, gate: SafePointGate) -> None:
        self.client = client
        """A connected `zscout.Client`."""
        self.component = component
        """The component's name."""
        self.incarnation = incarnation
        """The number of this start of the component; each later start has a higher one."""
        self._gate = gate

    async def safe_point(self) -> None:
        """Allow a checkpoint or a move here. Await it often, wherever the state is complete: it costs almost no time.
        Until it returns, no other task of the component may change the state."""
        await self._gate.enter()


Stage = ComponentContext
"""Former name of ComponentContext, kept for components that import it."""


class SafePointGate:
    """Pauses `run` at a safe point while a checkpoint is taken or the component moves."""

    def __init__(self) -> None:
        self._open = asyncio.Event()
        self._open.set()
        self._entered = asyncio.Event()
        self._waiting = 0

    async def enter(self) -> None:
        await asyncio.sleep(0)
        while not self._open.is_set():
            self._waiting += 1
            self._entered.set()
            try:
                await self._open.wait()
            finally:
                self._waiting -= 1

    @property
    def holds(self) -> bool:
        """A task that was cancelled in `enter` no longer counts."""
        return self._waiting > 0

    async def hold(self, patience: float) -> bool:
        """Return False, with the gate open again, if no task has entered within `patience` seconds."""
        self._open.clear()
        try:
            async with asyncio.timeout(patience):
                while not self.holds:
                    self._entered.clear()
                    await self._entered.wait()
        except BaseException as error:
            self.release()
            if isinstance(error, TimeoutError):
                return False
            raise
        return True

    def release(self) -> None:
        self._open.set()


class BadKind(Exception):
    """A component of this kind can't be made on this host; the message is one line."""


def installed_kinds() -> dict[str, str]:
    """`module:class` by name of kind, from the metadata of all packages (some 10 ms). A kind that two packages register
    with different classes is left out."""
    found: dict[str, set[str]] = {}
    for entry in metadata.entry_points(group=GROUP):
        with suppress(BadName):
            found.setdefault(check_name(entry.name, "kind"), set()).add(entry.value)
    return {name: values.pop() for name, values in sorted(found.items()) if len(values) == 1}


def load_kind(kind: str, where: str) -> type[Component]:
    """Import a kind from `where`, a value of `installed_kinds`. Raises BadKind, or any error of the import."""
    module_name, _, attributes = where.partition(":")
    try:
        found: Any = importlib.import_module(module_name.strip())
    except ImportError as error:
        if missing := how_to_get(error):
            raise BadKind(f"kind {kind} {missing}") from error
        raise
    for attribute in attributes.partition("[")[0].strip().split("."):
        found = getattr(found, attribute, None)
    if not (isinstance(found, type) and issubclass(found, Component)):
        words = f"{where} is not a subclass of zscout.behaviors.components.component.Component"
        raise BadKind(f"kind {kind}: {words}; fix the entry point in the group {GROUP}")
    return found
