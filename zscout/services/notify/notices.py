"""Notifications and their texts. Pure. A new event is a value of `NotifyEvent` and a function here."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from datetime import UTC, datetime, tzinfo
from typing import Final, NamedTuple

from zscout.config.notify import NotifyEvent
from zscout.messages import LoadReport
from zscout.rcm.steps import BookedDanger
from zscout.scheduling.model import ArcRequest, Outcome
from zscout.scheduling.reason import named
from zscout.services.bookings.dates import zone_of
from zscout.services.rcm.digest import Began, Over
from zscout.types import SECOND, HostName, Ns, RcName, clean, span

MAX_TITLE: Final = 120
MAX_BODY: Final = 1_000
"""Characters; longer texts are cut, as parts of them come from other programs."""
DAY: Final = 86_400


class Notification(NamedTuple):
    """`user` is the recipient; empty: no particular user."""

    event: NotifyEvent
    user: str
    title: str
    body: str


class HoldNotices:
    """Notifies of grants after a wait of at least `after`, of preempted holds, and of unwell devices."""

    def __init__(self, fleet: str, after: Ns, notify: Callable[[Notification], object]) -> None:
        self._fleet, self._after, self._notify = fleet, after, notify

    def on_began(self, began: Began) -> None:
        if not began.waited or began.waited < self._after:
            return
        request = began.request
        title = f"zscout {self._fleet}: {request.name} is yours now"
        body = f"{_whose(request)} holds {_listed(began.rcs)} after a wait of {span(began.waited / SECOND)}"
        self._notify(notification("yours_now", _user(request), title, body))

    def on_over(self, over: Over) -> None:
        if over.outcome is not Outcome.PREEMPTED:
            return
        request, held = over.began.request, over.at - over.began.at
        title = f"zscout {self._fleet}: {request.name} was preempted"
        waits = "; it waits again" if over.requeued else ""
        body = f"{_whose(request)} held {_listed(over.began.rcs)} for {span(held / SECOND)}: {over.reason}{waits}"
        self._notify(notification("preempted", _user(request), title, body))

    def on_unwell(self, rc: RcName, why: str, holders: Sequence[ArcRequest]) -> None:
        title = f"zscout {self._fleet}: {rc} is {'unwell' if why else 'well again'}"
        for request in holders:
            body = f"{_whose(request)} keeps it" + (f" until it is lost: {why}" if why else "")
            self._notify(notification("device_unwell", _user(request), title, body))
        if not holders:
            body = f"only operators get it: {why}" if why else "it is granted again"
            self._notify(notification("device_unwell", "", title, body))


def booking_notice(fleet: str, danger: BookedDanger) -> Notification:
    """A booking is in danger, has lapsed, or is safe again; its date is in the owner's zone."""
    record, why, later = danger.record, danger.why, danger.later
    state = "has lapsed" if danger.over else "is in danger" if why else "is safe again"
    title = f"zscout {fleet}: your booking {record.name} {state}"
    zone: tzinfo = UTC
    with suppress(ValueError):  # the zone is unknown here
        zone = zone_of(record.zone)
    at = datetime.fromtimestamp(danger.start, zone).strftime("%Y-%m-%d %H:%M %Z")
    more = f", and {later} later date{'s' * (later > 1)}" if later else ""
    body = f"{_listed(record.needs)} from {at} on{more}{': ' if why else ''}{why}"
    return notification("booking_in_danger", (record.who.user if record.who else "") or record.owner, title, body)


class CertificateNotices:
    """Notifies once of each host whose certificate ends soon, and again after a renewal."""

    def __init__(self, fleet: str) -> None:
        self._fleet = fleet
        self._notified: set[HostName] = set()

    def look(self, reports: Iterable[LoadReport]) -> list[Notification]:
        found = []
        for report in reports:
            left = report.certificate_ends_in
            if left is None or not report.renew:
                self._notified.discard(report.host)
            elif report.host not in self._notified:
                self._notified.add(report.host)
                end = f"expires in {left / DAY:.1f} days" if left > 0 else "has expired"
                title = f"zscout {self._fleet}: the certificate of {report.host} {end}"
                found.append(notification("certificate_ends", "", title, "renew it: zscout cert renew"))
        return found


def notification(event: NotifyEvent, user: str, title: str, body: str) -> Notification:
    return Notification(event, user, clean(title)[:MAX_TITLE], clean(body)[:MAX_BODY])


def _user(request: ArcRequest) -> str:
    """The user given in the request, else the host (the certificate's name in a secured fleet)."""
    return (request.who.user if request.who is not None else "") or request.client.partition("/")[0]


def _whose(request: ArcRequest) -> str:
    return named(request.who, request.client, request.name)


def _listed(rcs: Iterable[RcName]) -> str:
    return ", ".join(rcs)
