"""Events and effects of the placer's core (`placer.py`). Requests and host commands are messages; `Placement` publishes
a component's state.

Times are whole ns on the caller's clock. Reasons are text for people alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from zscout import messages
from zscout.messages import Incarnation, Placement
from zscout.types import ComponentId, HostName, Kind, Ns


@dataclass(frozen=True, slots=True)
class _OnHost:
    component: ComponentId
    incarnation: Incarnation
    host: HostName


@dataclass(frozen=True, slots=True)
class StartAnswered(_OnHost):
    """`ok` (runs or is on standby), `refused` (another host may accept), `failed` (ended, or was not ready), `unknown`
    (no answer). `again`: another try on this host could help."""

    result: Literal["ok", "refused", "failed", "unknown"]
    reason: str = ""
    tail: str = ""
    movable: bool = False
    again: bool = True
    bad_params: bool = False
    """Failed for its parameters: another host is no better."""


@dataclass(frozen=True, slots=True)
class StopAnswered(_OnHost):
    """`done` False: no answer."""

    done: bool


@dataclass(frozen=True, slots=True)
class MoveAnswered(_OnHost):
    """`refused`: it stays where it was."""

    result: Literal["moved", "refused", "unknown"]
    reason: str = ""
    dead: float = 0.0
    """Dead time in seconds: from the source's last work to the target's first."""


@dataclass(frozen=True, slots=True)
class TokenAppeared(_OnHost):
    """The component's liveliness token appeared: this incarnation runs there."""


@dataclass(frozen=True, slots=True)
class TokenVanished(_OnHost):
    """The token is gone; the host's next list has the cause (`ComponentsListed`)."""


@dataclass(frozen=True, slots=True)
class ComponentsListed:
    """A host's reply to ListComponents, or its list at a change of leader: all its components, or `only` one. `kinds`:
    kinds it can start; None: unknown."""

    host: HostName
    components: Sequence[messages.ComponentView]
    only: ComponentId | None = None
    kinds: frozenset[Kind] | None = None


@dataclass(frozen=True, slots=True)
class HostJoined:
    host: HostName


@dataclass(frozen=True, slots=True)
class HostLost:
    host: HostName


@dataclass(frozen=True, slots=True)
class Inherited:
    """The published placements of the previous placer: all that is known of components on dead hosts."""

    components: Sequence[Placement] = ()
    cordoned: frozenset[HostName] = frozenset()


@dataclass(frozen=True, slots=True)
class Maintained:
    """The hosts in maintenance now: they are cordoned for as long."""

    hosts: frozenset[HostName]


_Request: TypeAlias = messages.PlacementOperation | messages.DrainHost | messages.UncordonHost
_Answer: TypeAlias = StartAnswered | StopAnswered | MoveAnswered | ComponentsListed
PlacerEvent: TypeAlias = (
    _Request | _Answer | TokenAppeared | TokenVanished | HostJoined | HostLost | Inherited | Maintained
)


@dataclass(frozen=True, slots=True)
class HostCommand:
    """Starts are idempotent, and repeated after `unknown`; a list of one component may stay unanswered."""

    host: HostName
    operation: messages.StartComponent | messages.StopComponent | messages.MoveComponent | messages.ListComponents


@dataclass(frozen=True, slots=True)
class ComponentChanged:
    """Publish the placement (None: forgotten), and answer requests that wait for it."""

    component: ComponentId
    placement: Placement | None


@dataclass(frozen=True, slots=True)
class PlacementRefused:
    """`code` as in docs/protocol/errors.md; `message` is one line; `subject`: the component, or the host to drain."""

    subject: str
    code: str
    message: str


@dataclass(frozen=True, slots=True)
class PlacerWakeAt:
    """Wake the core at this time if no event comes before. Replaces the last one; None: not needed."""

    at: Ns | None


PlacerEffect: TypeAlias = HostCommand | ComponentChanged | PlacementRefused | PlacerWakeAt
