"""Other processes of a benchmark: each says when it is ready, and ends when its stdin is closed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

END = 20.0


class Child:
    """A module of this package as a process; it has reported once before this is made."""

    def __init__(self, module: str, *args: str) -> None:
        command = [sys.executable, "-m", f"benchmarks.{module}", *args]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._orders: IO[str] = self._process.stdin
        self._reports: IO[str] = self._process.stdout
        self._name = module

    def order(self, what: dict[str, Any]) -> None:
        print(json.dumps(what), file=self._orders, flush=True)

    def report(self) -> Any:
        """The next thing that it says, as JSON; waits for it."""
        line = self._reports.readline()
        assert line, f"benchmarks.{self._name} ended"
        return json.loads(line)

    def close(self) -> None:
        self._orders.close()
        self._process.wait(END)
        self._reports.close()


@contextmanager
def child(module: str, *args: str) -> Iterator[Child]:
    """Runs a module of this package until the end of the block."""
    process = Child(module, *args)
    try:
        process.report()
        yield process
    finally:
        process.close()


def ready() -> None:
    """What a child says first."""
    print(json.dumps("ready"), flush=True)
