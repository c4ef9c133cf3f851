"""The recorder: what is heard on the mesh, written to the timeline.

It only listens. The holders of each RC come from what the RCM publishes; why an ARC waits, from the notices
to its client; hosts and RCs that come and go, from liveliness; what runs on which host, from the component
placer; what robots do and see, from behaviors, framegrabbers and buildings. `rcm/state` is read at the start
and where something was missed, so that a recorder may begin in the middle of things.

As a program, `python -m zscout.services.recorder`, it is told what to do as `recorder_process.Job` says.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable
from dataclasses import dataclass, field

from zscout import clock
from zscout.config import Fleet
from zscout.keyexpr import BadName, Role, Token, new_instance
from zscout.mesh import Declared, Mesh
from zscout.messages import (
    Grants,
    HoldView,
    LoadReport,
    Notice,
    RcmState,
    RcState,
    Revocation,
    StateAsk,
    absurd,
)
from zscout.messages import Holder as ToldHolder
from zscout.scheduling.model import NO_TERM, SECOND, Grant, Term
from zscout.services.comings import words_of
from zscout.services.host_pane import Use
from zscout.services.recorder_placements import PlacementFollower
from zscout.services.recorder_robots import RobotFollower
from zscout.services.robot_story import hold_of
from zscout.services.timeline import Holder, Timeline

log = logging.getLogger(__name__)

READ_TIMEOUT = 2.0
PAUSE = 0.1
"""Seconds before a leader that did not answer is asked again."""
LAST_WORDS = 0.5
"""Seconds for what was said before the end and is on its way still."""
LOOK = 1.0
"""Seconds between two looks at whether anything was dropped here."""
DEPTH = 8_192
"""Publications of one kind that may wait here."""
MAX_OPEN = 20_000
"""Requests followed at one time."""
MAX_RCS = 10_000
MAX_HOLDERS = 1_024

Key = tuple[str, str]
"""Client and id of a request."""


@dataclass(slots=True)
class _Arc:
    """A request that is followed."""

    label: str
    """The ARC's name; of several that are open at one time, a numbered one."""
    state: str = ""
    detail: str = ""
    grant: Grant | None = None
    last: tuple[Term, int] = field(default=(NO_TERM, 0))
    """The newest notice."""


class Recorder:
    """Follows one fleet and writes it to `timeline`, in seconds since this object was made; of each camera at
    most `frames` pictures a second, with 0 none."""

    def __init__(self, mesh: Mesh, fleet: Fleet, timeline: Timeline, frames: float = 2.0) -> None:
        self.mesh, self.fleet, self.timeline = mesh, fleet, timeline
        self.term: Term = NO_TERM
        self.seq = 0
        """The newest publication heard; older ones are ignored."""
        self._zero = clock.now()
        self._arcs: dict[Key, _Arc] = {}
        self._labels: set[str] = set()
        self._rcs: dict[str, dict[Grant, Holder]] = {}
        self._tokens: dict[tuple[str, str, str], set[str]] = {}
        self._declared: list[Declared] = []
        self._leaders: set[Token] = set()
        self._placements = PlacementFollower(mesh, timeline, self._now)
        self._robots = RobotFollower(mesh, timeline, self._now, frames)
        self._wanted = asyncio.Event()
        self._missed = 0
        self._caught_up = False

    async def run(self, stop: asyncio.Event) -> None:
        """Records until `stop`. Its liveliness token appears when an RCM has told it the whole state."""
        keys, mesh = self.mesh.keys, self.mesh
        self._declared = [
            mesh.subscribe(keys.grants, Grants, self._on_grants, depth=DEPTH),
            mesh.subscribe(keys.notice_any, Notice, self._on_notice, depth=DEPTH),
            mesh.subscribe(keys.rc_state_any, RcState, self._on_rc_state, depth=DEPTH),
            mesh.subscribe(keys.load_any, LoadReport, self._on_load),
            self._placements.subscribe(),
            mesh.watch(keys.alive_any(), self._on_token),
        ]
        # Apart: of what these miss, the RCM's state tells nothing.
        robots = self._robots.subscribe()
        self._wanted.set()
        reading = [
            asyncio.create_task(self._keep_reading()),
            asyncio.create_task(self._placements.keep_reading()),
            asyncio.create_task(self._robots.run()),
        ]
        try:
            await stop.wait()
            await self._hear_out()
        finally:
            for task in reading:
                task.cancel()
            await asyncio.gather(*reading, return_exceptions=True)
            for declared in [*robots, *reversed(self._declared)]:
                declared.close()

    async def _hear_out(self) -> None:
        """Whoever ends this may be quicker than what was published before. An answer of the RCM comes behind
        all that it has published, on the same link; where nobody leads there is nothing to wait for."""
        key = self.mesh.keys.rcm_state
        await self.mesh.ask(key, StateAsk(), RcmState, timeout=LAST_WORDS, enough=lambda _: True)

    def _now(self) -> float:
        return (clock.now() - self._zero) / SECOND

    # What the RCM publishes

    def _on_grants(self, _key: str, said: Grants) -> None:
        if (said.term, said.seq) < (self.term, self.seq) or absurd(said.term, self.term):
            return
        if said.term != self.term or said.prev > self.seq:
            self._wanted.set()
        self.term, self.seq = said.term, said.seq
        at = self._now()
        for revoked in said.revoked:
            self._revoked(at, revoked, said)
        for rc, holders in said.rcs.items():
            for holder in holders[:MAX_HOLDERS]:
                self._runs(at, (holder.client, holder.id), holder, holder.rcs)
            self._show(at, rc, [(self._label(holder), holder) for holder in holders[:MAX_HOLDERS]])

    def _revoked(self, at: float, revoked: Revocation, said: Grants) -> None:
        for rc in revoked.rcs:
            if rc not in said.rcs:
                self._drop(at, rc, {revoked.grant})
        arc = self._arcs.get((revoked.client, revoked.id))
        if arc is None or arc.grant not in (None, revoked.grant):
            return
        arc.grant = None
        match revoked.outcome:
            case "preempted":
                by = revoked.reason.removeprefix("preempted ")
                self._set(at, arc, "preempted", by)
                self.timeline.event(at, f"{arc.label} is preempted {by}, and waits again", "WARN")
            case "lost":
                self._set(at, arc, "waiting", revoked.reason)
                self.timeline.event(at, f"{arc.label} lost its hold: {revoked.reason}", "WARN")
            case "handed_over":
                self._move(at, revoked, said)
            case outcome:
                self._done(at, (revoked.client, revoked.id), outcome, revoked.reason)

    def _move(self, at: float, revoked: Revocation, said: Grants) -> None:
        """The ARC goes on in another client: it keeps its lane."""
        arc = self._arcs.pop((revoked.client, revoked.id))
        self.timeline.event(at, f"{arc.label} goes on elsewhere: {revoked.reason}")
        for holder in (holder for rc in revoked.rcs for holder in said.rcs.get(rc, [])):
            if holder.id == revoked.id and holder.client != revoked.client and holder.arc == revoked.arc:
                self._arcs[holder.client, holder.id] = arc
                return
        self._labels.discard(arc.label)

    def _runs(self, at: float, key: Key, hold: ToldHolder | HoldView, rcs: Iterable[str]) -> None:
        arc = self._track(key, hold.arc)
        if arc is None or arc.grant == hold.grant:
            return
        arc.grant = hold.grant
        self._set(at, arc, "running", f"priority {hold.priority} · min {float(hold.min_runtime):g} s")
        self.timeline.event(at, f"{arc.label} runs on {', '.join(sorted(rcs))}")

    # What clients are told

    def _on_notice(self, key: str, notice: Notice) -> None:
        try:
            client = str(self.mesh.keys.sender_of(key))
        except BadName:
            return
        if client != notice.client or notice.term < self.term:
            return
        at, known = self._now(), (client, notice.id)
        if notice.state == "ended":
            self._done(at, known, notice.outcome or "ended", notice.reason)
            return
        arc = self._track(known, notice.arc)
        if arc is None or (notice.term, notice.step) <= arc.last:
            return
        arc.last = (notice.term, notice.step)
        # That it runs is read from the publication. What was preempted stays so until it runs again.
        if notice.state == "queued" and arc.state not in ("preempted", "running"):
            self._waits(at, arc, notice.reason)

    def _waits(self, at: float, arc: _Arc, reason: str) -> None:
        if (arc.state, arc.detail) != ("waiting", reason):
            self._set(at, arc, "waiting", reason)
            self.timeline.event(at, f"{arc.label} waits: {reason}")

    # The whole state, where something was missed

    async def _keep_reading(self) -> None:
        while True:
            try:
                async with asyncio.timeout(LOOK):
                    await self._wanted.wait()
            except TimeoutError:
                missed = sum(declared.missed for declared in self._declared)
                if missed == self._missed:
                    continue
                log.warning("%d publications were missed; the state is read", missed - self._missed)
                self._missed = missed
                self._placements.read_again()
            self._wanted.clear()
            if not await self._read() and self._leaders:
                await asyncio.sleep(PAUSE)
                self._wanted.set()

    async def _read(self) -> bool:
        """Whether the state is known now. Without a leader, the token of the next asks again."""
        key, me = self.mesh.keys.rcm_state, self.mesh.me
        replies = await self.mesh.ask(key, StateAsk(), RcmState, timeout=READ_TIMEOUT)
        states = [reply.message for reply in replies if reply.message is not None]
        newest = max(states, key=lambda state: (state.term, state.seq), default=None)
        if newest is None or (newest.term, newest.seq) < (self.term, self.seq):
            return False
        self._take(newest)
        if not self._caught_up:
            self._caught_up = True
            self._declared.append(self.mesh.alive(Token(me.host, Role.RECORDER, me.client, new_instance())))
        return True

    def _take(self, state: RcmState) -> None:
        self.term, self.seq = state.term, state.seq
        at = self._now()
        holders: dict[str, list[tuple[str, HoldView]]] = {view.rc: [] for view in state.rcs}
        stand: set[Key] = set()
        for hold in state.holds:
            key = (hold.client, hold.id)
            stand.add(key)
            self._runs(at, key, hold, hold.needs)
            for rc in hold.needs:
                holders.setdefault(rc, []).append((self._label(hold), hold))
        for wait in state.queue:
            key = (wait.client, wait.id)
            stand.add(key)
            arc = self._track(key, wait.arc)
            if arc is None:
                continue
            if arc.grant is not None or not arc.state:
                arc.grant = None
                if wait.preemptions:
                    self._set(at, arc, "preempted", wait.reason)
            if arc.state != "preempted":
                self._waits(at, arc, wait.reason)
        for key in [key for key, arc in self._arcs.items() if key not in stand]:
            # What the answer left out may still wait.
            if not state.more or self._arcs[key].grant is not None:
                self._done(at, key, "ended", "while nobody listened")
        for rc in self._rcs.keys() - holders.keys():
            self._show(at, rc, [])
        for rc, held in holders.items():
            self._show(at, rc, held)

    # What RCs, hosts and tokens say

    def _on_rc_state(self, key: str, state: RcState) -> None:
        """A hold that ended at the device has ended, whether an RCM is there to say so or not."""
        if self.mesh.keys.rc_of(key) != state.rc:
            return
        at = self._now()
        if state.ended:
            self._drop(at, state.rc, {ended.grant for ended in state.ended})
        self._robots.story.state(at, state)

    def _on_load(self, key: str, report: LoadReport) -> None:
        host = self.mesh.keys.host_of(key)
        if host == report.host:
            at = self._now()
            self.timeline.load(at, host, report.load_average[0], report.cpu / 100)
            self.timeline.uses(
                at, host, [Use(one.component, one.cpu, one.memory) for one in report.components]
            )

    def _on_token(self, token: Token, alive: bool) -> None:
        instances = self._tokens.setdefault((token.host, token.role, token.name), set())
        before = bool(instances)
        (instances.add if alive else instances.discard)(token.instance)
        if not instances:
            del self._tokens[token.host, token.role, token.name]
        if token.role == Role.RCM:
            (self._leaders.add if alive else self._leaders.discard)(token)
            if alive:
                self._wanted.set()
                self._placements.read_again()
        if bool(instances) == before and token.role != Role.RCM:
            return
        self._robots.token(token, alive)
        at = self._now()
        words = words_of(token, alive)
        if words is not None:
            self.timeline.event(at, *words)
        # Before the state was read, nobody knows that a new RC is free.
        if token.role == Role.RC and self._caught_up and (not alive or token.name not in self._rcs):
            self._show(at, token.name, [])

    # The timeline

    def _track(self, key: Key, name: str) -> _Arc | None:
        """The request, followed from now on; None where too many are open."""
        arc = self._arcs.get(key)
        if arc is None and len(self._arcs) < MAX_OPEN:
            label, number = name, 1
            while label in self._labels:
                number += 1
                label = f"{name}.{number}"
            self._labels.add(label)
            arc = self._arcs[key] = _Arc(label)
        return arc

    def _label(self, hold: ToldHolder | HoldView) -> str:
        arc = self._arcs.get((hold.client, hold.id))
        return arc.label if arc is not None else hold.arc

    def _set(self, at: float, arc: _Arc, state: str, detail: str) -> None:
        arc.state, arc.detail = state, detail
        self.timeline.arc(at, arc.label, state, detail)

    def _done(self, at: float, key: Key, outcome: str, reason: str) -> None:
        arc = self._arcs.pop(key, None)
        if arc is None:
            return
        self._labels.discard(arc.label)
        self.timeline.arc(at, arc.label, "done", "" if outcome == "completed" else outcome)
        level = "WARN" if outcome == "client_lost" else "INFO"
        self.timeline.event(at, f"{arc.label} {outcome.replace('_', ' ')}: {reason}", level)

    def _show(self, at: float, rc: str, holders: Iterable[tuple[str, ToldHolder | HoldView]]) -> None:
        if rc not in self._rcs and len(self._rcs) >= MAX_RCS:
            return
        operator, holders = self.fleet.operator_priority, list(holders)
        self._rcs[rc] = {hold.grant: Holder(label, hold.priority >= operator) for label, hold in holders}
        self._robots.story.held(rc, {hold.grant: hold_of(hold, operator) for _, hold in holders})
        self.timeline.holders(at, rc, list(self._rcs[rc].values()))

    def _drop(self, at: float, rc: str, grants: set[Grant]) -> None:
        held = self._rcs.get(rc, {})
        if grants & held.keys():
            self._rcs[rc] = {grant: holder for grant, holder in held.items() if grant not in grants}
            self._robots.story.dropped(rc, grants)
            self.timeline.holders(at, rc, list(self._rcs[rc].values()))


if __name__ == "__main__":
    from zscout.services.recorder_run import main

    main()
