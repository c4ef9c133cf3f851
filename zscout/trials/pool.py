"""Work spread over processes that end with whoever started them.

Each process has a pipe of its own, so that one that is killed, even in the middle of an answer, is the end of
its pipe and not of the waiting for it (`zscout.cli.study_pool` tells why that matters).
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Final, Generic, TypeVar

import cv2

from zscout.strict import BadInput

ENDING: Final = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}

J = TypeVar("J")
A = TypeVar("A")


class ProcessDied(Exception):
    """A process of the pool is gone, or none can be started."""


async def spread(
    work: Callable[[J], A], jobs: Sequence[J], processes: int
) -> AsyncGenerator[tuple[int, A], None]:
    """Runs `work`, a function of a module, on each job: (number of the job, answer), as they come. However it
    ends, no process is left. Raises ProcessDied, BadInput that `work` raised, and RuntimeError
    where it raised something else.

    Close the iterator (`contextlib.aclosing`) if it is not read to its end."""
    answers: asyncio.Queue[tuple[_Worker[J, A], A | Exception]] = asyncio.Queue()
    loop = asyncio.get_running_loop()
    workers: list[_Worker[J, A]] = []
    rest = iter(enumerate(jobs))
    try:
        for _ in range(min(processes, len(jobs))):
            worker = _Worker(work)
            workers.append(worker)
            loop.add_reader(worker.pipe.fileno(), _pass_on, worker, answers)
            worker.take(next(rest))
        for _ in jobs:
            worker, answer = await answers.get()
            if isinstance(answer, Exception):
                raise answer
            done = worker.job
            if (job := next(rest, None)) is not None:
                worker.take(job)
            yield done, answer
    finally:
        for worker in workers:
            loop.remove_reader(worker.pipe.fileno())
            worker.end()


def _pass_on(worker: _Worker[J, A], answers: asyncio.Queue[tuple[_Worker[J, A], A | Exception]]) -> None:
    answers.put_nowait((worker, worker.answer()))


class _Worker(Generic[J, A]):
    """A process that runs one job at a time, and this end of its pipe. Raises ProcessDied."""

    def __init__(self, work: Callable[[J], A]) -> None:
        # Spawned, not forked: this process has threads by now.
        context = multiprocessing.get_context("spawn")
        self.job = -1
        # Started together with a process, multiprocessing's tracker would let the signals through again.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
        try:
            self.pipe, theirs = context.Pipe()
            self._process = context.Process(target=_work, args=(work, theirs), daemon=True)
            # Closed here, so that only the process holds it: its death is the pipe's end.
            with theirs:
                self._process.start()
        except OSError as error:
            raise ProcessDied(f"a process can't be started ({error.strerror})") from None
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def take(self, job: tuple[int, J]) -> None:
        self.job = job[0]
        # A process that is gone is told of by `answer`.
        with suppress(OSError):
            self.pipe.send(job[1])

    def answer(self) -> A | Exception:
        """What has come of the job."""
        try:
            fine, answer = self.pipe.recv()
        except (EOFError, OSError):
            return ProcessDied("a process of the study died, perhaps for want of memory")
        if fine:
            done: A = answer
            return done
        return answer if isinstance(answer, BadInput) else RuntimeError(f"job {self.job} failed:\n{answer}")

    def end(self) -> None:
        self._process.kill()
        self._process.join()
        self._process.close()
        self.pipe.close()


# In the processes


def _work(work: Callable[[J], A], pipe: Connection) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # One process, one processor: more threads would only get into the others' way.
    cv2.setNumThreads(1)
    # The pipe ends when the parent does.
    with suppress(EOFError, OSError):
        while True:
            job = pipe.recv()
            try:
                answer: tuple[bool, A | str | BadInput] = True, work(job)
            except BadInput as bad:
                answer = False, bad
            except Exception:  # noqa: BLE001 - whatever it is, the parent shows it
                answer = False, traceback.format_exc()
            pipe.send(answer)


def _end_with_parent() -> None:
    """A parent that is killed can't end its children: they see to it themselves."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
