"""Standard input, output and error: open, however the program was started, and able to write every text."""

from __future__ import annotations

import codecs
import os
import sys
from contextlib import suppress
from io import TextIOWrapper
from typing import Final

ESCAPED: Final = "zscout.escaped"
"""The codecs' name of what is done with characters that a stream can't write: \\uXXXX, as in JSON."""


def open_standard_streams() -> None:
    """Open those of 0, 1 and 2 that are closed on /dev/null: else the next file or socket gets such a number, and a
    library that takes it for a standard stream, or a child that inherits it, fails."""
    for fd, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(fd)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(fd, "w" if fd else "r", encoding="utf-8", closefd=False))  # noqa: SIM115


def escape_what_cannot_be_written() -> None:
    """From now on no text that this program writes to standard output or error is an error for its encoding."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            with suppress(ValueError):  # it was closed
                stream.reconfigure(errors=ESCAPED)


def escaped(text: str) -> str:
    """As JSON escapes it; lone surrogates, of file names that are no text, included."""
    code = text.encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{code[at : at + 4]}" for at in range(0, len(code), 4))


def writable(text: str) -> str:
    """As standard output can show it: what is measured before it is written must not grow."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    return text if text.isascii() else text.encode(encoding, ESCAPED).decode(encoding)


def _escaped(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return escaped(error.object[error.start : error.end]), error.end


codecs.register_error(ESCAPED, _escaped)
