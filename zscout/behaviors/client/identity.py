"""Identity of this program for people: user, host and command. It grants no rights."""

from __future__ import annotations

import getpass
import os
import socket
import sys
from pathlib import Path

from zscout.config.certificates import read_certificates
from zscout.config.fleet import Fleet
from zscout.keyexpr import valid_name
from zscout.messages import MAX_COMMENT, MAX_WHO, Who
from zscout.types import clean

_MAIN = ("__main__", "__init__")


def this_program(host: str) -> Who:
    """Without the program's arguments, which may contain secrets."""
    return Who(bounded(_user()), bounded(host), bounded(_program()))


def host_of(fleet: Fleet) -> str:
    """In keys: its certificate's name; without certificates $ZSCOUT_HOST, else this machine's. Raises BadInput."""
    if fleet.security is not None:
        return read_certificates(fleet.security).name
    return os.environ.get("ZSCOUT_HOST") or this_machine()


def this_machine() -> str:
    return valid_name(socket.gethostname())


def bounded(text: str, most: int = MAX_WHO) -> str:
    text = " ".join(clean(text).split())
    return text if len(text) <= most else text[: most - 1].rstrip() + "…"


def checked_comment(text: str) -> str:
    """Return a comment on one line. Raises ValueError if it is longer than MAX_COMMENT."""
    text = " ".join(clean(text).split())
    if len(text) > MAX_COMMENT:
        raise ValueError(f"the comment has {len(text)} characters; write at most {MAX_COMMENT}")
    return text


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):  # an id without a name, as in containers
        return str(os.getuid())


def _program() -> str:
    called = sys.argv[0] if getattr(sys, "argv", None) else ""
    if called in ("", "-c", "-m"):
        return "python"
    path = Path(called)
    return path.parent.name if path.stem in _MAIN else path.name
