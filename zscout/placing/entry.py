"""A component as the placer keeps it, and a move of it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final, Literal

from zscout.balancing.model import ComponentId, HostName, Ns
from zscout.placing.events import HowEnded, Incarnation, Record, Spec, State

OVER: Final = 16
"""Incarnations of a component of which the placer remembers that they ended."""

Sight = Literal["unknown", "running", "standby", "ended"]
"""What the placer was told last of one side of a move."""


@dataclass(frozen=True, slots=True)
class Fate:
    """How an incarnation ended. `with_host`: it could do nothing about it."""

    how: HowEnded
    reason: str
    tail: str = ""
    with_host: bool = False


@dataclass(slots=True)
class Moving:
    """A move under way: the target gets ready (`starting`), the source hands over (`handing`), or nobody
    knows how that went (`looking`)."""

    to: HostName
    incarnation: Incarnation
    why: str
    stage: Literal["starting", "handing", "looking"] = "starting"
    start_until: Ns | None = None
    tries: int = 0
    source: Sight = "running"
    target: Sight = "unknown"
    token: bool = False
    """The target's token is there: it has taken over."""
    fate: Fate | None = None
    """Of the source, if it ended before anything was known."""


@dataclass(slots=True)
class Entry:
    """A component. `host` is where its incarnation is, or starts; None: nowhere."""

    component: ComponentId
    spec: Spec
    state: State = "waiting"
    incarnation: Incarnation = 0
    past: bool = False
    """That incarnation is of what was placed before under this name, and must not live."""
    host: HostName | None = None
    wanted: bool = True
    reason: str = ""
    why: str = ""
    """Why it is where it is: the reason of what runs."""
    stays: str = ""
    """Why it is still on a host that is drained."""
    cause: str = ""
    """Why it is started once more."""
    tail: str = ""
    movable: bool = False
    restarts: int = 0
    rounds: int = 0
    """How often all hosts were tried in vain."""
    moves: int = 0
    dead: Ns | None = None
    since: Ns | None = None
    """Since when it runs."""
    start_until: Ns | None = None
    """A start is out, and not answered; it is given up for lost then."""
    asks: int = 0
    """How often an answer failed to come, of the thing that is asked for now."""
    token: bool = False
    told: bool = False
    """Its host said that it runs, and whether it can be moved."""
    looked: bool = False
    """Its host was asked how it stands, and has not answered."""
    stopped: bool = False
    """Its host says that it has ended, or was never there."""
    tried: dict[HostName, str] = field(default_factory=dict)
    """Hosts that did not start it, in this round; why, where another try would not help, else empty."""
    missing: bool = False
    """It says that it went on elsewhere, and nobody has told where."""
    move: Moving | None = None
    retry_at: Ns = 0
    """It is not tried sooner again: to move it off a drained host, to place what was inherited."""
    over: deque[Incarnation] = field(default_factory=lambda: deque(maxlen=OVER))

    def record(self) -> Record:
        return Record(
            component=self.component,
            spec=self.spec,
            state=self.state,
            incarnation=self.incarnation,
            host=self.host,
            to=self.move.to if self.move is not None else None,
            reason=self.stays or self.reason,
            movable=self.movable,
            wanted=self.wanted,
            restarts=self.restarts,
            moves=self.moves,
            dead=self.dead,
            tail=self.tail,
        )
