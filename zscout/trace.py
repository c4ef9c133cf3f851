"""What becomes of holds, as lines of JSON in the log `zscout.trace` at level debug: `formal/` holds them against the
model.

    publish   an RCM: the holders of the RCs that it names
    over      an RCM: an ARC that it will never grant again
    promise, hear, read, end, command   an RC: what it heard, and what it holds then

Each has the time `at` on this host's monotonic clock, in nanoseconds."""

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
    """Ask whether it is `enabled` first: the arguments are not free."""
    log.debug("%s", msgspec.json.encode({"at": at, "do": do, **what}).decode())


def lines(text: Iterable[str]) -> list[Mapping[str, Any]]:
    """The events among the lines of a log, in the order of time."""
    found = (line[line.index('{"at":') :] for line in text if '{"at":' in line)
    events: list[dict[str, Any]] = [msgspec.json.decode(one) for one in found]
    return sorted(events, key=lambda event: event["at"])
