"""Logs of zscout's programs: one line for each record, whatever text from outside is in it."""

from __future__ import annotations

import logging
import sys
from types import TracebackType
from typing import Final

from zscout.types import clean

_Fault = tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None]
FORM: Final = "%(asctime)s %(levelname)s %(message)s"


class LineFormatter(logging.Formatter):
    """Control and bidi characters are left out; a traceback follows in indented lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        return clean(super().formatMessage(record))

    def formatException(self, ei: _Fault) -> str:  # noqa: N802 - logging's name
        return "\n".join(f"  {clean(line)}" for line in super().formatException(ei).splitlines())


def log_to_stderr(level: str | int, form: str = FORM) -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter(form))
    logging.basicConfig(level=level, handlers=[handler])
