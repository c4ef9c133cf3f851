"""Trials spread over processes; results come back in the order of the jobs.

Each process has a pipe of its own, and a thread here waits for its answer. A killed process is the end of its
pipe, even in the middle of a result, and so of the thread's waiting. The processes of a ProcessPoolExecutor
share one pipe, whose writing end their parent holds as well: when one of them was killed in the middle of a
result, the parent waited for the rest of it for ever.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import AsyncGenerator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Final

from zscout.cli.common import Failed
from zscout.scheduling.study.trial import Job, Trial, run

AHEAD: Final = 4
"""Jobs per process that are handed out before the results of earlier ones are taken."""
ENDING: Final = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


async def spread(jobs: Sequence[Job], processes: int) -> AsyncGenerator[Trial, None]:
    """Runs the jobs. However it ends, no process is left. Raises Failed if one of them dies or can't start.

    Close the iterator (`contextlib.aclosing`) if it is not read to its end."""
    workers: list[_Worker] = []
    threads = ThreadPoolExecutor(processes)
    rest, out = iter(jobs), deque[Future[Trial]]()
    try:
        with _no_signals():
            for _ in range(processes):
                workers.append(_Worker())  # noqa: PERF401 - those that did start are to be seen below
        # As many as threads: one that has a job finds an idle worker.
        idle = deque(workers)
        while True:
            while len(out) < AHEAD * processes and (job := next(rest, None)) is not None:
                out.append(threads.submit(_carry_out, job, idle))
            if not out:
                break
            yield await asyncio.wrap_future(out.popleft())
    finally:
        for worker in workers:
            worker.process.kill()
        threads.shutdown(cancel_futures=True)
        for worker in workers:
            worker.close()


class _Worker:
    """A process that runs one job at a time, and this end of its pipe. Raises Failed if it can't start."""

    def __init__(self) -> None:
        # Spawned, not forked: this process has threads by now (the progress bar's).
        context = multiprocessing.get_context("spawn")
        try:
            self.pipe, theirs = context.Pipe()
            self.process = context.Process(target=_work, args=(theirs,), daemon=True)
            # Closed here, so that only the process holds it: its death is the pipe's end.
            with theirs:
                self.process.start()
        except OSError as error:
            raise Failed(f"a process can't be started ({error.strerror}); use fewer with --jobs 1") from None

    def close(self) -> None:
        """Clears up after a process that was killed."""
        self.process.join()
        self.process.close()
        self.pipe.close()


def _carry_out(job: Job, idle: deque[_Worker]) -> Trial:
    """Runs a job on an idle worker. Raises Failed if its process dies, RuntimeError if the trial broke."""
    worker = idle.popleft()
    try:
        worker.pipe.send(job)
        answer: Trial | str = worker.pipe.recv()
    except (EOFError, OSError):
        raise Failed(
            "a process of the study died, perhaps for want of memory; use fewer with --jobs 1"
        ) from None
    finally:
        idle.append(worker)
    if isinstance(answer, Trial):
        return answer
    raise RuntimeError(f"{job} failed:\n{answer}")


@contextmanager
def _no_signals() -> Iterator[None]:
    """Processes that start in here never hear what ends this one: it ends them itself."""
    # Started together with a process, multiprocessing's tracker would let the signals through again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# In the processes


def _work(pipe: Connection) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # The pipe ends when the parent does.
    with suppress(EOFError, OSError):
        while True:
            pipe.send(_answer(pipe.recv()))


def _answer(job: Job) -> Trial | str:
    """The trial, or how it failed."""
    try:
        # Processor time, as the study keeps all processors busy; of all threads, as a solver may have some.
        return run(job, time.process_time_ns)
    except Exception:  # noqa: BLE001 - whatever it is, the parent shows it
        return traceback.format_exc()


def _end_with_parent() -> None:
    """A parent that is killed can't end its children: they see to it themselves."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
