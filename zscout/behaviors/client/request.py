"""A client's requests, and the state of each by its newest notice. Time is passed in."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any, NamedTuple, Self

import msgspec

from zscout.behaviors.client.hold_notices import HoldNotice
from zscout.behaviors.client.remedies import with_remedy
from zscout.keyexpr import BadName, check_name, check_need, check_rc, is_pattern, matcher, new_instance
from zscout.messages import Amounts, Ask, Cancel, Notice, OpenRequest, Problem, ReasonInfo, Release, Who, carried
from zscout.types import NO_TERM, SECOND, Grant, Ns, Place, Term

Needs = Mapping[str, Mapping[str, Any]]


class RequestRefused(Exception):
    """The request was refused. The message is the `fault` and what to do about it; `code` is one of the codes of the
    protocol, and so is `remedy`, if there is one that the program can take."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(with_remedy(problem.message, problem.remedy))
        self.code, self.fault, self.remedy = problem.code, problem.message, problem.remedy


class NoRcm(Exception):
    """No leader is on the mesh. The message is the `fault` and what to check; `remedy` is its code."""

    def __init__(self, fault: str, remedy: str = "") -> None:
        super().__init__(with_remedy(fault, remedy))
        self.fault, self.remedy = fault, remedy


class CommandRefused(Exception):
    """A device refused a command. `rc` names it; `code` is the protocol's, or `unknown` if no answer came."""

    def __init__(self, rc: str, problem: Problem) -> None:
        super().__init__(f"{rc}: {problem.message}")
        self.rc, self.problem = rc, problem
        self.code, self.message = problem.code, problem.message
        self.left = problem.left
        """With `code` `settling`: seconds, at most, until the device is ready."""


class HoldEnd(NamedTuple):
    """How a hold ended: the protocol's outcome, the reason for people, and the name of the request that took it."""

    outcome: str
    reason: str
    by: str | None = None


@dataclass(slots=True)
class OpenArc:
    """A request of this client, as `Client.request` returns it. Read it, and pass it to the methods of `Client`; those
    change it. Times are in ns on this host's clock.

    `state` is `asking` until the leader has answered, then `queued`, `running`, `ended` or `refused`. A request that
    another client hands over is `expected` first, and `awaited` if a later leader still counts it as that client's. A
    request that was handed over to another client is `moved`.
    """

    id: str
    name: str
    needs: dict[str, Amounts]
    """Parameters by device or pattern, as requested."""
    priority: int
    min_runtime: Decimal
    """Seconds for which a hold is protected."""
    keep: bool = False
    """True if the hold then continues until another request waits."""
    estimate: bool = False
    """True to request estimates of its start from the RCM."""
    direct: bool = False
    """True if its program also reaches devices past zscout (`direct.py`)."""
    continues: str = ""
    """Name of this client's request whose hold it replaces."""
    who: Who | None = None
    """User, host and command of the request, shown to other people."""
    booking: str = ""
    """The booking that it takes up: its id; once the leader has answered, with its date: `<id>@<start>`."""
    until_done: bool = False
    """Whether it runs a command, which the fleet's `command_min_runtime` protects."""
    _check: bool = False
    """True to be refused at once if it can never start."""
    _wait_for_device: bool = False
    """True to wait for an unknown RC instead of being refused."""
    state: str = "asking"
    reason: str = ""
    """Why it is in this state, for people."""
    why: ReasonInfo | None = None
    """`reason` in structured form, if the RCM sent it."""
    outcome: str | None = None
    """How its last hold, or the request, ended: an outcome of the protocol, such as `preempted`."""
    by: str | None = None
    """The name of the request that took its devices."""
    _place: Place | None = None
    _seal: str | None = None
    """The RCM's proof that the place belongs to this request."""
    _former_id: str | None = None
    """Former id, if `_place` was given under another id."""
    ahead: int | None = None
    """While it is queued: how many requests are before it."""
    start: Ns | None = None
    """While it is queued: its start by the leader's last estimate."""
    grant: Grant | None = None
    """While it runs: the grant, which each command carries."""
    rcs: list[str] = field(default_factory=list)
    """The devices that it holds, or held last."""
    bound: dict[str, str] = field(default_factory=dict)
    """For each pattern, the device among them that satisfies it."""
    hosts: dict[str, str] = field(default_factory=dict)
    """The host of each device, if the leader has named it."""
    end: Ns = 0
    """Latest end of the present hold's minimum runtime."""
    ready: Ns | None = None
    """While devices of the present hold are starting: the latest time by which they are ready. Its runtime begins
    then."""
    upcoming: list[HoldNotice] = field(default_factory=list)
    """While it runs: the request, and the booking or maintenance, to which the hold yields next."""
    since: Ns = 0
    """When `state` began."""
    _waits_since: Ns | None = None
    """Begin of its present wait, under any RCM."""
    _unconfirmed: tuple[Grant, list[str]] | None = None
    """A grant and the RCs that did not confirm it, until the RCM has answered that report."""
    _settling: Grant | None = None
    """A grant of which some RCs are still settling."""
    _grant_left: Grant | None = None
    """The last grant whose program was asked to leave: no body enters it again."""
    _unserved: Grant | None = None
    """A grant whose time passed while RCs were settling, until the RCM has answered that report."""
    _ending: HoldEnd | None = None
    """How the last hold ended; `outcome` and `reason` come from the newest notice of any kind."""
    _place_shown_in: Term = NO_TERM
    """Term in which the client last showed its place to an RCM that had assigned a worse one."""
    _last: tuple[Term, int] = field(default=(NO_TERM, 0))
    """Term and step of the newest notice."""
    _notified_at: Ns = 0
    """Time of the newest notice."""
    _moved_in: Term | None = field(default=None, init=False, repr=False)
    """Term in which another client handed it over, until an RCM of a later term confirms that."""
    _change: asyncio.Event = field(default_factory=asyncio.Event, init=False, compare=False, repr=False)

    @classmethod
    def _expected(cls, request: OpenRequest, now: Ns) -> Self:
        """Return a request that another client will hand over. Raises BadName."""
        for need in request.needs:
            check_need(need)
        id_, name = check_name(request.id, "id"), check_name(request.arc, "arc")
        arc = cls(id_, name, request.needs, request.priority, request.min_runtime, request.keep, _place=request.place)
        arc.direct, arc.continues, arc.booking = request.direct, request.continues, request.booking
        arc.until_done = request.until_done
        arc.who = request.who and msgspec.structs.replace(request.who, host="")
        arc.state, arc.reason = "expected", "waiting for another client to hand it over"
        arc.since, arc._waits_since = now, now - round(request.waited * SECOND)
        return arc

    def _is_over(self, now: Ns) -> bool:
        """Return True if the time of the present hold is over by this host's clock."""
        return not self.keep and self.ready is None and now >= self.end

    @property
    def open(self) -> bool:
        """False once it has ended, was refused or belongs to another client."""
        return self.state in ("asking", "queued", "running", "awaited")

    def _take(self, notice: Notice, now: Ns) -> bool:
        """Apply a notice. Return False, with nothing changed, if it is outdated or has other devices than requested."""
        if (notice.term, notice.step) <= self._last or not self.open:
            return False
        if (bound := self._binding(notice)) is None:
            return False
        self._last, self._unconfirmed, self._unserved = (notice.term, notice.step), None, None
        self._notified_at = now
        self.booking = notice.booking or self.booking
        if self._moved_in is not None and self._moved_in < notice.term:
            self._moved_in = None
        if notice.state != self.state or notice.grant != self.grant:
            self.since = now
        if notice.state != "running":
            self._end_hold(HoldEnd(notice.outcome or "lost", notice.reason, notice.by), now)
        elif notice.grant != self.grant:
            self._end_hold(HoldEnd("lost", "the leader considered this client gone; it is granted again"), now)
        self.state = notice.state
        self.reason, self.why = notice.reason, notice.why
        self.outcome, self.by = notice.outcome, notice.by
        self.ahead = notice.ahead
        self.start = None if notice.starts_in is None else now + round(notice.starts_in * SECOND)
        if notice.place is not None and (self._place is None or notice.place <= self._place):
            self._place, self._seal, self._former_id = notice.place, notice.seal, None
        if notice.state == "running":
            self.grant = notice.grant
            self.bound, self.rcs = bound, sorted(bound.get(need, need) for need in self.needs)
            self.hosts = notice.hosts
            self.ready = None if notice.waits is None else now + round(notice.waits * SECOND)
            self.end = now + round((notice.remaining or 0.0) * SECOND)
            self.upcoming = [HoldNotice.of(end, now) for end in notice.upcoming]
        return True

    def _binding(self, notice: Notice) -> dict[str, str] | None:
        """The RC for each pattern. None if the RCs don't satisfy the needs, as after a false report by a node."""
        bound = {need: notice.bound.get(need, "") for need in self.needs if is_pattern(need)}
        if notice.state != "running":
            return {}
        rcs = {bound.get(need, need) for need in self.needs}
        if notice.rcs and {*notice.rcs} != rcs:
            return None
        with suppress(BadName):
            if len(rcs) == len(self.needs) and all(matcher(need)(check_rc(rc)) for need, rc in bound.items()):
                return bound
        return None

    def _end_hold(self, ending: HoldEnd, now: Ns) -> None:
        if self.grant is not None:
            self.grant, self._ending, self._waits_since, self.ready = None, ending, now, None
            self.upcoming = []
        elif self._waits_since is None:
            self._waits_since = now

    def _lose(self, reason: str, now: Ns) -> None:
        """End the hold by the client's own judgement; the request must be submitted again."""
        self._end_hold(HoldEnd("lost", reason), now)
        self.state, self.reason, self.outcome, self.since = "asking", reason, "lost", now
        self.why = None

    def _not_confirmed(self, rcs: list[str], reason: str, now: Ns) -> None:
        """Give up the hold because `rcs` do not confirm its grant; the RCM will queue it again."""
        assert self.grant is not None  # noqa: S101 - only grants are confirmed
        self._unconfirmed = self.grant, rcs
        self._lose(reason, now)

    def _not_served(self, grant: Grant | None, now: Ns) -> None:
        """Give up a grant whose time passed while its RCs were settling; it keeps its place."""
        self._lose("its time passed while its devices settled", now)
        self._unserved, self._settling = grant, None

    def _finish(self, outcome: str, reason: str, now: Ns) -> None:
        self._end_hold(HoldEnd(outcome, reason), now)
        self.state, self.outcome, self.reason, self.since = "ended", outcome, reason, now
        self.why = None

    def _must_show_place(self, notice: Notice) -> bool:
        """Return True if the RCM gave it a worse place in answer to an older query; at most once per term."""
        if notice.state != "queued" or notice.place is None or notice.place == self._place:
            return False
        shown, self._place_shown_in = self._place_shown_in, notice.term
        return shown != notice.term

    def _reopen(self, now: Ns) -> None:
        """Undo an end as `client_lost`, as this client lives; the request keeps its place."""
        self.state, self.since, self.why = "asking", now, None

    def _take_first(self, notice: Notice, now: Ns) -> bool:
        """Apply an expected request's first notice. Return False for an end, an old notice or other devices."""
        before, self.state = self.state, "asking"
        if notice.state != "ended" and self._take(notice, now):
            self._moved_in = notice.term
            return True
        self.state = before
        return False

    def _must_be_handed_over_again(self, notice: Notice) -> bool:
        """Return True if by a later RCM it still belongs to the client that handed it over, which must do so again."""
        return (
            self.open
            and notice.outcome == "handed_over"
            and self._moved_in is not None
            and self._moved_in < notice.term
        )

    def _await_again(self, notice: Notice, now: Ns) -> None:
        self._lose("waiting for its old client to hand it over again", now)
        self.state, self._moved_in, self._last = "awaited", None, (notice.term, notice.step)

    def _go_back(self, term: Term) -> None:
        """Forget all that came from leaders of terms above `term`, which the fleet no longer knows."""
        if self._last[0] > term:
            self._last = NO_TERM, 0
        if self._place is not None and self._place.term > term:
            self._place = self._seal = self._former_id = None
        if self._unconfirmed is not None and self._unconfirmed[0].term > term:
            self._unconfirmed = None
        if self._unserved is not None and self._unserved.term > term:
            self._unserved = None

    def _move(self, now: Ns) -> None:
        """End the hold here; the request continues in another client."""
        self._end_hold(HoldEnd("handed_over", "handed over"), now)
        self.state, self.since = "moved", now

    def _take_back(self, new_id: str, reason: str, now: Ns) -> None:
        """Prepare a new request, with `new_id`, at the old place."""
        if self._ending is not None and self._ending.outcome == "handed_over":
            self._ending = HoldEnd("lost", reason)
        self.id, self._former_id, self._last = new_id, self._former_id or self.id, (NO_TERM, 0)
        self.state, self.reason, self.outcome, self.since = "asking", reason, None, now
        self.why = None

    def _ask(self, now: Ns, *, reachable: bool = False) -> Ask:
        """`reachable`: the tokens of RCs that did not confirm the last grant are back."""
        grant, unconfirmed = self._unconfirmed or (self.grant or self._unserved, [])
        return carried(
            self._as_asked(now, grant),
            Ask,
            estimate=self.estimate,
            unconfirmed=unconfirmed,
            reachable=reachable,
            unserved=self._unserved is not None and grant == self._unserved,
            check=self._check and self._place is None,
            wait_for_device=self._wait_for_device and self._place is None,
        )

    def _open_request(self, now: Ns) -> OpenRequest:
        return self._as_asked(now, self.grant)

    def _as_asked(self, now: Ns, grant: Grant | None) -> OpenRequest:
        since = now if self._waits_since is None or self.grant is not None else self._waits_since
        return OpenRequest(
            id=self.id,
            arc=self.name,
            needs=self.needs,
            priority=self.priority,
            min_runtime=self.min_runtime,
            keep=self.keep,
            place=self._place,
            seal=self._seal,
            was=self._former_id,
            waited=max(0, now - since) / SECOND,
            grant=grant,
            rcs=self.rcs if grant is not None else [],
            direct=self.direct,
            continues=self.continues,
            who=self.who,
            booking=self.booking,
            until_done=self.until_done,
        )


def amounts(needs: Needs) -> dict[str, Amounts]:
    """Convert the numbers in needs (int, float, Decimal) for the mesh; 0.1 means one tenth. Raises TypeError."""
    if not isinstance(needs, Mapping):
        raise TypeError(f'needs is {needs!r}; write {{"robot/scout33": {{}}}}')
    for rc, params in needs.items():
        if not isinstance(params, Mapping):
            raise TypeError(f'{rc!r} has {params!r}; write its parameters: {{"{rc}": {{}}}}')
    return {rc: {name: Decimal(str(value)) for name, value in params.items()} for rc, params in needs.items()}


def check_seconds(what: str, value: Any) -> None:
    """Raises ValueError unless `value` is a finite number above 0."""
    is_number = isinstance(value, (int, float, Decimal)) and not isinstance(value, bool)
    if not is_number or not math.isfinite(value) or value <= 0:
        raise ValueError(f"{what} is {value!r}; write a number of seconds above 0")


class RequestStore:
    """A client's requests that are not over, by id, and its paused state."""

    def __init__(self, now: Callable[[], Ns], ask_again: Callable[[OpenArc], object]) -> None:
        """`ask_again` gets each request to submit again: the RCM dropped it because this client seemed gone, or
        assigned a worse place; or it is `awaited`."""
        self._now, self._ask_again = now, ask_again
        self.arcs: dict[str, OpenArc] = {}
        self.moved: dict[str, OpenArc] = {}
        """Requests handed over while this client was paused, which it may take back."""
        self.expected: dict[str, OpenArc] = {}
        """Requests that another client will hand over, before their first notice."""
        self.withdrawn: dict[str, Release | Cancel] = {}
        """Requests that this client gave up, until an RCM has answered that."""
        self.undecided: set[str] = set()
        """Ids of requests whose hand-over has an unknown outcome."""
        self.reclaimed: set[str] = set()
        """Ids of undecided requests that the client has reclaimed: under a new id if they turn out to be handed
        over."""
        self.resumed = asyncio.Event()
        """Cleared while the client is paused."""
        self.resumed.set()
        self.watchers: list[Callable[[OpenArc], None]] = []
        """Each is called with every request that changes."""

    @property
    def open(self) -> list[OpenArc]:
        return [arc for arc in self.arcs.values() if arc.open]

    @property
    def acknowledged(self) -> list[OpenArc]:
        """Requests that an RCM has answered: queued, running, or submitted again at their place."""
        return [arc for arc in self.open if arc.state != "asking" or arc._place is not None]

    def add(self, arc: OpenArc) -> None:
        self.arcs[arc.id] = arc

    def expect(self, arc: OpenArc) -> None:
        """Expect `arc` from another client. Notices from before it was last handed over there are outdated."""
        if (before := self.moved.pop(arc.id, None)) is not None:
            arc._last, arc._change = before._last, before._change
        self.withdrawn.pop(arc.id, None)
        self.expected[arc.id] = arc

    def adopt(self, arc: OpenArc) -> None:
        """Take an expected request as this client's, after its first notice, or to submit it."""
        if self.expected.pop(arc.id, None) is not None:
            if arc.state in ("expected", "awaited"):
                arc.state = "asking"
            self.add(arc)

    def forget(self, arc: OpenArc) -> None:
        self.arcs.pop(arc.id, None)
        self.moved.pop(arc.id, None)
        self.expected.pop(arc.id, None)

    def notify(self, arc: OpenArc) -> None:
        arc._change.set()
        for watcher in self.watchers:
            watcher(arc)

    async def changed(self, arc: OpenArc) -> None:
        """Wait for the next change of `arc`; return at once if there can be none."""
        if arc.id in self.arcs or arc.id in self.moved or arc.id in self.expected:
            arc._change.clear()
            await arc._change.wait()

    def take(self, arc: OpenArc, notice: Notice) -> None:
        """Apply the RCM's notice of one of `arcs`."""
        if notice.id != arc.id:
            # An answer that was under way when the ARC was taken back under another id.
            return
        granted, unserved = arc.grant is not None, {arc._settling, arc._unserved} - {None}
        if notice.outcome == "handed_over" and not self.resumed.is_set():
            # Wait for the answer to the hand-over: an RCM that dies before may not have notified the new client.
            return
        if notice.outcome == "handed_over" and arc.id in self.reclaimed and arc.open:
            self.move(arc, notice)
            self.reclaim(arc)
        elif arc._must_be_handed_over_again(notice):
            arc._await_again(notice, self._now())
            del self.arcs[arc.id]
            self.expected[arc.id] = arc
            self.notify(arc)
            self._ask_again(arc)
        elif arc._take(notice, self._now()):
            self.reclaimed.discard(arc.id)
            if not arc.open and arc.outcome == "client_lost":
                arc._reopen(self._now())
                self._ask_again(arc)
            elif arc.outcome == "completed" and notice.grant in unserved:
                arc._not_served(notice.grant, self._now())
                self._ask_again(arc)
            elif not granted and arc.outcome == "completed":
                self._submit_under_new_id(arc)
            elif arc._must_show_place(notice):
                self._ask_again(arc)
            self.notify(arc)
            if not arc.open:
                self.forget(arc)

    def _submit_under_new_id(self, arc: OpenArc) -> None:
        """Submit a request under a new id at its old place: its time was over before the grant was received."""
        del self.arcs[arc.id]
        arc._take_back(new_instance(), "its time was over before this client learned of the grant", self._now())
        arc.booking = ""  # the booking's time is over too
        self.arcs[arc.id] = arc
        self._ask_again(arc)

    def open_requests(self) -> list[OpenRequest]:
        """All requests for a new leader. Expected ones have no place: without a report by RCs they are not queued."""
        now = self._now()
        expected = [msgspec.structs.replace(arc._open_request(now), place=None) for arc in self.expected.values()]
        return [*(arc._open_request(now) for arc in self.open), *expected]

    def move(self, arc: OpenArc, notice: Notice) -> None:
        """Mark `arc` as moved to another client, as of `notice`; earlier notices are outdated."""
        arc._move(self._now())
        arc._last = max(arc._last, (notice.term, notice.step))
        self.arcs.pop(arc.id, None)
        self.moved[arc.id] = arc
        self.notify(arc)

    def go_back(self, term: Term) -> None:
        """Forget all that came from leaders above `term`."""
        for arc in (*self.arcs.values(), *self.moved.values(), *self.expected.values()):
            arc._go_back(term)

    def reclaim(self, arc: OpenArc) -> None:
        """Take back a moved request, under a new id; it must be submitted again."""
        del self.moved[arc.id]
        self.reclaimed.discard(arc.id)
        arc._take_back(new_instance(), "it was handed over, and its new client is gone", self._now())
        self.arcs[arc.id] = arc
        self.notify(arc)
