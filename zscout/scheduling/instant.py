"""A core driven by somebody who knows all votes: replay, forecast, studies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from zscout.scheduling.core import Core
from zscout.scheduling.effects import Effect, Propose, WakeAt
from zscout.scheduling.events import Event, Tick, Vote
from zscout.types import Ns


def play_instant(
    core: Core, now: Ns, events: Iterable[Event], vote: Callable[[Propose], Vote]
) -> Iterator[list[Effect]]:
    """One instant, with every vote and every further pass that it takes; yields the effects of each batch."""
    batch = list(events)
    while batch:
        effects = core.handle(now, *batch)
        yield effects
        batch = [vote(effect) for effect in effects if isinstance(effect, Propose)]
        if not batch and any(isinstance(effect, WakeAt) and effect.at == now for effect in effects):
            batch = [Tick()]
