"""The model of ownership, and whether what the simulated fleet does is a behaviour of it."""

from __future__ import annotations

import msgspec
import pytest

from formal.__main__ import WITHOUT
from formal.tlc import ENTERING, SETTLING, Instance, NoTlc, check, check_entering, check_settling, jar
from formal.traces import Behaviour, accept
from studies.faults.simulation import simulate

try:
    jar()
    why_not = ""
except NoTlc as error:
    why_not = str(error)
pytestmark = [pytest.mark.live, pytest.mark.skipif(bool(why_not), reason=why_not)]


@pytest.mark.slow
def test_two_reigns_keep_what_is_promised() -> None:
    outcome = check(Instance("small", terms=2, steps=2, joins=2))
    assert outcome.violated is None
    assert outcome.states > 1_000


@pytest.mark.slow
@pytest.mark.parametrize("instance", WITHOUT, ids=lambda instance: instance.name)
def test_without_a_guard_some_promise_breaks(instance: Instance) -> None:
    assert check(instance).violated is not None


@pytest.mark.slow
@pytest.mark.parametrize("without", ["", *ENTERING])
def test_a_grant_is_answered_first_and_confirmed_beside_its_body_unless_a_guard_is_taken_out(without: str) -> None:
    outcome = check_entering(without, terms=2, numbers=3 if without == "by name" else 2)
    promises = {"confirm": "progress", "waits": "Undisturbed", "by name": "Undisturbed", "newer": "Forward"}
    assert outcome.violated == promises.get(without)
    assert outcome.states > 1_000


@pytest.mark.slow
@pytest.mark.parametrize("without", ["", *SETTLING])
def test_no_two_programs_are_at_an_rc_that_settles_unless_a_guard_is_taken_out(without: str) -> None:
    outcome = check_settling(without, holds=2)
    assert outcome.violated == ("Alone" if without else None)
    assert outcome.states > 1_000


@pytest.fixture(scope="module")
def trace() -> list[str]:
    return simulate(21, traced=True).trace


@pytest.mark.slow
def test_what_the_fleet_does_is_a_behaviour_of_the_model(trace: list[str]) -> None:
    """Whole, and in pieces, each of which begins with what the one before it led to."""
    whole, cut = Behaviour(trace, piece=10_000), Behaviour(trace, piece=50)
    assert len(whole.pieces) == 1
    assert len(cut.pieces) > 5
    assert whole.actions == cut.actions
    verdict = accept([whole, cut])
    assert not verdict.refused
    # Of each piece the beginning, its actions, and what the next begins with.
    assert verdict.states == 2 * whole.actions + 2 + 2 * (len(cut.pieces) - 1)


@pytest.mark.slow
def test_a_forged_step_is_refused_in_any_piece(trace: list[str]) -> None:
    events = [msgspec.json.decode(line) for line in trace]
    # Of sharable RCs the model knows nothing.
    exclusive = [number for number, event in enumerate(events) if event["do"] == "hear" and not event["sharable"]]
    heard = [number for number in exclusive if events[number]["holds"]]
    forged = []
    for at in (heard[0], heard[-1]):
        mine = msgspec.json.decode(msgspec.json.encode(events))
        # A grant that nobody gave.
        mine[at]["holds"][0][1] += 1
        forged.append(Behaviour(mine, piece=50))
    # What a piece begins with is not what was before.
    cut = Behaviour(trace, piece=50)
    cut.pieces[3].actions.pop()
    verdict = accept([*forged, Behaviour(trace), cut])
    assert verdict.refused.keys() == {0, 1, 3}
    assert "piece 1, " in verdict.refused[0]
    assert f"line {heard[-1] + 1}, piece " in verdict.refused[1]
    assert "piece 1, " not in verdict.refused[1]
    assert "holds" in verdict.refused[1]
    assert "does not lead to" in verdict.refused[3]


@pytest.mark.slow
def test_who_promises_once_more_goes_on_with_what_it_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A leader that was away itself asks its RCs again, and names what they hold as before."""
    # Java's second compiler takes half a second, which only long runs get back.
    monkeypatch.setenv("JAVA_TOOL_OPTIONS", "-XX:TieredStopAtLevel=1")
    term, robot, radio = [1, "z"], {"rc": "robot/a", "instance": "a"}, {"rc": "radio/b", "instance": "b"}
    both, grant = {"robot/a": "a", "radio/b": "b"}, [[1, "z"], 2]
    held = [[grant, "arc", [term, 1], ["robot/a"]]]
    events = [
        {"do": "promise", **robot, "seq": 0, "holds": []},
        {"do": "promise", **radio, "seq": 0, "holds": []},
        {"do": "publish", "seq": 1, "rcs": {"robot/a": [], "radio/b": []}, "instances": both},
        {"do": "publish", "seq": 2, "rcs": {"robot/a": held}, "instances": {"robot/a": "a"}},
        {"do": "hear", **robot, "seq": 2, "holds": [grant]},
        {"do": "promise", **robot, "seq": 2, "holds": [grant]},
        # It does not hear this one.
        {"do": "publish", "seq": 3, "rcs": {"robot/a": held, "radio/b": []}, "instances": both},
        {"do": "command", **robot, "seq": 2, "holds": [grant], "grant": grant},
    ]
    assert not accept([Behaviour([{**event, "term": term} for event in events])]).refused
