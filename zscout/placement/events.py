"""Events and effects of the placer's core (`placer.py`). What is requested of it and what it has hosts do are
the messages that carry that; what it knows of components it publishes as `Placement`.

Times are whole ns on the caller's clock. Reasons are text for people; nothing reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from zscout import messages
from zscout.messages import Incarnation, Placement
from zscout.types import ComponentId, HostName, Kind, Ns


@dataclass(frozen=True, slots=True)
class _OnHost:
    """An incarnation of a component on a host."""

    component: ComponentId
    incarnation: Incarnation
    host: HostName


# Events


@dataclass(frozen=True, slots=True)
class StartAnswered(_OnHost):
    """Outcome of a StartComponent: `ok` (it runs, or stands by), `refused` (this host will not: another may),
    `failed` (it started and ended, or did not get ready), `unknown` (no answer: it may run or not).

    `again`: whether another try there could help; an unregistered kind stays one."""

    result: Literal["ok", "refused", "failed", "unknown"]
    reason: str = ""
    tail: str = ""
    movable: bool = False
    again: bool = True
    bad_params: bool = False
    """It failed because of its parameters, which are no better on another host."""


@dataclass(frozen=True, slots=True)
class StopAnswered(_OnHost):
    """Outcome of a StopComponent. `done` False: no answer."""

    done: bool


@dataclass(frozen=True, slots=True)
class MoveAnswered(_OnHost):
    """Outcome of a MoveComponent: `moved`, `refused` (it stays where it was), `unknown`."""

    result: Literal["moved", "refused", "unknown"]
    reason: str = ""
    dead: float = 0.0
    """The dead time in seconds: from the source's last work to the target's first."""


@dataclass(frozen=True, slots=True)
class TokenAppeared(_OnHost):
    """A component's liveliness token: this incarnation runs there."""


@dataclass(frozen=True, slots=True)
class TokenVanished(_OnHost):
    """A component's token is gone. How it ended is in its host's next list (`ComponentsListed`)."""


@dataclass(frozen=True, slots=True)
class ComponentsListed:
    """A host's list, as answer to a ListComponents or at a change of leader: all of its components, or, with
    `only`, that one. `kinds` are those that the host can start; None: it does not tell."""

    host: HostName
    components: Sequence[messages.ComponentView]
    only: ComponentId | None = None
    kinds: frozenset[Kind] | None = None


@dataclass(frozen=True, slots=True)
class HostJoined:
    """A host's node has its token."""

    host: HostName


@dataclass(frozen=True, slots=True)
class HostLost:
    """A host's node is gone, and its components with it."""

    host: HostName


@dataclass(frozen=True, slots=True)
class Inherited:
    """What the placer of the term before had published: all that is known of components on dead hosts."""

    components: Sequence[Placement] = ()
    cordoned: frozenset[HostName] = frozenset()


PlacerEvent: TypeAlias = (
    messages.PlacementOperation
    | messages.DrainHost
    | messages.UncordonHost
    | StartAnswered
    | StopAnswered
    | MoveAnswered
    | TokenAppeared
    | TokenVanished
    | ComponentsListed
    | HostJoined
    | HostLost
    | Inherited
)


# Effects


@dataclass(frozen=True, slots=True)
class HostCommand:
    """Have this host do it. A start is idempotent, and repeated after `unknown`; the answer to a list of one
    component is ComponentsListed with `only`, or none."""

    host: HostName
    operation: messages.StartComponent | messages.StopComponent | messages.MoveComponent | messages.ListComponents


@dataclass(frozen=True, slots=True)
class ComponentChanged:
    """Publish the component's placement (None: it is forgotten), and answer requests that wait for it."""

    component: ComponentId
    placement: Placement | None


@dataclass(frozen=True, slots=True)
class PlacementRefused:
    """A request is refused: `code` as in docs/protocol.md, `message` one line. `subject` names the component,
    or the host that can't be drained."""

    subject: str
    code: str
    message: str


@dataclass(frozen=True, slots=True)
class PlacerWakeAt:
    """Have the core handle no event then, if none came before. Replaces the last one; None: not needed."""

    at: Ns | None


PlacerEffect: TypeAlias = HostCommand | ComponentChanged | PlacementRefused | PlacerWakeAt
