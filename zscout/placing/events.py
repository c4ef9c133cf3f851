"""What may happen to the placer, and what it must do: events and effects of its core (`placer.py`).

Durations and times are whole ns on the caller's clock. Texts are for people.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from zscout.balancing.model import ComponentId, HostName, Kind, Metric, Ns, Policy, Requirements

Incarnation: TypeAlias = int
Restart: TypeAlias = Literal["never", "on_failure", "always"]
State: TypeAlias = Literal[
    "waiting", "starting", "running", "moving", "backing_off", "stopping", "ended", "given_up"
]
HowEnded: TypeAlias = Literal["completed", "failed", "stopped", "moved", "superseded", "lost"]
"""`lost`: with its host, or nobody knows how."""


@dataclass(frozen=True, slots=True)
class Spec:
    """What is placed. `extra` is the business of the host that starts it: parameters, limits."""

    kind: Kind
    restart: Restart = "on_failure"
    metric: Metric = "composite"
    policy: Policy = "pending"
    requirements: Requirements = field(default_factory=Requirements)
    hosts: frozenset[HostName] | None = None
    extra: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Seen:
    """A component as a host tells of it. `ended` is None while it lives; a standby does not run yet."""

    component: ComponentId
    incarnation: Incarnation
    spec: Spec
    running: bool
    standby: bool = False
    movable: bool = False
    ended: HowEnded | None = None
    reason: str = ""
    tail: str = ""


# Events


@dataclass(frozen=True, slots=True)
class PlaceAsked:
    component: ComponentId
    spec: Spec


@dataclass(frozen=True, slots=True)
class StopAsked:
    component: ComponentId


@dataclass(frozen=True, slots=True)
class MoveAsked:
    """`to` None: the best other host."""

    component: ComponentId
    to: HostName | None = None


@dataclass(frozen=True, slots=True)
class DrainAsked:
    host: HostName


@dataclass(frozen=True, slots=True)
class UncordonAsked:
    host: HostName


@dataclass(frozen=True, slots=True)
class StartAnswered:
    """What came of `Start`: `ok` (it runs, or stands by), `refused` (this host will not: the next one may),
    `failed` (it started and ended, or did not get ready), `unknown` (no answer: it may run or not)."""

    component: ComponentId
    incarnation: Incarnation
    host: HostName
    result: Literal["ok", "refused", "failed", "unknown"]
    reason: str = ""
    tail: str = ""
    movable: bool = False
    again: bool = True
    """Of a failure: whether another try could help; an unregistered kind or a bad parameter will not mend."""


@dataclass(frozen=True, slots=True)
class StopAnswered:
    """`done` False: no answer."""

    component: ComponentId
    incarnation: Incarnation
    host: HostName
    done: bool


@dataclass(frozen=True, slots=True)
class MoveAnswered:
    """What came of `Move`: `moved`, `refused` (it goes on where it was), or `unknown`. `dead` in ns."""

    component: ComponentId
    incarnation: Incarnation
    host: HostName
    result: Literal["moved", "refused", "unknown"]
    reason: str = ""
    dead: Ns = 0


@dataclass(frozen=True, slots=True)
class Appeared:
    """A component's token: this incarnation runs there."""

    component: ComponentId
    incarnation: Incarnation
    host: HostName


@dataclass(frozen=True, slots=True)
class Vanished:
    """A component's token is gone. How it ended, its host tells (`HostTold`) if it lives."""

    component: ComponentId
    incarnation: Incarnation
    host: HostName


@dataclass(frozen=True, slots=True)
class HostTold:
    """A host's answer to `Look`, or what it said at a change of leader: all of its components, or, with
    `only`, that one."""

    host: HostName
    components: tuple[Seen, ...]
    only: ComponentId | None = None


@dataclass(frozen=True, slots=True)
class HostSeen:
    """A host's node is there."""

    host: HostName


@dataclass(frozen=True, slots=True)
class HostLost:
    """A host's node is gone, and with it its components."""

    host: HostName


@dataclass(frozen=True, slots=True)
class Inherited:
    """What the placer before this one had published: of a component that no living host tells of, this is
    all that is known."""

    records: tuple[Record, ...]
    cordoned: frozenset[HostName] = frozenset()


@dataclass(frozen=True, slots=True)
class Tick:
    """Time has passed."""


Event: TypeAlias = (
    PlaceAsked
    | StopAsked
    | MoveAsked
    | DrainAsked
    | UncordonAsked
    | StartAnswered
    | StopAnswered
    | MoveAnswered
    | Appeared
    | Vanished
    | HostTold
    | HostSeen
    | HostLost
    | Inherited
    | Tick
)


# Effects


@dataclass(frozen=True, slots=True)
class Start:
    """Start it there; answer with StartAnswered. The same again after `unknown` is meant so."""

    component: ComponentId
    incarnation: Incarnation
    host: HostName
    spec: Spec
    standby: bool = False


@dataclass(frozen=True, slots=True)
class Stop:
    """End this incarnation there; answer with StopAnswered."""

    component: ComponentId
    incarnation: Incarnation
    host: HostName


@dataclass(frozen=True, slots=True)
class Move:
    """Have it hand over to what stands by; answer with MoveAnswered."""

    component: ComponentId
    incarnation: Incarnation
    host: HostName
    to: HostName
    to_incarnation: Incarnation


@dataclass(frozen=True, slots=True)
class Look:
    """Ask a host how this component stands; answer with HostTold(only=component), if it answers."""

    host: HostName
    component: ComponentId


@dataclass(frozen=True, slots=True)
class Changed:
    """The record of a component is another: publish it, and tell who waits for it."""

    component: ComponentId


@dataclass(frozen=True, slots=True)
class Forgotten:
    """Nothing is known of it any more."""

    component: ComponentId


@dataclass(frozen=True, slots=True)
class Refused:
    """What was asked can't be: `code` as in docs/protocol.md, `message` one line. Of a host that can't be
    drained, `component` is its name."""

    component: ComponentId
    code: str
    message: str


@dataclass(frozen=True, slots=True)
class WakeAt:
    """Send a Tick then, if nothing came before. Replaces the last one; None: no need."""

    at: Ns | None


Effect: TypeAlias = Start | Stop | Move | Look | Changed | Forgotten | Refused | WakeAt


@dataclass(frozen=True, slots=True)
class Record:
    """A component as the placer knows it; `state` as in messages.Placement."""

    component: ComponentId
    spec: Spec
    state: State
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
