"""Logs of zscout's programs: one line for each record, even with foreign text in it."""

from __future__ import annotations

import errno
import logging
import os
import sys
from types import TracebackType
from typing import Final

from zscout.types import clean

_Fault = tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None]
FORM: Final = "%(asctime)s %(levelname)s %(message)s"


MAX_SHOWN: Final = 200
"""Characters of a name."""
REMEDIES: Final = {
    errno.ENOSPC: "free some",
    errno.EDQUOT: "free some",
    errno.EFBIG: "raise the limit (ulimit -f)",
    errno.EROFS: "name a folder that can be written",
    errno.EMFILE: "raise the limit (ulimit -n, in a unit LimitNOFILE=)",
    errno.ENFILE: "end some programs of this host",
    errno.ENOMEM: "free some",
    errno.EAGAIN: "end some processes, or raise the limit (ulimit -u, in a unit TasksMax=)",
}


def shortage(error: BaseException | None) -> str:
    """A shortage of this host (disk, memory, descriptors, ...) or a file name that is not UTF-8, with the remedy; ""
    for other errors, whose traceback may help."""
    if isinstance(error, BaseExceptionGroup):
        return next(filter(None, map(shortage, error.exceptions)), "")
    if isinstance(error, UnicodeEncodeError) and "\udc80" <= error.object[error.start] <= "\udcff":
        return f"{error.object[:MAX_SHOWN]!a} is not UTF-8; rename it"
    if isinstance(error, RuntimeError) and "start new thread" in str(error):
        error = OSError(errno.EAGAIN, "no more threads can be started")
    elif isinstance(error, MemoryError):
        error = OSError(errno.ENOMEM, "there is no memory left")
    if not isinstance(error, OSError):
        return ""
    file = f": {os.fsdecode(error.filename)}" if isinstance(error.filename, str | bytes) else ""
    remedy = (
        "mount /proc so that this user can read it" if file.startswith(": /proc/") else REMEDIES.get(error.errno or 0)
    )
    return f"{error.strerror}{file}; {remedy}" if remedy else ""


class LineFormatter(logging.Formatter):
    """Removes control and bidi characters. A traceback follows in indented lines, except for a shortage."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        why = shortage(record.exc_info[1]) if record.exc_info else ""
        return clean(super().formatMessage(record) + (f": {why}" if why else ""))

    def formatException(self, ei: _Fault) -> str:  # noqa: N802 - logging's name
        if shortage(ei[1]):
            return ""
        return "\n".join(f"  {clean(line)}" for line in super().formatException(ei).splitlines())


def log_to_stderr(level: str | int, form: str = FORM) -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter(form))
    logging.basicConfig(level=level, handlers=[handler])
