"""The recorder: writes the activity of the mesh to the timeline.

It only subscribes and queries. Holders of RCs come from publications of the RCM, reasons to wait from notices to
clients, the presence of hosts and RCs from liveliness tokens, components from the placer, and the activity of robots
from behaviors, framegrabbers and buildings. `rcm/state` is read at the start and after missed publications, so that a
recorder may start at any time. Earlier holds come from journals, and bookings from the leader."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from typing import Final

from zscout import messages
from zscout.config.fleet import Fleet
from zscout.keyexpr import Role, Sender, Token, new_instance
from zscout.mesh import Declaration, IncomingQuery, Mesh, Supervisor
from zscout.mesh.supervision import done_within
from zscout.services.journal.asking import NoJournal, ask_journals
from zscout.services.recorder.hosts import MAX_FOLLOWED
from zscout.services.recorder.past import past_of
from zscout.services.recorder.request_tracker import RequestTracker
from zscout.services.recorder.robots import MAX_CAMERAS
from zscout.services.recorder.timeline import Timeline
from zscout.types import SECOND

log = logging.getLogger(__name__)

READ_TIMEOUT: Final = 2.0
PAUSE: Final = 0.1
"""Seconds before a leader that did not answer is queried again."""
AGAIN: Final = 2.0
"""Seconds until a placer, or journals, that did not answer are queried again."""
BOOKINGS_EVERY: Final = 5.0
"""Seconds between two queries for bookings."""
MANY_BOOKINGS: Final = 100
"""Number of bookings beyond which the period grows in proportion."""
MAX_PAST: Final = 5_000
"""Holds drawn of the time before the recording: the latest."""
COMMITTED: Final = 2.0
"""Seconds until journals have committed earlier publications."""
TRIES: Final = 5
"""Queries without an answer, after which the next query waits for a new RCM or a missed publication."""
CHECK_EVERY: Final = 1.0
"""Seconds between two checks for publications dropped here."""
DOUBT_EVERY: Final = 5.0
"""Seconds between two readings of the state while it and the tokens differ on which devices are present."""
BANNER_AFTER: Final = 2.0
DEPTH: Final = 8_192
ROBOT_DEPTH: Final = 1_024
"""Publications of one kind that may wait."""
CAMERAS: Final = "framegrabber/"
CAMERA_FIGURE: Final = "frames_per_second"
"""Figure of a camera of another kind."""
"""RCs of this kind have pictures."""
NO_PICTURE: Final = 3.0
"""Seconds without a picture after which the recording shows that."""
TICK: Final = 0.25
MAX_REPORT: Final = 8_192
MAX_POSES: Final = 65_536
"""Bytes."""

PRESENCE: Final = {
    Role.NODE: ("node {host} is gone", "node {host} is there"),
    Role.RC: ("{name} is gone from {host}", "{name} is offered by {host}"),
    Role.CLIENT: ("client {host}/{name} left", "client {host}/{name} joined"),
}
"""By role: the texts when its token disappears and appears, listed apart from the events."""
LEADS: Final = ("{host} does not lead any more", "{host} leads")


class RecorderFailed(RuntimeError):
    """Part of a recorder raised; it was logged with its traceback."""


class Recorder:
    """Records one fleet to `timeline`, in seconds since this object was created: at most `frames` pictures a second of
    each camera; 0: no subscriptions to pictures, so framegrabbers need not publish any."""

    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        timeline: Timeline,
        frames: float = 2.0,
        where: Callable[[], messages.Recorded] | None = None,
        past: float = 0.0,
        wall: Callable[[], float] = time.time,
    ) -> None:
        """`where` answers queries for the place of the recording; without it there are no answers. `past`: seconds
        before this object's creation, from journals. `wall`: seconds since 1970, UTC."""
        self.mesh, self.timeline, self.frames, self._where = mesh, timeline, frames, where
        self.fleet, self.past, self._wall = fleet, past, wall
        self._zero, self._epoch = mesh.now(), wall()
        timeline.start_clock(self._epoch)
        self._hosts, self._robots, self._bookings = timeline.hosts, timeline.robots, timeline.bookings
        self._requests = RequestTracker(timeline, fleet.operator_priority)
        self._tokens: dict[tuple[str, str, str], set[str]] = {}
        self._declared: list[Declaration] = []
        self._wanted, self._placer_wanted, self._bookings_wanted = asyncio.Event(), asyncio.Event(), asyncio.Event()
        self._fresher: set[str] | None = None
        """Components published since the placer was queried for all, until its answer."""
        self._caught_up = asyncio.Event()
        self._sound = 0.0
        """Last time, in seconds of the timeline, at which the recorder had caught up and there was a leader."""
        self._cameras: dict[str, asyncio.Task[None]] = {}
        self._asking: asyncio.Task[None] | None = None

    async def run(self, stop: asyncio.Event) -> None:
        """Record until `stop`, which a failure sets too. Its token: an RCM's state was read. Raises RecorderFailed."""
        self._supervisor = Supervisor("the recorder", lambda _: stop.set())
        keys, subscribe, guard = self.mesh.keys, self.mesh.subscribe, self._supervisor.guard
        self._declared = [
            subscribe(keys.grants, messages.Grants, guard(self._on_grants), depth=DEPTH),
            subscribe(keys.notice_any, messages.Notice, guard(self._on_notice), depth=DEPTH),
            subscribe(keys.rc_state_any, messages.RcState, guard(self._on_rc_state), depth=DEPTH),
            subscribe(keys.load_any, messages.LoadReport, guard(self._on_load)),
            subscribe(keys.placements, messages.Placements, guard(self._on_placements), depth=DEPTH),
            self.mesh.watch(keys.alive_any(), guard(self._on_token)),
        ]
        self.mesh.watch_links()
        if self._where is not None:
            self._declared.append(self.mesh.serve(keys.recorded(self.mesh.me), messages.RecordedAsk, self._send_place))
        # Not among `_declared`: reading the RCM's state would not restore what these miss.
        behavior, poses = guard(self._on_behavior), guard(self._on_poses)
        robots = [
            subscribe(keys.behavior_any, messages.BehaviorSaid, behavior, depth=ROBOT_DEPTH, limit=MAX_REPORT),
            subscribe(keys.building_poses_any, messages.BuildingPoses, poses, depth=ROBOT_DEPTH, limit=MAX_POSES),
        ]
        self._wanted.set()
        self._placer_wanted.set()
        work = [self._keep_reading(), self._keep_asking_placer(), self._keep_asking_for_bookings(), self._tick()]
        if self.past > 0:
            work.append(self._show_past())
        for task in work:
            self._supervisor.spawn(task)
        try:
            await stop.wait()
            if self._supervisor.error is not None:
                raise RecorderFailed from self._supervisor.error
            # Earlier publications may still be on their way. An answer of the RCM arrives after all its publications;
            # without a leader there is nothing to wait for.
            await self._read()
        finally:
            await self._supervisor.close()
            for declared in [*robots, *reversed(self._declared)]:
                declared.close()

    def now(self) -> float:
        """Seconds of the timeline."""
        return (self.mesh.now() - self._zero) / SECOND

    def _send_place(self, request: IncomingQuery[messages.RecordedAsk]) -> None:
        if self._where is not None:
            request.answer(self._where())

    def _on_grants(self, _key: str, grants: messages.Grants) -> None:
        if self._requests.grants(self.now(), grants):
            self._wanted.set()

    def _on_notice(self, key: str, notice: messages.Notice) -> None:
        if str(self.mesh.keys.sender_of(key)) == notice.client:
            self._requests.notice(self.now(), notice)

    def _on_rc_state(self, key: str, state: messages.RcState) -> None:
        """End holds that the RC ended, even without an RCM to publish that."""
        if self.mesh.keys.rc_of(key) != state.rc:
            return
        at = self.now()
        if state.ended:
            self._requests.dropped(at, state.rc, {ended.grant for ended in state.ended})
        if CAMERA_FIGURE in state.figures and (state.host, Role.RC, state.rc) in self._tokens:
            self._follow_camera(at, state.rc, alive=True)
        self._robots.state(at, state)

    def _on_load(self, key: str, report: messages.LoadReport) -> None:
        host, at = self.mesh.keys.host_of(key), self.now()
        if host == report.host:
            self._hosts.load(at, host, report.load_average[0], report.cpu / 100)
            self._hosts.uses(at, host, report.components)

    def _on_token(self, token: Token, alive: bool) -> None:
        instances = self._tokens.setdefault((token.host, token.role, token.name), set())
        before = bool(instances)
        (instances.add if alive else instances.discard)(token.instance)
        if not instances:
            del self._tokens[token.host, token.role, token.name]
        if token.role == Role.RCM:
            if alive:
                self._wanted.set()
                self._placer_wanted.set()
                self._bookings_wanted.set()
        elif bool(instances) == before:
            return
        at = self.now()
        if token.role == Role.CLIENT and not alive:
            self._robots.left(at, Sender(token.host, token.name))
        if token.role == Role.RC and (token.name.startswith(CAMERAS) or not alive):
            self._follow_camera(at, token.name, alive)
        level = "INFO" if alive or token.role == Role.CLIENT else "WARN"
        if token.role == Role.RCM:
            self.timeline.event(at, LEADS[alive].format(host=token.host), level)
        elif token.role in PRESENCE:
            self.timeline.presence(at, PRESENCE[token.role][alive].format(host=token.host, name=token.name), level)
        # Until the state was read, it is unknown whether a new RC is free.
        if token.role == Role.RC and self._requests.offer(token.name, token.host, alive) and self._caught_up.is_set():
            self._requests.rc(at, token.name, alive)
            # The leader decides its holders, and whether it is present.
            self._wanted.set()

    async def _keep_reading(self) -> None:
        known, read_at = 0, 0.0
        while True:
            if not await done_within(CHECK_EVERY, self._wanted.wait()):
                missed = sum(declared.missed for declared in self._declared)
                if missed == known:
                    if not self._requests.in_doubt or self.now() - read_at < DOUBT_EVERY:
                        continue
                else:
                    log.warning("%d publications were missed; the state is read", missed - known)
                    known = missed
                    self._placer_wanted.set()
            self._wanted.clear()
            read_at = self.now()
            if not await self._read() and self._led:
                await asyncio.sleep(PAUSE)
                self._wanted.set()

    async def _read(self) -> bool:
        """Return True if the state is known now. Without a leader, the token of the next wakes `_keep_reading`."""
        key, ask = self.mesh.keys.ask_state(self.mesh.me), messages.StateAsk()
        replies = await self.mesh.ask(key, ask, messages.RcmState, timeout=READ_TIMEOUT)
        states = [reply.message for reply in replies if reply.message is not None]
        newest = max(states, key=lambda state: (state.term, state.seq), default=None)
        if newest is None or not self._requests.state(self.now(), newest):
            return False
        if not self._caught_up.is_set():
            self._caught_up.set()
            me = self.mesh.me
            self._declared.append(self.mesh.alive(Token(me.host, Role.RECORDER, me.client, new_instance())))
        return True

    async def _keep_asking_placer(self) -> None:
        """Query the placer at the start, and whenever publications may have been missed. Does not return."""
        key, failed = self.mesh.keys.placer(self.mesh.me), 0
        while True:
            if await done_within(AGAIN if 0 < failed < TRIES else None, self._placer_wanted.wait()):
                failed = 0
            self._placer_wanted.clear()
            self._fresher = fresher = set[str]()
            reply = await self.mesh.ask_one(key, messages.ListPlacements(), messages.Placements, timeout=READ_TIMEOUT)
            self._fresher = None
            if reply is None or reply.message is None:
                failed += 1
            else:
                failed = 0
                self._hosts.placements(self.now(), reply.message, fresher)

    def _on_placements(self, _key: str, news: messages.Placements) -> None:
        if self._fresher is not None and len(self._fresher) < MAX_FOLLOWED:
            self._fresher.update(placement.component for placement in news.components)
            self._fresher.update(news.forgotten)
        self._hosts.placements(self.now(), news)

    async def _keep_asking_for_bookings(self) -> None:
        """Query bookings periodically. Does not return."""
        key, ask = self.mesh.keys.ask_bookings(self.mesh.me), messages.BookingsAsk()
        while True:
            self._bookings_wanted.clear()
            reply = await self.mesh.ask_one(key, ask, messages.BookingsTold, timeout=READ_TIMEOUT)
            answer = reply.message if reply is not None else None
            if answer is not None:
                self._bookings.take(self.now(), answer)
            many = len(answer.bookings) / MANY_BOOKINGS if answer is not None else 1.0
            await done_within(BOOKINGS_EVERY * max(1.0, many), self._bookings_wanted.wait())

    async def _show_past(self) -> None:
        """Draw the holds before second 0, once journals answer."""
        await self._caught_up.wait()
        await asyncio.sleep(COMMITTED)
        for _ in range(TRIES):
            ago = self._wall() - self._epoch
            asked = messages.HistoryAsk(since=ago + self.past, until=ago)
            try:
                history = await ask_journals(self.mesh, self.fleet, asked, MAX_PAST, wall=self._wall)
            except NoJournal as error:
                log.info("the past is not shown: %s", error)
                await asyncio.sleep(AGAIN)
                continue
            past = await asyncio.to_thread(past_of, history, self._epoch, self.past, self.fleet.operator_priority)
            self.timeline.past(self.past, past.lanes)
            for text in past.words:
                self.timeline.event(self.now(), text)
            for text in past.gaps:
                self.timeline.warn(self.now(), text)
            return

    @property
    def _led(self) -> bool:
        return any(role == Role.RCM for _, role, _ in self._tokens)

    def _show_banner(self, at: float) -> None:
        """Explain above the panes why they may be empty or outdated, after BANNER_AFTER seconds."""
        if self._caught_up.is_set() and self._led:
            self._sound = at
            text = ""
        elif at - self._sound < BANNER_AFTER:
            return
        elif self._led:
            text = (
                "Catching up: waiting for the leader's list of devices and requests. The panes fill when it has come."
            )
        elif self._caught_up.is_set():
            since = datetime.fromtimestamp(self._epoch + self._sound, UTC)
            text = f"No leader since {since:%H:%M:%S} UTC. Holders and waiting requests are shown as they were then."
        else:
            text = "Catching up: no leader is seen yet. Devices and requests appear as soon as one leads."
        self.timeline.banner(text)

    async def _tick(self) -> None:
        while True:
            await asyncio.sleep(TICK)
            at = self.now()
            self._show_banner(at)
            self._robots.tick(at)
            self._bookings.tick(at)
            self.timeline.regroup(at)

    def _follow_camera(self, at: float, camera: str, alive: bool) -> None:
        if alive and self.frames and camera not in self._cameras and len(self._cameras) < MAX_CAMERAS:
            self._cameras[camera] = self._supervisor.spawn(self._look(camera))
        elif not alive and camera in self._cameras:
            self._cameras.pop(camera).cancel()
            self._robots.no_frame(at, camera)

    async def _look(self, camera: str) -> None:
        """Record a camera's newest picture whenever the next is due."""
        with closing(self.mesh.frames(self.mesh.keys.frame(camera))) as watch:
            while True:
                frame = await watch.next(NO_PICTURE)
                if frame is None:
                    self._robots.no_frame(self.now(), camera)
                    continue
                self._robots.frame(self.now(), camera, frame.head, frame.jpeg)
                await asyncio.sleep(1 / self.frames)

    def _on_behavior(self, key: str, report: messages.BehaviorSaid) -> None:
        self._robots.behavior(self.now(), self.mesh.keys.sender_of(key), report)

    def _on_poses(self, key: str, poses: messages.BuildingPoses) -> None:
        at = self.now()
        self._robots.floor.poses(at, self.mesh.keys.sender_of(key), poses)
        if self._asking is None or self._asking.done():
            sender = self._robots.floor.wants_plan(at)
            if sender is not None:
                self._asking = self._supervisor.spawn(self._ask_plan(sender))

    async def _ask_plan(self, sender: Sender) -> None:
        key, ask, limit = self.mesh.keys.building_plan(sender), messages.PlanAsk(), messages.MAX_PLAN
        replies = await self.mesh.ask(
            key, ask, messages.BuildingPlan, timeout=READ_TIMEOUT, enough=lambda _: True, limit=limit
        )
        for reply in replies:
            if reply.message is not None:
                self._robots.floor.plan(self.now(), sender, reply.message)
