"""What all tests of nodes share."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator

import psutil
import pytest


@pytest.fixture
def started() -> Iterator[list[subprocess.Popen[str]]]:
    """Processes that are gone afterwards, with their children."""
    processes: list[subprocess.Popen[str]] = []
    yield processes
    for process in processes:
        for child in psutil.Process(process.pid).children(recursive=True):
            child.kill()
        process.kill()
        process.communicate()
