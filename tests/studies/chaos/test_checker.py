"""Each promise that a run is held against is found broken where it is: a check that can't fail is worth nothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from studies.chaos.checker import Apart, Checker, Violation, check, events
from studies.chaos.faults import SECOND, Fault, isolated
from studies.chaos.report import figures, late, spread, table
from studies.chaos.work import CAPACITY, CLIENT, HOSTS, Json, host_of, rcs_of

TERM = [3, "aa"]
OLD, NEW = [TERM, 1], [TERM, 2]


def rc(at: float, do: str, holds: list[Any], name: str = "arm/x1", *, seq: int = 2, **more: Any) -> tuple[str, Json]:
    known = {"rc": name, "instance": more.pop("instance", "i1"), "sharable": name in CAPACITY}
    told = {"at": round(at * SECOND), "do": do, **known, "term": more.pop("term", TERM), "seq": seq, "holds": holds}
    return host_of(name), told | more


def client(at: float, do: str, request: str = "q", host: str = "c1", **more: Any) -> tuple[str, Json]:
    known = {"place": [TERM, 5], "outcome": None, "reason": "", "rcs": ["arm/x1"], "grant": None, "ended": False}
    return host, {"at": round(at * SECOND), "do": do, "id": request, **known, **more}


def asked(at: float, request: str = "q", host: str = "c1", rc: str = "arm/x1", rate: int = 0) -> tuple[str, Json]:
    return client(at, "asked", request, host, needs={rc: {"rate": rate}}, min_runtime=1)


def publish(
    at: float, grants: list[Any], owners: list[str], name: str = "arm/x1", term: Any = TERM
) -> tuple[str, Json]:
    holders = [[grant, owner, [TERM, 5], [name]] for grant, owner in zip(grants, owners, strict=True)]
    return "n1", {"at": round(at * SECOND), "do": "publish", "term": term, "seq": 1, "rcs": {name: holders}}


def commanded(at: float, grant: Any, sent: float) -> tuple[str, Json]:
    return client(at, "commanded", rc="arm/x1", grant=grant, sent=round(sent * SECOND), code="")


Q = f"c1/{CLIENT}/q"
LIFE = [
    asked(1, "p"),
    client(1.1, "anew", "p", new="q"),
    client(1.1, "queued"),
    publish(1.2, [OLD], [Q]),
    rc(1.2, "hear", [OLD], seq=1),
    client(1.3, "running", grant=OLD),
    rc(1.4, "command", [OLD], seq=1, grant=OLD),
    commanded(1.5, OLD, 1.3),
    client(2, "gave_up"),
    rc(2.1, "hear", []),
]
BROKEN: dict[str, list[tuple[str, Json]]] = {
    "1 one holder": [rc(3, "hear", [NEW, [TERM, 3]])],
    "2 no older command": [
        rc(3, "command", [NEW], seq=3, grant=NEW),
        rc(4, "command", [OLD], seq=4, instance="i2", grant=OLD),
    ],
    "3 only holders command": [rc(3, "command", [], grant=OLD)],
    "4 capacity": [
        asked(3, "q1", rc="radio/x1", rate=2),
        asked(3, "q2", rc="radio/x1", rate=2),
        publish(3, [OLD, NEW], [f"c1/{CLIENT}/q1", f"c1/{CLIENT}/q2"], "radio/x1"),
        rc(3, "hear", [OLD, NEW], "radio/x1"),
        client(4, "gave_up", "q1"),
        client(4, "gave_up", "q2"),
    ],
    "5 obeys no older": [rc(3, "hear", [], seq=1)],
    "6 no second beginning": [rc(3, "hear", [OLD], seq=3)],
    "8 no half gang": [
        asked(3, "q1"),
        client(3.1, "running", "q1", grant=NEW, rcs=["arm/x1", "arm/x2"]),
        rc(3.2, "hear", [NEW], seq=3),
        rc(3.5, "hear", [], seq=4),
        client(9, "gave_up", "q1"),
    ],
    "9 nothing is thrown away": [asked(3, "q1"), client(4, "ended", "q1"), client(4, "gave_up", "q1", ended=True)],
    "10 living clients are kept": [
        asked(3, "q1"),
        client(4, "ended", "q1", outcome="client_lost"),
        client(5, "gave_up", "q1"),
    ],
    "10 untouched holds continue": [
        asked(3, "q1"),
        client(3.1, "running", "q1", grant=NEW),
        client(3.1, "entered", "q1", grant=NEW),
        client(3.2, "queued", "q1", outcome="lost"),
        client(4, "gave_up", "q1"),
    ],
    "11 places": [
        asked(3, "q1"),
        client(4, "queued", "q1"),
        client(5, "queued", "q1", place=[TERM, 9]),
        client(9, "queued", "q1", place=[TERM, 9]),
        client(9, "gave_up", "q1"),
    ],
    "13 terms": [publish(3 + number, [], [], term=[10 + number, "x"]) for number in range(4)],
    "15 nothing after giving up": [publish(6, [NEW], [Q]), rc(6, "hear", [NEW], seq=3), rc(7, "hear", [], seq=4)],
    "16 all is served": [asked(3, "q1")],
    "16 all is forgotten": [publish(3, [NEW], [f"c1/{CLIENT}/q1"]), rc(4, "hear", [NEW], seq=3)],
}


def held_against(story: list[tuple[str, Json]], *faults: Fault, apart: Sequence[Apart] = ()) -> list[Violation]:
    checker = Checker(faults, apart)
    for host, event in sorted(story, key=lambda one: one[1]["at"]):
        checker.take(host, event)
    checker.finish(20 * SECOND)
    return checker.found


def test_a_life_without_faults_breaks_nothing() -> None:
    assert held_against(LIFE) == []


@pytest.mark.parametrize("promise", BROKEN)
def test_each_promise_is_found_broken(promise: str) -> None:
    found = {one.promise for one in held_against([*LIFE, *BROKEN[promise]])}
    # Some of these stories end in the middle.
    assert found - {"16 all is forgotten"} == {promise} - {"16 all is forgotten"}
    assert promise in found


def test_an_older_command_is_found_from_what_its_senders_saw() -> None:
    found = held_against([*LIFE, commanded(3, NEW, 2.9), commanded(4, OLD, 3.5)])
    assert [one.promise for one in found] == ["2 no older command"]
    # Sent before the other was answered, it may have been there first.
    assert held_against([*LIFE, commanded(3, NEW, 2.9), commanded(4, OLD, 2.95)]) == []


def test_what_was_given_up_may_be_granted_once_more_as_links_come_back() -> None:
    fault = Fault("cut", "cut", 3, ("x1",), isolated("x1"), began=3 * SECOND, at=3 * SECOND, mended=6 * SECOND)
    again = BROKEN["15 nothing after giving up"]
    assert [one.promise for one in held_against([*LIFE, *again])] == ["15 nothing after giving up"]
    assert held_against([*LIFE, *again], fault) == []


def test_an_rc_that_heard_nobody_must_not_hold() -> None:
    fault = Fault("cut", "cut", 5, ("x1",), isolated("x1"), began=3 * SECOND, at=3 * SECOND, mended=8 * SECOND)
    held = [publish(2.5, [NEW], [Q]), rc(2.6, "hear", [NEW], seq=3), rc(9, "hear", [], seq=4)]
    mended = ("x1", {"at": 8 * SECOND, "do": "mended", "since": 3 * SECOND})
    found = held_against([*LIFE, *held, mended], fault)
    assert [one.promise for one in found] == ["7 silence ends holds"]
    assert held_against([*LIFE, *held[:2], rc(6.1, "end", [], seq=3), mended], fault) == []
    # Its client has given it up meanwhile.
    found = held_against([*LIFE[:-2], client(4, "gave_up"), mended, rc(9, "hear", [])], fault)
    assert "7 silence ends holds" in [one.promise for one in found]


@pytest.mark.parametrize("promise", ["10 living clients are kept", "10 untouched holds continue", "13 terms"])
def test_who_was_struck_may_lose(promise: str) -> None:
    at = 3 * SECOND
    struck = [Fault("frozen", "freeze", 1, (one,), began=at, at=at, mended=at + SECOND) for one in ("c1", "n1")]
    assert held_against([*LIFE, *BROKEN[promise]], *struck) == []


def test_a_hold_that_a_new_leader_gives_back_is_the_same() -> None:
    """It had its time, and its RC was lost: it may be over."""
    before = [asked(3, "q1"), client(3.1, "running", "q1", grant=NEW), client(3.9, "queued", "q1")]
    held = [publish(3.1, [NEW], [f"c1/{CLIENT}/q1"]), rc(3.1, "hear", [NEW], seq=3), rc(9.5, "hear", [], seq=4)]
    again = client(4, "running", "q1", grant=NEW)
    assert held_against([*LIFE, *before, *held, again, client(9.5, "gave_up", "q1")]) == []
    lost = [client(4.5, "ended", "q1", outcome="lost"), client(4.5, "gave_up", "q1", ended=True)]
    assert held_against([*LIFE, *before, client(4, "running", "q1", grant=NEW), *lost]) == []
    found = held_against([*LIFE, *before, client(4, "running", "q1", grant=[TERM, 9]), *lost])
    assert [one.promise for one in found] == ["9 nothing is thrown away"]


@pytest.mark.parametrize("promise", ["10 living clients are kept", "10 untouched holds continue"])
def test_who_had_no_link_with_the_leader_may_lose(promise: str) -> None:
    def found(node: str, until: float) -> list[Violation]:
        apart = Apart(frozenset((node, "c1")), round(1.1 * SECOND), round(until * SECOND))
        return held_against([*LIFE, *BROKEN[promise]], apart=[apart])

    assert found("n1", 2.2) == []
    # For less than a lease, and with another than the leader.
    assert found("n1", 2) != [] != found("n2", 2.2)


@pytest.mark.parametrize("promise", ["10 living clients are kept", "10 untouched holds continue"])
def test_a_leader_that_is_just_back_may_drop_somebody(promise: str) -> None:
    def found(node: str, lost: float, began: float = 2) -> list[Violation]:
        fault = Fault("leader away", "cut", 1, (node,), isolated(node), began=round(began * SECOND))
        fault.mended = round((lost - 0.15) * SECOND)
        return held_against([*LIFE, *BROKEN[promise]], fault)

    at = 4 if promise == "10 living clients are kept" else 3.2
    assert found("n1", at) == []
    # Longer ago, another than the leader, and one that had led long before.
    assert found("n1", at - 0.1) != [] != found("n2", at)
    assert found("n1", at, began=3.03)


def test_a_killed_client_asks_for_nothing_any_more() -> None:
    killed = ("c1", {"at": 5 * SECOND, "do": "killed"})
    assert held_against([*LIFE, *BROKEN["16 all is served"], killed]) == []


def test_errors_in_logs_are_found(tmp_path: Path) -> None:
    (tmp_path / "n1.log").write_text('x DEBUG {"at":5,"do":"up"}\nx ERROR Task exception was never retrieved\n')
    (tmp_path / "c1.log").write_text('{"at": 3, "do": "imported", "modules": ["zscout"]}\n{"at": 4, "do": "as')
    found = check(tmp_path, [], [], SECOND).found
    assert [one.promise for one in found] == ["the foreign ones are foreign", "17 no error unseen"]


def test_a_line_that_was_broken_off_by_a_kill_hides_none_behind_it(tmp_path: Path) -> None:
    (tmp_path / "n1.log").write_text(
        'x DEBUG {"at":4,"do":"publish","rcs":{"a":[[{"y DEBUG {"at":5,"do":"up","holds":[]}\n'
    )
    assert [one["at"] for one in events(tmp_path / "n1.log")] == [5]


def test_everything_has_its_host() -> None:
    everything = [name for host in HOSTS for name in rcs_of(host)]
    assert len(everything) == len(set(everything)) == 17
    assert all(name in rcs_of(host_of(name)) for name in everything)


def test_figures() -> None:
    assert spread([]) == {"n": 0}
    assert spread([float(number) for number in range(1, 101)]) == {
        "n": 100,
        "median": 50.5,
        "p99": 100.0,
        "worst": 100.0,
    }
    fault = Fault("leader killed", "kill", 1, ("n1",), at=SECOND, mended=3 * SECOND)
    fault.granted, fault.linked, fault.served = 2 * SECOND, 4 * SECOND, 6 * SECOND
    row = figures([fault])["leader killed"]
    assert {name: one["worst"] for name, one in row.items()} == {"next_grant": 1, "healed": 3, "zenoh": 1, "ours": 2}
    assert "leader killed" in table(figures([fault]))
    assert late([fault], 0) == ["2.00 s after leader killed (kill) of n1 from 1.00 s for 2.00 s"]
