"""A client's requests: what was asked for, and the state of each by the newest notice. Time is passed in."""

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
from zscout.keyexpr import BadName, check_name, check_need, check_rc, is_pattern, matcher, new_instance
from zscout.messages import Amounts, Ask, Cancel, Notice, OpenRequest, Problem, ReasonInfo, Release, Who, carried
from zscout.types import NO_TERM, SECOND, Grant, Ns, Place, Term

Needs = Mapping[str, Mapping[str, Any]]


HINT = ("add --wait-for-device", "pass wait_for_device=True")
"""What a leader proposes to people, and what a program writes."""


class RequestRefused(Exception):
    """The request was refused. The message is the reason; `code` is one of the codes of the protocol."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.message.replace(*HINT))
        self.code = problem.code


class NoRcm(Exception):
    """No leader is on the mesh; the message says what to check."""


class CommandRefused(Exception):
    """A device refused a command. `rc` names it, `code` is one of the codes of the protocol, or `unknown` if no
    answer came."""

    def __init__(self, rc: str, problem: Problem) -> None:
        super().__init__(f"{rc}: {problem.message}")
        self.rc, self.problem = rc, problem
        self.code, self.message = problem.code, problem.message
        self.left = problem.left
        """With `code` `settling`: seconds, at most, until the device is ready."""


class HoldEnd(NamedTuple):
    """How a hold ended: the protocol's outcome, the reason in words, and the ARC that it was taken for."""

    outcome: str
    reason: str
    by: str | None = None


@dataclass(slots=True)
class OpenArc:
    """A request of this client, as `Client.request` returns it. Read it, and pass it to the methods of `Client`; those
    change it. Times are in ns on this host's clock.

    `state` is `asking` until the leader has answered, then `queued`, `running`, `ended` or `refused`. A request that
    another client hands over is `expected` first, and `awaited` where a later leader still counts it as that client's;
    one that was handed over to another client is `moved`.
    """

    id: str
    name: str
    needs: dict[str, Amounts]
    """Parameters by device or pattern, as requested."""
    priority: int
    min_runtime: Decimal
    """Seconds for which a hold is protected."""
    keep: bool = False
    """Whether a hold continues after that until another request waits."""
    estimate: bool = False
    """Whether the RCM is asked to estimate when it will start."""
    direct: bool = False
    """Whether its program touches devices past their RCs (`direct.py`)."""
    continues: str = ""
    """The name of another ARC of its client's, from which it goes on."""
    who: Who | None = None
    """Who asks, as others are told."""
    booking: str = ""
    """The booking that it takes up: its id; once the leader has answered, with its date: `<id>@<start>`."""
    _check: bool = False
    """Whether it is to be refused at once if it can never start."""
    _wait_for_device: bool = False
    """Whether it waits for an RC that nobody knows all the same."""
    state: str = "asking"
    reason: str = ""
    """Why it is in this state, in words."""
    why: ReasonInfo | None = None
    """What `reason` says, as data, where the RCM gave that."""
    outcome: str | None = None
    """How its last hold, or the request, ended: an outcome of the protocol, such as `preempted`."""
    by: str | None = None
    """The name of the request that took its devices."""
    _place: Place | None = None
    _seal: str | None = None
    """Proof that the place is its own, by the RCM's word."""
    _was: str | None = None
    """The id under which it had that place, if that was another one."""
    ahead: int | None = None
    """While it is queued: how many requests are before it."""
    start: Ns | None = None
    """While it is queued: when it will start by the leader's last estimate."""
    grant: Grant | None = None
    """While it runs: the grant, which commands show."""
    rcs: list[str] = field(default_factory=list)
    """The devices that it holds, or held last."""
    bound: dict[str, str] = field(default_factory=dict)
    """For each pattern, the device among them that satisfies it."""
    hosts: dict[str, str] = field(default_factory=dict)
    """The host of each device, as far as the leader names it."""
    end: Ns = 0
    """When the minimum runtime of the present hold is over, at the latest."""
    ready: Ns | None = None
    """While devices of the present hold are starting: when they are ready, at the latest. Its runtime begins then."""
    upcoming: list[HoldNotice] = field(default_factory=list)
    """While it runs: the request, and the booking or maintenance, to which the hold yields next."""
    since: Ns = 0
    """When `state` began."""
    _waits_since: Ns | None = None
    """When it was last queued: its present wait began then, whichever RCM leads."""
    _unconfirmed: tuple[Grant, list[str]] | None = None
    """The grant that some of its RCs did not confirm, and which, until the RCM has answered that."""
    _settling: Grant | None = None
    """The grant whose RCs have not all stopped settling."""
    _left: Grant | None = None
    """The last grant whose program was told to leave: it is not entered again."""
    _unserved: Grant | None = None
    """The grant whose time went by so, until the RCM has answered that."""
    _ending: HoldEnd | None = None
    """How the last hold ended; `outcome` and `reason` are of the newest notice, whatever it is about."""
    _shown: Term = NO_TERM
    """In which term its place was shown last, to an RCM that had given a worse one."""
    _last: tuple[Term, int] = field(default=(NO_TERM, 0))
    _told: Ns = 0
    """When the newest notice came."""
    _came: Term | None = field(default=None, init=False, repr=False)
    """In which term another client handed it over, until an RCM of a later one says whose it is."""
    _news: asyncio.Event = field(default_factory=asyncio.Event, init=False, compare=False, repr=False)

    @classmethod
    def _expected(cls, request: OpenRequest, now: Ns) -> Self:
        """What another client will hand over. Raises BadName."""
        for need in request.needs:
            check_need(need)
        id_, name = check_name(request.id, "id"), check_name(request.arc, "arc")
        arc = cls(id_, name, request.needs, request.priority, request.min_runtime, request.keep, _place=request.place)
        arc.direct, arc.continues, arc.booking = request.direct, request.continues, request.booking
        arc.who = request.who and msgspec.structs.replace(request.who, host="")
        arc.state, arc.reason = "expected", "another client is to hand it over"
        arc.since, arc._waits_since = now, now - round(request.waited * SECOND)
        return arc

    def _is_over(self, now: Ns) -> bool:
        """Whether the time of the present hold is over by this host's clock."""
        return not self.keep and self.ready is None and now >= self.end

    @property
    def open(self) -> bool:
        """False once it has ended, was refused or belongs to another client."""
        return self.state in ("asking", "queued", "running", "awaited")

    def _take(self, notice: Notice, now: Ns) -> bool:
        """Applies a newer notice of this request. False if it is an old one, a replaced RCM's, or reports a
        hold that is not what was asked for."""
        if (notice.term, notice.step) <= self._last or not self.open:
            return False
        if (bound := self._binding(notice)) is None:
            return False
        self._last, self._unconfirmed, self._unserved = (notice.term, notice.step), None, None
        self._told = now
        self.booking = notice.booking or self.booking
        if self._came is not None and self._came < notice.term:
            self._came = None
        if notice.state != self.state or notice.grant != self.grant:
            self.since = now
        if notice.state != "running":
            self._close(HoldEnd(notice.outcome or "lost", notice.reason, notice.by), now)
        elif notice.grant != self.grant:
            self._close(HoldEnd("lost", "the leader took this client for gone; it is granted again"), now)
        self.state = notice.state
        self.reason, self.why = notice.reason, notice.why
        self.outcome, self.by = notice.outcome, notice.by
        self.ahead = notice.ahead
        self.start = None if notice.starts_in is None else now + round(notice.starts_in * SECOND)
        if notice.place is not None and (self._place is None or notice.place <= self._place):
            self._place, self._seal, self._was = notice.place, notice.seal, None
        if notice.state == "running":
            self.grant = notice.grant
            self.bound, self.rcs = bound, sorted(bound.get(need, need) for need in self.needs)
            self.hosts = notice.hosts
            self.ready = None if notice.waits is None else now + round(notice.waits * SECOND)
            self.end = now + round((notice.remaining or 0.0) * SECOND)
            self.upcoming = [HoldNotice.of(end, now) for end in notice.upcoming]
        return True

    def _binding(self, notice: Notice) -> dict[str, str] | None:
        """The RC that meets each pattern, each another one; None: this is no binding of what was asked for, or it is of
        other RCs, as some node has reported it."""
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

    def _close(self, ending: HoldEnd, now: Ns) -> None:
        if self.grant is not None:
            self.grant, self._ending, self._waits_since, self.ready = None, ending, now, None
            self.upcoming = []
        elif self._waits_since is None:
            self._waits_since = now

    def _lose(self, reason: str, now: Ns) -> None:
        """The hold is over by the client's own judgement; the request is asked again."""
        self._close(HoldEnd("lost", reason), now)
        self.state, self.reason, self.outcome, self.since = "asking", reason, "lost", now
        self.why = None

    def _not_confirmed(self, rcs: list[str], reason: str, now: Ns) -> None:
        """These RCs do not confirm its grant: it is not entered, and the RCM is to queue it again."""
        assert self.grant is not None  # noqa: S101 - what is not confirmed was granted
        self._unconfirmed = self.grant, rcs
        self._lose(reason, now)

    def _not_served(self, grant: Grant | None, now: Ns) -> None:
        """The time of this grant went by while RCs of it settled: it is asked for once more, at its place."""
        self._lose("its time passed while its devices settled", now)
        self._unserved, self._settling = grant, None

    def _finish(self, outcome: str, reason: str, now: Ns) -> None:
        """The request is over by the client's own judgement."""
        self._close(HoldEnd(outcome, reason), now)
        self.state, self.outcome, self.reason, self.since = "ended", outcome, reason, now
        self.why = None

    def _shows_place(self, notice: Notice) -> bool:
        """Whether the RCM is to be shown its place, once in a term: it gave a worse one, to a question from before."""
        if notice.state != "queued" or notice.place is None or notice.place == self._place:
            return False
        shown, self._shown = self._shown, notice.term
        return shown != notice.term

    def _reopen(self, now: Ns) -> None:
        """It ended because this client seemed gone, which lives: it is asked for again, at its place."""
        self.state, self.since, self.why = "asking", now, None

    def _take_first(self, notice: Notice, now: Ns) -> bool:
        """Applies the first notice of an expected request. False if it is none: an old one, or not credible."""
        before, self.state = self.state, "asking"
        if notice.state != "ended" and self._take(notice, now):
            self._came = notice.term
            return True
        self.state = before
        return False

    def _is_not_here_yet(self, notice: Notice) -> bool:
        """Whether the notice says that it is another client's still, which had handed it over to this one at an RCM
        that was replaced: it is to hand it over once more."""
        return self.open and notice.outcome == "handed_over" and self._came is not None and self._came < notice.term

    def _await_again(self, notice: Notice, now: Ns) -> None:
        """It is not here yet."""
        self._lose("its old client is to hand it over once more", now)
        self.state, self._came, self._last = "awaited", None, (notice.term, notice.step)

    def _go_back(self, term: Term) -> None:
        """Forget what leaders of terms above `term` said: their fleet knows no such term any more."""
        if self._last[0] > term:
            self._last = NO_TERM, 0
        if self._place is not None and self._place.term > term:
            self._place = self._seal = self._was = None
        if self._unconfirmed is not None and self._unconfirmed[0].term > term:
            self._unconfirmed = None
        if self._unserved is not None and self._unserved.term > term:
            self._unserved = None

    def _move(self, now: Ns) -> None:
        """It goes on in another client."""
        self._close(HoldEnd("handed_over", "handed over"), now)
        self.state, self.since = "moved", now

    def _take_back(self, new_id: str, reason: str, now: Ns) -> None:
        """The client to which it was handed over is gone: it is asked for anew, at its old place."""
        if self._ending is not None and self._ending.outcome == "handed_over":
            self._ending = HoldEnd("lost", reason)
        self.id, self._was, self._last = new_id, self._was or self.id, (NO_TERM, 0)
        self.state, self.reason, self.outcome, self.since = "asking", reason, None, now
        self.why = None

    def _ask(self, now: Ns, *, reachable: bool = False) -> Ask:
        """`reachable`: the RCs that did not confirm its last grant have shown themselves anew."""
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
        """As it is reported to an RCM that takes the lead."""
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
            was=self._was,
            waited=max(0, now - since) / SECOND,
            grant=grant,
            rcs=self.rcs if grant is not None else [],
            direct=self.direct,
            continues=self.continues,
            who=self.who,
            booking=self.booking,
        )


def amounts(needs: Needs) -> dict[str, Amounts]:
    """Needs as people write them (ints, floats, Decimals), as they are sent. 0.1 means one tenth. Raises TypeError."""
    if not isinstance(needs, Mapping):
        raise TypeError(f'needs is {needs!r}; write {{"robot/scout33": {{}}}}')
    for rc, params in needs.items():
        if not isinstance(params, Mapping):
            raise TypeError(f'{rc!r} has {params!r}; write its parameters: {{"{rc}": {{}}}}')
    return {rc: {name: Decimal(str(value)) for name, value in params.items()} for rc, params in needs.items()}


def check_seconds(what: str, value: Any) -> None:
    """Raises ValueError for what is no span of time."""
    is_number = isinstance(value, (int, float, Decimal)) and not isinstance(value, bool)
    if not is_number or not math.isfinite(value) or value <= 0:
        raise ValueError(f"{what} is {value!r}; write a number of seconds above 0")


class RequestStore:
    """All that a client has asked for and that is not over, by request id; who waits for news of it; and
    whether the client is paused."""

    def __init__(self, now: Callable[[], Ns], ask_again: Callable[[OpenArc], object]) -> None:
        """`ask_again` is called with what the RCM dropped because this client seemed gone, or has at a worse place than
        it had; and with what is `awaited`: it came from another client, and is that one's still by a later RCM."""
        self._now, self._ask_again = now, ask_again
        self.arcs: dict[str, OpenArc] = {}
        self.moved: dict[str, OpenArc] = {}
        """What was handed over while this client was paused, and may be taken back."""
        self.expected: dict[str, OpenArc] = {}
        """What is to be handed to this client, and of which no notice has come yet."""
        self.withdrawn: dict[str, Release | Cancel] = {}
        """What this client gave up, until an RCM has answered that."""
        self.undecided: set[str] = set()
        """Ids of what was to be handed over, where nobody could tell whether it was."""
        self.reclaimed: set[str] = set()
        """Those of them that are this client's in any case: under a new id if they were handed over."""
        self.resumed = asyncio.Event()
        """Not set while the client is paused."""
        self.resumed.set()
        self.watchers: list[Callable[[OpenArc], None]] = []
        """Each is called with whatever there is news of."""

    @property
    def open(self) -> list[OpenArc]:
        return [arc for arc in self.arcs.values() if arc.open]

    @property
    def acknowledged(self) -> list[OpenArc]:
        """Those that an RCM has answered: queued, running, or asked for again at their place."""
        return [arc for arc in self.open if arc.state != "asking" or arc._place is not None]

    def add(self, arc: OpenArc) -> None:
        self.arcs[arc.id] = arc

    def expect(self, arc: OpenArc) -> None:
        """`arc` is to be handed to this client. If it comes back, notices from before it went are old."""
        if (before := self.moved.pop(arc.id, None)) is not None:
            arc._last, arc._news = before._last, before._news
        self.withdrawn.pop(arc.id, None)
        self.expected[arc.id] = arc

    def adopt(self, arc: OpenArc) -> None:
        """What was expected is this client's: told so by a notice, or to be asked for."""
        if self.expected.pop(arc.id, None) is not None:
            if arc.state in ("expected", "awaited"):
                arc.state = "asking"
            self.add(arc)

    def forget(self, arc: OpenArc) -> None:
        self.arcs.pop(arc.id, None)
        self.moved.pop(arc.id, None)
        self.expected.pop(arc.id, None)

    def notify(self, arc: OpenArc) -> None:
        """Wakes all who wait for news of `arc`."""
        arc._news.set()
        for watcher in self.watchers:
            watcher(arc)

    async def changed(self, arc: OpenArc) -> None:
        """Waits for the next news; not at all where none is to come."""
        if arc.id in self.arcs or arc.id in self.moved or arc.id in self.expected:
            arc._news.clear()
            await arc._news.wait()

    def take(self, arc: OpenArc, notice: Notice) -> None:
        """Applies a notice of the RCM about one of `arcs`."""
        if notice.id != arc.id:
            # An answer that was on its way when the ARC was taken back under another id.
            return
        granted, unserved = arc.grant is not None, {arc._settling, arc._unserved} - {None}
        if notice.outcome == "handed_over" and not self.resumed.is_set():
            # Not before the hand-over is answered: an RCM that dies first may not have notified the other.
            return
        if notice.outcome == "handed_over" and arc.id in self.reclaimed and arc.open:
            self.move(arc, notice)
            self.reclaim(arc)
        elif arc._is_not_here_yet(notice):
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
                self._ask_anew(arc)
            elif arc._shows_place(notice):
                self._ask_again(arc)
            self.notify(arc)
            if not arc.open:
                self.forget(arc)

    def _ask_anew(self, arc: OpenArc) -> None:
        """Nobody made use of its time: it is asked for under a new id, at its place."""
        del self.arcs[arc.id]
        arc._take_back(new_instance(), "it had its time before this client heard of it", self._now())
        arc.booking = ""  # so had that
        self.arcs[arc.id] = arc
        self._ask_again(arc)

    def open_requests(self) -> list[OpenRequest]:
        """All, as it is reported to an RCM that takes the lead. What is expected has no place: it is this
        client's if the RCs report it so, and nothing is queued for it otherwise."""
        now = self._now()
        expected = [msgspec.structs.replace(arc._open_request(now), place=None) for arc in self.expected.values()]
        return [*(arc._open_request(now) for arc in self.open), *expected]

    def move(self, arc: OpenArc, notice: Notice) -> None:
        """`arc` goes on in another client, as of `notice`; earlier notices are old."""
        arc._move(self._now())
        arc._last = max(arc._last, (notice.term, notice.step))
        self.arcs.pop(arc.id, None)
        self.moved[arc.id] = arc
        self.notify(arc)

    def go_back(self, term: Term) -> None:
        """The client follows the leader of `term` after higher ones."""
        for arc in (*self.arcs.values(), *self.moved.values(), *self.expected.values()):
            arc._go_back(term)

    def reclaim(self, arc: OpenArc) -> None:
        """A moved one is this client's again, under a new id; it is to be asked for."""
        del self.moved[arc.id]
        self.reclaimed.discard(arc.id)
        arc._take_back(new_instance(), "it was handed over, and its new client is gone", self._now())
        self.arcs[arc.id] = arc
        self.notify(arc)
