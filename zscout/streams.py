"""Makes standard streams usable: open, even if the program was started without them, and able to write every text."""

from __future__ import annotations

import codecs
import os
import sys
from contextlib import suppress
from io import TextIOWrapper
from typing import Final

ESCAPED: Final = "zscout.escaped"
"""Name of the codec error handler that writes unencodable characters as \\uXXXX, as in JSON."""


def open_standard_streams() -> None:
    """Open closed descriptors among 0, 1 and 2 on /dev/null: else the next file or socket would get such a number, and
    a library or child process would use it as a standard stream."""
    for fd, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(fd)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # gets the lowest free number
        if getattr(sys, name) is None:
            setattr(sys, name, open(fd, "w" if fd else "r", encoding="utf-8", closefd=False))  # noqa: SIM115


def escape_what_cannot_be_written() -> None:
    """Make standard output and error escape characters that their encoding lacks, instead of raising."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            with suppress(ValueError):  # the stream is closed
                stream.reconfigure(errors=ESCAPED)


def escaped(text: str) -> str:
    """Escape all characters as in JSON, also the lone surrogates of file names that are not UTF-8."""
    code = text.encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{code[at : at + 4]}" for at in range(0, len(code), 4))


def writable(text: str) -> str:
    """The text as standard output will show it, so that its width can be measured before."""
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    return text if text.isascii() else text.encode(encoding, ESCAPED).decode(encoding)


def _escaped(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return escaped(error.object[error.start : error.end]), error.end


codecs.register_error(ESCAPED, _escaped)
