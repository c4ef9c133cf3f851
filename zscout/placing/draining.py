"""Emptying hosts: on a cordoned host nothing is placed, and what can be moved leaves it, heaviest first."""

from __future__ import annotations

from typing import Final

from zscout.balancing.balancer import MAX_HOSTS
from zscout.balancing.model import HostName
from zscout.placing.entry import Entry
from zscout.placing.ground import DRAIN, Ground
from zscout.placing.moving import RETRY, Mover

SIDE_BY_SIDE: Final = 2
"""Components that leave one host at the same time."""


class Drain:
    def __init__(self, ground: Ground, mover: Mover) -> None:
        self.ground, self.mover = ground, mover

    def asked(self, host: HostName) -> None:
        """Whoever is not known can't be drained: it is a slip of the pen, and the host meant would go on."""
        ground = self.ground
        cordoned = ground.balancer.cordoned
        if host not in cordoned:
            if host not in ground.alive and host not in ground.balancer.reports:
                ground.refuse(host, "unknown_host", f"there is no host {host}")
                return
            if len(cordoned) >= MAX_HOSTS:
                ground.refuse(host, "too_many", f"{len(cordoned)} hosts are drained already")
                return
        cordoned.add(host)
        ground.ranks.begin(ground.now)
        ground.drain_soon(host)

    def uncordon(self, host: HostName) -> None:
        """What waits may go there again; what stayed there stays in peace."""
        ground = self.ground
        ground.balancer.cordoned.discard(host)
        ground.ranks.begin(ground.now)
        for entry in ground.entries.values():
            if entry.state == "waiting":
                ground.wake(entry, max(ground.now, entry.retry_at))
            elif entry.host == host and entry.stays:
                entry.stays = ""
                ground.touch(entry.component)

    def run(self) -> None:
        """Moves what may go now, and says of the rest why it stays."""
        ground = self.ground
        cordoned = ground.balancer.cordoned
        on: dict[HostName, list[Entry]] = {}
        for entry in ground.entries.values():
            if entry.host in cordoned and entry.state in ("running", "moving"):
                on.setdefault(entry.host, []).append(entry)
        for host in sorted(on):
            self._empty(host, on[host])

    def _empty(self, host: HostName, entries: list[Entry]) -> None:
        ground = self.ground
        room = SIDE_BY_SIDE - sum(entry.move is not None for entry in entries)
        names = [(entry.component, entry.spec.kind) for entry in entries if entry.move is None]
        for component in ground.balancer.heaviest_first(names):
            entry = ground.entries[component]
            if not entry.movable:
                self._say(entry, f"it can't be moved; {host} is drained")
            elif entry.retry_at > ground.now:
                self._later()
            elif room > 0:
                room -= self._leave(entry, host)
        if any(entry.movable and entry.move is None for entry in entries):
            self._later()

    def _leave(self, entry: Entry, host: HostName) -> bool:
        fit = self.ground.fit(entry.spec, but=host)
        if fit.hosts:
            self.ground.touch(entry.component)
            self.mover.begin(entry, fit.hosts[0].host, f"{host} is drained")
            return True
        entry.retry_at = self.ground.now + RETRY
        self._say(entry, f"{host} is drained, and no other host will do: {fit.why_none()}")
        return False

    def _say(self, entry: Entry, why: str) -> None:
        if entry.stays != why:
            entry.stays = why
            self.ground.touch(entry.component)

    def _later(self) -> None:
        self.ground.timers.set(DRAIN, self.ground.now + RETRY)
