"""Components: operations of nodes, to start, move and stop them, and of the placer."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias

import msgspec

from zscout.messages.base import MAX_INCARNATION, Bytes, Elapsed, Figure, Message, ShortText
from zscout.messages.hosts import MAX_LABELS, MAX_RANKED
from zscout.messages.scheduling import OpenRequest
from zscout.types import NO_TERM, Metric, Policy, Term

MAX_COMPONENT_NAME = 48
"""Characters: its client's name is this, a point and the incarnation."""
MAX_PARAMS_SIZE = 16_384
"""Bytes of a component's parameters as JSON."""
MAX_CHECKPOINT = 4_000_000
"""Bytes of a component's state."""
MAX_MOVE = 6_000_000
"""Bytes of a message that carries one: base64 makes four of three."""
MAX_OUTPUT = 65_536
"""Bytes of output that a node keeps of each component."""
MAX_TAIL = 2_000
"""Characters of it that are reported with an end."""
MAX_PLACED = 10_000
"""Components of one fleet."""

Incarnation: TypeAlias = Annotated[int, msgspec.Meta(ge=1, le=MAX_INCARNATION)]
"""Which start of a component this is: of two the higher counts. Grows over changes of RCM as well."""
ComponentName: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=MAX_COMPONENT_NAME)]
Restart: TypeAlias = Literal["never", "on_failure", "always"]


class ComponentSpec(Message, frozen=True):
    """What a component is, and where and how it is to be kept: the same wherever it runs."""

    kind: ShortText
    """The name of an entry point of the group `zscout.components`."""
    params: dict[str, Any] = {}
    """For the component itself; MAX_PARAMS_SIZE bytes as JSON at most."""
    restart: Restart = "on_failure"
    metric: Metric = "composite"
    policy: Policy = "pending"
    labels: Annotated[list[ShortText], msgspec.Meta(max_length=MAX_LABELS)] = []
    """What its host must have."""
    hosts: Annotated[list[ShortText], msgspec.Meta(max_length=MAX_RANKED)] | None = None
    """Where it may run; None: anywhere."""
    memory: Bytes = 0
    """Bytes that its host must have available."""
    memory_limit: Bytes = 0
    """Bytes that it may use with all its processes; 0: as many as there are."""
    cpu_limit: Figure = 0.0
    """Cores that it may use with all its processes; 0: as many as there are."""
    owner: Annotated[str, msgspec.Meta(max_length=64)] = ""
    """Who had it placed, by the name of a certificate: set by the placer. Empty on a mesh without."""


# To a node


class StartComponent(Message, frozen=True, tag_field="op", tag="start"):
    """Starts a component. Answered with a ComponentView once it runs (or stands by), or has failed.

    `standby`: it gets ready to take over from an earlier incarnation, and does not run before it is
    activated, or has been handed an ARC and sees no token of that one. Idempotent: for the same incarnation,
    answered with its present state."""

    component: ComponentName
    incarnation: Incarnation
    spec: ComponentSpec
    standby: bool = False


class StopComponent(Message, frozen=True, tag_field="op", tag="stop"):
    """Ends a component, which is killed after `grace` seconds. Answered with a ComponentView once it has
    ended. Without `incarnation`, whichever there is; what is not there has ended already."""

    component: ComponentName
    incarnation: Incarnation | None = None
    grace: Elapsed = 5.0


class CheckpointComponent(Message, frozen=True, tag_field="op", tag="checkpoint"):
    """Asks for the state of a component that goes on. Answered with a Checkpoint."""

    component: ComponentName


class ListComponents(Message, frozen=True, tag_field="op", tag="list"):
    """Lists the components of a host, ended ones for a while. Answered with a ComponentList."""

    component: ComponentName | None = None
    """Only this one."""


class ReadOutput(Message, frozen=True, tag_field="op", tag="logs"):
    """Asks for what a component wrote, from byte `start` of all that it wrote. Answered with an Output."""

    component: ComponentName
    start: Annotated[int, msgspec.Meta(ge=0)] = 0


class MoveComponent(Message, frozen=True, tag_field="op", tag="move"):
    """Has a running component hand over to incarnation `to_incarnation`, which stands by on `to`. It has
    `patience` seconds to come to a safe point. Answered with a Moved; on a problem it goes on here."""

    component: ComponentName
    incarnation: Incarnation
    to: ShortText
    to_incarnation: Incarnation
    patience: Elapsed = 5.0


class RestoreComponent(Message, frozen=True, tag_field="op", tag="restore"):
    """From the earlier incarnation to the one that stands by: its state, and the ARCs that will be handed to
    it. Answered with a ComponentView once it has taken the state in; it does not run yet."""

    component: ComponentName
    incarnation: Incarnation
    state: bytes
    requests: list[OpenRequest] = []


class ActivateComponent(Message, frozen=True, tag_field="op", tag="activate"):
    """The earlier incarnation will not go on: this one runs from now on. Answered with a ComponentView."""

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
    """Whether it can give and take a checkpoint."""
    uptime: Elapsed = 0.0
    """Seconds since it was started, or that it lasted."""
    pid: int | None = None
    ended: HowEnded | None = None
    reason: str = ""
    """Of an end, in words; or which limit this host can't set."""
    tail: str = ""
    """Of one that failed: the end of its output."""
    bad_params: bool = False
    """It failed because its parameters are no good, on whichever host."""


class ComponentList(Message, frozen=True):
    """All components of a host. `kinds` are those that it can start, MAX_KINDS of them at most; None: it does not
    tell."""

    host: str
    components: list[ComponentView] = []
    kinds: list[str] | None = None


class Checkpoint(Message, frozen=True):
    component: str
    incarnation: Incarnation
    state: bytes


class Output(Message, frozen=True):
    """What a component wrote, bytes `start` to `end`: what is older than that is lost."""

    component: str
    incarnation: Incarnation
    start: int
    end: int
    text: str
    over: bool = False
    """No more will come of this incarnation."""


class Moved(Message, frozen=True):
    """A component goes on elsewhere. `dead` seconds lay between its last step here and its first there, on
    the clock of the host that it left."""

    component: str
    host: str
    incarnation: Incarnation
    dead: Elapsed


# To the placer


class PlaceComponent(Message, frozen=True, tag_field="op", tag="place"):
    """Has a component run somewhere. Idempotent. Answered with a Placement once it runs or can't, or when
    `wait` seconds are over."""

    component: ComponentName
    spec: ComponentSpec
    wait: Elapsed = 10.0


class EndComponent(Message, frozen=True, tag_field="op", tag="stop"):
    """Stops a component for good. Answered with a Placement, as above."""

    component: ComponentName
    wait: Elapsed = 10.0


class MigrateComponent(Message, frozen=True, tag_field="op", tag="migrate"):
    """Moves a running component, to host `to` or to the best other one. Answered with a Placement."""

    component: ComponentName
    to: ShortText | None = None
    wait: Elapsed = 20.0


class DrainHost(Message, frozen=True, tag_field="op", tag="drain"):
    """Nothing is placed on `host` any more, and what can be moved leaves it. Answered with Placements of what
    is there still; ask again, or `list`, to see it empty."""

    host: ShortText


class UncordonHost(Message, frozen=True, tag_field="op", tag="uncordon"):
    """`host` is used again. Answered with Placements of what is there."""

    host: ShortText


class ListPlacements(Message, frozen=True, tag_field="op", tag="list"):
    """Answered with Placements."""

    component: ComponentName | None = None


PlacementOperation: TypeAlias = PlaceComponent | EndComponent | MigrateComponent
PlacerOperation: TypeAlias = PlacementOperation | DrainHost | UncordonHost | ListPlacements


ComponentState: TypeAlias = Literal[
    "waiting", "starting", "running", "moving", "backing_off", "stopping", "ended", "given_up"
]


class Placement(Message, frozen=True):
    """A component as the placer knows it. `waiting`: no host will do; `ended`: it completed or was stopped;
    `given_up`: it failed, and its restart policy or their limit says that is all."""

    component: str
    spec: ComponentSpec
    state: ComponentState
    incarnation: Annotated[int, msgspec.Meta(ge=0)] = 0
    """0: it was never started."""
    host: str | None = None
    to: str | None = None
    """Where it is moving."""
    reason: str = ""
    """In words: why it waits or failed, or why it is where it is."""
    movable: bool = False
    wanted: bool = True
    """Whether it is to run: False once it was stopped."""
    restarts: int = 0
    """In a row."""
    moves: int = 0
    dead: Elapsed | None = None
    """Seconds that its last move took it out of work."""
    tail: str = ""
    """The end of its output, where it failed."""


class Placements(Message, frozen=True):
    """Components by name, and the hosts on which nothing is placed, some for as long as they are in maintenance. Also
    published at each change: then only what has changed, and `forgotten` names what the placer keeps no longer."""

    term: Term = NO_TERM
    components: list[Placement] = []
    cordoned: list[str] = []
    forgotten: list[str] = []
    maintained: list[str] = []
