"""`python -m studies` as people and programs run it."""

from __future__ import annotations

import subprocess
import sys
from typing import Final

from studies.__main__ import main
from tests.hang import HANG

STUDIES: Final = (sys.executable, "-m", "studies")


def study(*args: str) -> subprocess.CompletedProcess[str]:
    """Run a study in a pipe, to its end."""
    return subprocess.run([*STUDIES, *args], capture_output=True, text=True, timeout=3 * HANG)


def study_here(*args: object) -> int:
    """Run a study in this process; return the exit code."""
    return main([str(arg) for arg in args])
