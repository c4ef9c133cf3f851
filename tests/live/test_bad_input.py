"""What strangers may ask: every queryable of a live node is fed with rubbish, raw, by plain `zenoh`.

Each query gets one clear answer; the node serves on, logs no traceback and does not grow.
"""

from __future__ import annotations

import json
from collections.abc import Iterator

import psutil
import pytest

from tests.live.stranger import HIGH, Stranger, bad, beside_a_node, command, good_ask, proposal, rate, seconds

pytestmark = pytest.mark.live

DEEP = b'{"op":"request","x":' + b"[" * 20_000 + b"]" * 20_000 + b"}"
SCHEDULE = "rcm/schedule/t/bad"
RANK = "balancer/rank"
VOTE = "rc/radio/a/vote"
COMMAND = "rc/robot/a/command/t/bad"


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stranger]:
    yield from beside_a_node(tmp_path_factory.mktemp("fleet"))


QUERIES: list[tuple[str, str, bytes | None, str, str]] = [
    # What it is about, key, payload, code, part of the message
    ("not JSON", SCHEDULE, b"hello", "malformed", "not a valid operation: JSON is malformed"),
    ("not UTF-8", SCHEDULE, b'{"op":"cancel","id":"\xff"}', "malformed", "not a valid operation"),
    ("no payload", SCHEDULE, None, "malformed", "missing required field `op`"),
    ("empty payload", SCHEDULE, b"", "malformed", "not a valid operation"),
    ("cut off", SCHEDULE, bad()[:-5], "malformed", "truncated"),
    ("an array", SCHEDULE, b"[]", "malformed", "Expected `object`"),
    ("null", SCHEDULE, b"null", "malformed", "Expected `object`"),
    ("1 MB", SCHEDULE, b" " * 1_000_000, "malformed", "1000000 bytes are too many"),
    ("1 MB of JSON", SCHEDULE, bad(arc="x" * 1_000_000), "malformed", "are too many; at most 65536"),
    ("deeply nested", SCHEDULE, DEEP, "malformed", "recursion"),
    ("unknown op", SCHEDULE, bad(op="steal"), "malformed", "Invalid value 'steal' - at `$.op`"),
    ("an op that fills a page", SCHEDULE, bad(op="x" * 60_000), "malformed", "Invalid value"),
    ("no op", SCHEDULE, bad(op=...), "malformed", "`op`"),
    ("no id", SCHEDULE, bad(id=...), "malformed", "missing required field `id`"),
    ("a number as id", SCHEDULE, bad(id=5), "malformed", "Expected `str`, got `int` - at `$.id`"),
    ("no arc", SCHEDULE, bad(arc=...), "malformed", "`arc`"),
    ("no needs", SCHEDULE, bad(needs=...), "malformed", "`needs`"),
    ("needs as a list", SCHEDULE, bad(needs=["robot/a"]), "malformed", "at `$.needs`"),
    ("a need twice", SCHEDULE, bad(needs={"robot/a": {}, "robot/b": {"r": 1}}).replace(b"/b", b"/a"),
     "malformed", '"robot/a" is given more than once; give it once'),
    ("an id twice", SCHEDULE, b'{"op":"cancel","id":"x","id":"y"}', "malformed", '"id" is given more than'),
    ("text as priority", SCHEDULE, bad(priority="9"), "malformed", "at `$.priority`"),
    ("a fraction as priority", SCHEDULE, bad(priority=1.5), "malformed", "at `$.priority`"),
    ("a priority of 400 digits", SCHEDULE, bad(priority=10**400), "bad_request", "priority must lie between"),
    ("a priority of 5000 digits", SCHEDULE, bad(priority="@").replace(b'"@"', b"9" * 5000), "malformed",
     "at `$.priority`"),
    ("an absurd priority", SCHEDULE, bad(priority=10**7), "bad_request", "between -1000000 and 1000000"),
    ("an absurdly low one", SCHEDULE, bad(priority=-(10**7)), "bad_request", "between -1000000 and 1000000"),
    ("no min_runtime", SCHEDULE, bad(min_runtime=...), "malformed", "`min_runtime`"),
    ("a time of zero", SCHEDULE, seconds("0"), "bad_request", "min_runtime must be positive"),
    ("a negative time", SCHEDULE, seconds("-1"), "bad_request", "min_runtime must not be negative"),
    ("a time below a nanosecond", SCHEDULE, seconds("1e-12"), "bad_request", "must be positive"),
    ("a time of NaN", SCHEDULE, seconds("NaN"), "malformed", "JSON is malformed"),
    ('a time of "NaN"', SCHEDULE, seconds('"NaN"'), "bad_request", "must be a number, not NaN"),
    ('a time of "sNaN"', SCHEDULE, seconds('"sNaN"'), "bad_request", "must be a number, not sNaN"),
    ("a time of 1e999", SCHEDULE, seconds("1e999"), "bad_request", "between 1e-18 and 1e18"),
    ("an infinite time", SCHEDULE, seconds('"Infinity"'), "bad_request", "must be a number, not Infinity"),
    ("a time of 60000 digits", SCHEDULE, seconds("9" * 60_000), "bad_request", "between 1e-18 and 1e18"),
    ("eleven years", SCHEDULE, seconds("350000000"), "bad_request", "ten years"),
    ("no needs in it", SCHEDULE, bad(needs={}), "bad_request", "needs is empty"),
    ("too many needs", SCHEDULE, bad(needs={f"r/{n}": {} for n in range(9)}), "bad_request", "9 needs; at"),
    ("too many parameters", SCHEDULE, bad(needs={"radio/a": {f"p{n}": 1 for n in range(17)}}), "bad_request",
     "more than 16"),
    ("a negative amount", SCHEDULE, rate("-0.1"), "bad_request", "rate must not be negative"),
    ('an amount of "NaN"', SCHEDULE, rate('"NaN"'), "bad_request", "rate must be a number"),
    ("an amount of 1e999", SCHEDULE, rate("1e999"), "bad_request", "rate must lie between"),
    ("an amount of 1e9999999999999999999", SCHEDULE, rate("1e9999999999999999999"), "malformed", "decimal"),
    ("an amount of 40 digits", SCHEDULE, rate("0." + "1" * 40), "bad_request", "more than 25 digits"),
    ("an amount in words", SCHEDULE, rate('"much"'), "malformed", "decimal"),
    ("an RC without a kind", SCHEDULE, bad(needs={"scout33": {}}), "bad_request", "write kind/name"),
    ("an RC with a space", SCHEDULE, bad(needs={"robot/a b": {}}), "bad_request", 'device name "a b" is not valid'),
    ("a pattern over chunks", SCHEDULE, bad(needs={"robot/**": {}}), "bad_request", "write kind/name with *"),
    ("a pattern of 60000 signs", SCHEDULE, bad(needs={"r/" + "$*" * 30_000: {}}), "bad_request", 'pattern "r/$*$*'),
    ("many patterns", SCHEDULE, bad(needs={f"r/*#{n}": {} for n in range(1, 10)}), "bad_request", "9 ne"),
    ("patterns at odds", SCHEDULE, bad(needs={"radio/*": {"rate": 1}, "radio/*#2": {}}), "bad_request",
     "different parameters; give them all the same"),
    ("foresee a bad pattern", SCHEDULE, bad(op="foresee", needs={"robot/*#": {}}), "bad_request", "is not"),
    ("a pattern for a sender", "rcm/schedule/t/$*x", bad(), "bad_key", "no wildcards"),
    ("an RC of three parts", SCHEDULE, bad(needs={"robot/a/b": {}}), "bad_request", 'device name "a/b" is not valid'),
    ("a bad parameter name", SCHEDULE, bad(needs={"radio/a": {"a rate": 1}}), "bad_request", "parameter of"),
    ("a bad ARC name", SCHEDULE, bad(arc="my arc"), "bad_request", 'arc "my arc" is not valid'),
    ("an id with a slash", SCHEDULE, bad(id="t/other/x"), "bad_name", 'id "t/other/x" is not valid'),
    ("an empty id", SCHEDULE, bad(id=""), "bad_name", 'id "" is not valid'),
    ("a long id", SCHEDULE, bad(id="x" * 65), "bad_name", "use 1 to 64 of"),
    ("an id with a line feed", SCHEDULE, bad(id="x\ny"), "bad_name", '"x\\ny" is not valid'),
    ("no metric of ours", RANK, b'{"metric": "luck"}', "malformed", "Invalid enum value 'luck'"),
    ("no policy of ours", RANK, b'{"policy": 7}', "malformed", "at `$.policy`"),
    ("no host to be named", RANK, b'{"at_most": 0}', "malformed", "at `$.at_most`"),
    ("hosts by pattern", RANK, b'{"hosts": ["*"]}', "bad_name", "host \"*\" is not valid"),
    ("a thousand hosts", RANK, json.dumps({"hosts": ["h"] * 1000}).encode(), "malformed", "at `$.hosts`"),
    ("less than no memory", RANK, b'{"memory": -1}', "malformed", "at `$.memory`"),
    ("a place of a future term", SCHEDULE, bad(place=[[HIGH, "f"], 1]), "bad_request", "place has a future term"),
    ("a place of one part", SCHEDULE, bad(place=[[1, "x"]]), "malformed", "at `$.place`"),
    ("a place before the first", SCHEDULE, bad(place=[[0, ""], 0]), "bad_request", "place was never given"),
    ("keep in words", SCHEDULE, bad(keep="yes"), "malformed", "at `$.keep`"),
    ("a cancel for nobody", SCHEDULE, b'{"op":"cancel","id":"x","client":"x"}', "bad_name", 'client "" is'),
    ("a cancel for all", SCHEDULE, b'{"op":"cancel","id":"x","client":"*/*"}', "bad_name", 'host "*" is not'),
    ("a hand-over without a goal", SCHEDULE, b'{"op":"hand_over","id":"x"}', "malformed", "`to`"),
    ("a hand-over to no name", SCHEDULE, b'{"op":"hand_over","id":"x","to":"x"}', "bad_name", 'client ""'),
    ("a hand-over of nothing", SCHEDULE, b'{"op":"hand_over","id":"x","to":"t/good"}', "not_running", "x "),
    ("a wildcard for a client", "rcm/schedule/t/*", bad(), "bad_key", "name yourself in the key"),
    ("wildcards for a sender", "rcm/schedule/*/*", bad(), "bad_key", "no wildcards"),
    ("a half wildcard", "rcm/schedule/t/go$*", bad(), "bad_key", "no wildcards"),
    ("a sender with a space", "rcm/schedule/t/the boss", bad(), "bad_name", 'client "the boss" is not valid'),
    ("a sender in Greek", "rcm/schedule/t/βοσσ", bad(), "bad_name", "is not valid"),
    ("a long sender", f"rcm/schedule/{'t' * 65}/x", bad(), "bad_name", "use 1 to 64"),
    ("state: not JSON", "rcm/state", b"\x00", "malformed", "not a valid StateAsk"),
    ("state: a number as arc", "rcm/state", b'{"arc":5}', "malformed", "at `$.arc`"),
    ("state: 1 MB", "rcm/state", b"1" * 1_000_000, "malformed", "too many"),
    ("vote: no payload", VOTE, None, "malformed", "not a valid Proposal"),
    ("vote: not JSON", VOTE, b"?", "malformed", "not a valid Proposal"),
    ("vote: no list", VOTE, proposal(holders=None), "malformed", "at `$.holders`"),
    ("vote: a term of one part", VOTE, proposal(term=[1]), "malformed", "at `$.term`"),
    ("command: not JSON", COMMAND, b"{", "malformed", "not a valid Command"),
    ("command: no payload", COMMAND, None, "malformed", "`do`"),
    ("command: no grant", COMMAND, command(grant=...), "no_grant", "takes commands only under a grant"),
    ("command: a grant in words", COMMAND, command(grant="mine"), "malformed", "at `$.grant`"),
    ("command: a list to do", COMMAND, command(do=[]), "malformed", "at `$.do`"),
    ("command: ttl 0", COMMAND, command(ttl=0), "bad_command", "ttl must lie between 0 and 60"),
    ("command: ttl -1", COMMAND, command(ttl=-1), "bad_command", "ttl must lie between 0 and 60"),
    ("command: ttl too long", COMMAND, command(ttl=61), "bad_command", "ttl must lie between 0 and 60"),
    ("command: ttl in words", COMMAND, command(ttl="1"), "malformed", "at `$.ttl`"),
    ("command: ttl 1e999", COMMAND, command(ttl="@").replace(b'"@"', b"1e999"), "malformed", "out of range"),
    ("command: nothing held", COMMAND, command(), "free", "robot/a is free; request it"),
    ("command: an absurd grant", COMMAND, command(grant=[[HIGH, "f"], 1]), "free", "is free; request it first"),
    ("command: by all", "rc/robot/a/command/*/*", command(), "bad_key", "no wildcards"),
    ("command: by a bad name", "rc/robot/a/command/t/a b", command(), "bad_name", 'client "a b"'),
    ("RC state: not JSON", "rc/robot/a/state", b"}", "malformed", "not a valid RcAsk"),
    ("RC state: a promise in words", "rc/robot/a/state", b'{"promise":"me"}', "malformed", "at `$.promise`"),
    ("RC state: an old promise", "rc/robot/a/state", b'{"promise":[0,"x"]}', "old_term", "has promised to obey term"),
    ("RC state: a negative one", "rc/robot/a/state", b'{"promise":[-1,"x"]}', "old_term", "has promised to obey term"),
    ("RC state: an absurd promise", "rc/robot/a/state", b'{"promise":[%d,""]}' % HIGH, "old_term", "promised to obey"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("key", "payload", "code", "part"), [query[1:] for query in QUERIES], ids=[query[0] for query in QUERIES]
)
def test_a_bad_query_gets_one_clear_answer(
    stranger: Stranger, key: str, payload: bytes | None, code: str, part: str
) -> None:
    [(kind, answer)] = stranger.get(key, payload)
    assert (kind, answer["code"]) == ("err", code), answer
    assert part in answer["message"]
    assert len(answer["message"]) < 600
    assert "\n" not in answer["message"]
    stranger.serves()


@pytest.mark.parametrize("rate", [b'"NaN"', b"-1"])
def test_a_rate_that_is_none_is_voted_against(stranger: Stranger, rate: bytes) -> None:
    [(kind, answer)] = stranger.get(VOTE, proposal().replace(b'"rate": 1', b'"rate": ' + rate))
    assert (kind, answer["accept"]) == ("ok", False), answer
    assert "rate" in answer["reason"]
    stranger.serves()


def test_a_cancel_of_an_unknown_request_succeeds(stranger: Stranger) -> None:
    for op, outcome in (("cancel", "cancelled"), ("release", "released")):
        notice = stranger.ask(SCHEDULE, {"op": op, "id": "never", "client": "elsewhere/nobody"})
        assert (notice["state"], notice["reason"]) == ("ended", "no such request is open")
        # Its own client may have asked before: that comes late, and must not be taken up.
        notice = stranger.ask(SCHEDULE, {"op": op, "id": f"never-{op}"})
        assert (notice["state"], notice["outcome"], notice["reason"]) == ("ended", outcome, "given up by its client")
    stranger.serves()


def test_a_place_that_was_never_given_is_refused(stranger: Stranger) -> None:
    term = stranger.state()["term"]
    [(kind, answer)] = stranger.get(SCHEDULE, bad(place=[term, 10**9]))
    assert (kind, answer["code"]) == ("err", "bad_request")
    assert "never given" in answer["message"]
    stranger.serves()


def test_one_client_one_host_and_all_together_may_wait_with_so_many(stranger: Stranger) -> None:
    clients = [*(f"t/many{number}" for number in range(3)), "other/many"]
    tokens = [stranger.token(f"{one.replace('/', '/client/')}/1") for one in clients]
    try:
        for client in clients:
            for number in range(5):
                asked = good_ask(id=f"n{number}", needs={"robot/ghost": {}})
                assert stranger.ask(f"rcm/schedule/{client}", asked)["state"] == "queued"
            if client == "t/many0":
                [(kind, answer)] = stranger.get("rcm/schedule/t/many0", bad(id="n6"))
                assert (kind, answer["code"]) == ("err", "too_many")
                assert "t/many0 already has 5 open requests, the most allowed" in answer["message"]
            if client == "t/many2":
                [(kind, answer)] = stranger.get("rcm/schedule/t/more", bad())
                assert (kind, answer["code"]) == ("err", "too_many")
                assert "clients of t already have 15 open requests, the most allowed" in answer["message"]
        [(kind, answer)] = stranger.get("rcm/schedule/other/more", bad())
        assert (kind, answer["code"]) == ("err", "queue_full")
        assert "20 requests already wait" in answer["message"]
        for client in clients:
            for number in range(5):
                stranger.ask(f"rcm/schedule/{client}", {"op": "cancel", "id": f"n{number}"})
    finally:
        for token in tokens:
            token.undeclare()
    assert not stranger.state().get("queue")
    stranger.serves()


@pytest.mark.slow
def test_a_node_does_not_grow(stranger: Stranger) -> None:
    node = psutil.Process(stranger.lab.nodes["n"].pid)

    def flood(rounds: int) -> None:
        for number in range(rounds):
            for key in (SCHEDULE, VOTE, COMMAND, "rcm/state", "rc/robot/a/state"):
                assert stranger.get(key, b"[" * 1_000_000)[0][1]["code"] == "malformed"
            for key in ("rcm/grants", "rc/robot/a/state", "client/t/good/notice"):
                stranger.put(key, b"{" * 1_000_000)
            stranger.ask(SCHEDULE, {"op": "cancel", "id": f"flood-{number}"})

    flood(5)
    before = node.memory_info().rss
    flood(60)
    stranger.serves()
    assert node.memory_info().rss - before < 60_000_000
