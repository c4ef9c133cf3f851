"""A fleet in its own namespaces, faults in it, and the recovery times after them."""

from __future__ import annotations

import itertools
import json
import random
import re
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from studies.chaos.checker import Apart, Violation, check
from studies.chaos.faults import SECOND, Fault, Way, draw
from studies.chaos.net import Links, Net, Processes
from studies.chaos.work import (
    CAPACITY,
    CLIENTS,
    FOREIGN_CLIENTS,
    HOSTS,
    JOBS,
    NODES,
    OWN_CLIENTS,
    RC_HOSTS,
    Json,
    now,
    rcs_of,
)

LOOK: Final = 0.02
"""Seconds between two looks at the logs."""
LOOK_AT_LINKS: Final = 0.1
STANDS: Final = 0.5
"""Seconds after which a link counts as restored: short links, made only to exchange locators, end sooner."""
BEGIN_WITHIN: Final = 60.0
RECOVER_WITHIN: Final = 30.0
SERVED_WITHIN: Final = 60.0
FORGOTTEN_WITHIN: Final = 7.0
PAIRS: Final = {frozenset(pair) for pair in itertools.combinations(HOSTS, 2) if not set(pair) <= set(CLIENTS)}
"""Pairs of hosts that need a link: all but those of two clients."""
PUBLISH: Final = re.compile(rb'"do":"publish","term":\[(\d+),"(\w+)"\]')
FOLLOWED: Final = (b'"entered"', b'"running"', b'"asked"', b'"token"', b'"up"', b'"quiet"')


class NotServed(Exception):
    """A condition was not met in time."""


class Tail:
    def __init__(self, file: Path) -> None:
        self._file, self._at, self._rest = file, 0, b""

    def lines(self) -> list[bytes]:
        if not self._file.exists():
            return []
        with self._file.open("rb") as file:
            if self._file.stat().st_size < self._at:
                self._at = 0  # it was shortened
            file.seek(self._at)
            text = self._rest + file.read()
            self._at = file.tell()
        *lines, self._rest = text.split(b"\n")
        return lines


class Watch:
    """Follows the logs of the running programs: the leader, grants, and tokens that come back."""

    def __init__(self, folder: Path) -> None:
        self._tails = {host: Tail(folder / f"{host}.log") for host in HOSTS}
        self.term: tuple[int, str] = (0, "")
        self.leader = ""
        self.up: Counter[str] = Counter()
        self.quiet: Counter[str] = Counter()
        self.entered: dict[str, int] = {}
        """When each client last entered a hold of job `all`."""
        self.waits: list[float] = []
        """Seconds from each request of job `near` to its first grant."""
        self.granted: list[tuple[int, int]] = []
        """Times of these requests and their grants."""
        self.token_back = 0
        """When a known token last came back."""
        self._asked: dict[str, tuple[int, str]] = {}
        self._tokens: set[tuple[str, str]] = set()

    def look(self) -> None:
        for host, tail in self._tails.items():
            for line in tail.lines():
                if host in NODES:
                    if (found := PUBLISH.search(line)) is not None:
                        term = int(found[1]), found[2].decode()
                        if term > self.term:
                            self.term, self.leader = term, host
                elif any(word in line[:60] for word in FOLLOWED) and line.startswith(b'{"at":'):
                    self._take(host, json.loads(line))

    def _take(self, host: str, event: Json) -> None:
        match event["do"]:
            case "asked":
                if (job := event["arc"].split("-")[0]) != "work":
                    self._asked[event["id"]] = event["at"], job
            case "running" if event["id"] in self._asked and self._asked[event["id"]][1] == "near":
                asked, _ = self._asked.pop(event["id"])
                self.granted.append((asked, event["at"]))
                self.waits.append((event["at"] - asked) / SECOND)
                del self.granted[:-1000]
            case "entered" if self._asked.pop(event["id"], (0, ""))[1] == "all":
                self.entered[host] = event["at"]
            case "token":
                seen = host, event["token"]
                if event["alive"] and seen in self._tokens:
                    self.token_back = event["at"]
                self._tokens.add(seen)
            case "up":
                self.up[host] += 1
            case "quiet":
                self.quiet[host] += 1


class Fleet:
    """Three nodes, RCs and clients written from the protocol page alone, and zscout's own clients, each on its own
    host. At the end of the context only the folder remains."""

    def __init__(self, folder: Path, seed: str, *, traced: bool = True) -> None:
        self.folder, self.seed = folder, seed
        self.net = Net(HOSTS)
        self.processes = Processes(self.net, folder)
        self.watch = Watch(folder)
        self.links = Links(self.net)
        self.marks: list[tuple[str, Json]] = []
        self._log = "debug" if traced else "warning"
        self._cuts: Counter[Way] = Counter()
        self._down: set[str] = set()
        """Hosts with a killed or frozen process."""
        self._standing: dict[frozenset[str], frozenset[int]] = {}
        self._linked = self._looked = 0
        self._missing: dict[frozenset[str], int] = {}
        """Pairs of running hosts without a link, and since when."""
        self._back: dict[frozenset[str], int] = {}
        """Pairs of `_missing` that have a link again, and since when."""
        self.apart: list[Apart] = []
        self.found: list[Violation] = []

    def __enter__(self) -> Self:
        try:
            self.net.open()
            name = f"chaos-{self.net.mark}"
            file = self.folder / "fleet.toml"
            file.write_text(
                f'[fleet]\nname = "{name}"\n[mesh]\nmulticast_address = "224.0.0.224:7446"\ninterface = "eth0"\n'
            )
            for host in NODES:
                self._node(host)
            for host in RC_HOSTS + FOREIGN_CLIENTS:
                what = "rcs" if host in RC_HOSTS else "client"
                self._start(host, "studies.chaos.foreign", what, name, host, f"{self.seed} {host}")
            for host in OWN_CLIENTS:
                self._start(host, "studies.chaos.own", str(file), host, f"{self.seed} {host}")
            others = RC_HOSTS + CLIENTS
            self.until(lambda: all(self.watch.up[host] for host in others), BEGIN_WITHIN, "all programs are up")
            self.until(lambda: self.watch.entered.keys() == set(CLIENTS), BEGIN_WITHIN, "all clients are served")
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.processes.close()
        finally:
            self.net.close()

    def _start(self, host: str, module: str, *words: str) -> None:
        self.processes.start(host, [sys.executable, "-m", module, *words])

    def _node(self, host: str) -> None:
        text = f'[node]\nhost = "{host}"\nfleet = "fleet.toml"\n'
        for rc in rcs_of(host):
            text += f'[[rc]]\nname = "{rc}"\n'
            capacity = f"capacity = {{ rate = {CAPACITY.get(rc)} }}\n"
            text += f'driver = "capacity"\n{capacity}' if rc in CAPACITY else 'driver = "exclusive"\n'
        file = self.folder / f"{host}.toml"
        file.write_text(text)
        self._start(host, "zscout.node", str(file), "--log-level", self._log)

    def look(self) -> None:
        self.watch.look()
        if gone := [host for host in HOSTS if host not in self.processes.pids() and host not in self._down]:
            raise NotServed(f"{', '.join(gone)} ended by itself")
        if now() - self._looked > LOOK_AT_LINKS * SECOND:
            self._look_at_links()

    def until(self, done: Callable[[], bool], within: float, what: str) -> None:
        """Look until `done`. Raises NotServed after `within` seconds; `what` names the condition."""
        deadline = time.monotonic() + within
        while not done():
            if time.monotonic() > deadline:
                raise NotServed(f"not within {within:g} s: {what}")
            time.sleep(LOOK)
            self.look()

    def rest(self, seconds: float, also: Callable[[], object] = lambda: None) -> None:
        """Look for `seconds`, and call `also` at each look."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            time.sleep(min(LOOK, left))
            self.look()
            also()

    def _look_at_links(self) -> None:
        standing = self.links.standing(self.processes.pids())
        standing = {pair: ports for pair, ports in standing.items() if pair in PAIRS}
        if any(not ports <= self._standing.get(pair, frozenset()) for pair, ports in standing.items()):
            self._linked = now()
        before, self._looked, self._standing = self._looked, now(), standing
        for pair in PAIRS - standing.keys():
            self._missing.setdefault(pair, before)
            self._back.pop(pair, None)
        for pair in standing.keys() & self._missing.keys():
            if self._looked - self._back.setdefault(pair, self._looked) > STANDS * SECOND:
                self.apart.append(Apart(pair, self._missing.pop(pair), self._back.pop(pair)))

    def still_apart(self, at: int) -> list[Apart]:
        return [Apart(pair, since, at) for pair, since in self._missing.items()]

    def _without_link(self) -> str:
        return ", ".join("-".join(sorted(pair)) for pair in PAIRS - self._standing.keys())

    def begin(self, fault: Fault) -> None:
        fault.term, fault.began = self.watch.term[0], now()
        self._cuts.update(fault.ways)
        self.net.cut(+self._cuts)
        for host in fault.hosts:
            if fault.how == "kill":
                self._down.add(host)
                self.processes.kill(host)
                self.mark("killed", host)
            elif fault.how == "freeze":
                self._down.add(host)
                self.processes.signal(host, signal.SIGSTOP)
            elif fault.how == "cable":
                self.net.unplug(host)
            elif fault.how == "address":
                self.net.take_address(host)
        fault.at = now()

    def mend(self, fault: Fault) -> None:
        self._look_at_links()
        fault.mended = now()
        self._cuts.subtract(fault.ways)
        for host in fault.hosts:
            if fault.how == "kill":
                self.processes.start(host)
            elif fault.how == "freeze":
                self.processes.signal(host, signal.SIGCONT)
            elif fault.how == "cable":
                self.net.plug_in(host)
            elif fault.how == "address":
                self.net.give_address(host)
            elif host in RC_HOSTS:
                self.mark("mended", host, since=fault.at)
        self._down -= set(fault.hosts)
        self.net.cut(+self._cuts)
        fault.mended = now()

    def mark(self, do: str, host: str, **what: Any) -> None:
        self.marks.append((host, {"at": now(), "do": do, **what}))

    def recover(self, fault: Fault) -> None:
        """Wait until every client has held RCs of every host since the fault's end."""
        self._linked = self.watch.token_back = 0

        def served() -> bool:
            self._look_at_links()
            self.granted(fault)
            return all(self.watch.entered.get(client, 0) > fault.mended for client in CLIENTS)

        try:
            self.until(served, RECOVER_WITHIN, f"all are served after {fault.kind} ({', '.join(fault.touched)})")
        except NotServed as error:
            late = [client for client in CLIENTS if self.watch.entered.get(client, 0) <= fault.mended]
            text = f"{error}; late: {', '.join(late)}; no link: {self._without_link() or 'all stand'}"
            self.found.append(Violation(now(), "16 all is served", text))
            return
        fault.served = max(self.watch.entered[client] for client in CLIENTS)
        fault.linked = min(max(fault.mended, self._linked, self.watch.token_back), fault.served)

    def granted(self, fault: Fault) -> None:
        if not fault.granted:
            fault.granted = min((at for asked, at in self.watch.granted if asked > fault.at), default=0)


def random_faults(fleet: Fleet, rng: random.Random, kinds: list[str], until: Callable[[int], bool]) -> list[Fault]:
    """Cause faults until `until` returns True for their number. Some come in pairs, and some before all clients are
    served again."""
    faults: list[Fault] = []
    single = len(kinds) == 1
    while not until(len(faults)):
        fleet.until(lambda: fleet.watch.leader not in fleet._down, RECOVER_WITHIN, "a node leads")
        fault = draw(rng, kinds, fleet.watch.leader)
        faults.append(fault)
        fleet.begin(fault)
        second = None if single or rng.random() > 0.2 else draw(rng, kinds, fleet.watch.leader)
        if second is not None and not set(second.hosts) & set(fault.hosts):
            fault.alone = second.alone = False
            fleet.rest(fault.lasts * rng.random())
            faults.append(second)
            fleet.begin(second)
            fleet.rest(second.lasts)
            fleet.mend(second)
        fleet.rest(fault.lasts - (now() - fault.at) / SECOND, lambda fault=fault: fleet.granted(fault))  # type: ignore[misc]
        fleet.mend(fault)
        if single or rng.random() < 0.8:
            fleet.recover(fault)
            if second is not None:
                second.served = fault.served
            fleet.rest(rng.uniform(0.3, 1.0))
        else:
            fault.alone = False
            fleet.rest(rng.uniform(0.0, 1.0))
    return faults


def finish(fleet: Fleet, faults: list[Fault]) -> tuple[list[Violation], Counter[str]]:
    """End faults and requests, wait until all is served and released, and check the logs against the promises."""
    found = fleet.found
    try:
        fleet.until(
            lambda: all(fleet.watch.up[host] >= fleet.processes.starts[host] for host in CLIENTS),
            BEGIN_WITHIN,
            "all programs are up",
        )
        for host in CLIENTS:
            fleet.processes.signal(host, signal.SIGUSR1)
        all_quiet = lambda: all(fleet.watch.quiet[host] >= len(JOBS) for host in CLIENTS)  # noqa: E731
        fleet.until(all_quiet, SERVED_WITHIN, "all that was asked for is served")
        fleet.rest(FORGOTTEN_WITHIN)
    except NotServed as error:
        found.append(Violation(now(), "16 all is served", str(error)))
    end = now()
    fleet.processes.close()
    checker = check(fleet.folder, faults, fleet.marks, end, [*fleet.apart, *fleet.still_apart(end)])
    return [*found, *checker.found], Counter(checker.counts)
