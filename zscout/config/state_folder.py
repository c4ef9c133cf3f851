"""The folder for files that must outlive a host's processes, by fleet and host.

It is in the folder `state` of the node file; else `$STATE_DIRECTORY`, which systemd sets for its units; else
`$XDG_STATE_HOME/zscout`, else `~/.local/state/zscout`."""

from __future__ import annotations

import logging
import os
import stat
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

log = logging.getLogger(__name__)


def state_folder(fleet: str, host: str, named: Path | None = None, env: Mapping[str, str] = os.environ) -> Path | None:
    """The folder of one host of one fleet, made if needed. None, with a line in the log, if it can't be written."""
    folder = _top(named, env)
    if folder is None:
        log.warning("no folder for files that outlive this node: set `state` under [node], or $XDG_STATE_HOME")
        return None
    folder = folder / fleet / host
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        probe = folder / f".written-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        log.warning("can't write %s (%s): set `state` under [node] to another folder", folder, error.strerror)
        return None
    return folder


def _top(named: Path | None, env: Mapping[str, str]) -> Path | None:
    if named is not None:
        return named
    if given := env.get("STATE_DIRECTORY"):
        return Path(given.split(":")[0])
    if given := env.get("XDG_STATE_HOME"):
        return Path(given) / "zscout"
    with suppress(RuntimeError):  # this user has no home
        return Path.home() / ".local" / "state" / "zscout"
    return None


def write_durably(path: Path, content: bytes, mode: int | None = None) -> None:
    """Write a file atomically; it is on disk on return. A new file has `mode` from its first byte on; with `mode`, a
    replaced file keeps its mode and owner. Raises OSError."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    new = path.with_name(f".{path.name}.new")
    new.unlink(missing_ok=True)
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
    with open(os.open(new, flags, 0o666 if mode is None else mode), "wb") as file:  # noqa: PTH123 - a descriptor
        if mode is not None and path.exists():
            was = path.stat()
            os.fchown(file.fileno(), was.st_uid, was.st_gid)
            os.fchmod(file.fileno(), stat.S_IMODE(was.st_mode))
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    new.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
