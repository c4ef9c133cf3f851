"""What others can cause as often as they like is logged once in a while."""

from __future__ import annotations

import asyncio
import logging

import pytest

from tests.mesh.kit import until
from zscout.keyexpr import Sender
from zscout.mesh.sparse_log import MAX_KEYS, SparseLog
from zscout.mesh.transport import Quality
from zscout.messages import Grants, RcmState, StateAsk
from zscout.testing.memory import MemoryNetwork
from zscout.types import SECOND, Ns

log = logging.getLogger("zscout.test")


def test_one_line_about_each_key_in_a_while_and_how_many_were_left_out(caplog: pytest.LogCaptureFixture) -> None:
    now: Ns = 0
    sparse = SparseLog(log, lambda: now)
    for second in range(21):
        now = second * SECOND
        sparse.warning("a", "%s is odd", "a")
        if second == 5:
            sparse.warning("b", "%s is odd", "b")
    more = "a is odd (9 more since the last warning)"
    assert [record.getMessage() for record in caplog.records] == ["a is odd", "b is odd", more, more]


def test_who_takes_ever_new_keys_fills_neither_log_nor_memory(caplog: pytest.LogCaptureFixture) -> None:
    now: Ns = 0
    sparse = SparseLog(log, lambda: now)
    for number in range(1_000):
        sparse.warning(f"{number}" + "x" * 100_000, "odd")
    assert (len(caplog.records), len(sparse._logged)) == (MAX_KEYS + 1, MAX_KEYS + 1)
    assert max(len(key) for _, key in sparse._logged) <= 200
    # Those that are long silent make room.
    now = 100 * SECOND
    sparse.warning("new", "odd")
    assert list(sparse._logged) == [("odd", "new")]


async def test_malformed_answers_and_publications_and_bad_names_are_logged_so(caplog: pytest.LogCaptureFixture) -> None:
    network = MemoryNetwork()
    here, other = network.open("f", Sender("h", "here")), network.open("f", Sender("h", "other"))
    transport, keys = other._transport, here.keys
    transport.queryable(keys.rcm_state, lambda query: query.reply(query.key, b"?", StateAsk))
    heard: list[Grants] = []

    def on_grants(_: str, grants: Grants) -> None:
        heard.append(grants)
        keys.rc_of("nonsense")

    here.subscribe(keys.grants, Grants, on_grants)
    watched = here.watch(keys.alive_any(), lambda *_: None)
    publisher, tokens = transport.publisher(keys.grants, Grants, Quality.CONTROL), []
    for number in range(50):
        publisher.put(b"?")
        other.put(keys.grants, Grants((1, "x"), number, number, 0.5))  # type: ignore[arg-type]
        tokens.append(transport.token(f"{keys.base}/alive/odd"))
        assert await here.ask(keys.rcm_state, StateAsk(), RcmState, timeout=1) == []
        await asyncio.sleep(0.01)
    await until(lambda: len(heard) == 50)
    watched.close()
    starts = [" ".join(record.getMessage().split()[:3]) for record in caplog.records]
    assert sorted(starts) == ["a reply on", "ignored a liveliness", "ignored a message", "ignored a publication"]
