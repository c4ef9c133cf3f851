"""Checks every request before it enters the core, whichever way it comes. Pure.

Clients ask, ask for forecasts, hand over, book and take up; at a change of RCM they list their open requests, and RCs
report their holds. `docs/protocol/access.md` has the facts for which each sender is trusted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol, TypeAlias

from msgspec.structs import replace

from zscout.config.fleet import RcmLimits
from zscout.keyexpr import BadName, Sender, check_maintained, check_name, check_need, is_pattern, matcher
from zscout.messages import (
    MAX_PARAMS,
    Amounts,
    Ask,
    Book,
    BookingRecord,
    FindSlots,
    Foresee,
    OpenRequest,
    Refused,
    absurd,
    duration,
    exact_amounts,
)
from zscout.rcm.authority import Authority
from zscout.rcm.places import Places, arc_id
from zscout.scheduling.model import ArcRequest, ArcStatus
from zscout.types import SECOND, ArcId, ClientId, Need, Params, Place, RcName

MAX_PRIORITY: Final = 1_000_000

Wanted: TypeAlias = Ask | Foresee | OpenRequest


class Present(Protocol):
    """The open requests, as limits and quotas count them."""

    @property
    def waiting_now(self) -> int: ...
    def of_client(self, client: ClientId) -> int: ...
    def of_owners(self, names: Collection[str], *but: ArcId) -> int: ...


class Holding(Present, Protocol):
    def held_by(self, names: Collection[str], *but: ArcId) -> int: ...


@dataclass(slots=True)
class Admitted:
    """The requests admitted so far in one instant, before the core has them."""

    waiting_now: int = 0
    _clients: Counter[ClientId] = field(default_factory=Counter)
    _owners: Counter[str] = field(default_factory=Counter)

    def add(self, request: ArcRequest, *, waits: bool) -> None:
        self.waiting_now += waits
        self._clients[request.client] += 1
        self._owners[request.owner] += 1

    def of_client(self, client: ClientId) -> int:
        return self._clients[client]

    def of_owners(self, names: Collection[str], *_: ArcId) -> int:
        return sum(self._owners[name] for name in names)


class Admission:
    def __init__(self, authority: Authority, places: Places) -> None:
        self.authority, self.places = authority, places

    @property
    def limits(self) -> RcmLimits:
        return self.authority.limits

    @property
    def closed(self) -> bool:
        return self.authority.enforced

    def admit(self, asked: Wanted, sender: Sender, present: Present) -> ArcRequest:
        """Return the request, without place and booking. Raises Refused with the fault and the remedy."""
        request = self.form(asked, sender)
        self.check(request, present)
        return request

    def check(self, request: ArcRequest, present: Present) -> None:
        client, owner, limits = request.client, request.owner, self.limits
        self.authority.check_ask(client.partition("/")[0], request, lambda names: present.of_owners(names, request.arc))
        if present.waiting_now >= limits.max_queued:
            raise Refused("queue_full", f"{limits.max_queued} requests already wait; try again later")
        if present.of_client(client) >= (most := limits.max_requests_per_client):
            raise Refused("too_many", f"{client} already has {most} open requests, the most allowed; cancel one")
        if present.of_owners((owner,)) >= (most := limits.max_requests_per_host):
            raise Refused(
                "too_many", f"clients of {owner} already have {most} open requests, the most allowed; cancel one"
            )

    def form(self, asked: Wanted, sender: Sender) -> ArcRequest:
        """The request, if its names and numbers are valid. Raises Refused."""
        more = asked if not isinstance(asked, Foresee) else None
        client = str(sender)
        try:
            self._check_needs(asked.needs, asked.priority)
            check_name(asked.id, "id")
            check_name(asked.arc, "arc")
            if more is not None and more.continues:
                check_name(more.continues, "continues")
            min_runtime = duration(asked.min_runtime, "min_runtime")
            until_done = more is not None and more.until_done
            return ArcRequest(
                arc=arc_id(client, asked.id),
                client=client,
                needs={name: exact_amounts(params) if params else {} for name, params in asked.needs.items()},
                priority=asked.priority,
                min_runtime=min_runtime,
                keep=asked.keep,
                label=asked.arc,
                direct=more is not None and more.direct,
                continues="" if more is None else more.continues,
                who=None if more is None else self.authority.certified_who(sender, more.who),
                charged_to=self.authority.starter(client),
                until_done=self.authority.until_done(sender.host, min_runtime) if until_done else 0,
            )
        except (BadName, ValueError) as error:
            raise Refused("bad_request", str(error)) from None

    def _check_maintenance(self, wanted: Book) -> None:
        """Raises Refused."""
        try:
            self._check_needs(wanted.needs, wanted.priority, check_maintained)
            for params in wanted.needs.values():
                exact_amounts(params)
        except ValueError as error:
            raise Refused("bad_request", str(error)) from None

    def _check_needs(
        self, needs: Mapping[Need, Amounts], priority: int, check: Callable[[str], str] = check_need
    ) -> None:
        """Raises ValueError, BadName."""
        if not needs:
            raise ValueError("needs is empty; name at least one device")
        if len(needs) > self.limits.max_needs:
            raise ValueError(f"{len(needs)} needs; at most {self.limits.max_needs} are allowed")
        if not -MAX_PRIORITY <= priority <= MAX_PRIORITY:
            raise ValueError(f"priority must lie between -{MAX_PRIORITY} and {MAX_PRIORITY}")
        for name, params in needs.items():
            check(name)
            if len(params) > MAX_PARAMS:
                raise ValueError(f"{name} has more than {MAX_PARAMS} parameters")
            for parameter in params:
                check_name(parameter, f"parameter of {name}")

    def check_place(self, place: Place, could_have_issued: Callable[[Place], bool]) -> None:
        """Raises Refused for a place that no RCM can have issued."""
        if absurd(place.term, self.places.term):
            raise Refused("bad_request", "place has a future term; omit it")
        if place.term > self.places.term:
            words = "place has a higher term than this leader; ask the leader of that term"
            raise Refused("old_term", words, self.places.term)
        if place.arrival < 1 or not could_have_issued(place):
            raise Refused("bad_request", "place was never given; omit it")

    def listed_place(self, asked: OpenRequest, client: ClientId) -> Place | None:
        """The listed place, if it is this client's. Raises Refused for an impossible place."""
        if asked.place is None:
            return None
        self.check_place(asked.place, lambda place: place.term != self.places.term)
        known = self.places.may_recover(asked.place, client, asked.was or asked.id, asked.seal)
        return asked.place if known else None

    def check_hand_over(
        self, sender: Sender, to: Sender, arcs: Sequence[ArcStatus], replaced: Sequence[ArcId], present: Holding
    ) -> None:
        """Raises Refused if `to` may not have these ARCs; it has `replaced` already."""
        added, client = len(arcs) - len(replaced), str(to)
        rooms = [(f"{client} has", self.limits.max_requests_per_client - present.of_client(client))]
        if to.host != sender.host:
            left = self.limits.max_requests_per_host - present.of_owners((to.host,))
            rooms.append((f"the clients of {to.host} have", left))
        for who, room in rooms:
            if added > room:
                raise Refused("too_many", f"{who} room for {max(0, room)} more requests, not for {added}")
        self.authority.check_hand_over(
            sender,
            to,
            arcs,
            lambda names: present.of_owners(names, *replaced),
            lambda names: present.held_by(names, *replaced),
        )

    def check_booking(self, wanted: Book | FindSlots, sender: Sender, *, held: bool = False) -> None:
        """Raises Refused if `sender` may not make this booking. `held`: it reports devices broken that it holds."""
        if isinstance(wanted, Book) and wanted.maintenance:
            if not held:
                what = "report devices broken that it does not hold" if wanted.broken else "put devices in maintenance"
                self.authority.check_operator(sender, what)
            self._check_maintenance(wanted)
            return
        asked = Foresee(wanted.id, wanted.id, wanted.needs, wanted.priority, wanted.runtime)
        request = self.form(asked, sender)
        self.authority.check_ask(sender.host, request, lambda _: 0)
        key = "max_booking" if self.limits.max_booking else "max_runtime"
        if (most := getattr(self.limits, key)) and request.min_runtime > most:
            wished, allowed = (f"{span / SECOND:g} s" for span in (request.min_runtime, most))
            raise Refused("bad_date", f"the booking is {wished} long; book at most {allowed} ([limits] {key})")

    def check_owner(self, sender: Sender, record: BookingRecord, what: str) -> None:
        if sender.host != record.owner:
            self.authority.check_operator(sender, f"{what}: {record.name} is {record.owner}'s")

    def check_take_up(self, asked: Ask | OpenRequest, sender: Sender, record: BookingRecord) -> None:
        """Raises Refused."""
        self.check_owner(sender, record, "take it up")
        if record.maintenance:
            raise Refused("bad_request", f"{record.name} is maintenance, which no request can use")
        if asked.needs != record.needs or asked.priority != record.priority:
            raise Refused("bad_request", f"needs or priority differ from booking {record.name}; leave them out")

    def listed_booking(self, asked: OpenRequest, sender: Sender, record: BookingRecord | None) -> str:
        """The booked date that a listed request may use, if any; `record`: of its booking, if known. Raises Refused."""
        if record is not None and self.closed:
            if record.unbooked:
                return ""
            self.check_take_up(asked, sender, record)
        return asked.booking

    def clamped(self, request: ArcRequest) -> ArcRequest:
        """The request of a hold, cut down to what its client may ask for now."""
        host = request.client.partition("/")[0]
        most, longest = self.authority.highest_priority(host), self.authority.longest_runtime(host)
        most = MAX_PRIORITY if most is None else most
        priority = max(-MAX_PRIORITY, min(request.priority, most))
        request = request.at_most(longest) if longest else request
        return request if priority == request.priority else replace(request, priority=priority)


def binding(
    needs: Mapping[Need, Params], held: Collection[RcName], bound: Mapping[Need, RcName]
) -> dict[Need, RcName] | None:
    """The RC for each pattern if `held` meet `needs` exactly, else None: as `bound` if that is valid."""
    patterns = [need for need in needs if is_pattern(need)]
    left = {*held} - needs.keys()
    if len(needs) != len({*held}) or len(left) != len(patterns):
        return None
    if (
        bound.keys() == {*patterns}
        and {*bound.values()} == left
        and all(matcher(need)(rc) for need, rc in bound.items())
    ):
        return dict(bound)
    found: dict[RcName, Need] = {}
    for need in patterns:
        if not _meets(need, left, found, set()):
            return None
    return {need: rc for rc, need in found.items()}


def _meets(need: Need, left: Collection[RcName], found: dict[RcName, Need], tried: set[RcName]) -> bool:
    """Find an RC for a pattern, and move other patterns to other RCs if necessary."""
    for rc in sorted(left):
        if rc not in tried and matcher(need)(rc):
            tried.add(rc)
            if rc not in found or _meets(found[rc], left, found, tried):
                found[rc] = need
                return True
    return False
