"""Random workloads, small and full of ties: many things happen at one instant, sums sit on the boundary."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction

from hypothesis import strategies as st

from zscout.scheduling.capacity import excess
from zscout.scheduling.model import ArcRequest, Propose, Vote
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND, Params, RcName

PARAMETERS = ("rate", "width")
ABSENT: RcName = "robot/absent"
"""An RC that no workload has, and some ARCs need all the same."""

_shares = st.sampled_from([Fraction(1, 10), Fraction(2, 10), Fraction(3, 10), Fraction(1, 2)])
# 0.1 + 0.2 fills 0.3 exactly: with floats it would not.
_capacities = st.sampled_from([Fraction(2, 10), Fraction(3, 10), Fraction(6, 10), Fraction(1)])

# Mostly `rate` on both sides, so that RCs are short of it and reprieves matter.
params: st.SearchStrategy[Params] = st.one_of(
    st.fixed_dictionaries({"rate": _shares}), st.dictionaries(st.sampled_from(PARAMETERS), _shares, max_size=2)
)
capacity: st.SearchStrategy[Params] = st.one_of(
    st.fixed_dictionaries({"rate": _capacities}), st.dictionaries(st.sampled_from(PARAMETERS), _capacities, max_size=2)
)


def voter(workload: Workload) -> Callable[[Propose], Vote]:
    """How the RCs of a workload vote: by their own sums."""
    capacities = {rc.name: rc.capacity for rc in workload.rcs}

    def vote(asked: Propose) -> Vote:
        reason = excess(capacities[asked.rc], asked.holders.items())
        return Vote(asked.proposal, accept=not reason, reason=reason)

    return vote


@st.composite
def rcs(draw: st.DrawFn) -> tuple[WorkloadRc, ...]:
    """One to six RCs, more often few, exclusive and sharable mixed."""
    number_of = draw(st.sampled_from([1, 2, 2, 3, 3, 4, 6]))
    kinds = draw(st.lists(st.booleans(), min_size=number_of, max_size=number_of))
    return tuple(
        WorkloadRc(f"radio/{number}", sharable=True, capacity=draw(capacity))
        if sharable
        else WorkloadRc(f"robot/{number}")
        for number, sharable in enumerate(kinds)
    )


@st.composite
def requests(draw: st.DrawFn, arc: str, names: list[RcName], *, keep: bool = True) -> ArcRequest:
    """One ARC that needs one to four of `names`, now and then of `ABSENT`; kept sometimes, if `keep`."""
    needed = draw(st.lists(st.sampled_from(names), min_size=1, max_size=4, unique=True))
    if draw(st.integers(0, 15)) == 15:
        needed.append(ABSENT)
    return ArcRequest(
        arc=arc,
        client=f"host/{draw(st.integers(0, 2))}",
        needs={name: draw(params) for name in needed},
        priority=draw(st.integers(0, 3)),
        min_runtime=draw(st.sampled_from([1, 2, 3, 5])) * SECOND,
        keep=keep and draw(st.integers(0, 5)) == 5,
    )


@st.composite
def workloads(draw: st.DrawFn, *, keep: bool = True) -> Workload:
    """RCs and one to twelve ARCs that ask within a few seconds."""
    fleet = draw(rcs())
    names = [rc.name for rc in fleet]
    arrivals = [
        Arrival(draw(st.sampled_from([0, 1, 2, 3, 5])) * SECOND, draw(requests(f"a{number}", names, keep=keep)))
        for number in range(draw(st.sampled_from([1, 2, 4, 6, 8, 10, 12])))
    ]
    return Workload(fleet, tuple(arrivals))
