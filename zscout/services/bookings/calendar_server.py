"""Serves bookings as calendars over HTTP, for subscribing programs: of the fleet, an RC, an owner.

Requests query the leader, at most once in `FRESH` seconds. Without a leader programs get 503, and keep their copy."""

from __future__ import annotations

import asyncio
import re
import time
from typing import Final

from zscout.keyexpr import NAME
from zscout.mesh import Mesh
from zscout.messages import BookingsAsk, BookingsTold
from zscout.services.bookings.calendar_text import CONTENT_TYPE, CalendarSelection, calendar_text
from zscout.services.plain_http import Page, PlainHttpServer

FRESH: Final = 5.0  # seconds for which the leader's answer is reused
ASK: Final = 2.0  # seconds for the leader's answer
MAX_TEXTS: Final = 64  # calendars kept as text
_PATH: Final = re.compile(rf"/(?:fleet|rc/(?P<rc>{NAME.pattern}/{NAME.pattern})|owner/(?P<owner>{NAME.pattern}))\.ics")
NOT_NOW: Final = Page(b"no leader answers now\n", status="503 Service Unavailable", headers="Retry-After: 60\r\n")


class CalendarServer(PlainHttpServer):
    where = "calendars are at /fleet.ics, /rc/KIND/NAME.ics and /owner/NAME.ics"

    def __init__(self, mesh: Mesh, fleet: str, bind: str, port: int) -> None:
        super().__init__("calendars", bind, port)
        self._mesh, self._fleet = mesh, fleet
        self._one_by_one = asyncio.Lock()
        self._answer: BookingsTold | None = None
        self._asked = float("-inf")
        self._texts: dict[CalendarSelection, bytes] = {}

    async def page(self, path: str) -> Page | None:
        found = _PATH.fullmatch(path)
        if found is None:
            return None
        selection = CalendarSelection(found["owner"], found["rc"])
        async with self._one_by_one:
            if time.monotonic() - self._asked > FRESH:
                await self._ask()
            if self._answer is None:
                return NOT_NOW
            if selection not in self._texts:
                if len(self._texts) >= MAX_TEXTS:
                    self._texts.clear()
                text = await asyncio.to_thread(calendar_text, self._fleet, self._answer.bookings, selection)
                self._texts[selection] = text
            return Page(self._texts[selection], CONTENT_TYPE)

    async def _ask(self) -> None:
        reply = await self._mesh.ask_one(self._mesh.keys.rcm_bookings, BookingsAsk(), BookingsTold, timeout=ASK)
        answer = reply.message if reply is not None else None
        if answer is None or self._answer is None or answer.bookings != self._answer.bookings:
            self._texts.clear()
        self._answer, self._asked = answer, time.monotonic()
