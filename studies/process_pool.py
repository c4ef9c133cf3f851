"""Work distributed over processes that end with their parent.

Each process has its own pipe, and only it holds the other end. So the pipe ends when the process is killed, even in the
middle of an answer. The processes of `concurrent.futures.ProcessPoolExecutor` share one pipe, and their parent also
holds its writing end: when a process was killed in the middle of an answer, the parent waited forever for the rest.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import aclosing, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Final, Generic, TypeVar

from zscout import terminal
from zscout.cli.common import Failed
from zscout.config.strict import BadInput

ENDING: Final = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
MAX_PROCESSES: Final = 256

J = TypeVar("J")
A = TypeVar("A")


async def run_trials(
    work: Callable[[J], A], jobs: Sequence[J], processes: int | None, take: Callable[[A], None]
) -> None:
    """Pass the answers of `work` to `take`, in the order of the jobs, with a progress bar at a terminal. Default: as
    many `processes` as processors. Raises as `answers` does."""
    processes = processes or min(MAX_PROCESSES, len(os.sched_getaffinity(0)))
    with terminal.progress(len(jobs)) as advance:
        async with aclosing(answers(work, jobs, processes)) as found:
            async for answer in found:
                take(answer)
                advance()


async def answers(work: Callable[[J], A], jobs: Sequence[J], processes: int) -> AsyncGenerator[A, None]:
    """Run `work`, a module-level function, on each job, and yield the answers in the order of the jobs. Close the
    iterator (`contextlib.aclosing`) before its end: then no process is left. Raises Failed if a process dies or can't
    start, BadInput if `work` raised it, and RuntimeError for other exceptions of `work`."""
    answered: asyncio.Queue[tuple[_Worker[J, A], A | Exception]] = asyncio.Queue()
    loop = asyncio.get_running_loop()
    workers: list[_Worker[J, A]] = []
    rest, done = iter(enumerate(jobs)), dict[int, A]()
    try:
        for _ in range(min(processes, len(jobs))):
            worker = _Worker(work)
            workers.append(worker)
            loop.add_reader(worker.pipe.fileno(), _receive, worker, answered)
            worker.send(*next(rest))
        for number in range(len(jobs)):
            while number not in done:
                worker, answer = await answered.get()
                if isinstance(answer, Exception):
                    raise answer
                done[worker.number] = answer
                if (job := next(rest, None)) is not None:
                    worker.send(*job)
                # A signal can end this between two answers, however fast they come.
                await asyncio.sleep(0)
            yield done.pop(number)
    finally:
        for worker in workers:
            loop.remove_reader(worker.pipe.fileno())
            worker.kill()


def _receive(worker: _Worker[J, A], answered: asyncio.Queue[tuple[_Worker[J, A], A | Exception]]) -> None:
    answered.put_nowait((worker, worker.receive()))


class _Worker(Generic[J, A]):
    """A process that runs a job at a time, and the parent's end of its pipe. Raises Failed if it can't start."""

    def __init__(self, work: Callable[[J], A]) -> None:
        # Spawned, not forked, because this process has threads (of the progress bar).
        context = multiprocessing.get_context("spawn")
        self.number = -1
        """Number of its job."""
        # If it were started together with a process, multiprocessing's tracker would unblock the signals.
        resource_tracker.ensure_running()
        # The process inherits the mask, because its parent ends it.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
        try:
            self.pipe, theirs = context.Pipe()
            self._process = context.Process(target=_serve, args=(work, theirs), daemon=True)
            # Closed here, so that only the process holds it, and the pipe ends with the process.
            with theirs:
                self._process.start()
        except OSError as error:
            raise Failed(f"a process can't be started ({error.strerror}); use fewer with --jobs 1") from None
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def send(self, number: int, job: J) -> None:
        self.number = number
        # `receive` reports dead processes.
        with suppress(OSError):
            self.pipe.send(job)

    def receive(self) -> A | Exception:
        """Return the answer to the job, or an exception to raise."""
        try:
            answer: A | Exception = self.pipe.recv()
        except (EOFError, OSError):
            return Failed("a process of the study died, perhaps because memory ran out; use fewer with --jobs 1")
        return answer

    def kill(self) -> None:
        self._process.kill()
        self._process.join()
        self._process.close()
        self.pipe.close()


def _serve(work: Callable[[J], A], pipe: Connection) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    # The pipe ends when the parent does.
    with suppress(EOFError, OSError):
        while True:
            pipe.send(_answer(work, pipe.recv()))


def _answer(work: Callable[[J], A], job: J) -> A | Exception:
    try:
        return work(job)
    except BadInput as bad:
        return bad
    except Exception:  # noqa: BLE001 - the parent shows it
        return RuntimeError(f"{job} failed:\n{traceback.format_exc()}")


def _end_with_parent() -> None:
    """End this process when its parent dies: a killed parent can't end its children."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
