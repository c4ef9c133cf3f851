"""A resource controller (RC) on the mesh: the part that every driver shares.

A driver (`driver.py`) controls its device; `ResourceController` owns the keys, checks every command against its time to
live and the hold in force when it is carried out, votes, and puts the device into its safe state when its holder is
gone.

When the holder's client dies, the leader notices (`rcm/roster.py`), and its next publication no longer has the hold. A
node that loses the mesh receives no publication of a leader: after the hold lease `HoldTable.expire` (`holds.py`)
ends the holds, and `_make_safe` follows."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable, Collection
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from msgspec import structs

from zscout import messages, trace
from zscout.config import devices
from zscout.drivers.confirm_server import CommandQuery, ConfirmServer
from zscout.drivers.driver import Driver
from zscout.drivers.holds import HoldChange, HoldTable
from zscout.drivers.instances import Instances, InstanceState
from zscout.drivers.last_holder import LastHolder
from zscout.drivers.own import RcDirectory
from zscout.drivers.repeated import CommandMemory
from zscout.drivers.tolerance import Tolerance
from zscout.drivers.use import UseCounter
from zscout.drivers.work_queue import COMMANDS_PER_HOST, WorkQueue
from zscout.keyexpr import Role, Token, new_instance
from zscout.mesh import Declaration, IncomingQuery, Mesh, Refused, Reply, Supervisor, Tally
from zscout.mesh.renewal import SILENT_RCM_PATIENCE
from zscout.mesh.supervision import Alarm, StallWatch
from zscout.mesh.terms import LastTerms
from zscout.scheduling.reason import starting
from zscout.types import NO_TERM, SECOND, VERSION, Grant, Ns, Term

if TYPE_CHECKING:
    from zscout.mesh.frames import FramePublisher

log = logging.getLogger(__name__)

MIN_EXPIRY_DELAY_S = 0.02
"""Until overdue holds are checked again."""
MAX_TTL = 60.0
LEADERLESS = 5.0
"""Seconds: longer than an election takes."""
REREAD_TIMEOUT = 0.5
"""Seconds for the answer to one query for `rcm/state`."""
REREADS = 4
"""Queries in a row when publications overtake the answers."""
SETTLE: Final = devices.SETTLE / SECOND
"""Seconds within which a program must be gone, from when its client learned of the end of its direct hold. Also the
time within which a device must be safe."""
SAFE_WAIT_S: Final = 0.1
"""How long the next work waits until the device is safe. Later commands are answered `settling`."""
NEVER_HELD_BACK: Final = ("stop", "halt")
COMMAND_QUEUE = 64
EARLY_WAIT_S: Final = 0.25
"""How long a command under an unknown grant waits for the publication of this grant."""
INFORMED_WITHIN: Final = 1.0
"""Seconds from its start until an RC knows the leader, if there is one."""
CHECK_PERIOD_S = 0.5
"""Between two checks that the visible leaders publish and ask for promises."""
FIGURES_PERIOD = 1.0
"""Seconds between two publications of changed figures."""
WAITS_DELAY_S: Final = 0.05
"""After this time an RC publishes that a new holder waits for the device to begin."""
BEGUN_POLL_S: Final = 0.1
"""Between two checks whether a device has begun."""
REPUBLISH_PERIOD_S = 10.0
"""An RC publishes an unchanged state after this time, for receivers that missed a change."""


class ResourceController:
    """One RC: its keys, its holds and its driver. If the RC itself fails, rather than its driver, it leaves the mesh,
    makes its device safe and calls `on_failure`.

    `hold_lease`, `settle` and `begin_within` are in seconds; `begin_within` defaults to the driver's. Without a
    `tolerance` an unwell device is lost at once. `last_holder` outlives the RC. `confirmations` is shared by all RCs of
    the process; by default the RC has its own."""

    def __init__(
        self,
        mesh: Mesh,
        name: str,
        driver: Driver,
        *,
        hold_lease: float,
        stall: StallWatch,
        settle: float = SETTLE,
        begin_within: float | None = None,
        tolerance: Tolerance | None = None,
        last_holder: LastHolder | None = None,
        confirmations: ConfirmServer | None = None,
        on_failure: Callable[[Exception], object] = lambda _error: None,
    ) -> None:
        self.mesh, self.name, self.driver = mesh, name, driver
        self.instance = new_instance()
        lease, self._settle = round(hold_lease * SECOND), round(settle * SECOND)
        self.holds = HoldTable(name, hold_lease=lease, settle=self._settle, instance=self.instance, begins=True)
        self._begin_within = begin_within
        self._longest_begin = 0.0
        """Seconds: the longest beginning that its driver has announced."""
        self._last_holder, self._noting = last_holder or LastHolder(), asyncio.Lock()
        self._confirmations = confirmations or ConfirmServer(mesh)
        self.rules = 0
        self.health = "ok"
        self._tolerance = tolerance or Tolerance(0, 0, 0)
        self.queue, self._memory = WorkQueue(), CommandMemory()
        self.tally = Tally()
        """How its commands ended."""
        self._use = UseCounter()
        self.directory = RcDirectory(mesh) if driver.relays else None
        self.stall, self._on_failure = stall, on_failure
        self.supervisor = Supervisor(name, self._failed)
        self.instances = Instances(
            mesh, name, self.instance, self.supervisor, self._on_instance_state, patience=hold_lease + settle
        )
        self._leaders: set[Token] = set()
        self._asked: Term = NO_TERM
        """The newest term promised to a query to this instance."""
        self._last_published: Ns | None = None
        """When the last publication of the obeyed RCM arrived. Its answers do not count."""
        self._published_since_token = False
        """True if it has published since a token of an RCM last appeared or disappeared: an RCM that died has not."""
        self._is_open = False
        """True while its driver is open."""
        self._served: list[Declaration] = []
        """Its queryables, which depend on its state among the instances of this RC."""
        self._declared: list[Declaration] = []
        self._warm_at: Ns = 0
        self._at_driver: set[Grant] = set()
        """Holds that have begun at the driver."""
        self._held_back: dict[Grant, messages.Holder] = {}
        """Holds that have not: a former holder's program may still use the device, or it is being made safe."""
        self._entered: set[Grant] = set()
        """Holds whose `begin` at the driver has returned: the device may still be starting."""
        self._published_waits: set[Grant] = set()
        """Holds that were published as waiting for the device."""
        self._beginning: asyncio.Task[None] | None = None
        """Polls until the device has begun."""
        self._making_safe: asyncio.Task[None] | None = None
        self._safe_by: Ns = 0
        """When `_making_safe` must be done."""
        self._safe_again = False
        """True if the device must be made safe again after `_making_safe`."""
        self._last_terms = LastTerms(mesh, self.supervisor, self.holds.catch_up, timeout=REREAD_TIMEOUT)
        self._reading: asyncio.Task[None] | None = None
        self._missed = False
        """True if it missed something and has not read `rcm/state` since."""
        self.informed = asyncio.Event()
        self._published = mesh.now()
        """When it last published its state."""
        self._alarm = Alarm(mesh.now, self.supervisor, self._expire)
        self._waits_timer: asyncio.TimerHandle | None = None
        """Runs while the device has not begun for some holders that were not published as waiting."""
        self._stopping: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Start without holds. Obey no command before subscribing to grants and then reading `rcm/state`."""
        keys, mesh, guard = self.mesh.keys, self.mesh, self.supervisor.guard
        self._state = mesh.publisher(keys.rc_state(self.name), messages.RcState)
        self._declared.append(mesh.watch(keys.alive_any(Role.RCM), guard(self._on_leader)))
        self._declared.append(self.instances.watch())
        if self._last_holder.may_be_direct:
            log.warning("%s settles: a direct hold may have been in force before its start", self.name)
            self.holds.settle_at_start(mesh.now())
            self._set_alarm()
        self._declared.append(mesh.subscribe(keys.grants, messages.Grants, guard(self._on_grants)))
        await asyncio.wait({self._read_state()})
        self.supervisor.call_later(INFORMED_WITHIN, self.informed.set)
        if self.directory is not None:
            self._declared.append(self.directory.watch())
        # If another instance is there, its holder may have the device: the driver must not touch it on opening.
        self.instances.begin()
        await self.driver.open(self)
        # Raises Malformed if the driver's figures, capacity or parameters are unreadable: it is not offered then.
        messages.decode(messages.encode(self._rc_state([])), messages.RcState)
        self.supervisor.spawn(self._worker())
        self.supervisor.spawn(self._publish_figures())
        self.supervisor.spawn(self._keep_checking())
        self._is_open = True
        self._serve()
        self._declared.append(mesh.alive(Token(mesh.me.host, Role.RC, self.name, self.instance)))

    def _serve(self) -> None:
        for declared in self._served:
            declared.close()
        keys, mesh, state = self.mesh.keys, self.mesh, self.instances.state
        self._served = []
        if state is not InstanceState.STANDS_BY:
            self._served.append(mesh.serve(keys.rc_state(self.name), messages.RcAsk, self._on_state_query))
            if keys.closed:
                self._served.append(mesh.serve(keys.asked_state_any(self.name), messages.RcAsk, self._on_question))
        if state is InstanceState.SERVES:
            if self.driver.sharable:
                self._served.append(mesh.serve(keys.vote(self.name), messages.Proposal, self._on_proposal))
            command = keys.command_any(self.name)
            taken = mesh.serve(command, messages.Command, self._on_command, depth=2 * COMMAND_QUEUE, tally=self.tally)
            self._served.append(taken)
            self._served.append(self._confirmations.serve(self.name, self._on_command))

    def _on_instance_state(self) -> None:
        if self._is_open:
            self._serve()
            self.publish()

    async def stop(self) -> None:
        """Leave the mesh and make the device safe. May be called several times."""
        if self._stopping is None:
            self._stopping = asyncio.get_running_loop().create_task(self._stop())
        await asyncio.shield(self._stopping)

    async def _stop(self) -> None:
        self._is_open = False
        for declared in (*self._served, *reversed(self._declared)):
            declared.close()
        await self.supervisor.close()
        # While another instance serves, its holder has the device.
        if self.instances.state is not InstanceState.STANDS_BY or self._at_driver:
            await self._guard(self._make_safe_in_time())
        # If a program may still use the device, the RCM must not choose another instance at once.
        self._state.put(self._rc_state([], leaving=not self._last_holder.may_be_direct))
        await self._guard(self.driver.close())
        self._state.close()

    def _failed(self, error: Exception) -> None:
        self._stopping = asyncio.get_running_loop().create_task(self._stop())
        self._on_failure(error)
        self.fail(f"its resource controller failed: {error}")  # this may raise as well

    def now(self) -> Ns:
        return self.mesh.now()

    def holders(self) -> list[messages.Holder]:
        return self.holds.holders(self.mesh.now())

    def frame_publisher(self) -> FramePublisher:
        return self.mesh.frame_publisher(self.mesh.keys.frame(self.name))

    def rules_changed(self) -> None:
        self.rules += 1
        self.publish()

    def unwell(self, why: str) -> None:
        if self.health != "ok":
            self.fail(why)
            return
        news = why != self._tolerance.why
        self._tolerance.unwell(why, self.mesh.now())
        if not self._lost_by_now():
            if news:
                log.warning("%s is unwell: %s", self.name, why)
            self.publish()
            self._set_alarm()

    def _lost_by_now(self) -> bool:
        """Return True if the device has been unwell for longer than is tolerated, and mark it as lost."""
        at, why = self._tolerance.lost_at, self._tolerance.why
        if at is None or at > self.mesh.now():
            return False
        self.fail(why)
        return True

    def fail(self, why: str) -> None:
        if why != self.health:
            log.warning("%s is lost: %s", self.name, why)
        self.health = why
        self._tolerance.well()
        change = self.holds.fail(why, self.mesh.now())
        if change:
            self._trace("end")
        self._apply(change)
        self.publish()

    def used(self, grant: Grant) -> None:
        now = self.mesh.now()
        self._use.carried_out(grant, now, now)

    def recover(self) -> None:
        if self.health != "ok" or self._tolerance.why:
            log.info("%s is well", self.name)
        self.health = "ok"
        self._tolerance.well()
        self.publish()
        self._set_alarm()

    @property
    def begin_within(self) -> float:
        """The longest time in seconds from a grant until the device has begun, without settling."""
        own = self._begin_within
        return max(self.driver.begin_within, self._longest_begin) if own is None else own

    def publish(self, ended: list[messages.EndedHold] | None = None) -> None:
        self._published, self._use.unpublished = self.mesh.now(), False
        self._state.put(self._rc_state(ended or []))

    def _on_leader(self, token: Token, alive: bool) -> None:
        (self._leaders.add if alive else self._leaders.discard)(token)
        self._published_since_token = False
        if not alive and self._asked.rcm == token.instance:
            # A leader from which this RC was cut off asks it again.
            self._asked = NO_TERM

    def _on_grants(self, _key: str, grants: messages.Grants) -> None:
        now, before = self.mesh.now(), (self.holds.term, self.holds.seq)
        # The timer of a lease is not moved here: when it fires it is set again, as most leases are renewed in time.
        change = None if self.holds.follow(grants, now) else self._apply_grants(grants, now)
        if grants.term == self.holds.term:
            self._last_published = now
            self._published_since_token = True
        if change or before != (self.holds.term, self.holds.seq):
            self._trace("hear")
        if change is not None:
            self._apply(change)
        if self._missed:
            self._read_state()

    def _apply_grants(self, grants: messages.Grants, now: Ns) -> HoldChange:
        self._last_terms.shown(grants.term, self.holds.term)
        sharable, stalled = self.driver.sharable, self.stall.fresh()
        return self.holds.apply_grants(grants, now, sharable=sharable, stalled=stalled)

    def _on_state_query(self, query: IncomingQuery[messages.RcAsk]) -> None:
        if query.message.above is None:
            self._promise(query, above=False)
        else:
            self.supervisor.spawn(self._promise_above(query, query.message.above))

    def _on_question(self, query: IncomingQuery[messages.RcAsk]) -> None:
        query.answer(self._rc_state([]))

    async def _promise_above(self, query: IncomingQuery[messages.RcAsk], host: str) -> None:
        seen = await self.mesh.living(self.mesh.keys.alive_any(Role.CANDIDATE), timeout=REREAD_TIMEOUT)
        try:
            self._promise(query, above=any(token.host == host for token in seen))
        except Refused as refused:
            query.refuse(refused.problem)

    def _promise(self, query: IncomingQuery[messages.RcAsk], *, above: bool) -> None:
        promise = query.message.promise
        if promise is not None:
            self._last_terms.shown(promise, self.holds.term)
        promised = promise is not None and self.holds.promise(promise, self.mesh.now(), above=above)
        if promise is not None and not promised and not query.message.ordinary:
            raise Refused(
                "old_term", f"{self.name} has promised to obey term {self.holds.term.counter}", self.holds.term
            )
        if promise is not None and promised:
            if query.message.instance in (None, self.instance):
                self._asked = promise
            self._trace("promise", promised=promise)
        query.answer(self._rc_state([]))

    def _rc_state(self, ended: list[messages.EndedHold], *, leaving: bool = False) -> messages.RcState:
        waits = {} if leaving else self._waits()
        self._published_waits |= waits.keys()
        # A leader counts only while it publishes: the token of a hanging program remains.
        return messages.RcState(
            rc=self.name,
            host=self.mesh.me.host,
            instance=self.instance,
            sharable=self.driver.sharable,
            term=self.holds.term,
            # 0 means incomplete: from a complete state, an RCM takes missing holds for lost.
            seq=0 if self._missed else self.holds.seq,
            holders=self.holds.holders(self.mesh.now(), waits),
            ended=ended,
            health=self.health,
            unwell=self._unwell(),
            rules=self.rules,
            leader=self._receives and bool(self._leaders),
            # When leaving, the driver is not called any more: it may have failed.
            capacity={} if leaving else self.driver.capacity(),
            figures={} if leaving else self._figures(),
            duplicate_of=self.instances.duplicate_of,
            leaving=leaving,
            settle=self._settle / SECOND,
            begin_within=self.begin_within,
            parameters=None if leaving else self.driver.parameters(),
            version=VERSION,
            used=self._use.report(self.mesh.now()),
        )

    @property
    def unwell_for(self) -> float:
        """Seconds; 0 if the device is well or lost."""
        return (self.mesh.now() - self._tolerance.since) / SECOND if self._tolerance.why else 0.0

    def _unwell(self) -> messages.Unwell | None:
        at = self._tolerance.lost_at
        if at is None:
            return None
        return messages.Unwell(self._tolerance.why, self.unwell_for, max(0, at - self.mesh.now()) / SECOND)

    def _figures(self) -> messages.Figures:
        """The driver's figures without NaN and infinity, which messages can't carry."""
        return {name: value for name, value in self.driver.figures().items() if math.isfinite(value)}

    def _on_proposal(self, query: IncomingQuery[messages.Proposal]) -> None:
        proposal = query.message
        try:
            reason = self.driver.vote(proposal.holders)
        except ValueError as error:
            reason = str(error) or "the driver can't read the proposal"
        query.answer(messages.Ballot(proposal=proposal.proposal, accept=not reason, reason=reason))

    def _on_command(self, query: CommandQuery) -> None:
        sender = self.mesh.keys.sender_of(query.key)  # refuses invalid names
        if not self._memory.is_new(sender, query):
            return
        # Commands without a grant, which stop robots, have room of their own.
        room = COMMAND_QUEUE if query.message.grant is not None else 2 * COMMAND_QUEUE
        if self.queue.commands >= room:
            raise Refused("busy", f"{self.name} has {COMMAND_QUEUE} commands waiting; try again")
        if not 0 < query.message.ttl <= MAX_TTL:
            raise Refused("bad_command", f"ttl must lie between 0 and {MAX_TTL:g} seconds")
        # They do not count against the limit of their host either.
        if not self.queue.put_command(query, sender.host if query.message.grant is not None else ""):
            raise Refused("busy", f"{COMMANDS_PER_HOST} commands of {sender.host} to {self.name} wait; try again")

    async def _worker(self) -> None:
        while True:
            work = await self.queue.get()
            if isinstance(work, HoldChange):
                await self._carry_out_change(work)
            elif not self._is_early(work):
                await self._answer(work, self._carry_out(work))
            elif self.queue.set_aside(work, self.mesh.keys.sender_of(work.key).host):
                # A client can know its grant before the RCs do. Most grants are published within this wait.
                left = work.message.ttl - self._waited(work) / SECOND
                self.supervisor.call_later(max(0.0, min(EARLY_WAIT_S, left)), self._read_for_early)
            else:
                work.refuse(Refused("busy", f"too many early commands for {self.name}; try again").problem)

    def _read_for_early(self) -> None:
        if self.queue.early:
            self._read_state()

    async def _carry_out(self, query: CommandQuery) -> Any:
        command = query.message
        sender = self.mesh.keys.sender_of(query.key)
        if self._is_stale(query):
            waited = f"{self._waited(query) / SECOND:.2f} s"
            raise Refused("stale", f"the command waited {waited}, longer than its ttl {command.ttl:g} s; send it again")
        if command.grant is None:
            return await self.driver.command_without_grant(sender, command.do)
        if (name := command.do.get("name")) in ("leaving", "left"):
            return self._on_program_end(command.grant, str(sender), gone=name == "left")
        self._raise_refusal(query)
        if name == "confirm":
            # Only the confirmation waits for the write to disk, not other work.
            direct = self.holds.held[command.grant].holder.direct
            return asyncio.ensure_future(self._confirm_direct(query)) if direct else self._confirm(command.grant)
        if name == "expect_outage":
            tolerated = self._tolerance.expect(command.grant, command.do, self.mesh.now())
            self._set_alarm()
            self.publish()
            return messages.Done(result={"seconds": tolerated})
        self._trace("command", grant=command.grant)
        warming = max(0.0, (self._warm_at - self.mesh.now()) / SECOND)
        if warming and not self.driver.usable_cold(command.do):
            raise Refused("warming", f"{self.name} is warming up; wait {warming:.1f} s")
        grant, began = command.grant, self.mesh.now()
        result = await self.driver.command(self.holds.held[grant].holder, command.do)
        if isinstance(result, asyncio.Future):
            result.add_done_callback(lambda done: self._on_done(grant, began, done))
        else:
            self._use.carried_out(grant, began, self.mesh.now())
        return result

    def _on_done(self, grant: Grant, began: Ns, done: asyncio.Future[Any]) -> None:
        if not done.cancelled() and done.exception() is None:
            self._use.carried_out(grant, began, self.mesh.now())

    def _on_program_end(self, grant: Grant, client: str, *, gone: bool) -> messages.Done:
        """The client of a direct hold reports that its program is leaving, or `gone`. Raises Refused."""
        report = self.holds.left if gone else self.holds.leaving
        result = report(grant, client, self.mesh.now())
        if isinstance(result, messages.Problem):
            raise Refused.by(result)
        self._apply(result)
        return messages.Done()

    def _confirm(self, grant: Grant) -> messages.Done:
        self._trace("command", grant=grant)
        warming = max(0.0, (self._warm_at - self.mesh.now()) / SECOND)
        return messages.Done(warming=warming, settle=self._settle / SECOND)

    async def _confirm_direct(self, query: CommandQuery) -> messages.Done:
        """Note the direct holder on disk before confirming its hold. Raises Refused."""
        grant = query.message.grant
        async with self._noting:
            if not self._last_holder.may_be_direct:
                try:
                    await self._last_holder.note(direct=True)
                except OSError as error:
                    why = f"{self.name} can't note its direct hold ({error}); check the state folder of its node"
                    raise Refused("failed", why) from None
            self._raise_refusal(query)
            assert grant is not None  # noqa: S101 - commands without a grant do not come here
            self.holds.confirmed(grant, self.mesh.now())
        return self._confirm(grant)

    async def _forget_direct(self) -> None:
        async with self._noting:
            if self._last_holder.may_be_direct and not self.holds.may_be_direct(self.mesh.now()):
                with suppress(OSError):  # then it settles once more than necessary
                    await self._last_holder.note(direct=False)

    def _raise_refusal(self, query: CommandQuery) -> None:
        if problem := self._refusal(query):
            raise Refused.by(problem)

    def _refusal(self, query: CommandQuery) -> messages.Problem | None:
        """Return why a command is not obeyed under its grant, or None if it is obeyed or has no grant."""
        grant, sender = query.message.grant, self.mesh.keys.sender_of(query.key)
        if grant is None:
            return None
        client, held, directory = str(sender), self.holds.held.get(grant), self.directory
        if held and directory and directory.is_node_of_gang(sender, held.holder, self.name):
            client = held.holder.client
        problem = self.holds.check(grant, client, self.mesh.now())
        if self._missed and problem is not None and problem.code in ("free", "not_holder"):
            # The state that is being read may contain the grant.
            return structs.replace(problem, code="not_yet", message=f"{self.name} is catching up; try again")
        if problem is None and grant in self._held_back and query.message.do.get("name") not in NEVER_HELD_BACK:
            until = max(self.holds.settles(grant) or 0, 0 if self._making_safe is None else self._safe_by)
            left = max(0.0, (until - self.mesh.now()) / SECOND)
            words = f"{self.name} is settling: a former holder may still use it; wait at most {left:.1f} s"
            return messages.Problem("settling", words, left=left)
        if (
            problem is None
            and (left := self.driver.begins_for())
            and query.message.do.get("name") not in NEVER_HELD_BACK
        ):
            return messages.Problem("settling", f"{self.name} is {starting(left)}", left=left)
        return problem

    def _waited(self, query: CommandQuery) -> Ns:
        """The longest time that a command may have waited: in the queue here, and in the network during a stall."""
        return self.mesh.now() - query.arrived + self.stall.waited_through(query.arrived)

    def _is_stale(self, query: CommandQuery) -> bool:
        """Return True if the command's time to live is over: it is refused then, not carried out."""
        return self._waited(query) > query.message.ttl * SECOND

    async def _answer(self, query: CommandQuery, work: Awaitable[Any]) -> None:
        try:
            result = await work
            if isinstance(result, asyncio.Future):
                self.supervisor.spawn(self._answer(query, result))
            else:
                query.answer(result if isinstance(result, messages.Done) else messages.Done(result=result))
        except Refused as refused:
            query.refuse(refused.problem)
        except Exception:
            log.exception("%s: a command failed", self.name)
            query.refuse(Refused("failed", f"the command failed at {self.name}; see the log of its node").problem)

    def _is_early(self, query: CommandQuery) -> bool:
        """Return True if the command has a grant that this RC does not know yet."""
        problem = self._refusal(query)
        return problem is not None and problem.code == "not_yet" and not self._is_stale(query)

    async def _carry_out_change(self, change: HoldChange) -> None:
        for holder in change.over:
            if holder.grant in self._at_driver:
                await self._guard(self.driver.end(holder))
        before = {holder.grant for holder in change.removed} & self._at_driver
        continued = change.continued
        self._at_driver -= before
        self._entered -= before
        for holder in change.removed:
            self._held_back.pop(holder.grant, None)
        # A device that still serves other holders, or continues in another hold, stays as it is.
        if (before and change.interrupts) or (change.settled and not self._at_driver):
            await self._make_safe()
        for holder in change.began:
            former = continued.get(holder.grant)
            if former is not None and former.grant in before:
                await self._begin(holder, self.driver.carry_on(former, holder))
            else:
                self._held_back[holder.grant] = holder
        await self._begin_held_back(at_once=change.began)
        if self._last_holder.may_be_direct and not self.holds.may_be_direct(self.mesh.now()):
            self.supervisor.spawn(self._forget_direct())

    async def _begin_held_back(self, *, at_once: Collection[messages.Holder]) -> None:
        """Begin the holds at the driver that nothing holds back any more; skip ended ones, and their `end`."""
        if self._making_safe is not None:
            return
        for grant, holder in list(self._held_back.items()):
            if grant in self.holds.held and self.holds.settles(grant) is None:
                del self._held_back[grant]
                if not self._at_driver and holder not in at_once:
                    # The device was granted earlier, but warms up from now on.
                    self._warm_at = self.mesh.now() + round(self.driver.activation * SECOND)
                await self._begin(holder, self.driver.begin(holder))

    async def _begin(self, holder: messages.Holder, beginning: Awaitable[None]) -> None:
        self._at_driver.add(holder.grant)
        if holder.direct:
            self._use.direct_began(holder.grant, self.mesh.now())
        await self._guard(beginning)
        self._entered.add(holder.grant)
        if left := self.driver.begins_for():
            self._longest_begin = max(self._longest_begin, left)
            if self._waits():
                self.publish()
            if self._beginning is None or self._beginning.done():
                self._beginning = self.supervisor.spawn(self._poll_until_begun())
        else:
            self._note_begun()

    async def _poll_until_begun(self) -> None:
        while left := self.driver.begins_for():  # noqa: ASYNC110 - drivers have no event for it
            await asyncio.sleep(min(left, BEGUN_POLL_S))
        self._note_begun()

    def _note_begun(self) -> None:
        now, late = self.mesh.now(), self._published_waits & self._entered
        for grant in self._entered & self.holds.held.keys():
            self.holds.begun(grant, now, late=grant in late)
        self._published_waits -= late
        if self._waits_timer is not None and all(entry.begun for entry in self.holds.held.values()):
            self._waits_timer.cancel()
            self._waits_timer = None
        if late:
            self.publish()
        self._set_alarm()

    def _publish_waits(self) -> None:
        self._waits_timer = None
        if self._waits().keys() - self._published_waits:
            self.publish()

    def _waits(self) -> dict[Grant, Ns]:
        """By grant whose device has not begun yet: the longest time until it has."""
        waits: dict[Grant, Ns] = {}
        now, bound = self.mesh.now(), round(self.begin_within * SECOND)
        for grant, entry in self.holds.held.items():
            if entry.begun:
                continue
            if grant in self._entered:
                waits[grant] = max(1, min(round(self.driver.begins_for() * SECOND), bound))
            else:
                safe = 0 if self._making_safe is None else self._safe_by
                waits[grant] = max(0, max(self.holds.settles(grant) or 0, safe) - now) + bound
        return waits

    async def _make_safe(self) -> None:
        """Make the device safe. After SAFE_WAIT_S this continues beside other work, and new holds are held back."""
        if self._making_safe is not None:
            self._safe_again = True
            return
        self._safe_by = self.mesh.now() + self._settle
        self._making_safe = self.supervisor.spawn(self._make_safe_in_time())
        await asyncio.wait({self._making_safe}, timeout=SAFE_WAIT_S)
        if self._making_safe.done():
            self._making_safe = None
        else:
            self._making_safe.add_done_callback(self._on_safe)

    def _on_safe(self, _task: asyncio.Task[None]) -> None:
        self._making_safe = None
        again, self._safe_again = self._safe_again, False
        # This change lets the held back holds begin.
        self.queue.put_change(HoldChange(settled=again))

    async def _make_safe_in_time(self) -> None:
        try:
            async with asyncio.timeout(self._settle / SECOND):
                await self._guard(self.driver.safe())
        except TimeoutError:
            self.fail(f"its device was not safe after {self._settle / SECOND:g} s; is its `settle` too short?")

    async def _guard(self, action: Awaitable[None]) -> None:
        try:
            await action
        except Exception as error:
            log.exception("%s: its driver failed; if it does not recover by itself, restart its node", self.name)
            self.fail(f"its driver failed: {error}")

    def _apply(self, change: HoldChange) -> None:
        if change.named is not None:
            self.instances.take(change.named, change.named_host)
        if change:
            continued = {grant: former.grant for grant, former in change.continued.items()}
            self._tolerance.changed(self.holds.held.keys(), continued, self.mesh.now())
        if change or change.settled:
            self._published_waits -= {holder.grant for holder in change.removed}
            for holder in change.removed:
                self._use.hold_ended(holder.grant, self.mesh.now())
            for holder in change.began:
                self._use.hold_began(holder.grant)
            if change.began and change.interrupts:
                self._warm_at = self.mesh.now() + round(self.driver.activation * SECOND)
            if change.began and self._waits_timer is None:
                self._waits_timer = self.supervisor.call_later(WAITS_DELAY_S, self._publish_waits)
            self.queue.put_change(change)
            self.queue.resume(lambda query: query.message.grant in self.holds.held)
        self._missed |= change.reread
        if change.announce or change.expired_locally:
            self.publish(change.expired_locally)
        self._set_alarm()
        self._lost_by_now()

    def _read_state(self) -> asyncio.Task[None]:
        """Read `rcm/state`, or return the task that is already reading it."""
        if self._reading is None or self._reading.done():
            self._reading = self.supervisor.spawn(self._read())
        return self._reading

    async def _read(self) -> None:
        for _ in range(REREADS):
            key, ask = self.mesh.keys.rcm_state, messages.StateAsk(holds_only=True)
            replies = await self.mesh.ask(key, ask, messages.RcmState, timeout=REREAD_TIMEOUT, enough=self._is_current)
            # An absurd answer must not hide a true one.
            answers = (reply.message for reply in replies if reply.message is not None)
            states = [state for state in answers if self.holds.believes(state.term, self.mesh.now())]
            if not states:
                break
            newest = max(states, key=lambda state: (state.term, state.seq))
            overtaken = (newest.term, newest.seq) < (self.holds.term, self.holds.seq)
            change = self.holds.apply_snapshot(newest, self.mesh.now(), self._carries)
            # A publication that overtook the answer may have hidden the gap for which the state was read.
            if not overtaken:
                self._trace("read")
                self._missed = False
            self._apply(change)
            if not overtaken:
                self.informed.set()
            if not overtaken:
                break
        self.queue.resume(lambda query: not self._is_early(query))
        for query in self.queue.drop_early():
            if problem := self._refusal(query):
                query.refuse(problem)

    def _carries(self, holders: Collection[messages.Holder]) -> bool:
        proposed = [messages.ProposedHolder(held.id, held.arc, held.client, held.params) for held in holders]
        try:
            return self.driver.sharable and not self.driver.vote(proposed)
        except ValueError:
            return False

    def _is_current(self, reply: Reply[messages.RcmState]) -> bool:
        """Return True if this answer is from the obeyed RCM, so that no other answer is needed."""
        state, holds = reply.message, self.holds
        return state is not None and state.term == holds.term and state.seq >= holds.seq

    def _trace(self, do: str, **what: Any) -> None:
        if trace.enabled():
            known = {"rc": self.name, "instance": self.instance, "sharable": self.driver.sharable}
            holds = sorted(self.holds.held)
            trace.write(self.mesh.now(), do, **known, term=self.holds.term, seq=self.holds.seq, holds=holds, **what)

    def _set_alarm(self) -> None:
        ends, now = (self.holds.next_expiry(), self._tolerance.lost_at), self.mesh.now()
        at = min((end for end in ends if end is not None), default=None)
        self._alarm.set(at if at is None or at > now else now + round(MIN_EXPIRY_DELAY_S * SECOND))

    def _expire(self) -> None:
        if self._lost_by_now():
            return
        # After a stall of this process, publications of the RCM may still wait in the inbox: leases must not end now.
        change = self.holds.expire(self.mesh.now(), lease=not self.stall.fresh())
        if change:
            self._trace("end")
        self._apply(change)

    async def _publish_figures(self) -> None:
        while True:
            published = self._figures()
            await asyncio.sleep(FIGURES_PERIOD)
            silent = self.mesh.now() - self._published > REPUBLISH_PERIOD_S * SECOND
            # The time used grows steadily, so it alone causes no publication.
            if self._figures() != published or self._use.unpublished or silent:
                self.publish()

    async def _keep_checking(self) -> None:
        while True:
            await asyncio.sleep(CHECK_PERIOD_S)
            await self._check_for_contradictions()

    async def _check_for_contradictions(self) -> None:
        """Suspect the mesh if of a leader's token, publications and queries some are missing while others arrive, as
        then declarations were lost; or if candidates are seen and none leads in time."""
        silent = bool(self._leaders) and not self._receives
        self.mesh.suspicions.suspect(
            f"{self.name}: an RCM is seen that does not publish", so=silent, patience=SILENT_RCM_PATIENCE
        )
        publishes = self._receives and self._published_since_token
        signs = {
            f"{self.name}: the RCM publishes and is not seen": publishes and not self._leaders,
            f"{self.name}: the RCM publishes and has not asked for its promise": publishes
            and self.instances.state is not InstanceState.STANDS_BY
            and self._asked != self.holds.term,
        }
        for sign, seen in signs.items():
            self.mesh.suspicions.suspect(sign, so=seen)
        candidates = self.mesh.keys.alive_any(Role.CANDIDATE)
        missed = not (self._leaders or self._receives) and await self.mesh.living(candidates, timeout=REREAD_TIMEOUT)
        self.mesh.suspicions.suspect(
            f"{self.name}: candidates are seen, and no RCM", so=bool(missed), patience=LEADERLESS
        )

    @property
    def _receives(self) -> bool:
        # Half a hold lease is longer than a heartbeat, and leaves time for a new leader before holds end.
        return self._last_published is not None and self.mesh.now() - self._last_published < self.holds.hold_lease // 2
