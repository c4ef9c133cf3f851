"""Record the calls in a process of zscout, for `benchmarks.grant_path`; a `sitecustomize` installs it."""

from __future__ import annotations

import atexit
import json
import os
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

_OPTIMIZED = 1
"""Flag of functions' code; code of modules and class bodies does not have it."""

Call = tuple[int, str, str]
"""Monotonic clock in ns, module, qualified name."""


def install(folder: Path) -> None:
    """Record each call of a function of zscout in the main thread, and each resumption of a coroutine. Writes them to a
    file in `folder` when a subprocess is started, or at exit."""
    calls: list[Call] = []

    def profile(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_flags & _OPTIMIZED:
            module = frame.f_globals.get("__name__", "")
            if module.startswith("zscout."):
                calls.append((time.monotonic_ns(), module, frame.f_code.co_qualname))

    def dump() -> None:
        sys.setprofile(None)
        calls.append((time.monotonic_ns(), "", "end"))
        (folder / f"{os.getpid()}.json").write_text(json.dumps(calls))
        calls.clear()

    def audit(event: str, _: tuple[Any, ...]) -> None:
        if event == "subprocess.Popen" and calls:
            atexit.unregister(dump)
            dump()

    sys.setprofile(profile)
    sys.addaudithook(audit)
    atexit.register(dump)
