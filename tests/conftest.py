"""What holds for all tests."""

from __future__ import annotations

import os
import sys
import tempfile

import pytest

BYTECODE = pytest.StashKey[tempfile.TemporaryDirectory[str]]()


def pytest_configure(config: pytest.Config) -> None:
    """Tests start hundreds of Python processes. Where the environment forbids bytecode beside the sources,
    each would compile all it imports anew: they keep it in a folder of this run instead."""
    if sys.dont_write_bytecode and "PYTHONDONTWRITEBYTECODE" in os.environ:
        del os.environ["PYTHONDONTWRITEBYTECODE"]
        folder = config.stash[BYTECODE] = tempfile.TemporaryDirectory(prefix="zscout-bytecode-")
        os.environ["PYTHONPYCACHEPREFIX"] = folder.name


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests with processes on a mesh come first: they wait more than they compute; others fill the gaps."""
    items.sort(key=lambda item: item.get_closest_marker("live") is None)


def pytest_unconfigure(config: pytest.Config) -> None:
    if BYTECODE in config.stash:
        config.stash[BYTECODE].cleanup()
