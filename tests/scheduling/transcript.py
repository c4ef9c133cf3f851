"""Stories of the scheduling core as text (see `tests/transcripts.py`). Its commands:

    at TIME                                    sets the clock for what follows; `at TIME COMMAND` too
    join RC [sharable] [host=NAME] [begins=S|unknown]                       lost CLIENT
    unwell RC WHY       well RC
    leave RC [REASON]   waits RC ARC S         begun RC ARC
    ask ARC NEED,... [priority=N] [runtime=S] [client=NAME] [keep] [place=TERM.N] [continues=ARC]
    cancel ARC          release ARC            handover ARC CLIENT NEW_NAME    tick
    vote N yes|no [REASON]                     overdue N
    rules RC            ended RC ARC,...
    standing ARC ... grant=TERM.N start=S [waits=RC:S]  waiting ARC ...              for the `lead` that follows
    adopt ARC ... grant=TERM.N start=S         place ARC TERM.N             unconfirmed ARC TERM.N RC,...
    lead TERM
    book ID NEED,... start=S [runtime=S] [patience=S] [priority=N] [since=S] [bound=RC,...] [tentative]
        [maintenance] [urgent] [lasting] [broken]       which may name a host: `@anvil`
    unbook ID [now]     redate ID S            slots ID NEED,... start=S until=S [runtime=S] [priority=N] [bookings]
    strategy NAME [patience=S] [half_life=S]   a new core; without it, it is `priority`; a half-life: with fair shares
    upcoming                                   the holds that may have other upcoming ends, with these

`begins` is the bound on how long an RC needs to begin; `waits`: an ARC waits for it for S seconds at most. What is
unbooked `now` can't be at present. What is `bound` are the RCs kept for the patterns, in their order. A NEED is
`kind/name`, with parameters `kind/name{rate=5 width=0.1}`; a TERM is `COUNTER:RCM`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import TYPE_CHECKING, cast

from tests.scheduling.validate import validate
from tests.transcripts import ns, seconds, settings
from zscout.config.scheduling_policy import DEFAULT, FairShares
from zscout.keyexpr import is_pattern
from zscout.scheduling import model
from zscout.scheduling.booking import (
    Booked,
    Booking,
    BookingBound,
    BookingChanged,
    BookingConflict,
    BookingThreatened,
    Redated,
    Unbooked,
)
from zscout.scheduling.core import Core
from zscout.scheduling.reason import Reason, ReasonCode
from zscout.scheduling.strategies import STRATEGIES
from zscout.scheduling.upcoming import UpcomingEnd
from zscout.types import Grant, Ns, Params, Place, Term

if TYPE_CHECKING:
    from zscout.config.scheduling_policy import StrategyName

_NEED = re.compile(r"([\w.-]+/[\w.*#-]+|@\w+)(?:\{([^}]*)\})?")


@dataclass
class CorePlayer:
    """The core; it is checked after every batch."""

    core: Core = field(default_factory=Core)
    now: Ns = 0
    bounds: dict[str, Ns | None] = field(default_factory=dict)
    standing: list[model.RecoveredHold] = field(default_factory=list)
    waiting: list[model.Requested] = field(default_factory=list)

    def batch(self, line: str) -> list[str]:
        events: list[model.Event] = []
        for command in line.split(";"):
            words = command.split(maxsplit=2)
            if words[0] == "at":
                self.now = ns(words[1])
                words = words[2].split(maxsplit=2) if len(words) > 2 else []
            if words and words[0] == "upcoming":
                return self.upcoming()
            if words and words[0] == "slots":
                return self.slots(" ".join(words[1:]))
            if words and (event := self.event(words[0], " ".join(words[1:]))) is not None:
                events.append(event)
                if isinstance(event, model.RcJoined):
                    self.bounds[event.rc] = event.begin_within
        if not events:
            return []
        decided = self.core.handle(self.now, *events)
        wakes = [one for one in decided if isinstance(one, model.WakeAt)]
        effects = [*(one for one in decided if one not in wakes), *self.core.report_reasons(), *wakes]
        validate(self.core)
        return [_print(effect) for effect in effects] or ["nothing"]

    def upcoming(self) -> list[str]:
        found = [(arc, self.core.upcoming(arc)) for arc in self.core.contended_holds()]
        return [f"{arc}: {', '.join(map(_upcoming, ends)) or 'nothing'}" for arc, ends in found] or ["none"]

    def slots(self, rest: str) -> list[str]:
        """When a booking would be kept: until a vote is missing."""
        booking, options = _booking(rest, self.now)
        told = self.core.slots(booking, ns(options["until"]), 3, bookings_only="bookings" in rest.split())
        lines = []
        for slot in told.found:
            bound = "".join(f", {rc} for {need}" for need, rc in slot.bound.items())
            lines.append(f"free from {seconds(slot.start)} to {seconds(slot.latest)}{bound}")
        lines += [f"unknown {rc.name}: {', '.join(sorted(holders))}" for rc, holders in told.unknown]
        return lines or ["none"]

    def begins(self, rc: str, name: str, until: Ns | None) -> model.RcBegins:
        arc = self.core.arc(name)
        if arc is None or arc.hold is None:
            raise ValueError(f"{name} holds nothing")
        return model.RcBegins(rc, self.bounds[rc], {arc.hold.grant: until})

    def event(self, verb: str, rest: str) -> model.Event | None:
        first, _, second = rest.partition(" ")
        words = second.split()
        match verb:
            case "ask":
                request, options = _request(rest)
                return model.Requested(request, _place(options["place"]) if "place" in options else None)
            case "standing":
                self.standing.append(_held(rest))
                return None
            case "waiting":
                request, options = _request(rest)
                self.waiting.append(model.Requested(request, _place(options["place"])))
                return None
            case "lead":
                lead = model.LeadTaken(_term(first), tuple(self.standing), tuple(self.waiting))
                self.standing, self.waiting = [], []
                return lead
            case "vote":
                answer, _, reason = second.partition(" ")
                return model.Vote(int(first), accept=_choice(answer, yes="yes", no="no"), reason=reason)
            case "strategy":
                options = settings(words, "patience", "half_life")
                patience = ns(options["patience"]) if "patience" in options else DEFAULT.patience
                fair = FairShares(ns(options["half_life"])) if "half_life" in options else None
                policy = replace(DEFAULT, patience=patience, fair_shares=fair)
                self.core = Core(STRATEGIES[cast("StrategyName", first)](), policy)
                return None
        others: dict[str, Callable[[], model.Event]] = {
            "adopt": lambda: model.Adopted(_held(rest)),
            "place": lambda: model.PlaceShown(first, _place(second)),
            "unconfirmed": lambda: model.Unconfirmed(first, Grant(*_place(words[0])), tuple(words[1].split(","))),
            "reachable": lambda: model.Reachable(first),
            "join": lambda: _join(first, words),
            "waits": lambda: self.begins(first, words[0], self.now + ns(words[1])),
            "begun": lambda: self.begins(first, words[0], None),
            "unwell": lambda: model.RcUnwell(first, second),
            "well": lambda: model.RcUnwell(first),
            "leave": lambda: model.RcLost(first, second) if second else model.RcLost(first),
            "lost": lambda: model.ClientLost(first),
            "cancel": lambda: model.Cancelled(first),
            "release": lambda: model.Released(first),
            "handover": lambda: model.HandedOver(first, *words),
            "overdue": lambda: model.VoteOverdue(int(first)),
            "rules": lambda: model.RcReported(first, rules_changed=True),
            "ended": lambda: model.RcReported(first, ended=tuple(second.split(","))),
            "book": lambda: Booked(_booking(rest, self.now)[0], tentative="tentative" in rest.split()),
            "redate": lambda: Redated(first, ns(second)),
            "unbook": lambda: Unbooked(first, at_present=_flag(second, "now")),
            "tick": model.Tick,
        }
        if verb not in others:
            raise ValueError(f"no such command: {verb}")
        return others[verb]()


def _join(rc: str, words: list[str]) -> model.RcJoined:
    options = settings((word for word in words if word != "sharable"), "begins", "host")
    known, host = options.get("begins", "0"), options.get("host", "")
    return model.RcJoined(rc, "sharable" in words, host, None if known == "unknown" else ns(known))


def _held(text: str) -> model.RecoveredHold:
    request, options = _request(text)
    start = ns(options["start"])
    grant, place = Grant(*_place(options["grant"])), _place(options["place"])
    waits: dict[str, Ns | None] = {}
    if "waits" in options:
        rc, _, until = options["waits"].partition(":")
        waits[rc] = ns(until)
    end = max(start, waits.get(rc, start) or start) + request.min_runtime if waits else start + request.min_runtime
    return model.RecoveredHold(request, place, grant, start, end, waits=waits)


def _booking(text: str, now: Ns) -> tuple[Booking, dict[str, str]]:
    request, options = _request(text)
    patterns = list(filter(is_pattern, request.needs))
    bound = options["bound"].split(",") if "bound" in options else []
    booking = Booking(
        request.arc,
        request.needs,
        request.priority,
        ns(options["start"]),
        request.min_runtime,
        ns(options.get("patience", "5")),
        ns(options["since"]) if "since" in options else now,
        dict(zip(patterns, bound, strict=bool(bound))),
        owner="host",
        maintenance="maintenance" in text.split(),
        urgent="urgent" in text.split(),
        lasting="lasting" in text.split(),
        broken="broken" in text.split(),
    )
    return booking, options


def _request(text: str) -> tuple[model.ArcRequest, dict[str, str]]:
    """`ARC NEED,... key=value ... [keep]`."""
    braces = re.compile(r"\{[^}]*\}")
    # Parameters hold spaces; take them out of the way of the split.
    inner = braces.findall(text)
    arc, needs, *rest = braces.sub("{}", text).split()
    filled = iter(inner)
    wanted: dict[str, Params] = {}
    for need in braces.sub(lambda _: next(filled), needs).split(","):
        match = _NEED.fullmatch(need)
        if match is None:
            raise ValueError(f"not a need: {need}")
        pairs = (pair.split("=") for pair in (match[2] or "").split())
        wanted[match[1]] = {key: Fraction(value) for key, value in pairs}
    words = (
        word
        for word in rest
        if word not in {"keep", "maintenance", "urgent", "lasting", "broken", "bookings", "tentative"}
    )
    known = "priority runtime client place grant start booking patience since bound until waits continues"
    options = settings(words, *known.split())
    request = model.ArcRequest(
        arc=arc,
        client=options.get("client", "host/" + arc),
        needs=wanted,
        priority=int(options.get("priority", "0")),
        min_runtime=ns(options.get("runtime", "10")),
        keep="keep" in rest,
        booking=options.get("booking", ""),
        continues=options.get("continues", ""),
    )
    return request, options


def _term(text: str) -> Term:
    counter, _, rcm = text.partition(":")
    return Term(int(counter), rcm)


def _place(text: str) -> Place:
    term, _, number = text.rpartition(".")
    return Place(_term(term), int(number))


def _flag(word: str, flag: str) -> bool:
    if word not in {"", flag}:
        raise ValueError(f"{word!r} is not {flag!r}")
    return word == flag


def _choice(word: str, *, yes: str, no: str) -> bool:
    if word not in {yes, no}:
        raise ValueError(f"{word!r} is neither {yes!r} nor {no!r}")
    return word == yes


def _print(effect: model.Effect) -> str:
    match effect:
        case model.Propose(proposal=number, rc=rc, holders=holders):
            return f"propose {number} {rc}: " + ", ".join(arc + _share(holders[arc]) for arc in holders)
        case model.Granted(arc=arc, client=client, grant=grant, rcs=rcs, start=start, end=end):
            span = f"from {seconds(start)} " + ("on" if end is None else f"to {seconds(end)}")
            return f"grant {arc} to {client} ({_grant(grant)}): {', '.join(rcs)} {span}"
        case model.HoldTimed(arc=arc, grant=grant, waits=waits):
            return f"hold {arc} ({_grant(grant)}) " + ("begins" if waits is None else f"begins by {seconds(waits)}")
        case model.HoldEnded(arc=arc, grant=grant, outcome=outcome, reason=reason, requeued=requeued, by=by):
            took = f" by {by}" if by is not None else ""
            tail = "; queued again" if requeued else ""
            return f"revoke {arc} ({_grant(grant)}) {outcome.value}{took}: {_told(reason)}{tail}"
        case model.Queued(arc=arc, reason=reason, settled=settled):
            return f"queued {arc}: {_told(reason)}" + ("" if settled else " (not settled)")
        case model.Dropped(arc=arc, outcome=outcome, reason=reason):
            return f"dropped {arc} {outcome.value}: {reason}"
        case BookingChanged(booking=booking, state=state, arc=arc):
            return f"booking {booking} {state.value}" + (f" by {arc}" if arc is not None else "")
        case BookingThreatened(booking=booking, reason=reason):
            return f"booking {booking} " + ("in danger no more" if reason is None else f"in danger: {_told(reason)}")
        case BookingBound(booking=booking, bound=bound):
            return f"booking {booking} bound to {', '.join(bound.values())}"
        case BookingConflict(booking=booking, by=by):
            return f"booking {booking} " + ("stands again" if by is None else f"in conflict with {by or 'all choices'}")
        case model.WakeAt(at=at):
            return "wake " + ("never" if at is None else f"at {seconds(at)}")


def _upcoming(end: UpcomingEnd) -> str:
    date = "" if end.begins is None else f" from {seconds(end.begins)}"
    until = f"safe until {seconds(end.until)}" if end.until else "at any time"
    return f"{end.code} {end.by.name}{date} for {' '.join(end.rcs)}, {until}"


def _told(reason: Reason) -> str:
    """With the times of maintenance, which ends when it was said to."""
    return reason.text(seconds if reason.code is ReasonCode.MAINTENANCE else None)


def _share(params: Params) -> str:
    return "{" + " ".join(f"{key}={float(value):g}" for key, value in sorted(params.items())) + "}"


def _grant(grant: Grant) -> str:
    return f"{grant.term.counter}:{grant.term.rcm}.{grant.seq}"
