"""Hosts: how loaded they are, and which is the best."""

from __future__ import annotations

from typing import Annotated

import msgspec

from zscout.messages.base import (
    LIMITS,
    MAX_COUNTER,
    MAX_ERROR,
    MAX_INCARNATION,
    Bytes,
    Elapsed,
    Figure,
    Message,
    Seconds,
    ShortText,
    VersionText,
)
from zscout.types import Metric, Policy

MAX_RANKED = 256
"""Hosts in one answer of the balancer."""
MAX_LABELS = 32
"""Of one host."""
MAX_COMPONENTS = 256
"""In one load report."""


class ComponentUse(Message, frozen=True):
    """What one component uses, with all its child processes: `cpu` in cores, `memory` in bytes. `served` is
    the share of the time in which it wanted a processor that it had one; None where nobody knows."""

    component: ShortText
    kind: ShortText
    incarnation: Annotated[int, msgspec.Meta(ge=0, le=MAX_INCARNATION)]
    cpu: Figure
    memory: Bytes
    processes: Annotated[int, msgspec.Meta(ge=0, le=MAX_COUNTER)] = 1
    served: Annotated[float, msgspec.Meta(ge=0, le=1)] | None = None


class LoadReport(Message, frozen=True):
    """A host's load. `number` counts one reporter's reports; memory in bytes, `cpu` in percent of all.

    `speed` is how fast one core does a fixed piece of work (`docs/protocol.md`), 1.0 in a millisecond;
    clocks in MHz, 0 if unknown; `temperature` in degrees Celsius. `certificate_ends_in`: seconds until its node's ends,
    negative since; `renew`: so near that people are to be told."""

    host: str
    number: int
    cores: Annotated[int, msgspec.Meta(gt=0, le=1_000_000)] | Annotated[float, msgspec.Meta(gt=0, le=1_000_000)]
    load_average: tuple[float, float, float]
    cpu: float
    memory_available: int
    memory_total: int
    speed: Annotated[float, msgspec.Meta(ge=0.001, le=1_000)] = 1.0
    clock: Figure = 0.0
    clock_rated: Figure = 0.0
    temperature: float | None = None
    labels: Annotated[tuple[ShortText, ...], msgspec.Meta(max_length=MAX_LABELS)] = ()
    components: Annotated[tuple[ComponentUse, ...], msgspec.Meta(max_length=MAX_COMPONENTS)] = ()
    certificate_ends_in: Seconds | None = None
    renew: bool = False
    version: VersionText = ""
    """Of the node."""
    rights: VersionText = ""
    """Digest of the rights that the node enforces; empty: none."""
    fault: Annotated[str, msgspec.Meta(max_length=MAX_ERROR)] = ""
    """Why the node uses older settings than its files have, with file and key; empty: it does not."""
    recorder: Annotated[str, msgspec.Meta(max_length=MAX_ERROR)] = ""
    """Why the node's recorder writes nothing; empty: it writes, or there is none."""


class RankAsk(Message, frozen=True):
    """Which host is the best for a component of this kind? Only `hosts` where given, else all that report.

    `labels` and `memory` (bytes) are what a host must have."""

    hosts: Annotated[list[str], msgspec.Meta(max_length=MAX_RANKED)] | None = None
    kind: str = ""
    metric: Metric = "composite"
    policy: Policy = "pending"
    labels: Annotated[list[str], msgspec.Meta(max_length=MAX_LABELS)] = []
    memory: Bytes = 0
    at_most: Annotated[int, msgspec.Meta(ge=1, le=MAX_RANKED)] = 16
    """How many hosts are named."""
    reports: bool = False
    """Whether the last load report of each host that is named, ranked or left out, is wanted too."""


class RankedHost(Message, frozen=True):
    """The greater `score` is the better host; `reason` says it in words."""

    host: str
    score: float
    reason: str


class KnownLoad(Message, frozen=True):
    """The last report of a host, which came `age` seconds ago."""

    age: Elapsed
    report: LoadReport


class HostRanking(Message, frozen=True):
    """Hosts best first, by `metric`; `why` says how that was chosen. `left_out` names hosts that can't be
    ranked, and why; as many as were asked for of either."""

    hosts: list[RankedHost]
    metric: Metric
    why: str
    left_out: dict[str, str] = {}
    more: int = 0
    """Ranked hosts that are not named."""
    reports: list[KnownLoad] | None = None
    """None: they were not asked for, or the balancer does not know of that."""


class RecordedAsk(Message, frozen=True):
    """Asks a recorder where its recording is."""


class Recorded(Message, frozen=True):
    """Where a recorder writes, and serves the same live. `file` and `inode` tell whether that is the asker's host."""

    file: Annotated[str, msgspec.Meta(max_length=4096)]
    inode: int
    bind: Annotated[str, msgspec.Meta(max_length=45)]
    """IP address that the live view listens on."""
    port: Annotated[int, msgspec.Meta(ge=1, le=65_535)]


LIMITS[LoadReport] = 131_072
"""256 components with the longest names."""
