"""The requests of the clients in a chaos run, and the events that all its programs log. Standard library only, because
clients without any code of zscout use it too.

Each client makes three kinds of requests, again and again: for an RC of its own (`near`: how soon is a grant?), for a
line of every host with RCs (`all`: does every host serve it?), and for RCs that others want as well (`work`)."""

from __future__ import annotations

import json
import random
import secrets
import sys
import threading
import time
from typing import Any, Final, TypeAlias

Json: TypeAlias = dict[str, Any]

NODES: Final = ("n1", "n2", "n3")
RC_HOSTS: Final = ("x1", "x2")
FOREIGN_CLIENTS: Final = ("c1", "c2", "c3")
OWN_CLIENTS: Final = ("z1", "z2")
CLIENTS: Final = FOREIGN_CLIENTS + OWN_CLIENTS
HOSTS: Final = NODES + RC_HOSTS + CLIENTS
JOBS: Final = ("near", "all", "work")
CLIENT: Final = "worker"
"""The client's name at each of its hosts."""

CAPACITY: Final = {f"line/{host}": 100 for host in NODES + RC_HOSTS} | {"radio/n1": 3, "radio/x1": 3}
"""The rate that each sharable RC carries."""
WANTED: Final = (*(f"arm/{host}" for host in NODES + RC_HOSTS), "radio/n1", "radio/x1")
PULSE: Final = {"near": 0.1, "all": 0.2, "work": 0.3}
"""Approximate seconds from the end of a request to the next request of the same kind."""


def near(client: str) -> str:
    return f"tool/{client}"


def host_of(rc: str) -> str:
    kind, name = rc.split("/")
    return RC_HOSTS[CLIENTS.index(name) % 2] if kind == "tool" else name


def rcs_of(host: str) -> list[str]:
    everything = [*CAPACITY, *(rc for rc in WANTED if rc not in CAPACITY), *map(near, CLIENTS)]
    return [rc for rc in everything if host_of(rc) == host]


def draw(rng: random.Random, job: str, client: str) -> tuple[Json, float]:
    """A request, and the seconds for which its hold is used."""
    asked: Json = {"id": secrets.token_hex(8), "arc": f"{job}-{client}", "priority": 1, "min_runtime": 5}
    if job == "near":
        return asked | {"needs": {near(client): {}}}, 0.0
    if job == "all":
        return asked | {"needs": {f"line/{host}": {"rate": 1} for host in NODES + RC_HOSTS}}, 0.0
    rcs = rng.sample(WANTED, rng.randint(1, 3))
    asked["needs"] = {rc: {"rate": rng.randint(1, 2)} if rc in CAPACITY else {} for rc in rcs}
    asked["priority"] = rng.choice((0, 0, 1, 1, 2, 12))
    if rng.random() < 0.1:
        return asked | {"min_runtime": 1, "keep": True}, rng.uniform(1, 8)
    asked["min_runtime"] = round(rng.uniform(0.4, 1.5), 2)
    return asked, rng.uniform(0.1, 1.2)


def now() -> int:
    """Nanoseconds by the clock of `zscout.trace`, which all processes of a machine share."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


_OUT = threading.Lock()


def say(do: str, **what: Any) -> None:
    line = json.dumps({"at": now(), "do": do, **what}) + "\n"
    with _OUT:
        sys.stdout.write(line)
        sys.stdout.flush()
