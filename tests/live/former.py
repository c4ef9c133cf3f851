"""The first version, commit 0df377c (tag v0.1.0), on a mesh with this one."""

from __future__ import annotations

import shutil
import subprocess
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from tests.live.lab import Lab

FORMER: Final = "0df377c"
ROOT: Final = Path(__file__).parents[2]


def unpack(folder: Path) -> Path:
    """Its tree in `folder`, as if it were installed there. Skips where the repository does not reach back to it."""
    archive = folder.with_name(f"{folder.name}.tar")
    git = ("git", "-C", str(ROOT), "archive", f"--output={archive}", FORMER, "zscout", "tests", "pyproject.toml")
    try:
        subprocess.run(git, capture_output=True, check=True)
    except FileNotFoundError:
        pytest.skip("git is not installed: commit 0df377c (v0.1.0) can't be had")
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no commit 0df377c (v0.1.0) here, as in a shallow clone: {error.stderr.decode().strip()}")
    shutil.unpack_archive(archive, folder)
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    info = folder / f"zscout-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: zscout\nVersion: {project['version']}\n")
    kinds = project["entry-points"]["zscout.components"]
    lines = (f"{name} = {value}" for name, value in kinds.items())
    (info / "entry_points.txt").write_text("\n".join(["[zscout.components]", *lines]))
    return folder


def environment(former: Path, env: Mapping[str, str]) -> dict[str, str]:
    """For a Python, started in `former`, that is to find the first version before this one."""
    return {**env, "PYTHONPATH": str(former)}


class MixedLab(Lab):
    """Nodes and clients of both versions."""

    def __init__(self, folder: Path, former: Path, **how: Any) -> None:
        super().__init__(folder, **how)
        self._former = former

    @contextmanager
    def at(self, version: str) -> Iterator[None]:
        """What is started within is of the `old` version, or of the `new` one."""
        env, cwd = self.env, self.cwd
        if version == "old":
            self.env, self.cwd = environment(self._former, env), self._former
        try:
            yield
        finally:
            self.env, self.cwd = env, cwd
