"""What an RC reports, compared with what the RCM believes: what is lost, and what is published again."""

from __future__ import annotations

from zscout.messages import RcState
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest, HandedOver, LeadTaken, RcJoined, Requested
from zscout.scheduling.strategies import STRATEGIES
from zscout.services.rcm.membership import discrepancies
from zscout.services.rcm.rcm import holders_of
from zscout.types import SECOND, Term

RC = "robot/x"
TERM = Term(1, "m")
NOW = 1000 * SECOND


def granted() -> Core:
    """A core in which h/one holds RC."""
    core = Core(STRATEGIES["priority"]())
    request = ArcRequest("h/one/id", "h/one", {RC: {}}, 0, 60 * SECOND, label="tally")
    core.handle(NOW, RcJoined(RC, sharable=False), LeadTaken(TERM, (), ()), Requested(request))
    return core


def reports(core: Core, *, holds: bool = True) -> RcState:
    """What an RC reports that has received all that was published so far."""
    holders = holders_of(core.holders(RC), RC, NOW) if holds else []
    return RcState(rc=RC, host="d", instance="i", sharable=False, term=TERM, seq=core.seq, holders=list(holders))


def test_a_hold_that_its_rc_does_not_know_is_lost() -> None:
    core = granted()
    assert discrepancies(reports(core, holds=False), core.holders(RC), NOW, current=True) == (("h/one/id",), False)


def test_an_rc_that_presents_what_was_handed_over_has_not_heard_of_it_yet() -> None:
    """It read the state, with this number, before the publication came: the hand-over stands."""
    core = granted()
    before = reports(core)
    core.handle(NOW, HandedOver("h/one/id", "h/two", "h/two/id"))
    assert discrepancies(before, core.holders(RC), NOW, current=True) == ((), True)
    assert discrepancies(reports(core), core.holders(RC), NOW, current=True) == ((), False)
