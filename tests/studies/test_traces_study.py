"""`python -m studies traces`: a trace as devices, and the batch schedulers that strategies are compared with."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from studies.scheduling.backfill import POLICIES, conservative, easy, shortest_first
from studies.scheduling.swf import DEVICES, LOAD, Job, load, parse_trace, workload
from studies.scheduling.traces import TraceTrial, rows, run
from zscout.config.strict import BadInput
from zscout.types import SECOND


def job(at: int, runtime: int, mask: int = 0, width: int = 1) -> Job:
    return Job(at * SECOND, runtime * SECOND, mask, mask.bit_count() or width, 1, 1, is_higher=False)


def line(number: int, at: int, runtime: int, nodes: int, user: int = 1, group: int = 1, program: int = 1) -> str:
    return f"{number} {at} -1 {runtime} {nodes} -1 -1 {nodes} -1 -1 1 {user} {group} {program} -1 -1 -1 -1"


def starts(policy: Callable[[Sequence[Job]], list[int]], *jobs: Job) -> list[float]:
    return [start / SECOND for start in policy(jobs)]


def test_the_nodes_of_a_trace_become_devices() -> None:
    lines = [
        "; MaxNodes: 128",
        line(1, 0, 100, 128),
        *(line(n, 10 * n, 60, 4, user=n, group=n % 3) for n in range(2, 60)),
    ]
    jobs = parse_trace(lines, "trace")
    assert jobs[0].width == DEVICES
    assert jobs[0].mask == (1 << DEVICES) - 1
    assert {found.width for found in jobs[1:]} == {1}
    assert 0 < sum(not found.mask for found in jobs) < 30, "the most have a place of their own"
    assert load(jobs) == pytest.approx(LOAD, rel=0.01)
    work = workload(jobs, classes=True)
    assert {arrival.request.priority for arrival in work.arrivals} == {1, 5}
    assert work.arrivals[2].request.owner == "u3"


def test_a_line_that_is_no_job_is_told() -> None:
    with pytest.raises(BadInput, match="line 2 is not a job"):
        parse_trace([line(1, 0, 1, 1), "1 2 three"], "trace")


def test_easy_passes_the_first_only_where_it_delays_nobody() -> None:
    held, wide = job(0, 10, 0b01), job(1, 10, 0b11)
    assert starts(easy, held, wide, job(2, 8, 0b10), job(3, 8, 0b10)) == [0, 10, 2, 20]
    assert starts(shortest_first, held, wide, job(2, 8, 0b10), job(3, 8, 0b10)) == [0, 18, 2, 10]


def test_conservative_gives_everybody_a_place_at_the_arrival() -> None:
    first, second, third = job(0, 10, 0b01), job(1, 10, 0b11), job(2, 10, 0b110)
    assert starts(conservative, first, second, third, job(3, 8, 0b100)) == [0, 10, 20, 3]
    # Under EASY only the first of those that wait is kept a place.
    assert starts(easy, first, second, third, job(3, 18, 0b100)) == [0, 10, 21, 3]


def random_jobs(seed: int) -> list[Job]:
    draw, at, jobs = random.Random(seed), 0, []  # noqa: S311
    for _ in range(80):
        at += draw.randint(0, 6)
        width, place = draw.choice((1, 2, 4, 8, 32)), draw.randrange(DEVICES)
        row = sum(1 << (place + number) % DEVICES for number in range(width))
        jobs.append(job(at, draw.randint(1, 40), row if width > 4 or draw.random() < 0.7 else 0, width))
    return jobs


@pytest.mark.parametrize("policy", POLICIES)
def test_no_device_has_two_jobs(policy: str) -> None:
    for seed in range(20):
        jobs = random_jobs(seed)
        found = POLICIES[policy](jobs)
        assert all(start >= known.at for start, known in zip(found, jobs, strict=True))
        for now in found:
            running = [known for start, known in zip(found, jobs, strict=True) if start <= now < start + known.runtime]
            assert sum(known.width for known in running) <= DEVICES
            for number in range(DEVICES):
                assert sum(known.mask >> number & 1 for known in running) <= 1


def test_one_table_of_all(tmp_path: Path) -> None:
    path = tmp_path / "trace.swf"
    path.write_text("\n".join(line(n, 50 * n, 100 + n, 1 << n % 6, user=n % 7, group=n % 4) for n in range(60)))
    found = [run(TraceTrial(path, policy, classes=True)) for policy in (*POLICIES, "adaptive")]
    table = rows(found)
    assert [row[0] for row in table] == [*POLICIES, "adaptive"]
    assert table[0][2].endswith(" s")
    assert not found[-1].unserved
