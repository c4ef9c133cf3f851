"""Decides whether a fault may affect a process or an RC: meanwhile some promises do not hold (docs/promises.md)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from studies.faults.plan import Fault
from zscout.config.fleet import Fleet
from zscout.rcm.roster import PRESENT_PART
from zscout.testing.virtual_time import START
from zscout.types import SECOND, Term

FELT: Final = 5.0
"""Seconds after a fault's end during which it may have effects: links return, and lost holds are reported."""
IMPATIENCE: Final = 0.25
"""Part of the lease by which Zenoh may give a link up before its end."""


@dataclass(slots=True, kw_only=True)
class Excuses:
    """The excuses of a run: `felt` decides for which processes and RCs a promise is excused now."""

    hosts: Sequence[str]
    candidates_at: Sequence[str]
    """The hosts that may lead."""
    where: Mapping[str, str]
    """The process of each RC."""
    faults: Sequence[Fault]
    fleet: Fleet
    leading: Callable[[], Mapping[str, Term]]
    """The hosts whose candidates lead, each with its term."""
    terms: Mapping[Term, float]
    """When each term began."""
    now: Callable[[], float]
    killed: dict[Fault, tuple[str, float]] = field(default_factory=dict)
    """Faults that have killed a process: its name, and the time of the kill in the run."""
    led_throughout: dict[Fault, set[str]] = field(default_factory=dict)
    """By ended fault: hosts whose leaders led before its beginning and at its end."""

    def felt(self, since: float, *whom: str) -> bool:
        """Return True if a present or recent fault may affect these processes and RCs. `since`: of the hold, which may
        be a grant of a leader that, while hosts were apart, does not see all its RCs yet."""
        names = {*whom, *(self.where[rc] for rc in whom if rc in self.where)}
        hosts = {name.split("/")[0] for name in names} & {*self.hosts}
        now = self.now() - START
        faults = [fault for fault in self.faults if fault.at < now and fault.at + fault.lasts + fault.felt > now - FELT]
        failing = {name for fault in faults if fault.kind in ("freeze", "stall") for name in fault.whom}
        failing |= {self.killed[fault][0] for fault in faults if fault in self.killed}
        sound = {host for host in self.hosts if f"{host}/node" not in failing}
        if sound.isdisjoint(self.candidates_at):
            return True
        sides = [self._side(fault, hosts) for fault in faults if fault.kind in ("isolate", "part")]
        beside = {*self.hosts}.intersection(*sides) & sound
        # A hanging leader is given up after a silence. If the next candidate fails just then, holds may end.
        silence = max(4 * self.fleet.timing.heartbeat / SECOND, self.fleet.mesh.lease)
        hung = any(fault.kind == "stall" and fault.lasts > silence for fault in faults)
        if hung and len(beside.intersection(self.candidates_at)) < len(self.candidates_at) - 1:
            return True
        return any(self._felt(fault, names, hosts, since, beside) for fault in faults)

    def on_over(self, fault: Fault) -> None:
        self.led_throughout[fault] = self._led_since(fault.at)

    def _side(self, fault: Fault, hosts: set[str]) -> set[str]:
        """The side of a partition with these hosts; empty if it separates them."""
        side, other = {*fault.whom}, {*self.hosts} - {*fault.whom}
        return next((side for side in (side, other) if hosts <= side), set())

    def _led_since(self, at: float) -> set[str]:
        """Hosts whose leaders led at `at` and still lead."""
        return {host for host, term in self.leading().items() if self.terms.get(term, self.now()) < at + START}

    def _felt(self, fault: Fault, names: set[str], hosts: set[str], since: float, beside: set[str]) -> bool:
        """`beside`: hosts that no partition separates from these, and whose nodes have no fault of their own."""
        # A leader may lose its first link while the others return, which looks like the loss of a host.
        lasts, timing = self.now() - START - fault.at, self.fleet.timing
        answered = 2 * PRESENT_PART * self.fleet.mesh.lease
        just_over = 0 <= lasts - fault.lasts < answered
        match fault.kind:
            case "kill" | "old disk":
                name, at = self.killed.get(fault, ("", math.inf))
                # Its last messages may have reached only some processes.
                return name in names or 0 < since - at < self.fleet.mesh.lease
            case "stall" | "fail" | "double":
                return bool(names & {*fault.whom})
            case "disk" | "clock":
                return False
            case "lie":
                # RCs and clients that promised a term to a candidate that died may get a leader only later.
                return fault.message == "promised"
            case "freeze":
                return just_over or bool(names & {*fault.whom})
            case "isolate" | "part":
                there = self._side(fault, hosts)
                parted = not beside & {*self.candidates_at}
                # A leader that continues on the other side has granted RCs to others that it did not see for a lease.
                led = self.led_throughout.get(fault, set()) | self._led_since(fault.at)
                left = fault.lasts > self.fleet.mesh.lease * (1 - IMPATIENCE) and led - there
                # A candidate that is alone, without an RC of another host, waits for the hold lease: it may be cut off
                # itself.
                asked = {*self.candidates_at, *(process.split("/")[0] for process in self.where.values())}
                alone = len(beside & asked) == 1 and lasts > (timing.hold_lease - 2 * timing.heartbeat) / SECOND
                # The same holds for a leader that begins just then.
                over = START + fault.at + fault.lasts
                began = any(abs(at - over) < answered for at in self.terms.values())
                return just_over or began or parted or bool(left) or alone or since > fault.at
            case _:
                return True
