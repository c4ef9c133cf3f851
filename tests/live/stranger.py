"""A stranger on the mesh: a raw Zenoh session beside a live node, and the messages that it makes up."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zenoh

from tests.hang import HANG
from tests.live.lab import TTL, Lab
from zscout.mesh.zenoh_mesh import zenoh_config

LIMITS = "[limits]\nmax_needs = 8\nmax_queued = 20\nmax_requests_per_client = 5\nmax_requests_per_host = 15\n"
HIGH = 10**15
"""The counter of a term that no election leads to."""

Json = dict[str, Any]


class Stranger:
    """A raw Zenoh session beside a fleet of one node, `n`, with robot/a and radio/a (rate=10)."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.session = zenoh.open(zenoh_config(lab.fleet.mesh))
        self.base = f"zscout/{lab.fleet.name}"
        self.number = 0
        self.read = 0
        """Characters of the node's log that were looked at."""
        self.good = self.token("t/client/good/1")

    def token(self, tail: str) -> Any:
        return self.session.liveliness().declare_token(f"{self.base}/alive/{tail}")

    def get(self, key: str, payload: bytes | None) -> list[tuple[str, Json]]:
        """All answers, as ("ok" | "err", what was said)."""
        found = []
        for reply in self.session.get(
            f"{self.base}/{key}",
            payload=payload,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
            timeout=30.0,
        ):
            if reply.ok is not None:
                found.append(("ok", json.loads(reply.ok.payload.to_bytes())))
            elif reply.err is not None:
                payload = reply.err.payload.to_bytes()
                # Zenoh's own word for "unknown": a queryable that is taken back may leave a query unanswered.
                if payload != b"Timeout":
                    found.append(("err", json.loads(payload)))
        return found

    def ask(self, key: str, message: Json) -> Json:
        """The one answer, which must be a good one."""
        [(kind, answer)] = self.get(key, json.dumps(message).encode())
        assert kind == "ok", answer
        return answer

    def put(self, key: str, payload: bytes) -> None:
        # As queries are sent, so that none overtakes it.
        self.session.put(
            f"{self.base}/{key}",
            payload,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
        )

    def await_(self, what: str, true: Callable[[], bool]) -> None:
        deadline = time.monotonic() + HANG
        while not true():
            assert time.monotonic() < deadline, f"waited in vain until {what}"
            time.sleep(0.02)

    def state(self) -> Json:
        answers = [answer for kind, answer in self.get("rcm/state", b"{}") if kind == "ok"]
        return max(answers, key=lambda state: state["term"], default={"term": [0, ""], "rcs": [], "holds": []})

    def ready(self) -> None:
        self.await_(
            "both RCs are there",
            lambda: {rc["rc"] for rc in self.state()["rcs"] if rc["present"]} >= {"robot/a", "radio/a"},
        )

    def serves(self) -> None:
        """A good request is granted, confirmed and obeyed; and the log holds no traceback."""
        self.number += 1
        request = good_ask(id=f"good-{self.number}", needs={"robot/a": {}, "radio/a": {"rate": 10}}, priority=9)
        notice = self.ask("rcm/schedule/t/good", request)
        assert notice["state"] == "running", notice
        command = {"grant": notice["grant"], "do": {"name": "echo", "value": self.number}, "ttl": TTL}
        assert self.ask("rc/robot/a/command/t/good", command) == {"result": self.number}
        released = self.ask("rcm/schedule/t/good", {"op": "release", "id": request["id"]})
        assert released["outcome"] == "released"
        log = self.lab.log("n")
        news, self.read = log[self.read :], len(log)
        assert "Traceback" not in news

    def close(self) -> None:
        self.session.close()  # type: ignore[no-untyped-call]


def beside_a_node(folder: Path) -> Iterator[Stranger]:
    """A stranger beside a fleet of one node, for a fixture; everything is gone afterwards."""
    lab = Lab(folder, extra=LIMITS)
    node = lab.node("n", "robot/a", "radio/a:rate=10")
    stranger = Stranger(lab)
    try:
        stranger.ready()
        yield stranger
        assert "Traceback" not in lab.log("n")
        assert node.poll() is None
    finally:
        stranger.close()
        node.kill()
        node.wait()


def good_ask(**changes: Any) -> Json:
    ask = {"op": "request", "id": "x", "arc": "bad", "needs": {"robot/a": {}}, "priority": 0, "min_runtime": 1}
    return {name: value for name, value in (ask | changes).items() if value is not ...}


def bad(**changes: Any) -> bytes:
    """A request with some fields changed; `...` leaves one out."""
    return json.dumps(good_ask(**changes)).encode()


def rate(value: str) -> bytes:
    """A request whose bandwidth parameter is written so."""
    return bad(needs={"radio/a": {"rate": "@"}}).replace(b'"@"', value.encode())


def seconds(value: str) -> bytes:
    return bad(min_runtime="@").replace(b'"@"', value.encode())


def held(**changes: Any) -> Json:
    """A holder as grants and states name one."""
    holder = {
        "id": "f", "arc": "forged", "client": "t/forger", "rcs": ["robot/a"],
        "grant": [[HIGH, "f"], 1], "place": [[HIGH, "f"], 1], "min_runtime": 9, "remaining": 9.0,
    }  # fmt: skip
    return holder | changes


def grants(**changes: Any) -> Json:
    said = {"term": [HIGH, "f"], "seq": 1, "prev": 0, "every": 0.5, "rcs": {"robot/a": [held()]}}
    return said | changes


def rc_state(**changes: Any) -> Json:
    return {"rc": "robot/a", "host": "n", "instance": "f", "sharable": False, "term": [HIGH, "f"]} | changes


def command(**changes: Any) -> bytes:
    message = {"grant": [[0, "x"], 1], "do": {"name": "echo"}} | changes
    return json.dumps({name: value for name, value in message.items() if value is not ...}).encode()


def proposal(**changes: Any) -> bytes:
    holder = {"id": "x", "arc": "bad", "client": "t/bad", "params": {"rate": 1}}
    return json.dumps({"proposal": 1, "term": [1, "x"], "holders": [holder]} | changes).encode()
