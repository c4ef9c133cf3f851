"""A request as its client sees it: which words count, and what is kept of how a hold ended."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from dataclasses import replace
from decimal import Decimal
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from tests.behaviors.client.small_fleet import small_fleet
from zscout.behaviors.client.arc import Held, Revoked, hold
from zscout.behaviors.client.client import Client, CommandRefused
from zscout.behaviors.client.request import OpenArc, RequestStore
from zscout.config.fleet import default_fleet
from zscout.keyexpr import BadName, Keys, Sender
from zscout.mesh import Declaration, Mesh
from zscout.mesh.renewal import Suspicions
from zscout.messages import Amounts, Done, Notice, OpenRequest, Problem, ReasonInfo
from zscout.types import SECOND, Grant, Ns, Place, Term

OLD, TERM = Term(1, "zz"), Term(2, "aa")
FIRST, SECOND_GRANT = Grant(TERM, 1), Grant(TERM, 9)
NOW = 1000 * SECOND
NOBODY = cast("Client", None)
"""For what asks nobody on the mesh."""


def mesh(now: Callable[[], Ns]) -> Mesh:
    """The parts of a mesh that decisions of a client need. Nobody is seen there."""

    async def living(*_: Any, **__: Any) -> list[Any]:
        return []

    parts = SimpleNamespace(me=Sender("h", "c"), keys=Keys("fleet"), now=now, suspicions=Suspicions(now, lambda: None))
    parts.living, parts.watch = living, lambda *_: Declaration(lambda: None)
    return cast("Mesh", parts)


def arc(*needs: str) -> OpenArc:
    wanted: dict[str, Amounts] = {need: {} for need in needs or ("robot/x",)}
    return OpenArc("id", "survey", wanted, priority=0, min_runtime=Decimal(5))


def notice(step: int, state: Any = "queued", **details: Any) -> Notice:
    told = Notice("id", "survey", "h/c", state, TERM, step)
    return msgspec.structs.replace(told, **details)


RUNS = notice(2, "running", grant=FIRST, remaining=5.0, place=Place(TERM, 1))
TAKEN = notice(3, outcome="preempted", reason="preempted by op", by="h/c/op", grant=FIRST)
WAITS = notice(4, reason="needs robot/x")
AGAIN = notice(5, "running", grant=SECOND_GRANT, remaining=5.0)


def runs(bound: dict[str, str], step: int = 2, grant: Grant = FIRST) -> Notice:
    return notice(step, "running", grant=grant, remaining=5.0, bound=bound)


@pytest.mark.parametrize(
    ("words", "state", "grant", "ending"),
    [
        ([RUNS], "running", FIRST, None),
        ([RUNS, TAKEN], "queued", None, ("preempted", "preempted by op", "h/c/op")),
        # The reason to wait does not hide why the hold was taken away.
        ([RUNS, TAKEN, WAITS], "queued", None, ("preempted", "preempted by op", "h/c/op")),
        ([RUNS, TAKEN, WAITS, AGAIN], "running", SECOND_GRANT, ("preempted", "preempted by op", "h/c/op")),
        ([RUNS, WAITS], "queued", None, ("lost", "needs robot/x", None)),
        (
            [RUNS, AGAIN],
            "running",
            SECOND_GRANT,
            ("lost", "the leader considered this client gone; it is granted again", None),
        ),
        ([RUNS, notice(3, "ended", outcome="completed")], "ended", None, ("completed", "", None)),
        ([RUNS, notice(1)], "running", FIRST, None),
        ([RUNS, RUNS], "running", FIRST, None),
        ([RUNS, notice(99, term=OLD)], "running", FIRST, None),
        ([RUNS, notice(3, "ended", outcome="released"), AGAIN], "ended", None, ("released", "", None)),
    ],
)
def test_words_of_the_rcm(words: list[Notice], state: str, grant: Grant | None, ending: Any) -> None:
    known = arc()
    for number, word in enumerate(words):
        known._take(word, NOW + number)
    assert (known.state, known.grant, known._ending) == (state, grant, ending)
    assert (known._open_request(NOW).grant, known._place) == (grant, Place(TERM, 1))


def test_what_meets_a_pattern_is_what_the_newest_hold_says() -> None:
    known = arc("fg/*", "fg/*#2", "robot/x")
    assert known._take(runs({"fg/*": "fg/b", "fg/*#2": "fg/a"}), NOW)
    first = Held(NOBODY, known, FIRST)
    assert (first.rcs, first.rc("fg/*"), first.rc("fg/*#2")) == (["fg/a", "fg/b", "robot/x"], "fg/b", "fg/a")
    assert (first.rc("robot/x"), first.rc("fg/a")) == ("robot/x", "fg/a")
    known._take(TAKEN, NOW)
    known._take(runs({"fg/*": "fg/c", "fg/*#2": "fg/a"}, step=5, grant=SECOND_GRANT), NOW)
    again = Held(NOBODY, known, SECOND_GRANT)
    assert (again.rcs, again.rc("fg/*")) == (["fg/a", "fg/c", "robot/x"], "fg/c")
    assert first.rc("fg/*") == "fg/b"
    assert known._ask(NOW).needs.keys() == {"fg/*", "fg/*#2", "robot/x"}
    for unasked in ("fg/*#3", "video/*", "robot/y", "fg/b"):
        with pytest.raises(KeyError, match=re.escape(f"{unasked} is not a need of survey; it requested fg/*,")):
            again.rc(unasked)


@pytest.mark.parametrize(
    "bound",
    [
        {},
        {"fg/*": "fg/a"},
        {"fg/*": "fg/a", "fg/*#2": "fg/a"},
        {"fg/*": "fg/a", "fg/*#2": "robot/x"},
        {"fg/*": "fg/a", "fg/*#2": "fg/*"},
        {"fg/*": "fg/a", "fg/*#2": "fg/../b"},
        {"fg/*": "fg/a", "fg/*#3": "fg/b"},
    ],
)
def test_a_hold_that_is_not_what_was_asked_for_is_not_believed(bound: dict[str, str]) -> None:
    known = arc("fg/*", "fg/*#2", "robot/x")
    assert not known._take(runs(bound), NOW)
    assert (known.state, known.grant, known.rcs, known.bound) == ("asking", None, [], {})


def test_no_binding_makes_another_rc_of_one_that_was_named() -> None:
    known = arc("robot/x")
    assert known._take(runs({"robot/x": "robot/y"}), NOW)
    assert (known.rcs, known.bound) == (["robot/x"], {})


def test_a_hold_of_other_devices_that_some_node_reports_ends_none() -> None:
    known = arc("robot/x")
    known._take(RUNS, NOW)
    assert not known._take(msgspec.structs.replace(AGAIN, rcs=["robot/y"]), NOW)
    assert (known.state, known.grant) == ("running", FIRST)
    assert known._take(msgspec.structs.replace(AGAIN, rcs=["robot/x"]), NOW)


def test_what_the_client_ends_itself() -> None:
    lost, given_up = arc(), arc()
    for known in (lost, given_up):
        known._take(RUNS, NOW)
    lost._lose("no RCM was heard", NOW)
    assert (lost.state, lost.grant, lost.open, lost._ending) == (
        "asking",
        None,
        True,
        ("lost", "no RCM was heard", None),
    )
    given_up.why = ReasonInfo("held")
    given_up._finish("released", "given up", NOW)
    assert (given_up.open, given_up._ending) == (False, ("released", "given up", None))
    assert [given_up.why] == [None]
    assert not given_up._take(AGAIN, NOW)


def test_a_body_is_told_why_it_ended_whatever_came_after() -> None:
    known = arc()
    for word in (RUNS, TAKEN, WAITS):
        known._take(word, NOW)
    revoked = Revoked(known)
    assert (revoked.outcome, revoked.by, str(revoked)) == ("preempted", "h/c/op", "preempted by op")


def test_what_was_refused_before_any_hold_is_told_as_well() -> None:
    known = arc()
    known._take(notice(1, "ended", outcome="cancelled", reason="cancelled by an operator"), NOW)
    revoked = Revoked(replace(known))
    assert (revoked.outcome, str(revoked)) == ("cancelled", "cancelled by an operator")


EXPECTED = OpenRequest(
    "id", "survey", {"robot/x": {}}, 3, Decimal(5), True, place=Place(TERM, 1), waited=2.0, grant=FIRST
)


def test_what_is_expected_is_nobodys_until_there_is_word_of_it() -> None:
    known = OpenArc._expected(EXPECTED, NOW)
    assert (known.state, known.open, known.grant, known._place) == ("expected", False, None, Place(TERM, 1))
    assert known._open_request(NOW).waited == 2.0
    # The old client's end of it is not the new one's.
    assert not known._take_first(notice(9, "ended", outcome="handed_over"), NOW)
    # Nor is what was said of it when it was here before.
    known._last = (TERM, 1)
    assert not known._take_first(notice(1, "running", grant=FIRST, remaining=5.0), NOW)
    assert (known.state, known.open) == ("expected", False)
    assert known._take_first(RUNS, NOW)
    assert (known.state, known.grant, known.rcs) == ("running", FIRST, ["robot/x"])
    queued = OpenArc._expected(EXPECTED, NOW)
    assert queued._take_first(WAITS, NOW)
    assert (queued.state, queued._open_request(NOW + SECOND).waited) == ("queued", 3.0)


@pytest.mark.parametrize("bad", [{"id": "a/b"}, {"arc": ""}, {"needs": {"robot": {}}}])
def test_nobody_is_handed_what_has_no_name(bad: dict[str, Any]) -> None:
    with pytest.raises(BadName):
        OpenArc._expected(msgspec.structs.replace(EXPECTED, **bad), NOW)


@pytest.mark.parametrize("held", [True, False])
def test_what_moved_and_is_taken_back_keeps_its_place_and_its_wait(held: bool) -> None:
    known = arc()
    for word in (WAITS, RUNS, AGAIN) if held else (RUNS, TAKEN):
        known._take(word, NOW)
    known._place = Place(TERM, 1)
    known._move(NOW + SECOND)
    assert (known.state, known.open, known.grant) == ("moved", False, None)
    assert not known._take(notice(99), NOW + SECOND)
    known._take_back("new", "the new client is gone", NOW + 2 * SECOND)
    asked = known._ask(NOW + 3 * SECOND)
    assert (known.state, known.open) == ("asking", True)
    assert (asked.id, asked.place, asked.waited) == ("new", Place(TERM, 1), 2.0 if held else 3.0)
    revoked = Revoked(known)
    # A hold that moved is a hold that was lost; how an earlier one ended stays as it was.
    assert revoked.outcome == ("lost" if held else "preempted")
    assert known._take(notice(1, "running", grant=FIRST, remaining=5.0, term=OLD), NOW + 3 * SECOND)


async def test_while_it_is_paused_a_client_leaves_the_rcm_s_word_on_hand_overs_for_later() -> None:
    store, known = RequestStore(lambda: NOW, lambda _: None), arc()
    store.add(known)
    store.take(known, RUNS)
    store.resumed.clear()
    gone = notice(9, "ended", outcome="handed_over", grant=FIRST)
    store.take(known, gone)
    assert (known.state, store.acknowledged) == ("running", [known])
    store.move(known, notice(10, "running", client="h/new", grant=SECOND_GRANT))
    assert (store.open, store.moved, known._last) == ([], {"id": known}, (TERM, 10))
    # What is expected is told of without a place: the RCs decide whose it is.
    store.expected["other"] = OpenArc._expected(msgspec.structs.replace(EXPECTED, id="other"), NOW)
    assert [(told.id, told.place, told.grant) for told in store.open_requests()] == [("other", None, None)]
    store.resumed.set()
    store.reclaim(known)
    assert (list(store.arcs), store.moved, known.state) == ([known.id], {}, "asking")
    assert known.id != "id"
    # Of what may have been handed over it is told so afterwards: once more it is its own, elsewhere over.
    store.reclaimed = {second := known.id}
    store.take(known, notice(1, "ended", id=second, outcome="handed_over"))
    assert (list(store.arcs), known.state) == ([known.id], "asking")
    assert known.id != second
    # A second answer about the old id says nothing of the new one.
    store.take(known, notice(2, "ended", id=second, outcome="handed_over"))
    assert known.state == "asking"
    store.take(known, notice(2, "ended", id=known.id, outcome="handed_over"))
    assert (store.arcs, known.state) == ({}, "ended")


@pytest.mark.parametrize(
    ("answers", "told"),
    [
        (["not_yet", "stale", "not_yet", None], None),
        (["not_yet", "ended", None], (FIRST, ["robot/a"])),
        (["not_holder", None], (FIRST, ["robot/a"])),
        (["failed"], "failed"),
    ],
)
async def test_what_its_rc_does_not_confirm_is_asked_for_again_at_its_place(
    answers: list[str | None], told: Any
) -> None:
    client, known = Client(mesh(lambda: NOW), default_fleet()), arc("robot/a")
    client._store.add(known)
    known._take(runs({}), NOW)
    ended, asked = list[OpenArc](), list[Any]()

    async def command(rc: str, *_: Any, **__: Any) -> Done:
        if (code := answers.pop(0)) is not None:
            raise CommandRefused(rc, Problem(code, code))
        return Done()

    async def end(given_up: OpenArc) -> None:
        ended.append(given_up)

    async def submit(again: OpenArc) -> None:
        assert (again.state, again.grant) == ("asking", None)
        ask = again._ask(NOW)
        asked.append((ask.grant, ask.unconfirmed))
        again._take(runs({}, 3, SECOND_GRANT), NOW)
        client._store.notify(again)
        assert again._ask(NOW).unconfirmed == []

    client._confirmations._command = command
    client.end, client._rcm.submit = end, submit  # type: ignore[assignment,method-assign]
    if told == "failed":
        with pytest.raises(CommandRefused, match="failed"):
            await client.granted(known, confirmed=True)
        assert (ended, asked) == ([known], [])
    else:
        assert await client.granted(known, confirmed=True) == (FIRST if told is None else SECOND_GRANT)
        assert (ended, asked) == ([], [] if told is None else [told])
    assert answers == []


async def test_a_grant_is_confirmed_by_an_rc_whose_link_comes_within_the_second() -> None:
    loop = asyncio.get_running_loop()
    client, known = Client(mesh(lambda: round(loop.time() * SECOND)), default_fleet()), arc()
    known._take(runs({}), client.mesh.now())
    linked = loop.time() + 0.99

    async def command(rc: str, *_: Any, **__: Any) -> Done:
        if loop.time() < linked:
            raise CommandRefused(rc, Problem("unknown", "no answer, at once"))
        return Done()

    client._confirmations._command = command
    assert await client.granted(known, confirmed=True) == FIRST


async def test_a_client_that_stood_still_itself_gives_its_rcs_a_second_all_the_same() -> None:
    loop, still = asyncio.get_running_loop(), 0.0
    client, known = Client(mesh(lambda: round((loop.time() + still) * SECOND)), default_fleet()), arc()
    known._take(runs({}), client.mesh.now())

    async def command(rc: str, *_: Any, **__: Any) -> Done:
        nonlocal still
        if not still:
            still = 2.0
            raise CommandRefused(rc, Problem("unknown", "no answer"))
        if loop.time() < wakes:
            raise CommandRefused(rc, Problem("stale", "it stood still as well"))
        return Done()

    wakes = loop.time() + 0.3
    client._confirmations._command = command
    assert await client.granted(known, confirmed=True) == FIRST


async def test_who_shows_a_place_shows_the_term_as_well() -> None:
    mesh = SimpleNamespace(me=Sender("h", "c"), keys=Keys("fleet"), now=lambda: NOW)
    client, known, asked = Client(cast("Mesh", mesh), default_fleet()), arc(), list[Any]()

    async def query(operation: Any) -> None:
        asked.append(operation.term)

    client._rcm.query = query  # type: ignore[method-assign]
    await client._rcm.ask(known)
    client._rcm.accept(TERM)
    known._take(notice(1, place=Place(TERM, 1)), NOW)
    await client._rcm.ask(known)
    # An RCM of a lower term steps down at that, and does not refuse the place as one that can't be.
    assert asked == [None, TERM]


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"needs": ["robot/x"]}, "needs is ["),
        ({"needs": {"robot/x": None}}, "'robot/x' has None; write its parameters"),
        ({"min_runtime": "90s"}, "min_runtime is '90s'; write a number of seconds above 0"),
        ({"min_runtime": float("nan")}, "min_runtime is nan"),
        ({"min_runtime": Decimal("Infinity")}, "min_runtime is Decimal('Infinity')"),
        ({"min_runtime": 0}, "min_runtime is 0;"),
        ({"timeout": -1}, "timeout is -1;"),
        ({"timeout": True}, "timeout is True;"),
    ],
)
async def test_arguments_that_make_no_sense_are_told_in_one_line(how: dict[str, Any], words: str) -> None:
    async with small_fleet("one") as (_, (one,)):
        with pytest.raises((TypeError, ValueError), match=re.escape(words)):
            async with hold(one, "x", **{"needs": {"robot/x": {}}, **how}):
                pass
