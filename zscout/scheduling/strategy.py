"""What a strategy is to the core, and the core to a strategy."""

from __future__ import annotations

from typing import Protocol

from zscout.config.scheduling_policy import StrategyName
from zscout.scheduling.model import Arc, Rc
from zscout.scheduling.reason import Reason
from zscout.scheduling.state import SchedulerState
from zscout.scheduling.votes import HolderSet


class Actions(Protocol):
    """What a strategy may do; each call changes the state at once and becomes an effect."""

    def start(self, arc: Arc) -> None: ...
    def preempt(self, arc: Arc, by: Arc) -> bool:
        """Takes everything from a running ARC for `by`; True if it is queued again."""
        ...

    def wait(self, arc: Arc, reason: Reason, *, settled: bool = True) -> None: ...
    def propose(self, rc: Rc, holders: HolderSet) -> None: ...
    def run_again(self) -> None:
        """Asks for another pass at once: the strategy needs more time, and others shall have their turn."""
        ...


class Strategy(Protocol):
    """Decides who runs. One that keeps something from pass to pass serves one core only."""

    name: StrategyName

    def run_pass(self, state: SchedulerState, actions: Actions) -> None:
        """One pass: reads the state, and acts."""
        ...

    def news(self) -> str:
        """What is worth a line in a log since it was last asked for; mostly empty."""
        ...
