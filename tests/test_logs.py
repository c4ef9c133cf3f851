"""What a log says of an error: a traceback, but of a shortage of this host one line with its remedy."""

from __future__ import annotations

import errno
import logging
import os

import pytest

from zscout.logs import FORM, LineFormatter, shortage

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/var/x\nERROR forged")


def logged(error: BaseException) -> str:
    fault = (type(error), error, error.__traceback__)
    return LineFormatter(FORM).format(logging.LogRecord("x", logging.ERROR, "", 0, "it failed", (), fault))


def test_a_shortage_is_one_line_and_no_traceback() -> None:
    line = logged(FULL)
    assert line.endswith(" ERROR it failed: No space left on device: /var/x ERROR forged; free some")
    assert "\n" not in line
    assert "\n  ValueError: x" in logged(ValueError("x"))


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (FULL, "No space left on device"),
        (ExceptionGroup("x", [ValueError("x"), FULL]), "No space left on device"),
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files; raise the limit (ulimit -n"),
        (BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"), "Resource temporarily unavailable; end"),
        (RuntimeError("can't start new thread"), "no more threads can be started; end some processes"),
        (UnicodeEncodeError("utf-8", "lab/r\udcff", 5, 6, "surrogates not allowed"), "'lab/r\\udcff' is not UTF-8"),
        (MemoryError(), "there is no memory left"),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "/proc/stat"), "/proc/stat; mount /proc"),
        (PermissionError(errno.EACCES, "Permission denied", b"/proc/1/stat"), "/proc/1/stat; mount /proc"),
    ],
    ids=str,
)
def test_what_is_short_and_the_remedy(error: BaseException, words: str) -> None:
    assert words in shortage(error)


@pytest.mark.parametrize(
    "error",
    [
        ValueError("x"),
        RuntimeError("x"),
        OSError("x"),
        UnicodeEncodeError("ascii", "\xe4", 0, 1, "x"),
        OSError(errno.EBADF, "x"),
        None,
    ],
)
def test_other_errors_are_none(error: BaseException | None) -> None:
    assert shortage(error) == ""
