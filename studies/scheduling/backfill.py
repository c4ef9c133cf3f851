"""Batch schedulers for comparison: EASY and conservative backfill, and shortest first, on distinct devices.

Runtimes are exact, without preemption. Each returns the start of every job in ns, with jobs in order of arrival."""

from __future__ import annotations

import heapq
from bisect import bisect_right, insort
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Final, TypeAlias

from studies.scheduling.swf import DEVICES, Job
from zscout.scheduling.claim_index import bits
from zscout.types import Ns

ALL: Final = (1 << DEVICES) - 1

Running: TypeAlias = list[tuple[Ns, int]]
"""A heap of ends and bits of devices."""
Pick: TypeAlias = Callable[[Ns, list[int], int, Running], Iterator[tuple[int, int]]]
"""Picks the jobs that start now from a queue in order of arrival; yields numbers and devices. A picked job has left the
queue."""


def easy(jobs: Sequence[Job]) -> list[Ns]:
    """First come, first served; others may pass if they do not delay the first in the queue (Lifka, 1995)."""

    def pick(now: Ns, queue: list[int], free: int, running: Running) -> Iterator[tuple[int, int]]:
        while queue and (mask := _fit(jobs[queue[0]], free)):
            free &= ~mask
            yield queue[0], mask
        if not queue:
            return
        shadow, kept = _shadow(jobs[queue[0]], free, running)
        for number in queue[1:]:
            job = jobs[number]
            mask = _fit(job, free & ~kept) or (_fit(job, free) if now + job.runtime <= shadow else 0)
            if mask:
                free &= ~mask
                yield number, mask

    return _play(jobs, pick)


def shortest_first(jobs: Sequence[Job]) -> list[Ns]:
    """Every job that fits starts, the shortest first."""

    def pick(_now: Ns, queue: list[int], free: int, _running: Running) -> Iterator[tuple[int, int]]:
        for number in sorted(queue, key=lambda number: jobs[number].runtime):
            if mask := _fit(jobs[number], free):
                free &= ~mask
                yield number, mask

    return _play(jobs, pick)


def conservative(jobs: Sequence[Job]) -> list[Ns]:
    """Every job gets a reservation on arrival. As runtimes are exact, this is its start."""
    booked: list[list[tuple[Ns, Ns]]] = [[] for _ in range(DEVICES)]
    return [_book(job, booked) for job in jobs]


def _book(job: Job, booked: list[list[tuple[Ns, Ns]]]) -> Ns:
    named = [bit.bit_length() - 1 for bit in bits(job.mask)] or list(range(DEVICES))
    for number in named:
        spans = booked[number]
        del spans[: bisect_right([end for _, end in spans], job.at)]
    times = sorted({job.at, *(end for number in named for _, end in booked[number])})
    for start in times:
        free = [number for number in named if _is_free(booked[number], start, start + job.runtime)]
        if len(free) >= job.width:
            # Among equal devices, prefer those whose next reservation is earliest.
            free.sort(key=lambda number: next((begin for begin, _ in booked[number] if begin >= start), 1 << 62))
            for number in free[: job.width]:
                insort(booked[number], (start, start + job.runtime))
            return start
    raise AssertionError("after the last end all are free")


def _is_free(spans: Sequence[tuple[Ns, Ns]], start: Ns, end: Ns) -> bool:
    return not any(begin < end and start < over for begin, over in spans)


POLICIES: Final[Mapping[str, Callable[[Sequence[Job]], list[Ns]]]] = {
    "EASY": easy,
    "conservative": conservative,
    "shortest first": shortest_first,
}


def _play(jobs: Sequence[Job], pick: Pick) -> list[Ns]:
    coming, starts = deque(range(len(jobs))), [0] * len(jobs)
    queue: list[int] = []
    running: Running = []
    free = ALL
    while coming or running:
        now = min([*(jobs[number].at for number in islice(coming, 1)), *(end for end, _ in running[:1])])
        while running and running[0][0] <= now:
            free |= heapq.heappop(running)[1]
        while coming and jobs[coming[0]].at <= now:
            queue.append(coming.popleft())
        for number, mask in pick(now, queue, free, running):
            queue.remove(number)
            starts[number] = now
            free &= ~mask
            heapq.heappush(running, (now + jobs[number].runtime, mask))
    return starts


def _fit(job: Job, free: int) -> int:
    """The devices with which the job could start; 0: none."""
    if job.mask:
        return job.mask if not job.mask & ~free else 0
    return _lowest(free, job.width) if free.bit_count() >= job.width else 0


def _lowest(mask: int, count: int) -> int:
    found = 0
    for bit in bits(mask):
        if found.bit_count() == count:
            break
        found |= bit
    return found


def _shadow(job: Job, free: int, running: Running) -> tuple[Ns, int]:
    """The earliest start of a job, and its devices: among those free by then, the last to become free."""
    last: list[int] = []
    for end, mask in sorted(running):
        last.append(mask)
        free |= mask
        if _fit(job, free):
            if job.mask:
                return end, job.mask
            kept = 0
            for freed in (*reversed(last), free):
                kept |= _lowest(freed & ~kept, job.width - kept.bit_count())
            return end, kept
    raise AssertionError("after the last end all are free")
