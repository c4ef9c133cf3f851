"""Whatever a stranger says on any key, the fleet serves on; and what is no message, or of no believable term, does
nothing at all. The stranger's deeds are drawn by Hypothesis: a failure shrinks to the fewest, and repeats."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.fleet import ROWS, Fleet, Script, in_fleet
from tests.fuzz.hostile import is_one
from tests.fuzz.key_table import PROTOCOL, Row, read_rows
from tests.thorough import FACTOR, times
from zscout import messages
from zscout.behaviors.client.rcm_link import _TermOnly
from zscout.keyexpr import Keys, Sender, Token
from zscout.messages import Grants
from zscout.testing.memory import intersects

Deed = tuple[Row, int, int]
"""On which row, with how many faults, and of which seed."""


def deeds(most: int) -> st.SearchStrategy[list[Deed]]:
    one = st.tuples(st.sampled_from(ROWS), st.integers(0, 3), st.integers(0, 2**32 - 1))
    return st.lists(one, min_size=1, max_size=most)


def cases(number: int) -> settings:
    """The same ones from day to day; others each time where there are many."""
    return settings(max_examples=times(number), derandomize=FACTOR == 1, suppress_health_check=list(HealthCheck))


async def misbehave(fleet: Fleet, some: Sequence[Deed], *, elections: int = 0) -> list[str]:
    """Does all that, and waits until it has had its effect; what was done, in words."""
    script, done = Script(fleet), list[str]()
    for number, (row, faults, seed) in enumerate(some):
        if elections and number == len(some) // 2:
            await fleet.elect()
        done.append(script.do(row, faults, seed))
        await asyncio.sleep(0.01)
    await asyncio.sleep(3)
    return done


def serves_on(some: Sequence[Deed], *, elections: int = 0, recording: Path | None = None) -> None:
    async def story(fleet: Fleet) -> list[str]:
        done = await misbehave(fleet, some, elections=elections)
        fleet.errors += fleet.stranger.misunderstood()
        fleet.leave()
        await fleet.serves()
        return done

    errors, done = in_fleet(story, recording)
    assert not errors, "\n".join([*errors, "after", *done])


@cases(15)
@given(deeds(60), st.integers(0, 1))
def test_a_fleet_serves_on_whatever_a_stranger_says(some: list[Deed], elections: int) -> None:
    serves_on(some, elections=elections)


@pytest.mark.slow
@cases(50)
@given(deeds(60), st.integers(0, 1))
def test_a_fleet_serves_on_whatever_a_stranger_says_in_more_cases(some: list[Deed], elections: int) -> None:
    serves_on(some, elections=elections)


@cases(5)
@given(deeds(100))
def test_a_recorder_goes_on_whatever_it_hears(tmp_path: Path, some: list[Deed]) -> None:
    serves_on(some, recording=tmp_path / "run.rrd")


@cases(12)
@given(deeds(60))
def test_what_is_no_message_does_nothing(some: list[Deed]) -> None:
    async def story(fleet: Fleet) -> tuple[object, object, list[str]]:
        before, done = fleet.standing(), await misbehave_idly(fleet, some)
        return before, fleet.standing(), done

    errors, (before, after, done) = in_fleet(story)
    assert not errors, "\n".join([*errors, "after", *done])
    assert before == after, "\n".join(done)


async def misbehave_idly(fleet: Fleet, some: Sequence[Deed]) -> list[str]:
    script, done = Script(fleet), list[str]()
    for row, faults, seed in some:
        key, payload = script.said(row, 1 + faults, seed)
        # Of what an RCM publishes a client reads the term alone.
        kinds = (*row.asked, *row.published, *((_TermOnly,) if Grants in row.published else ()))
        if row.asked + row.published and not any(is_one(payload, kind, messages.MAX_STATE) for kind in kinds):
            fleet.stranger.ask(row, key, payload)
            fleet.stranger.put(key, payload)
            done.append(f"{key[:300]!r} {payload[:2_000]!r}")
    await asyncio.sleep(3)
    return done


# The key table drives it


def test_every_key_of_the_key_space_has_a_row() -> None:
    """What `Keys` builds, or subscribes to, stands in the document: so it is fuzzed."""
    sender = Sender("h", "c")
    arguments: dict[str, tuple[Any, ...]] = {
        "alive": (Token("h", "node", "node", "i"),),
        "alive_any": (),
        "alive_rc": ("k/n",),
        "command": ("k/n", sender),
        "component": ("h", sender),
        "confirm": ("h", sender),
        "history": ("h", sender),
        "ask_rc_state": ("k/n", sender),
        "served_placer": (),
        **dict.fromkeys(("vote", "command_any", "rc_state", "asked_state_any", "frame"), ("k/n",)),
        **dict.fromkeys(("load", "served_component", "confirm_any", "history_any", "bookings"), ("h",)),
    }
    no_keys = {"fleet", "closed", "base", "everything"}
    built: dict[str, str] = {}
    for keys in (Keys("zscout"), Keys("zscout", closed=True)):
        for name in [one for one in dir(Keys) if not one.startswith("_") and one not in no_keys]:
            member = getattr(keys, name)
            if not isinstance(member, str) and not name.endswith("_of"):
                member = member(*arguments.get(name, (sender,)))
            for key in (member,) if isinstance(member, str) else member if isinstance(member, tuple) else ():
                built[f"{name} {key}"] = key
    assert len(built) > 25
    rows = [f"zscout/zscout/{row.expression}" for row in ROWS] + ["zscout/zscout/alive/*/rc/*/*/*"]
    without = {name: key for name, key in built.items() if not any(intersects(key, row) for row in rows)}
    assert not without, "no row of the key table in docs/protocol/keys.md"


def test_a_row_that_does_not_say_what_crosses_there_is_refused() -> None:
    document = PROTOCOL.read_text()
    first = "| `zscout/<fleet>/rcm/grants` |"
    for row in ("| `zscout/<fleet>/new/key` | query: words | x | y |", "| `zscout/<fleet>/new/key` | words | x | y |"):
        with pytest.raises(ValueError, match="names no message"):
            read_rows(document.replace(first, f"{row}\n{first}"))
    with pytest.raises(AttributeError, match="NoSuch"):
        read_rows(document.replace(first, f"| `zscout/<fleet>/new` | publication: [NoSuch](#x) | x | y |\n{first}"))


def test_every_message_of_the_table_is_drawn_and_every_key_heard() -> None:
    """Without faults each is taken for what it is, and somebody in the fleet hears it."""

    async def story(fleet: Fleet) -> tuple[list[str], list[str]]:
        script = Script(fleet)
        strange = [
            f"{kind.__name__}: {payload!r}"
            for row in ROWS
            for kind in (*row.asked, *row.answers, *row.published)
            for payload in (script.hostile(row, 1).payload([kind], 0),)
            if not is_one(payload, kind, messages.MAX_STATE)
        ]
        return strange, [row.key for row in ROWS if not fleet.hears(row)]

    _, (strange, unheard) = in_fleet(story)
    assert not strange
    # These are for a recorder, and a building's plan is told by its simulation, which no message can change. The first
    # is served with `[security]` alone.
    assert unheard == [
        "rc/<kind>/<name>/state/<host>/<client>",
        "rc/<kind>/<name>/frame",
        "client/<host>/<client>/behavior",
        "recorder/<host>/<client>/recorded",
        "building/<host>/<client>/plan",
        "building/<host>/<client>/poses",
    ]
