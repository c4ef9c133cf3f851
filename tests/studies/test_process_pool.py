"""Jobs on several processes: answers in order, failures as they are, and no process left."""

from __future__ import annotations

import asyncio
import math
import multiprocessing
import operator
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import aclosing
from typing import Any

import pytest

from studies.process_pool import answers
from zscout.cli.common import Failed
from zscout.config.strict import BadInput

pytestmark = pytest.mark.live


def collected(work: Callable[[Any], Any], jobs: Sequence[Any], processes: int = 2) -> list[Any]:
    async def collect() -> list[Any]:
        async with aclosing(answers(work, jobs, processes)) as found:
            return [answer async for answer in found]

    return asyncio.run(collect())


def late(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def refused(job: str) -> None:
    raise BadInput(f"{job}: it can't be used; give another")


def killed_in_the_middle_of_its_answer(size: int) -> bytes:
    """Dies as soon as nothing more of the answer fits into the pipe, which holds 64 kB and is read slowly."""
    threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGKILL)).start()
    return bytes(size)


def test_answers_come_in_the_order_of_the_jobs() -> None:
    assert collected(operator.neg, range(20)) == [-number for number in range(20)]
    assert collected(late, [0.3, 0.0, 0.1, 0.0]) == [0.3, 0.0, 0.1, 0.0]
    assert multiprocessing.active_children() == []


def test_a_job_that_fails_ends_it_and_is_shown_with_its_traceback() -> None:
    with pytest.raises(RuntimeError, match=r"(?s)^-1.0 failed.*Traceback.*math domain error"):
        collected(math.sqrt, [4.0, -1.0], 1)
    assert multiprocessing.active_children() == []


def test_bad_input_stays_bad_input() -> None:
    with pytest.raises(BadInput, match=r"^a\.toml: it can't be used"):
        collected(refused, ["a.toml"], 1)


@pytest.mark.parametrize(("work", "job"), [(os._exit, 3), (killed_in_the_middle_of_its_answer, 100_000_000)])
def test_a_process_that_dies_ends_it(work: Callable[[int], Any], job: int) -> None:
    with pytest.raises(Failed, match="died, perhaps because memory ran out; use fewer with --jobs 1"):
        collected(work, [job, job])
    assert multiprocessing.active_children() == []


def test_left_early_it_leaves_no_process() -> None:
    async def first() -> int:
        async with aclosing(answers(operator.neg, range(1, 50), 2)) as found:
            async for answer in found:
                return answer
        return 0

    assert asyncio.run(first()) == -1
    assert multiprocessing.active_children() == []
