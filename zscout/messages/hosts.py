"""Hosts: their loads, and the ranking of hosts for a component."""

from __future__ import annotations

from typing import Annotated

import msgspec

from zscout.messages.base import (
    LIMITS,
    MAX_COUNTER,
    MAX_ERROR,
    MAX_INCARNATION,
    NEWEST_COUNTS,
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
"""Labels of one host."""
MAX_COMPONENTS = 256
"""Components in one load report."""


class ComponentUse(Message, frozen=True):
    """Resources used by one component with all its child processes: `cpu` in cores, `memory` in bytes. `served` is the
    share of the time that it got a processor when it wanted one; None if unknown."""

    component: ShortText
    kind: ShortText
    incarnation: Annotated[int, msgspec.Meta(ge=0, le=MAX_INCARNATION)]
    cpu: Figure
    memory: Bytes
    processes: Annotated[int, msgspec.Meta(ge=0, le=MAX_COUNTER)] = 1
    served: Annotated[float, msgspec.Meta(ge=0, le=1)] | None = None


class LoadReport(Message, frozen=True):
    """A host's load. `number` counts one reporter's reports; memory is in bytes, `cpu` in percent of all cores.

    `speed` is the speed of one core at a fixed piece of work (`docs/protocol/messages.md`): 1.0 does it in 1 ms. Clocks
    are in MHz, 0 if unknown; `temperature` is in degrees Celsius. `certificate_ends_in`: seconds until the node's
    certificate expires, negative if it has; `renew`: this is soon enough to warn people."""

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
    """Version of the node."""
    rights: VersionText = ""
    """Digest of the rights that the node enforces; empty if it enforces none."""
    fault: Annotated[str, msgspec.Meta(max_length=MAX_ERROR)] = ""
    """Why the node uses older settings than its files contain, with file and key; empty if they agree."""
    recorder: Annotated[str, msgspec.Meta(max_length=MAX_ERROR)] = ""
    """Why the node's recorder writes nothing; empty if it writes or there is no recorder."""


class RankAsk(Message, frozen=True):
    """Asks which host is the best for a component of `kind`, among `hosts` (absent: all hosts that report).

    `labels` and `memory` (bytes) are required of a host."""

    hosts: Annotated[list[str], msgspec.Meta(max_length=MAX_RANKED)] | None = None
    kind: str = ""
    metric: Metric = "composite"
    policy: Policy = "pending"
    labels: Annotated[list[str], msgspec.Meta(max_length=MAX_LABELS)] = []
    memory: Bytes = 0
    at_most: Annotated[int, msgspec.Meta(ge=1, le=MAX_RANKED)] = 16
    """Number of hosts in the answer."""
    reports: bool = False
    """Include the last load report of each host in the answer, ranked or left out."""


class RankedHost(Message, frozen=True):
    """A host with a greater `score` is better; `reason` explains the score in words."""

    host: str
    score: float
    reason: str


class KnownLoad(Message, frozen=True):
    """The last report of a host, received `age` seconds ago."""

    age: Elapsed
    report: LoadReport


class HostRanking(Message, frozen=True):
    """Hosts, the best first, by `metric`; `why` explains the choice of the metric. `left_out` has hosts that can't be
    ranked, with the reason. Both have at most as many hosts as the query asked for."""

    hosts: list[RankedHost]
    metric: Metric
    why: str
    left_out: dict[str, str] = {}
    more: int = 0
    """Number of ranked hosts that are not listed."""
    reports: list[KnownLoad] | None = None
    """None if they were not asked for, or the balancer is too old to send them."""


class RecordedAsk(Message, frozen=True):
    """Asks a recorder for the place of its recording."""


class Recorded(Message, frozen=True):
    """The file that a recorder writes, and the address where it serves the same data live. `file` and `inode` let a
    program find out if this is its own host."""

    file: Annotated[str, msgspec.Meta(max_length=4096)]
    inode: int
    bind: Annotated[str, msgspec.Meta(max_length=45)]
    """IP address on which the live view listens."""
    port: Annotated[int, msgspec.Meta(ge=1, le=65_535)]


LIMITS[LoadReport] = 131_072
"""256 components with the longest names."""
NEWEST_COUNTS.add(LoadReport)
