"""Job traces in the Standard Workload Format of the Parallel Workloads Archive, mapped to exclusive devices.

The nodes of the machine become 32 devices with equal numbers of nodes. Most programs (user and application) use a row
of devices at their own place; the others ask for any few devices, or name many. The intervals between submissions are
scaled to the load of a shared lab. System personnel may have a higher priority."""

from __future__ import annotations

import gzip
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from zscout.config.strict import BadInput
from zscout.scheduling.model import ArcRequest
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND, Need, Ns, Params

DEVICES: Final = 32
LOAD: Final = 0.35
NAMING: Final = 85
"""Percentage of programs with a place of their own."""
MOST_BY_PATTERN: Final = 4
PERSONNEL: Final = 2
"""The group of system personnel in the NASA iPSC log."""
HIGHER: Final = 5


class _Line(NamedTuple):
    """A line of the trace: seconds, nodes, and its owner."""

    submitted: int
    runtime: int
    nodes: int
    user: int
    group: int
    application: int


@dataclass(frozen=True, slots=True)
class Job:
    """`mask`: the devices that it names, by bit; 0: any `width` devices."""

    at: Ns
    runtime: Ns
    mask: int
    width: int
    user: int
    application: int
    is_higher: bool


def read_trace(path: Path, first: int | None = None, places: int = 0) -> list[Job]:
    """The jobs of a trace (.swf or .swf.gz) in order of arrival, or the `first` of them. `places` selects another
    random assignment of places to programs. Raises BadInput."""
    try:
        raw = path.read_bytes()
        text = (gzip.decompress(raw) if path.suffix == ".gz" else raw).decode("latin-1")
    except OSError as error:
        raise BadInput(f"{path}: {error.strerror or error}; give a trace in the Standard Workload Format") from None
    jobs = parse_trace(text.splitlines(), str(path), places)
    return jobs if first is None else jobs[:first]


def parse_trace(lines: Iterable[str], source: str, places: int = 0) -> list[Job]:
    """Raises BadInput."""
    found: list[_Line] = []
    machine = 0
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if text.startswith(";"):
            name, _, value = text.lstrip("; ").partition(":")
            if name in ("MaxNodes", "MaxProcs") and value.split()[:1] and value.split()[0].isdecimal():
                machine = max(machine, int(value.split()[0]))
            continue
        if not text:
            continue
        try:
            fields = [round(float(word)) for word in text.split()]
            job = _Line(fields[1], fields[3], max(fields[4], fields[7]), fields[11], fields[12], fields[13])
        except (ValueError, IndexError):
            raise BadInput(f"{source}: line {number} is not a job; write 18 numbers") from None
        if job.runtime > 0 and job.nodes > 0:
            found.append(job)
    machine = machine or max((job.nodes for job in found), default=1)
    return _mapped(sorted(found, key=lambda job: job.submitted), machine, places)


def _mapped(lines: list[_Line], machine: int, places: int) -> list[Job]:
    if not lines:
        return []
    widths = [min(DEVICES, -(-line.nodes * DEVICES // machine)) for line in lines]
    work = sum(width * line.runtime for width, line in zip(widths, lines, strict=True))
    span = lines[-1].submitted - lines[0].submitted
    pace = work / (DEVICES * LOAD * span) if span else 0.0
    jobs = []
    for line, width in zip(lines, widths, strict=True):
        name = f"{line.user}-{line.application}{places or ''}"
        place, chance = divmod(int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "little"), 100)
        named = width < DEVICES and chance < NAMING
        mask = 0 if width <= MOST_BY_PATTERN and not named else _row(place % (DEVICES - width + 1), width)
        at = round((line.submitted - lines[0].submitted) * pace * 1_000) * (SECOND // 1_000)
        higher = line.group == PERSONNEL
        jobs.append(Job(at, line.runtime * SECOND, mask, width, line.user, line.application, higher))
    return jobs


def _row(place: int, width: int) -> int:
    return ((1 << width) - 1) << place


def load(jobs: Iterable[Job]) -> float:
    known = list(jobs)
    span = known[-1].at - known[0].at if known else 0
    return sum(job.width * job.runtime for job in known) / (DEVICES * span) if span else 0.0


def workload(jobs: Iterable[Job], *, classes: bool) -> Workload:
    """The jobs as requests of their users. With `classes`, jobs of system personnel have a higher priority."""
    names = [f"node/n{number:02}" for number in range(DEVICES)]
    arrivals = []
    for number, job in enumerate(jobs):
        needs: dict[Need, Params] = {name: {} for bit, name in enumerate(names) if job.mask >> bit & 1}
        if not job.mask:
            needs = {f"node/*#{count}" if count > 1 else "node/*": {} for count in range(1, job.width + 1)}
        client = f"u{job.user}/a{job.application}"
        priority = HIGHER if classes and job.is_higher else 1
        arrivals.append(Arrival(job.at, ArcRequest(f"j{number}", client, needs, priority, job.runtime)))
    return Workload(tuple(map(WorkloadRc, names)), tuple(arrivals))
