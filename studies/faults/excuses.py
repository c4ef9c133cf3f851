"""Which faults a process or an RC may feel: while it does, some promises wait (docs/promises.md)."""

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
"""Seconds for which a fault may be felt when it is over: links come back, and holds that were lost are told of."""
IMPATIENCE: Final = 0.25
"""Part of the lease before whose end a link may be given up already, as Zenoh does."""


@dataclass(slots=True, kw_only=True)
class Excuses:
    """Of one run: `felt` says for whom a promise may wait now."""

    hosts: Sequence[str]
    candidates_at: Sequence[str]
    """The hosts that may lead."""
    where: Mapping[str, str]
    """In which process each RC is."""
    faults: Sequence[Fault]
    fleet: Fleet
    leading: Callable[[], Mapping[str, Term]]
    """The hosts whose candidates lead, each with its term."""
    terms: Mapping[Term, float]
    """When each began."""
    now: Callable[[], float]
    killed: dict[Fault, tuple[str, float]] = field(default_factory=dict)
    """Those that have killed a process, it, and after how many seconds."""
    led_throughout: dict[Fault, set[str]] = field(default_factory=dict)
    """By fault that is over: hosts whose leaders led before it began, and as it ended."""

    def felt(self, since: float, *whom: str) -> bool:
        """Whether a fault may be felt by these processes and RCs: one of now, or one that was over lately. What began
        (`since`) while hosts were apart may be the grant of a leader that does not see all of its RCs yet."""
        names = {*whom, *(self.where[rc] for rc in whom if rc in self.where)}
        hosts = {name.split("/")[0] for name in names} & {*self.hosts}
        now = self.now() - START
        faults = [fault for fault in self.faults if fault.at < now and fault.at + fault.lasts + fault.felt > now - FELT]
        failing = {one for fault in faults if fault.kind in ("freeze", "stall") for one in fault.whom}
        failing |= {self.killed[fault][0] for fault in faults if fault in self.killed}
        sound = {host for host in self.hosts if f"{host}/node" not in failing}
        if sound.isdisjoint(self.candidates_at):
            return True
        sides = [self._side(fault, hosts) for fault in faults if fault.kind in ("isolate", "part")]
        beside = {*self.hosts}.intersection(*sides) & sound
        # A leader that hangs is given up after a silence: where the next candidate fails just then, holds may be over.
        silence = max(4 * self.fleet.timing.heartbeat / SECOND, self.fleet.mesh.lease)
        hung = any(fault.kind == "stall" and fault.lasts > silence for fault in faults)
        if hung and len(beside.intersection(self.candidates_at)) < len(self.candidates_at) - 1:
            return True
        return any(self._felt(fault, names, hosts, since, beside) for fault in faults)

    def on_over(self, fault: Fault) -> None:
        self.led_throughout[fault] = self._led_since(fault.at)

    def _side(self, fault: Fault, hosts: set[str]) -> set[str]:
        """The hosts that a partition leaves with these; none, if it parts them."""
        one, other = {*fault.whom}, {*self.hosts} - {*fault.whom}
        return next((side for side in (one, other) if hosts <= side), set())

    def _led_since(self, at: float) -> set[str]:
        """Hosts whose leaders lead, and did then."""
        return {host for host, term in self.leading().items() if self.terms.get(term, self.now()) < at + START}

    def _felt(self, fault: Fault, names: set[str], hosts: set[str], since: float, beside: set[str]) -> bool:
        """`beside`: hosts that no partition parts from these, and whose nodes feel no fault of their own."""
        # Of a leader's links the first was lost as the others came back: nobody can tell that from a host that goes.
        lasts, timing = self.now() - START - fault.at, self.fleet.timing
        answered = 2 * PRESENT_PART * self.fleet.mesh.lease
        just_over = 0 <= lasts - fault.lasts < answered
        match fault.kind:
            case "kill" | "old disk":
                name, at = self.killed.get(fault, ("", math.inf))
                # What it said last may have reached some only.
                return name in names or 0 < since - at < self.fleet.mesh.lease
            case "stall" | "fail" | "double":
                return bool(names & {*fault.whom})
            case "disk" | "clock":
                return False
            case "lie":
                # RCs and clients that promised to a candidate which died may be led only later.
                return fault.message == "promised"
            case "freeze":
                return just_over or bool(names & {*fault.whom})
            case "isolate" | "part":
                there = self._side(fault, hosts)
                parted = not beside & {*self.candidates_at}
                # A leader on the other side that goes on has given to others what it did not see for a lease.
                led = self.led_throughout.get(fault, set()) | self._led_since(fault.at)
                left = fault.lasts > self.fleet.mesh.lease * (1 - IMPATIENCE) and led - there
                # A candidate that is left alone, with no RC of another host to ask, waits for as long as a hold lasts:
                # it may be cut off itself.
                asked = {*self.candidates_at, *(process.split("/")[0] for process in self.where.values())}
                alone = len(beside & asked) == 1 and lasts > (timing.hold_lease - 2 * timing.heartbeat) / SECOND
                # Nor can one tell it that begins to lead just then.
                over = START + fault.at + fault.lasts
                began = any(abs(at - over) < answered for at in self.terms.values())
                return just_over or began or parted or bool(left) or alone or since > fault.at
            case _:
                return True
