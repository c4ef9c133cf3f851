"""What the author of a component writes, and what a component is given: docs/components.md shows one.

It is found by its entry point of the group `zscout.components`.
"""

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
"""Exit code (EX_CONFIG) of a component whose parameters are no good: it is not started again, here or elsewhere."""


class Component:
    """Base class of components. An instance is made in the process that runs it, before that process joins the mesh."""

    def __init__(self, params: dict[str, Any]) -> None:
        """`params` are those of the component. Raise ValueError with one line if they are bad: the component is then
        given up with that line. For problems found later, exit with `sys.exit(BAD_PARAMS)`."""

    async def run(self, context: ComponentContext) -> None:
        """Do the work. Cancelled to end the component; `async with` then gives back its devices."""
        raise NotImplementedError(f"{type(self).__name__} has no run(); write one")

    def checkpoint(self) -> bytes:
        """Return the state, at most MAX_CHECKPOINT bytes (4 MB). Called while `run` is held at a safe point."""
        raise NotImplementedError

    def restore(self, state: bytes) -> None:
        """Take over the state that `checkpoint` returned in another process. Called before `run`."""
        raise NotImplementedError


def is_movable(component: Component) -> bool:
    """Whether a component can give and take a checkpoint."""
    kind = type(component)
    return kind.checkpoint is not Component.checkpoint and kind.restore is not Component.restore


class ComponentContext:
    """A component's surroundings: its client on the mesh, its name and its incarnation."""

    def __init__(self, client: Client, component: str, incarnation: int, gate: SafePointGate) -> None:
        self.client = client
        """A connected `zscout.Client`."""
        self.component = component
        """The component's name."""
        self.incarnation = incarnation
        """The number of this start of the component."""
        self._gate = gate

    async def safe_point(self) -> None:
        """Allow a checkpoint or a move here, where the state is complete. Call it often: it takes next to no time.
        Until it returns, no other task of the component may change the state."""
        await self._gate.come()


Stage = ComponentContext
"""Its former name, for components written with it."""


class SafePointGate:
    """Where `run` is held at a safe point."""

    def __init__(self) -> None:
        self._open = asyncio.Event()
        self._open.set()
        self._come = asyncio.Event()
        self._held = 0

    async def come(self) -> None:
        await asyncio.sleep(0)
        while not self._open.is_set():
            self._held += 1
            self._come.set()
            try:
                await self._open.wait()
            finally:
                self._held -= 1

    @property
    def holds(self) -> bool:
        """Whether something is held here now: not any more where it was cancelled."""
        return self._held > 0

    async def hold(self, patience: float) -> bool:
        """Holds what comes from now on; False, and nothing is held, if nothing came within `patience`
        seconds. `release` ends it."""
        self._open.clear()
        try:
            async with asyncio.timeout(patience):
                while not self.holds:
                    self._come.clear()
                    await self._come.wait()
        except BaseException as error:
            self.release()
            if isinstance(error, TimeoutError):
                return False
            raise
        return True

    def release(self) -> None:
        self._open.set()


# Which kinds are installed: the entry points of GROUP


class BadKind(Exception):
    """A component of this kind can't be made here; one line that says why."""


def installed_kinds() -> dict[str, str]:
    """Where each kind is: its name, and `module:class`. Reads the metadata of all packages: some 10 ms. A kind that two
    packages bring, in different places, is none: which one is meant nobody knows."""
    found: dict[str, set[str]] = {}
    for entry in metadata.entry_points(group=GROUP):
        with suppress(BadName):
            found.setdefault(check_name(entry.name, "kind"), set()).add(entry.value)
    return {name: values.pop() for name, values in sorted(found.items()) if len(values) == 1}


def load_kind(kind: str, where: str) -> type[Component]:
    """The class of a kind at `where`, as `installed_kinds` gives it. Raises BadKind, and what its import raises."""
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
