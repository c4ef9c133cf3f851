"""What tokens and hosts say of components, and what the placer before this one left: which incarnation is the
truth. Of two that live the higher is; the lower is told to stop.
"""

from __future__ import annotations

from zscout.balancing.model import ComponentId, HostName
from zscout.placing.entry import Entry, Fate
from zscout.placing.events import HostTold, Incarnation, Record, Seen
from zscout.placing.ground import ANSWER, Ground
from zscout.placing.keeping import GRACE, Keeper
from zscout.placing.moving import Mover


class Hearing:
    def __init__(self, ground: Ground, keeper: Keeper, mover: Mover) -> None:
        self.ground, self.strays, self.keeper, self.mover = ground, keeper.strays, keeper, mover
        self.inquiries = keeper.inquiries

    # Tokens

    def appeared(self, component: ComponentId, incarnation: Incarnation, host: HostName) -> None:
        ground = self.ground
        entry = ground.entry(component)
        if not ground.believes(incarnation):
            return
        ground.heard(component, incarnation)
        self.strays.token(component, incarnation, alive=True)
        if host not in ground.alive:
            # Its node's token is late; what can't be done now is, when that comes and it tells.
            self.inquiries.add(host, component)
        if entry is None:
            self.inquiries.add(host, component)
        elif incarnation in entry.over:
            # Late news, or it started after it was told to stop.
            self.strays.add(component, incarnation, host, token=True)
        elif (move := entry.move) is not None and incarnation == move.incarnation:
            self.mover.target_appeared(entry, move)
        elif incarnation != entry.incarnation or entry.past:
            self._other(entry, incarnation, host, token=True)
        elif self._is_over(entry):
            self.strays.add(component, incarnation, host, token=True)
        elif self._is_at(entry, host):
            entry.token = True
            if entry.move is None and entry.state != "stopping":
                self.keeper.runs(entry)

    def vanished(self, component: ComponentId, incarnation: Incarnation, host: HostName) -> None:
        """How it ended, its host tells; a token may also be gone for a while with the network."""
        ground = self.ground
        entry = ground.entry(component)
        self.strays.token(component, incarnation, alive=False)
        self.keeper.stray_over(component)
        if entry is None:
            return
        move = entry.move
        if incarnation == entry.incarnation and host == entry.host:
            entry.token = False
            if move is not None:
                self.mover.source_vanished(entry, move)
            elif entry.state == "running":
                entry.asks = 0
                self.keeper.woke(entry)
            elif entry.state == "stopping" and entry.stopped:
                self.keeper.over(entry)
        elif move is not None and incarnation == move.incarnation:
            move.token, move.target = False, "unknown"

    def _is_over(self, entry: Entry) -> bool:
        """Whether its incarnation must not live: it ended, or is to and its host was believed gone."""
        return entry.state in ("ended", "given_up") or (entry.state == "stopping" and entry.host is None)

    def _is_at(self, entry: Entry, host: HostName) -> bool:
        """Whether this incarnation can be at that host; if it was nowhere, it is there from now on."""
        if entry.host is None and host in self.ground.alive:
            entry.host = host
            entry.why = f"found running on {host}"
        return entry.host == host

    def _other(self, entry: Entry, incarnation: Incarnation, host: HostName, *, token: bool) -> None:
        """An incarnation runs that is not the one the placer knows."""
        ground = self.ground
        if self.strays.has(entry.component, incarnation):
            return
        stopped = entry.state in ("stopping", "ended", "given_up")
        if stopped or incarnation < entry.incarnation + entry.past:
            self.strays.add(entry.component, incarnation, host, token=token)
            return
        if host not in ground.alive:
            return
        if entry.host is not None:
            self.strays.add(
                entry.component, entry.incarnation, entry.host, entry.start_until, token=entry.token
            )
        self.mover.cancel(entry)
        ground.left(entry)
        entry.incarnation, entry.host, entry.token, entry.told = incarnation, host, token, False
        entry.start_until, entry.state, entry.past = None, "starting", False
        entry.why = f"found running on {host}"
        self.keeper.runs(entry)

    # Hosts

    def told(self, told: HostTold) -> None:
        """A host's list, or of one component what it knows."""
        # What a host said before it was lost is no answer.
        alive = told.host in self.ground.alive
        answered = self.inquiries.answered(told.host, told.only) if alive else []
        for seen in told.components:
            if told.only is None or seen.component == told.only:
                self._seen(told.host, seen)
        listed = {(seen.component, seen.incarnation) for seen in told.components}
        if told.only is not None:
            entry = self.ground.entries.get(told.only)
            concerned = [entry] if entry is not None else []
        else:
            concerned = self._there(told.host)
        for entry in concerned:
            self._not_listed(entry, told, listed)
        for name in answered:
            entry = self.ground.entries.get(name)
            if entry is not None and entry.state == "waiting":
                self.ground.wake(entry, self.ground.now)

    def _there(self, host: HostName) -> list[Entry]:
        """What is on a host, or on its way there."""
        return [
            entry
            for entry in self.ground.entries.values()
            if entry.host == host or (entry.move is not None and entry.move.to == host)
        ]

    def _seen(self, host: HostName, seen: Seen) -> None:
        ground = self.ground
        if not ground.believes(seen.incarnation):
            return
        ground.heard(seen.component, seen.incarnation)
        entry = ground.entry(seen.component)
        if entry is None:
            self._adopt(host, seen)
        elif seen.ended is not None:
            self._seen_ended(entry, host, seen)
        elif seen.incarnation in entry.over:
            self.strays.add(seen.component, seen.incarnation, host)
        elif (move := entry.move) is not None and seen.incarnation == move.incarnation:
            self.mover.told_target(entry, move, runs=seen.running, stands_by=seen.standby)
        elif seen.incarnation == entry.incarnation and not entry.past:
            self._seen_alive(entry, host, seen)
        elif not seen.standby:
            self._other(entry, seen.incarnation, host, token=False)

    def _adopt(self, host: HostName, seen: Seen) -> None:
        """Nobody asked this placer for it: one before it did."""
        ground = self.ground
        if seen.ended is not None or seen.standby or host not in ground.alive:
            return
        entry = ground.new_entry(seen.component, seen.spec)
        if entry is None:
            return
        entry.incarnation, entry.host, entry.state = seen.incarnation, host, "starting"
        entry.movable, entry.told, entry.why = seen.movable, seen.running, f"found running on {host}"
        if seen.running:
            self.keeper.runs(entry)
        else:
            entry.reason = f"found starting on {host}"
            ground.start(entry)

    def _seen_alive(self, entry: Entry, host: HostName, seen: Seen) -> None:
        """The incarnation that the entry names lives."""
        ground = self.ground
        if self._is_over(entry):
            if not seen.standby:
                self.strays.add(entry.component, seen.incarnation, host)
        elif entry.state != "stopping" and not seen.standby and self._is_at(entry, host):
            if seen.running:
                entry.movable, entry.told, entry.asks, entry.looked = seen.movable, True, 0, False
                if (move := entry.move) is not None:
                    self.mover.told_source(entry, move, runs=True)
                else:
                    self.keeper.runs(entry)
            elif entry.state in ("waiting", "backing_off"):
                entry.state = "starting"
                ground.start(entry)

    def _seen_ended(self, entry: Entry, host: HostName, seen: Seen) -> None:
        incarnation = seen.incarnation
        fate = Fate(seen.ended or "lost", seen.reason, seen.tail)
        if self.strays.has(entry.component, incarnation):
            self.strays.over(entry.component, incarnation)
            self.keeper.stray_over(entry.component)
        elif incarnation in entry.over and entry.host is None:
            pass
        elif (move := entry.move) is not None and incarnation == move.incarnation:
            entry.over.append(incarnation)
            self.mover.target_ended(entry, move, f"what stood by there has ended: {fate.reason or fate.how}")
        elif incarnation != entry.incarnation or entry.past or entry.state in ("ended", "given_up"):
            pass
        elif move is not None:
            self.mover.source_ended(entry, move, fate)
        elif entry.host == host or entry.host is None:
            entry.host = host
            self.keeper.ended(entry, fate)

    def _not_listed(self, entry: Entry, told: HostTold, listed: set[tuple[ComponentId, Incarnation]]) -> None:
        """A host tells of all that it has, or of this component, and not of this incarnation: it is not
        there. Unless it started after that was told: a token, or a start that is out, say more."""
        ground, move = self.ground, entry.move
        if (
            move is not None
            and move.to == told.host
            and (entry.component, move.incarnation) not in listed
            and move.stage == "looking"
            and not move.token
        ):
            ground.touch(entry.component)
            self.mover.target_ended(entry, move, "what stood by there is gone")
        if entry.host != told.host or (entry.component, entry.incarnation) in listed:
            return
        asked = entry.looked or told.only is None
        if entry.token or entry.start_until is not None or not asked:
            return
        fate = Fate("lost", f"{told.host} knows nothing of it any more")
        ground.touch(entry.component)
        if entry.move is not None:
            self.mover.source_ended(entry, entry.move, fate)
        elif entry.state in ("running", "stopping"):
            self.keeper.ended(entry, fate)

    def seen(self, host: HostName) -> None:
        """A host's node is there."""
        ground = self.ground
        if host in ground.alive:
            return
        ground.alive.add(host)
        ground.rested[host] = ground.now
        ground.drain_soon(host)
        self.inquiries.seen(host)
        for entry in ground.entries.values():
            if entry.state == "waiting":
                if self.inquiries.open(host, entry.component):
                    # Perhaps it is there still: better than to start it anew.
                    entry.retry_at = ground.now + ANSWER
                ground.wake(entry, max(ground.now, entry.retry_at))
            elif entry.state == "stopping" and entry.host == host:
                ground.wake(entry, ground.now)
            elif entry.state == "running" and entry.host == host:
                # Its list or its token comes in a moment.
                ground.wake(entry, ground.now + GRACE)

    def lost(self, host: HostName) -> None:
        """What it had is gone with it. If its node was only silent it is there still, and no token need tell:
        the host is asked of all that when it is back."""
        ground = self.ground
        ground.alive.discard(host)
        ground.rested.pop(host, None)
        ground.departed.pop(host, None)
        for component in self.strays.lost(host):
            self.inquiries.add(host, component)
            self.keeper.stray_over(component)
        for entry in self._there(host):
            ground.touch(entry.component)
            self.inquiries.add(host, entry.component)
            move = entry.move
            if move is not None and move.to == host:
                self.mover.target_host_lost(entry, move)
            elif move is not None:
                self.mover.source_host_lost(entry, move, host)
            else:
                self.keeper.host_lost(entry, host)

    # What came before

    def inherited(self, record: Record) -> None:
        """A record of the placer before. It stands until a host says otherwise, or is silent too long."""
        ground = self.ground
        if not ground.believes(record.incarnation):
            return
        ground.heard(record.component, record.incarnation)
        entry = ground.entry(record.component)
        if entry is not None:
            # A host was quicker to tell; that it is to stop is known here only.
            if not record.wanted and entry.wanted and entry.state not in ("ended", "given_up"):
                self.mover.cancel(entry)
                self.keeper.stop(entry)
            return
        entry = ground.new_entry(record.component, record.spec)
        if entry is None:
            return
        entry.state = "running" if record.state == "moving" else record.state
        entry.incarnation, entry.host, entry.wanted = record.incarnation, record.host, record.wanted
        entry.reason, entry.why, entry.tail = record.reason, record.reason, record.tail
        entry.movable = record.movable
        entry.restarts, entry.moves, entry.dead = record.restarts, record.moves, record.dead
        if record.state == "moving":
            entry.reason = f"it was to move to {record.to}"
        if entry.state == "running":
            entry.since = ground.now
        if entry.state not in ("starting", "running", "stopping"):
            entry.host = None
        entry.retry_at = ground.now + GRACE
        if entry.state in ("ended", "given_up"):
            ground.ended(entry)
        else:
            ground.wake(entry, entry.retry_at)
