"""Child processes of a benchmark: each reports when it is ready, and ends when its stdin is closed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Self

END = 20.0


class Child:
    """A process that takes orders and sends reports, both as JSON lines."""

    def __init__(
        self, command: Sequence[str], *, env: Mapping[str, str] | None = None, cwd: Path | None = None
    ) -> None:
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=env, cwd=cwd)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._orders: IO[str] = self._process.stdin
        self._reports: IO[str] = self._process.stdout
        self._name = " ".join(command[1:3])

    @classmethod
    def of(cls, module: str, *args: str) -> Self:
        """Start a module of this package."""
        return cls([sys.executable, "-m", f"benchmarks.{module}", *args])

    def order(self, what: Any) -> None:
        print(json.dumps(what), file=self._orders, flush=True)

    def report(self) -> Any:
        """Wait for its next report."""
        line = self._reports.readline()
        assert line, f"{self._name} ended"
        return json.loads(line)

    def close(self) -> None:
        self._orders.close()
        self._process.wait(END)
        self._reports.close()


@contextmanager
def child(module: str, *args: str) -> Iterator[Child]:
    """Run a module of this package until the end of the block."""
    process = Child.of(module, *args)
    try:
        process.report()
        yield process
    finally:
        process.close()


def ready() -> None:
    """Send a child's first report."""
    print(json.dumps("ready"), flush=True)
