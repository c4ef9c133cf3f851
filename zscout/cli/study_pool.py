"""Trials spread over processes; results come back in the order of the jobs."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import AsyncGenerator, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import Final

from zscout.cli.common import Failed
from zscout.scheduling.study.trial import Job, Trial, run

GIVE_UP: Final = 5.0
"""Seconds for an interrupted pool to come to its end."""
AHEAD: Final = 4
"""Jobs per process that are handed out before the results of earlier ones are taken."""


async def spread(jobs: Sequence[Job], processes: int) -> AsyncGenerator[Trial, None]:
    """Runs the jobs. However it ends, no process is left. Raises Failed if one of them dies.

    Close the iterator (`contextlib.aclosing`) if it is not read to its end."""
    others = set(multiprocessing.active_children())
    # Spawned, not forked: this process has threads by now (the progress bar's).
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), initializer=_start)
    rest, out = iter(jobs), deque[Future[Trial]]()
    done = False
    try:
        while True:
            with _no_interrupts():
                while len(out) < AHEAD * processes and (job := next(rest, None)) is not None:
                    out.append(pool.submit(_run, job))
            if not out:
                break
            yield await asyncio.wrap_future(out.popleft())
        done = True
    except BrokenProcessPool:
        raise Failed(
            "a process of the study died, perhaps for want of memory; use fewer with --jobs 1"
        ) from None
    finally:
        if not done:
            for child in set(multiprocessing.active_children()) - others:
                child.terminate()
        # Seen once: the pool of an interrupted study waited for ever. Why is not known; its wait is bounded.
        impatience = threading.Timer(GIVE_UP, os._exit, (1,))
        impatience.daemon = True
        if not done:
            impatience.start()
        pool.shutdown(cancel_futures=True)
        impatience.cancel()


@contextmanager
def _no_interrupts() -> Iterator[None]:
    """Processes that start in here never hear a Ctrl-C: this one does, and ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start() -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A parent that is killed can't end its children: they see to it themselves."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _run(job: Job) -> Trial:
    # Processor time, as the study keeps all processors busy; of all threads, as a solver may have some.
    return run(job, time.process_time_ns)
