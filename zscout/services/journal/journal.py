"""A candidate's journal: gathers publications of its leader and the RCs, commits them in a thread, answers queries.

The event loop only appends. At most once a second a thread derives the changes and commits them together."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from zscout.config.node import JournalConfig
from zscout.keyexpr import check_need
from zscout.mesh import Declaration, IncomingQuery, Mesh, MeshError
from zscout.mesh.supervision import Supervisor, done_within
from zscout.messages import Grants, HistoryAsk, JournalGap, PastHold, Problem, RcmState, RcState, StateAsk
from zscout.services.journal.follower import (
    Change,
    ClockSet,
    Follower,
    Observation,
    PublicationReceived,
    StateRead,
    UseReported,
)
from zscout.services.journal.store import Damaged, JournalStore, Unwritable
from zscout.types import NO_TERM, SECOND, Grant, Ns, RcName, Term

log = logging.getLogger(__name__)

COMMIT_EVERY: Final = 1.0  # seconds between two commits
HEARD_EVERY: Final = 30.0  # seconds after which the last publication of a quiet RCM is stored
READ_EVERY: Final = 2.0  # seconds between two queries for the RCM's state, while it is needed
AGAIN_AFTER: Final = 30.0  # seconds until a failed disk is retried
MAX_GATHERED: Final = 100_000  # holders and ends awaiting a commit; further ones are dropped, and make a gap
MAX_USES: Final = 10_000  # reports of use awaiting a commit, or remembered against duplicates
MAX_LATEST: Final = 5_000  # holds passed to `on_opened`
MAX_ASKING: Final = 16  # queries answered at one time
ENDS_WITHIN: Final = 5.0
STEADY: Final[Ns] = 600 * SECOND  # after the wall clock was set, until which no hold is removed for its age
CLOCK_SET: Final = 2.0  # a change of the wall clock against the mesh's, in seconds, that means it was set
MEGABYTE: Final = 1_000_000


class Journal:
    """The journal of one node. `silent`: seconds without publications that mean a lost leader."""

    def __init__(
        self,
        mesh: Mesh,
        folder: Path,
        config: JournalConfig,
        silent: float,
        wall: Callable[[], float] = time.time,
        on_opened: Callable[[list[PastHold]], object] = lambda _: None,
    ) -> None:
        """`wall`: seconds since 1970, UTC. `on_opened` gets the latest holds once, in the loop, oldest first."""
        self._mesh, self._silent, self._wall, self._on_opened = mesh, silent, wall, on_opened
        self._store = JournalStore(folder, config.max_age / SECOND, config.max_size * MEGABYTE)
        self._supervisor = Supervisor(
            "the journal", lambda _: log.error("no journal is written until this node restarts")
        )
        self._gathered: list[Observation] = []
        self._weight = 0  # of the gathered events
        self._uses: dict[tuple[RcName, Grant], float] = {}  # most seconds of use since the last commit
        self._reported: OrderedDict[RcName, dict[Grant, tuple[float, bool]]] = OrderedDict()
        """By RC and grant: seconds of the last report, and True if the hold ended."""
        self._reported_count = 0
        self._number: tuple[Term, int] = NO_TERM, 0
        self._at: Ns | None = None  # last publication, by the mesh's clock
        self._set_at = mesh.now()
        self._ahead: float | None = None  # wall clock minus the mesh's clock at the last publication
        self._first = self._heard = 0.0  # times of the first and last publication known to this journal
        self._committed = 0.0  # time of the last publication that was stored as received
        self._dropped, self._dropped_since = 0, 0.0
        self._follower: Follower | None = None  # None while the file is not open
        self._pending: list[Change] = []  # derived, but not written
        self._opened = False
        self._troubled: str | None = None
        self._not_before: Ns = 0
        self._read_at: Ns = 0
        self._used_last = False  # True if an RC reported an ended hold
        self._ending = asyncio.Event()
        self._reading = asyncio.Lock()
        self._declared: list[Declaration] = []

    def start(self) -> None:
        mesh, guard = self._mesh, self._supervisor.guard
        self._declared = [
            mesh.serve(mesh.keys.history_any(mesh.me.host), HistoryAsk, guard(self._on_asked), unanswered=MAX_ASKING),
            # The candidate has an equal subscription: a state is decoded once.
            mesh.subscribe(mesh.keys.rc_state_any, RcState, guard(self._on_rc_state)),
        ]
        self._keeping = self._supervisor.spawn(self._keep())

    async def stop(self) -> None:
        """Return once all events are on disk."""
        for declared in self._declared:
            declared.close()
        self._ending.set()
        await asyncio.wait([self._keeping], timeout=ENDS_WITHIN)
        await self._supervisor.close()

    def observe(self, grants: Grants) -> None:
        """Takes publications and heartbeats. Never raises: candidates also lead without a journal."""
        try:
            if self._supervisor.active:
                self._observe(grants)
        except Exception as error:  # noqa: BLE001 - `fail` logs it
            self._supervisor.fail(error)

    def _observe(self, grants: Grants) -> None:
        now, at, number = self._mesh.now(), self._wall(), (grants.term, grants.seq)
        silence = 0.0 if self._at is None else (now - self._at) / SECOND
        ahead, before = at - now / SECOND, self._ahead
        if before is not None and abs(ahead - before) > CLOCK_SET:
            self._set_at = now
            self._gather(ClockSet(ahead - before), at)
        self._ahead = ahead
        self._at, self._heard, self._first = now, at, self._first or at
        if grants.rcs or grants.revoked or number != self._number or silence > self._silent:
            self._gather(PublicationReceived(at, silence, grants), at)
        self._number = number

    def _gather(self, event: Observation, at: float) -> None:
        if self._weight + len(self._pending) + (weight := _weight(event)) > MAX_GATHERED:
            self._dropped_since = self._dropped_since if self._dropped else at
            self._dropped += 1
            return
        self._weight += weight
        self._gathered.append(event)

    def _on_rc_state(self, key: str, state: RcState) -> None:
        if self._mesh.keys.rc_of(key) != state.rc or not (state.used or state.rc in self._reported):
            return
        holds, current, before = {holder.grant for holder in state.holders}, {}, self._reported.pop(state.rc, {})
        for use in state.used:
            ended = state.leaving or use.grant not in holds
            if (use.seconds, ended) > before.get(use.grant, (-1.0, False)):
                hold = state.rc, use.grant
                if hold not in self._uses and len(self._uses) >= MAX_USES:
                    continue  # the RC repeats it
                self._uses[hold] = max(use.seconds, self._uses.get(hold, 0.0))
                self._used_last |= ended
            current[use.grant] = use.seconds, ended
        if current:
            self._reported[state.rc] = current
        self._reported_count += len(current) - len(before)
        while self._reported_count > MAX_USES:
            self._reported_count -= len(self._reported.popitem(last=False)[1])

    async def _keep(self) -> None:
        while not self._ending.is_set():
            await done_within(COMMIT_EVERY, self._ending.wait())
            now = self._mesh.now()
            news = self._gathered or self._pending or self._dropped or self._heard - self._committed > HEARD_EVERY
            # Use under open holds grows continuously: it is written only with other changes.
            news = news or self._used_last
            last = self._ending.is_set() and self._heard > self._committed
            # The file is opened before any publication, to answer queries.
            if last or (now >= self._not_before and (news or self._follower is None)):
                await self._commit()
            if self._follower is not None and self._follower.must_read and now - self._read_at > READ_EVERY * SECOND:
                self._read_at = now
                self._supervisor.spawn(self._read())
        await asyncio.to_thread(self._store.close)

    async def _commit(self) -> None:
        try:
            if self._follower is None:
                open_holds, left = await asyncio.to_thread(self._store.open)
                latest = [] if self._opened else await asyncio.to_thread(self._store.latest, MAX_LATEST)
                self._follower = Follower(self._silent, open_holds, left)
                if not self._opened:
                    self._opened = True
                    self._on_opened(latest)
            await self._write(self._follower)
        except Unwritable as error:
            self._trouble(error)
        else:
            if self._troubled is not None:
                log.info("the journal can be written again")
                self._troubled = None

    async def _write(self, follower: Follower) -> None:
        """Write all gathered and pending events. Raises Unwritable."""
        events, self._gathered, self._weight, heard = self._gathered, [], 0, self._heard
        if self._uses and heard:
            # After the starts and ends received before.
            events.append(UseReported([(*key, seconds) for key, seconds in self._uses.items()]))
            self._uses, self._used_last = {}, False
        dropped, self._dropped = self._dropped, 0
        steady = self._mesh.now() - self._set_at > STEADY
        gap = JournalGap(self._dropped_since, self._wall(), "dropped", dropped) if dropped else None

        def write() -> None:
            for event in events:
                self._pending += follower.take(event)
            if gap is not None:
                self._pending += follower.lost(gap)
            if heard:
                self._store.commit(self._pending, self._first, heard, self._wall() if steady else 0.0)

        await asyncio.to_thread(write)
        self._pending, self._committed = [], heard

    def _trouble(self, error: Unwritable) -> None:
        """Retry pending changes later, with newer ones."""
        if isinstance(error, Damaged):
            # The new file lacks the open holds, and the pending changes.
            self._follower, self._pending, self._first = None, [], self._wall()
            self._reported.clear()
            self._reported_count = 0
            return
        self._not_before = self._mesh.now() + round(AGAIN_AFTER * SECOND)
        if self._troubled != str(error):
            self._troubled = str(error)
            log.warning("the journal can't be written: %s; retrying every %g s", error, AGAIN_AFTER)

    async def _read(self) -> None:
        try:
            asked = StateAsk(holds_only=True)
            replies = await self._mesh.ask(self._mesh.keys.rcm_state, asked, RcmState, timeout=READ_EVERY)
        except MeshError as error:
            log.debug("the RCM's state was not read: %s", error)
            return
        for state in (reply.message for reply in replies if reply.message is not None):
            self._gather(StateRead(at := self._wall(), state), at)

    def _on_asked(self, query: IncomingQuery[HistoryAsk]) -> None:
        if query.message.rc is not None:
            check_need(query.message.rc)
        self._supervisor.spawn(self._answer(query))

    async def _answer(self, query: IncomingQuery[HistoryAsk]) -> None:
        asked, now = query.message, self._wall()
        try:
            # The store answers one query at a time: further threads of the shared pool would only wait.
            async with self._reading:
                answer = await asyncio.to_thread(self._store.answer, self._mesh.me.host, asked, now)
        except Unwritable as error:
            query.refuse(Problem("no_journal", str(error)))
            return
        silent_for = 0.0 if self._at is None else (self._mesh.now() - self._at) / SECOND
        if asked.before is None and silent_for > self._silent:
            answer = replace(answer, gaps=[*answer.gaps, JournalGap(self._heard, None, "silent")])
        query.answer(answer)


def _weight(event: Observation) -> int:
    """Rough size of an event's records."""
    match event:
        case StateRead():
            return 1 + len(event.state.holds)
        case PublicationReceived():
            return 1 + sum(map(len, event.grants.rcs.values())) + len(event.grants.revoked)
        case _:
            return 1
