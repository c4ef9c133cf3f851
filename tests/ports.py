"""Ports for servers that tests have others start."""

from __future__ import annotations

from zscout.ports import free_port as first_free


def free_port() -> int:
    """A TCP port of this machine that nobody listens on; a random one, so no test beside this one takes the same."""
    return first_free("127.0.0.1", 0)
