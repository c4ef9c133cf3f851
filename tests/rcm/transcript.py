"""Stories of the leader as text (see `tests/transcripts.py`): stimuli, and the Outbox that they lead to. Its commands:

    at TIME                                       sets the clock for what follows; `at TIME COMMAND` too
    secured NAME=client|operator ...                a new leader, with [security] and these roles
    holds RC HOST [begins=S] [unwell=WHY] [ID CLIENT TERM.N RC,... [priority=N] [remaining=S] [place=TERM.N]
                                                  [waits=S]]: what an RC answered to the takeover
    lists CLIENT [ID NEED,... [priority=N] [place=TERM.N] [grant=TERM.N]]
                                                  what a client answered to it
    lead                                          takes over what was answered
    come rc NAME HOST          come client NAME   gone rc NAME HOST         gone client NAME
    promise RC HOST [ID ...]                      an RC's answer to the question for its promise, as in `holds`
    requests CLIENT [ID ...]                      a client's answer to the question for its requests, as in `lists`
    state RC HOST [ID ...]                        an RC publishes its state
    ask CLIENT ID NEED,... [priority=N] [runtime=S] [place=TERM.N] [grant=TERM.N] [rcs=RC,...]
    release CLIENT ID          handover CLIENT ID NEW_CLIENT
    vote N yes|no              dates ID:NEED:START:RUNTIME:PRIORITY ...
    reload NAME=client|operator ...                 these roles are in force from now on
    wait                                          time has passed

All commands of a line, joined by `;`, are one burst. `--` stands between its steps. A TERM is a counter: the leader's
own is 9. Changes of holders, ends included, are numbered: a publication has the number of its last change, a grant that
of its own. Places have numbers of their own. `holds RC HOST` without more: it holds nothing. The log of requests is
written some 0.1 s late, so it appears with the first stimulus after that. `at once` answers need no instant."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any

from msgspec import Struct, structs

from tests.transcripts import ns, settings
from zscout.config.access import AccessPolicy, Roles
from zscout.config.fleet import default_fleet
from zscout.keyexpr import Keys, Role, Token, client_of
from zscout.messages import (
    Ask,
    ClientRequests,
    HandOver,
    Holder,
    Notice,
    OpenRequest,
    Problem,
    Proposal,
    RcState,
    Release,
    Unwell,
    Upcoming,
)
from zscout.rcm import steps
from zscout.rcm.admission import Admission
from zscout.rcm.authority import Authority
from zscout.rcm.device_check import DeviceCheck
from zscout.rcm.devices import ExpectedDevices
from zscout.rcm.leader import Leader
from zscout.rcm.places import Places
from zscout.rcm.recovery import take_over
from zscout.rcm.roster import Roster
from zscout.rcm.steps import Purpose
from zscout.scheduling.booking import Booking, Dates
from zscout.scheduling.core import Core
from zscout.scheduling.model import Effect, HoldEnded, Propose, Vote
from zscout.scheduling.strategies import STRATEGIES
from zscout.types import Grant, Ns, Place, Term

OWN = Term(9, "new")
OPTIONS = ("priority", "runtime", "remaining", "place", "grant", "rcs", "waits")


class NoBookings:
    settled, settles_at, time, age, next = True, 0, None, 0.0, None

    def at(self, _now: Ns) -> NoBookings:
        return self

    def note(self, *_: Any, **__: Any) -> steps.Outbox:
        return steps.Outbox()

    operation = retry = kept = shared = set_clock = tick = note

    def take_up(self, ask: Ask, _sender: Any) -> str:
        return ask.booking

    def dated(self, request: Any) -> Any:
        return request

    def record(self, _booking: str) -> None:
        return None

    def recovered(self, _taken: Any) -> list[Any]:
        return []

    def proposal(self, asked: Propose) -> steps.Proposed:
        return steps.Proposed(asked.rc, Proposal(proposal=asked.proposal, term=OWN, holders=[]))


def _access(words: list[str]) -> AccessPolicy:
    roles = settings(words, *(word.partition("=")[0] for word in words))
    clients, operators = (
        tuple(name for name, role in roles.items() if role == kind) for kind in ("client", "operator")
    )
    return AccessPolicy(Roles(client=clients, operator=operators))


def _pair(text: str) -> tuple[Term, int]:
    counter, _, number = text.partition(".")
    return (OWN if int(counter) == OWN.counter else Term(int(counter), "old")), int(number)


@dataclass
class LeaderPlayer:
    """The leader, and what its takeover has found."""

    now: Ns = 0
    states: list[RcState] = field(default_factory=list)
    lists: list[ClientRequests] = field(default_factory=list)
    open: dict[tuple[Purpose, str], Any] = field(default_factory=dict)
    tickets: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._begin(AccessPolicy(), secured=False)

    def _begin(self, access: AccessPolicy, *, secured: bool) -> None:
        fleet = structs.replace(default_fleet(), access=access, security=Path("keys") if secured else None)
        self.fleet, self.authority, keys = fleet, Authority(fleet), Keys("lab", closed=secured)
        core = Core(STRATEGIES["adaptive"](), self.authority.bound(fleet.scheduling))
        self.admission = Admission(self.authority, Places("lab", None, OWN))
        roster = Roster(keys, "leader", fleet, OWN, ExpectedDevices({}), self.admission, core.arc, self.now)
        device_check = DeviceCheck(ExpectedDevices({}), roster, 0)
        self.keys, self.leader = keys, Leader(fleet, core, self.admission, roster, device_check, NoBookings(), None)

    def batch(self, line: str) -> list[str]:
        stimuli = list[steps.Stimulus]()
        for command in line.split(";"):
            words = command.split()
            while words and words[0] == "at":
                self.now = ns(words[1])
                words = words[2:]
            if words:
                stimuli += self._stimuli(*words)
        if not stimuli and "wait" not in line:
            return []
        lines, more = list[str](), True
        while more:
            told = list[str]()
            for out in self.leader.step(self.now, stimuli):
                told += self._told(out)
                more = out.more
            stimuli = []
            lines += ["--", *told] if lines and told else told
        return lines

    # In

    def _stimuli(self, name: str, *words: str) -> list[steps.Stimulus]:
        what, rest = list(words), list(words[1:])
        match name:
            case "secured":
                self._begin(_access(what), secured=True)
            case "holds":
                self.states.append(self._state(*what))
            case "lists":
                self.lists.append(self._requests(*what))
            case "lead":
                return [steps.Lead(take_over(self.states, self.lists, self.now, self.admission))]
            case "come" | "gone":
                return [steps.TokenSeen(self._token(*what), name == "come")]
            case "promise":
                state = structs.replace(self._state(*what), term=OWN)
                return [steps.QuestionAnswered(self.open.pop((Purpose.PROMISE, what[0])), state)]
            case "requests":
                return [steps.QuestionAnswered(self.open.pop((Purpose.REQUESTS, what[0])), self._requests(*what))]
            case "state":
                state = structs.replace(self._state(*what), term=OWN, seq=self.leader.seq)
                return [steps.Reported(state)]
            case "ask":
                return [self._asked(what[0], self._ask(*rest))]
            case "release":
                return [self._asked(what[0], Release(what[1]))]
            case "handover":
                return [self._asked(what[0], HandOver(what[1], what[2]))]
            case "vote":
                return [steps.CoreEvents([Vote(int(what[0]), what[1] == "yes")])]
            case "dates":
                return [steps.CoreEvents([Dates(tuple(map(self._date, what)))])]
            case "reload":
                self.authority.reload(structs.replace(self.fleet, access=_access(what)))
                return [steps.Reloaded()]
            case "wait":
                pass
            case _:
                raise ValueError(f"no such command: {name}")
        return []

    def _token(self, kind: str, name: str, host: str = "") -> Token:
        if kind == "rc":
            return Token(host, Role.RC, name, f"{host}-1")
        client = client_of(name)
        return Token(client.host, Role.CLIENT, client.client, "1")

    def _state(self, rc: str, host: str, *words: str) -> RcState:
        holders, known = [], dict[str, Any]()
        if words and words[0].startswith("begins="):
            known = {"begin_within": float(words[0].partition("=")[2]), "settle": 5.0}
            words = words[1:]
        if words and words[0].startswith("unwell="):
            known["unwell"] = Unwell(words[0].partition("=")[2], since=1.0, left=59.0)
            words = words[1:]
        if words:
            id_, client, grant, rcs = words[:4]
            more = settings(words[4:], *OPTIONS)
            place = Place(*_pair(more.get("place", "1.1")))
            remaining, priority = float(more.get("remaining", 60)), int(more.get("priority", 0))
            held = Grant(*_pair(grant))
            holder = Holder(id_, id_, client, held, place, rcs.split(","), Decimal(60), remaining, priority=priority)
            if "waits" in more:
                holder = structs.replace(holder, waits=float(more["waits"]))
            holders.append(holder)
        return RcState(rc, host, f"{host}-1", sharable=False, holders=holders, **known)

    def _requests(self, client: str, *words: str) -> ClientRequests:
        return ClientRequests(client, [self._ask(*words, kind=OpenRequest)] if words else [], OWN)

    def _ask(self, id_: str, needs: str, *words: str, kind: type[Any] = Ask) -> Any:
        more = settings(words, *OPTIONS)
        known: dict[str, Any] = {"priority": int(more.get("priority", 0))}
        if "place" in more:
            known["place"] = Place(*_pair(more["place"]))
        if "grant" in more:
            known["grant"] = Grant(*_pair(more["grant"]))
        if "rcs" in more:
            known["rcs"] = more["rcs"].split(",")
        wanted = {need: dict[str, Decimal]() for need in needs.split(",")}
        return kind(id=id_, arc=id_, needs=wanted, min_runtime=Decimal(more.get("runtime", "60")), **known)

    def _asked(self, client: str, operation: Any) -> steps.OperationAsked:
        self.tickets.append(f"{client} {type(operation).__name__.lower()} {operation.id}")
        return steps.OperationAsked(len(self.tickets), client_of(client), operation)

    def _date(self, text: str) -> Booking:
        id_, need, start, runtime, priority = text.split(":")
        return Booking(id_, {need: {}}, int(priority), ns(start), ns(runtime), ns(runtime), 0, owner="desk")

    # Out

    def _told(self, out: steps.Outbox) -> Iterator[str]:
        for ticket, message in out.at_once:
            yield f"at once {self.tickets[ticket - 1]}: {_answer(message)}"
        for word, _ in out.higher:
            yield f"higher  term {word.term.counter} of {word.by}"
        for ticket, message in out.granted:
            yield f"answer  {self.tickets[ticket - 1]}: {_answer(message)}"
        yield from (f"notice  {_notice(notice)}" for notice in out.grant_notices)
        if out.publication is not None:
            number = f"{out.publication.term.counter}.{out.publication.seq}"
            for rc, held in out.publication.rcs.items():
                holders = ", ".join(
                    f"{holder.id} of {holder.client} by {_grant(holder.grant)}{_waits(holder)}" for holder in held
                )
                yield f"publish {number}: {rc}: {holders or 'nobody'}"
            for over in out.publication.revoked:
                yield f"publish {number}: {over.id} of {over.client} is over ({over.outcome}): {over.reason}"
        yield from (f"notice  {_notice(notice)}" for notice in out.notices)
        for ticket, message in out.answers:
            yield f"answer  {self.tickets[ticket - 1]}: {_answer(message)}"
        for proposed in out.proposals:
            yield f"propose {proposed.proposal.proposal} to {proposed.rc}"
        for question in out.questions:
            subject = question.token.name if question.token is not None else question.client
            self.open[question.purpose, subject] = question
            yield f"question {subject or question.key}: {question.purpose.value}"
        yield from (f"date    {_effect(effect)}" for effect in out.effects if "Booking" in type(effect).__name__)
        yield from (f"strange {text}" for _, text in out.strange)
        for text in out.log:
            yield from (f"log     {line.strip()}" for line in text.splitlines())


def _answer(message: Struct) -> str:
    if isinstance(message, Notice):
        return _state(message)
    return f"{message.code}: {message.message}" if isinstance(message, Problem) else str(message)


def _notice(notice: Notice) -> str:
    return f"{notice.client} {notice.id}: {_state(notice)}"


def _state(notice: Notice) -> str:
    if notice.state == "running" and notice.grant is not None:
        coming = "".join(f"; {_upcoming(end)}" for end in notice.upcoming)
        return f"running by {_grant(notice.grant)} on {', '.join(notice.rcs)}{_waits(notice)}{coming}"
    place = f" at place {notice.place.term.counter}.{notice.place.arrival}" if notice.place is not None else ""
    why = notice.problem.message if isinstance(notice.problem, Problem) else notice.reason
    return f"{notice.state}{place}{f' ({notice.outcome})' if notice.outcome else ''}{f': {why}' if why else ''}"


def _waits(told: Holder | Notice) -> str:
    if told.waits is None:
        return ""
    then = f"then {told.remaining:g} s" if isinstance(told, Holder) else f"until {told.remaining:g} s from now"
    return f", which begin within {told.waits:g} s, {then}"


def _upcoming(end: Upcoming) -> str:
    by, rcs = f"{end.by.arc} of {end.by.client}" if end.by.client else end.by.arc, ", ".join(end.rcs)
    date = "" if end.begins_in is None else f" from in {end.begins_in:g} s on"
    verb = {"waits": "waits for", "booked": "has booked", "maintenance": "maintains"}[end.code]
    return f"{by} {verb} {rcs}{date}: safe for {end.safe:g} s"


def _grant(grant: Grant) -> str:
    return f"{grant.term.counter}.{grant.seq}"


def _effect(effect: Effect) -> str:
    assert not isinstance(effect, HoldEnded)
    return " ".join(f"{name}={value}" for name, value in structs.asdict(effect).items())
