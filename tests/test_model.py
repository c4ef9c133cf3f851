"""The model of ownership, and whether what the simulated fleet does is a behaviour of it."""

from __future__ import annotations

import msgspec
import pytest

from formal.__main__ import WITHOUT
from formal.tlc import Instance, NoTlc, check, jar
from formal.traces import Behaviour, accept
from zscout.lab.faults.simulation import simulate

try:
    jar()
    why_not = ""
except NoTlc as error:
    why_not = str(error)
pytestmark = pytest.mark.skipif(bool(why_not), reason=why_not)


def test_two_reigns_keep_what_is_promised() -> None:
    outcome = check(Instance("small", terms=2, steps=2, joins=2))
    assert outcome.violated is None
    assert outcome.states > 1_000


@pytest.mark.parametrize("instance", WITHOUT, ids=lambda instance: instance.name)
def test_without_a_guard_some_promise_breaks(instance: Instance) -> None:
    assert check(instance).violated is not None


def test_what_the_fleet_does_is_a_behaviour_of_the_model() -> None:
    behaviours = [Behaviour(simulate(seed, traced=True).trace) for seed in range(20, 29)]
    outcome, where = accept(behaviours)
    assert outcome.violated is None, where
    assert outcome.states > sum(len(one.actions) for one in behaviours)


def test_a_forged_step_is_refused() -> None:
    trace = simulate(20, traced=True).trace
    events = [msgspec.json.decode(line) for line in trace]
    at = next(number for number, event in enumerate(events) if event["do"] == "hear" and event["holds"])
    # A grant that nobody gave.
    events[at]["holds"][0][1] += 1
    outcome, where = accept([Behaviour(events)])
    assert outcome.violated is not None
    assert "holds" in where
