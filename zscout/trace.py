"""Traces of holds as lines of JSON in the log `zscout.trace` at level debug; `formal/` checks them against the model.

    publish   by an RCM: the holders of the RCs in its publication
    over      by an RCM: an ARC that it will never grant again
    others    by an RC: its input, by kind, and its holds afterwards

Each event has the time `at` on this host's monotonic clock, in nanoseconds."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from typing import Any, Final

import msgspec

from zscout.types import Ns

log: Final = logging.getLogger("zscout.trace")


def enabled() -> bool:
    return log.isEnabledFor(logging.DEBUG)


def write(at: Ns, do: str, **what: Any) -> None:
    """Log an event. Check `enabled` first, since the arguments cost time."""
    log.debug("%s", msgspec.json.encode({"at": at, "do": do, **what}).decode())


def lines(text: Iterable[str]) -> list[Mapping[str, Any]]:
    """Parse the events in a log, sorted by time."""
    found = (line[line.index('{"at":') :] for line in text if '{"at":' in line)
    events: list[dict[str, Any]] = [msgspec.json.decode(event) for event in found]
    return sorted(events, key=lambda event: event["at"])
