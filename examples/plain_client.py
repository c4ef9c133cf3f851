"""Holds a device without zscout's package, by docs/protocol.md alone: `python plain_client.py robot/scout33 [FLEET]`.

It asks, waits for the grant, sends one command and gives the device back. A client for real work also repeats its
request every 5 s, obeys no lower term than it promised, and ends its hold when no leader publishes:
`tests/live/plain_client.py` does so.
"""

import json
import os
import queue
import secrets
import socket
import sys
import time

import zenoh

FLEET = sys.argv[2] if len(sys.argv) > 2 else "zscout"
HOST, NAME = socket.gethostname().partition(".")[0], f"plain-{secrets.token_hex(3)}"
BASE, ME = f"zscout/{FLEET}", f"{HOST}/{NAME}"


def ask(session: zenoh.Session, key: str, message: dict) -> dict | None:
    """Send a query; return its answer, or None without an answer."""
    how = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE, "timeout": 5.0}
    for reply in session.get(f"{BASE}/{key}", payload=json.dumps(message), **how):
        if reply.ok is not None:
            return json.loads(reply.ok.payload.to_bytes())
        print("refused:", reply.err.payload.to_string())
    return None


def main(device: str) -> None:
    config = zenoh.Config.from_env() if "ZENOH_CONFIG" in os.environ else zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("transport/link/tx/lease", "1000")
    notices: queue.SimpleQueue[dict] = queue.SimpleQueue()
    opened = {"id": "plain", "arc": NAME, "needs": {device: {}}, "priority": 0, "min_runtime": 60}

    def list_requests(query: zenoh.Query) -> None:
        with query:
            query.reply(f"{BASE}/client/{ME}/requests", json.dumps({"client": ME, "requests": [opened]}))

    with zenoh.open(config) as session:
        session.declare_subscriber(
            f"{BASE}/client/{ME}/notice", lambda sample: notices.put(json.loads(sample.payload.to_bytes()))
        )
        session.declare_queryable(f"{BASE}/client/{ME}/requests", list_requests)
        token = session.liveliness().declare_token(f"{BASE}/alive/{HOST}/client/{NAME}/{secrets.token_hex(6)}")
        time.sleep(1)  # until the peers have found each other
        notice = ask(session, f"rcm/schedule/{ME}", {"op": "request", **opened})
        if notice is None:
            sys.exit("no leader answers; is a node running?")
        while notice["state"] != "running":
            print("waiting:", notice.get("reason"))
            notice = notices.get()
        print("holding", *notice["rcs"])
        command = {"grant": notice["grant"], "do": {"name": "echo", "value": "hello"}}
        print("answer:", ask(session, f"rc/{device}/command/{ME}", command))
        ask(session, f"rcm/schedule/{ME}", {"op": "release", "id": "plain"})
        token.undeclare()


main(*sys.argv[1:2] or ["robot/scout33"])
