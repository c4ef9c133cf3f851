"""Components: operations of nodes (start, move, stop and others), and operations of the placer."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

import msgspec

from zscout.messages.base import MAX_INCARNATION, Bytes, Elapsed, Figure, Message, ShortText
from zscout.messages.hosts import MAX_LABELS, MAX_RANKED
from zscout.messages.scheduling import OpenRequest
from zscout.types import NO_TERM, Metric, Policy, Term

MAX_COMPONENT_NAME = 48
"""Characters; the name of a component's client is this name, a point and the incarnation."""
MAX_PARAMS_SIZE = 16_384
"""Bytes of a component's parameters as JSON."""
MAX_CHECKPOINT = 4_000_000
"""Bytes of a component's state."""
MAX_MOVE = 6_000_000
"""Bytes of a message with a checkpoint: base64 turns three bytes into four."""
MAX_OUTPUT = 65_536
"""Bytes of output that a node keeps of each component."""
MAX_TAIL = 2_000
"""Characters of the output that are reported when a component ends."""
MAX_PLACED = 10_000
"""Components of one fleet."""

Incarnation: TypeAlias = Annotated[int, msgspec.Meta(ge=1, le=MAX_INCARNATION)]
"""Number of a component's start, growing across changes of RCM too; of two incarnations the higher counts."""
ComponentName: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=MAX_COMPONENT_NAME)]
Restart: TypeAlias = Literal["never", "on_failure", "always"]


class ComponentSpec(Message, frozen=True):
    """A component's program, placement and restart policy, independent of the host."""

    kind: ShortText
    """The name of an entry point of the group `zscout.components`."""
    params: dict[str, Any] = {}
    """Parameters of the program; at most MAX_PARAMS_SIZE bytes as JSON."""
    restart: Restart = "on_failure"
    metric: Metric = "composite"
    policy: Policy = "pending"
    labels: Annotated[list[ShortText], msgspec.Meta(max_length=MAX_LABELS)] = []
    """Labels required of the host."""
    hosts: Annotated[list[ShortText], msgspec.Meta(max_length=MAX_RANKED)] | None = None
    """Hosts on which it may run; None: any."""
    memory: Bytes = 0
    """Bytes of memory that the host must have available."""
    memory_limit: Bytes = 0
    """Bytes that all its processes together may use; 0: no limit."""
    cpu_limit: Figure = 0.0
    """Cores that all its processes together may use; 0: no limit."""
    owner: Annotated[str, msgspec.Meta(max_length=64)] = ""
    """Certificate name of the client that had it placed, set by the placer; empty on a mesh without certificates."""


# To a node


class StartComponent(Message, frozen=True, tag_field="op", tag="start"):
    """Starts a component. Answered with a ComponentView once it runs, is on standby, or has failed.

    `standby`: it prepares to take over from an earlier incarnation, and runs only when it is activated, or when it has
    been handed an ARC and the earlier incarnation's token is gone. Idempotent: for the same incarnation, answered with
    the present state."""

    component: ComponentName
    incarnation: Incarnation
    spec: ComponentSpec
    standby: bool = False


class StopComponent(Message, frozen=True, tag_field="op", tag="stop"):
    """Stops a component, and kills it after `grace` seconds. Answered with a ComponentView once it has ended, or if it
    is not there. Without `incarnation`: any incarnation."""

    component: ComponentName
    incarnation: Incarnation | None = None
    grace: Elapsed = 5.0


class CheckpointComponent(Message, frozen=True, tag_field="op", tag="checkpoint"):
    """Asks for the state of a component, which continues to run. Answered with a Checkpoint."""

    component: ComponentName


class ListComponents(Message, frozen=True, tag_field="op", tag="list"):
    """Lists the components of a host, including recently ended ones. Answered with a ComponentList."""

    component: ComponentName | None = None
    """Only this component; None: all."""


class ReadOutput(Message, frozen=True, tag_field="op", tag="logs"):
    """Asks for a component's output from byte `start` of all its output. Answered with an Output."""

    component: ComponentName
    start: Annotated[int, msgspec.Meta(ge=0)] = 0


class MoveComponent(Message, frozen=True, tag_field="op", tag="move"):
    """Makes a running component hand over to incarnation `to_incarnation`, on standby on host `to`. It has `patience`
    seconds to reach a safe point. Answered with a Moved; on a problem it continues to run here."""

    component: ComponentName
    incarnation: Incarnation
    to: ShortText
    to_incarnation: Incarnation
    patience: Elapsed = 5.0


class RestoreComponent(Message, frozen=True, tag_field="op", tag="restore"):
    """From the earlier incarnation to the incarnation on standby: the state, and the ARCs that will be handed over.
    Answered with a ComponentView once the state is restored; the component does not run yet."""

    component: ComponentName
    incarnation: Incarnation
    state: bytes
    requests: list[OpenRequest] = []


class ActivateComponent(Message, frozen=True, tag_field="op", tag="activate"):
    """Makes an incarnation on standby run: the earlier incarnation runs no longer. Answered with a ComponentView."""

    component: ComponentName
    incarnation: Incarnation


ComponentOperation: TypeAlias = (
    StartComponent
    | StopComponent
    | CheckpointComponent
    | ListComponents
    | ReadOutput
    | MoveComponent
    | RestoreComponent
    | ActivateComponent
)

Phase: TypeAlias = Literal["starting", "standby", "running", "stopping", "ended"]
HowEnded: TypeAlias = Literal["completed", "failed", "stopped", "moved", "superseded"]


class ComponentView(Message, frozen=True):
    """A component as its node knows it."""

    component: str
    incarnation: Incarnation
    host: str
    spec: ComponentSpec
    phase: Phase
    movable: bool = False
    """The component can save and restore a checkpoint."""
    uptime: Elapsed = 0.0
    """Seconds since its start; once it has ended, from start to end."""
    pid: int | None = None
    ended: HowEnded | None = None
    reason: str = ""
    """Why it ended, in words; or the limit that this host can't enforce."""
    tail: str = ""
    """The last part of its output, if it failed."""
    bad_params: bool = False
    """It failed because of its parameters, and would fail on any host."""


class ComponentList(Message, frozen=True):
    """All components of a host. `kinds`: the kinds that it can start, at most MAX_KINDS; None if it does not list
    them."""

    host: str
    components: list[ComponentView] = []
    kinds: list[str] | None = None


class Checkpoint(Message, frozen=True):
    component: str
    incarnation: Incarnation
    state: bytes


class Output(Message, frozen=True):
    """Output of a component, bytes `start` to `end`; older output is lost."""

    component: str
    incarnation: Incarnation
    start: int
    end: int
    text: str
    over: bool = False
    """This incarnation has ended: no more output follows."""


class Moved(Message, frozen=True):
    """A component continues on another host. `dead`: seconds between its last step here and its first step there, by
    the clock of the host that it left."""

    component: str
    host: str
    incarnation: Incarnation
    dead: Elapsed


# To the placer


class PlaceComponent(Message, frozen=True, tag_field="op", tag="place"):
    """Places a component on a host. Idempotent. Answered with a Placement once it runs or can't run, or after `wait`
    seconds."""

    component: ComponentName
    spec: ComponentSpec
    wait: Elapsed = 10.0


class EndComponent(Message, frozen=True, tag_field="op", tag="stop"):
    """Stops a component for good. Answered with a Placement once it has ended, or after `wait` seconds."""

    component: ComponentName
    wait: Elapsed = 10.0


class MigrateComponent(Message, frozen=True, tag_field="op", tag="migrate"):
    """Moves a running component to host `to`, or to the best other host. Answered with a Placement."""

    component: ComponentName
    to: ShortText | None = None
    wait: Elapsed = 20.0


class DrainHost(Message, frozen=True, tag_field="op", tag="drain"):
    """Stops placing components on `host`, and moves away those that can move. Answered with Placements of the
    components still there; repeat it, or `list`, to see when the host is empty."""

    host: ShortText


class UncordonHost(Message, frozen=True, tag_field="op", tag="uncordon"):
    """Uses `host` again. Answered with Placements of the components there."""

    host: ShortText


class ListPlacements(Message, frozen=True, tag_field="op", tag="list"):
    """Lists components. Answered with Placements."""

    component: ComponentName | None = None


PlacementOperation: TypeAlias = PlaceComponent | EndComponent | MigrateComponent
PlacerOperation: TypeAlias = PlacementOperation | DrainHost | UncordonHost | ListPlacements


ComponentState: TypeAlias = Literal[
    "waiting", "starting", "running", "moving", "backing_off", "stopping", "ended", "given_up"
]


class Placement(Message, frozen=True):
    """A component as the placer knows it. `waiting`: no host is suitable; `ended`: it completed or was stopped;
    `given_up`: it failed, and its restart policy or the limit of restarts allows no restart."""

    component: str
    spec: ComponentSpec
    state: ComponentState
    incarnation: Annotated[int, msgspec.Meta(ge=0)] = 0
    """0 if it was never started."""
    host: str | None = None
    to: str | None = None
    """The target host of a move."""
    reason: str = ""
    """Why it waits or failed, or why it runs on its host, in words."""
    movable: bool = False
    wanted: bool = True
    """False once it was stopped."""
    restarts: int = 0
    """Restarts in a row."""
    moves: int = 0
    dead: Elapsed | None = None
    """Seconds for which its last move interrupted it."""
    tail: str = ""
    """The last part of its output, if it failed."""


class Placements(Message, frozen=True):
    """Components by name. `cordoned`: hosts on which no component is placed; `maintained`: those cordoned only while in
    maintenance. Also published at each change, with only the changed components; `forgotten` then names components that
    the placer dropped."""

    term: Term = NO_TERM
    components: list[Placement] = []
    cordoned: list[str] = []
    forgotten: list[str] = []
    maintained: list[str] = []
