"""Where a host keeps what must outlive its processes, by fleet and host.

That is the folder `state` of the node file; else `$STATE_DIRECTORY`, which systemd gives its units; else
`$XDG_STATE_HOME/zscout`, else `~/.local/state/zscout`."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

log = logging.getLogger(__name__)


def state_folder(fleet: str, host: str, named: Path | None = None, env: Mapping[str, str] = os.environ) -> Path | None:
    """The folder of one host of one fleet, made if need be. None, and a line in the log, where none can be written."""
    folder = _top(named, env)
    if folder is None:
        log.warning("there is no folder for what must outlive this node: set `state` under [node], or $XDG_STATE_HOME")
        return None
    folder = folder / fleet / host
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        probe = folder / f".written-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        log.warning("%s can't be written (%s): set `state` under [node] to a folder that can", folder, error.strerror)
        return None
    return folder


def _top(named: Path | None, env: Mapping[str, str]) -> Path | None:
    if named is not None:
        return named
    if given := env.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    if given := env.get("XDG_STATE_HOME"):
        return Path(given) / "zscout"
    with suppress(RuntimeError):  # nobody's home is known
        return Path.home() / ".local" / "state" / "zscout"
    return None


def write_durably(path: Path, content: bytes) -> None:
    """Writes a file whole or not at all; it is on disk on return. Raises OSError."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    new = path.with_name(f".{path.name}.new")
    with new.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
