"""Events and effects of the placer's core (`placer.py`).

Times and durations are whole ns on the caller's clock. Reasons are text for people; nothing reads them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Literal, TypeAlias

from zscout.messages import HowEnded, Incarnation, Restart
from zscout.placement.model import Requirements
from zscout.types import ComponentId, HostName, Kind, Metric, Ns, Policy

EndCause: TypeAlias = HowEnded | Literal["lost"]
"""`lost`: with its host, or nobody knows how."""


class ComponentState(StrEnum):
    """`waiting`: for a host; `ended`: completed or stopped; `given_up`: failed once too often."""

    WAITING = "waiting"
    STARTING = "starting"
    RUNNING = "running"
    MOVING = "moving"
    BACKING_OFF = "backing_off"
    STOPPING = "stopping"
    ENDED = "ended"
    GIVEN_UP = "given_up"


@dataclass(frozen=True, slots=True)
class PlacementSpec:
    """What is placed. `extra` is for the host that starts it: parameters, limits."""

    kind: Kind
    restart: Restart = "on_failure"
    metric: Metric = "composite"
    policy: Policy = "pending"
    requirements: Requirements = field(default_factory=Requirements)
    hosts: frozenset[HostName] | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ComponentStatus:
    """A component as the placer publishes it (`messages.Placement`)."""

    component: ComponentId
    spec: PlacementSpec
    state: ComponentState
    incarnation: Incarnation = 0
    host: HostName | None = None
    to: HostName | None = None
    reason: str = ""
    movable: bool = False
    wanted: bool = True
    restarts: int = 0
    moves: int = 0
    dead: Ns | None = None
    tail: str = ""


@dataclass(frozen=True, slots=True)
class ListedComponent:
    """A component in a host's list. `ended` is None while it lives; a standby does not run yet."""

    component: ComponentId
    incarnation: Incarnation
    spec: PlacementSpec
    running: bool
    standby: bool = False
    movable: bool = False
    ended: EndCause | None = None
    reason: str = ""
    tail: str = ""


@dataclass(frozen=True, slots=True)
class _OnHost:
    """An incarnation of a component on a host."""

    component: ComponentId
    incarnation: Incarnation
    host: HostName


# Events


@dataclass(frozen=True, slots=True)
class PlaceRequested:
    component: ComponentId
    spec: PlacementSpec


@dataclass(frozen=True, slots=True)
class StopRequested:
    component: ComponentId


@dataclass(frozen=True, slots=True)
class MoveRequested:
    """`to` None: the best other host."""

    component: ComponentId
    to: HostName | None = None


@dataclass(frozen=True, slots=True)
class DrainRequested:
    host: HostName


@dataclass(frozen=True, slots=True)
class UncordonRequested:
    host: HostName


@dataclass(frozen=True, slots=True)
class StartAnswered(_OnHost):
    """Outcome of a StartCommand: `ok` (it runs, or stands by), `refused` (this host will not: another may),
    `failed` (it started and ended, or did not get ready), `unknown` (no answer: it may run or not).

    `again`: whether another try could help; an unregistered kind or a bad parameter stays one."""

    result: Literal["ok", "refused", "failed", "unknown"]
    reason: str = ""
    tail: str = ""
    movable: bool = False
    again: bool = True


@dataclass(frozen=True, slots=True)
class StopAnswered(_OnHost):
    """Outcome of a StopCommand. `done` False: no answer."""

    done: bool


@dataclass(frozen=True, slots=True)
class MoveAnswered(_OnHost):
    """Outcome of a MoveCommand: `moved`, `refused` (it stays where it was), `unknown`."""

    result: Literal["moved", "refused", "unknown"]
    reason: str = ""
    dead: Ns = 0
    """The dead time: from the source's last work to the target's first."""


@dataclass(frozen=True, slots=True)
class TokenAppeared(_OnHost):
    """A component's liveliness token: this incarnation runs there."""


@dataclass(frozen=True, slots=True)
class TokenVanished(_OnHost):
    """A component's token is gone. How it ended is in its host's next list (`ComponentsListed`)."""


@dataclass(frozen=True, slots=True)
class ComponentsListed:
    """A host's list, as answer to a ProbeCommand or at a change of leader: all of its components, or, with
    `only`, that one."""

    host: HostName
    components: tuple[ListedComponent, ...]
    only: ComponentId | None = None


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

    components: tuple[ComponentStatus, ...]
    cordoned: frozenset[HostName] = frozenset()


@dataclass(frozen=True, slots=True)
class PlacerTick:
    """Time has passed."""


PlacerEvent: TypeAlias = (
    PlaceRequested
    | StopRequested
    | MoveRequested
    | DrainRequested
    | UncordonRequested
    | StartAnswered
    | StopAnswered
    | MoveAnswered
    | TokenAppeared
    | TokenVanished
    | ComponentsListed
    | HostJoined
    | HostLost
    | Inherited
    | PlacerTick
)


# Effects


@dataclass(frozen=True, slots=True)
class StartCommand(_OnHost):
    """Start it there; answered by StartAnswered. Idempotent: it is repeated after `unknown`."""

    spec: PlacementSpec
    standby: bool = False


@dataclass(frozen=True, slots=True)
class StopCommand(_OnHost):
    """End this incarnation there; answered by StopAnswered."""


@dataclass(frozen=True, slots=True)
class MoveCommand(_OnHost):
    """Have it hand over to the standby on `to`; answered by MoveAnswered."""

    to: HostName
    to_incarnation: Incarnation


@dataclass(frozen=True, slots=True)
class ProbeCommand:
    """Ask a host for this component; answered by ComponentsListed(only=component), or not at all."""

    host: HostName
    component: ComponentId


@dataclass(frozen=True, slots=True)
class ComponentChanged:
    """Publish the component's status, and answer requests that wait for it."""

    component: ComponentId


@dataclass(frozen=True, slots=True)
class ComponentForgotten:
    component: ComponentId


@dataclass(frozen=True, slots=True)
class PlacementRefused:
    """A request is refused: `code` as in docs/protocol.md, `message` one line. `subject` names the component,
    or the host that can't be drained."""

    subject: str
    code: str
    message: str


@dataclass(frozen=True, slots=True)
class PlacerWakeAt:
    """Send a PlacerTick then, if no event came before. Replaces the last one; None: not needed."""

    at: Ns | None


HostCommand: TypeAlias = StartCommand | StopCommand | MoveCommand | ProbeCommand
PlacerEffect: TypeAlias = (
    HostCommand | ComponentChanged | ComponentForgotten | PlacementRefused | PlacerWakeAt
)
