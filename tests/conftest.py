"""What holds for all tests."""

from __future__ import annotations

import os
import signal
import sys
import tempfile

import pytest
from hypothesis import settings

pytest_plugins = ["tests.async_tests", "tests.fleets", "tests.tiers"]

settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

BYTECODE, STATE = (pytest.StashKey[tempfile.TemporaryDirectory[str]]() for _ in range(2))


def pytest_configure(config: pytest.Config) -> None:
    """Tests end processes by signals that nohup, or a shell in the background, made this one ignore, and its children
    would too.

    Tests start hundreds of Python processes. Where the environment forbids bytecode beside the sources, each would
    compile all it imports anew: they keep it in a folder of this run instead."""
    for number, action in ((signal.SIGHUP, signal.SIG_DFL), (signal.SIGINT, signal.default_int_handler)):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, action)
    # What nodes keep for after them goes with this run.
    state = config.stash[STATE] = tempfile.TemporaryDirectory(prefix="zscout-state-")
    os.environ["XDG_STATE_HOME"] = state.name
    if sys.dont_write_bytecode and "PYTHONDONTWRITEBYTECODE" in os.environ:
        del os.environ["PYTHONDONTWRITEBYTECODE"]
        folder = config.stash[BYTECODE] = tempfile.TemporaryDirectory(prefix="zscout-bytecode-")
        os.environ["PYTHONPYCACHEPREFIX"] = folder.name


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests with processes on a mesh come first: they wait more than they compute; others fill the gaps."""
    items.sort(key=lambda item: item.get_closest_marker("live") is None)


def pytest_unconfigure(config: pytest.Config) -> None:
    for key in (BYTECODE, STATE):
        if key in config.stash:
            config.stash[key].cleanup()
