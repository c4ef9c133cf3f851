"""Query the journals of all candidates in parallel, and merge the answers."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from msgspec import structs

from zscout.config.fleet import MAX_CANDIDATES, Fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import Mesh
from zscout.mesh.supervision import done_within
from zscout.messages import MAX_PAGE, History, HistoryAsk, PastHold
from zscout.services.journal.merging import Span, enough, merged, unknown_to, unknown_to_all
from zscout.types import HostName

ASK: Final = 5.0  # seconds that a candidate has for a page
QUIET: Final = 0.3  # seconds without another candidate that end the search
AT_ONCE: Final = 16  # candidates queried at one time
CAUSES: Final[Mapping[str, str]] = {
    "off": "did not run",
    "silent": "received nothing from an RCM",
    "missed": "missed publications",
    "dropped": "could not store everything",
}


class NoJournal(Exception):
    """A journal is not available, or only in part; the text is one line with the reason."""


class NoCandidate(NoJournal): ...


@dataclass(frozen=True, slots=True)
class FleetHistory:
    """The merged answers of the journals of a fleet."""

    window: Span
    holds: Sequence[PastHold]  # by start; the latest, if there are too many
    more: bool  # True if there are earlier ones
    journals: Mapping[HostName, History]  # the first page of each candidate that answered
    without: Sequence[HostName]  # candidates without an answer: without a journal, of an old version, or too slow

    @property
    def unknown(self) -> list[Span]:
        """Times that no journal covers."""
        return unknown_to_all([*self.journals.values()], self.window)

    def causes(self, unknown: Span) -> str:
        """Why each candidate lacks the period `unknown`."""
        words = []
        for host, journal in sorted(self.journals.items()):
            found = [
                CAUSES[gap.cause]
                for gap in journal.gaps
                if gap.began < unknown.ended and (gap.ended is None or gap.ended > unknown.began)
            ]
            if not found and any(span.ended > unknown.began for span in unknown_to(journal, unknown)):
                found = ["has no entries of that time"]
            words += [f"{host} {', '.join(dict.fromkeys(found))}"] if found else []
        return "; ".join(words)


async def ask_journals(
    mesh: Mesh,
    fleet: Fleet,
    asked: HistoryAsk,
    most: int,
    *,
    look: float = QUIET,
    wall: Callable[[], float] = time.time,
) -> FleetHistory:
    """The latest holds, at most `most`, from as few journals as cover all. `look`: seconds for a first candidate to
    appear; `wall`: seconds since 1970, UTC. Raises NoJournal if none answers, or one stops midway."""
    hosts = await _candidates(mesh, fleet, look)
    why = f"no journal of fleet {fleet.name} can be read"
    if not hosts:
        raise NoCandidate(f"{why}: no node with a journal is on the mesh; see [journal] of a node file")
    slots = asyncio.Semaphore(AT_ONCE)

    async def page(host: HostName, question: HistoryAsk) -> History | None:
        async with slots:
            reply = await mesh.ask_one(mesh.keys.history(host, mesh.me), question, History, timeout=ASK)
        return reply.message if reply is not None and reply.message is not None and reply.message.host == host else None

    async def pages(host: HostName) -> tuple[list[PastHold], bool]:
        found: list[PastHold] = []
        question: HistoryAsk | None = structs.replace(asked, limit=min(most, MAX_PAGE))
        while question is not None and len(found) < most:
            answer = await page(host, question)
            if answer is None:
                raise NoJournal(f"{host} stopped answering halfway; try again")
            found += answer.holds
            # A page without progress would repeat for ever.
            ahead = answer.next is not None and answer.next != question.before
            question = structs.replace(question, before=answer.next) if ahead else None
        return found, question is not None

    firsts = await asyncio.gather(*(page(host, structs.replace(asked, limit=1)) for host in hosts))
    journals = {host: first for host, first in zip(hosts, firsts, strict=True) if first is not None}
    if not journals:
        count = "1 candidate" if len(hosts) == 1 else f"{len(hosts)} candidates"
        raise NoJournal(f"{why}: none of {count} answered; see [journal] of a node file")
    now = wall()
    begins = [journal.since for journal in journals.values() if journal.since is not None]
    began = now - asked.since if asked.since is not None else min(begins, default=now)
    window = Span(began, now - asked.until)
    found = await asyncio.gather(*map(pages, enough(journals, window)))
    holds = merged(some for some, _ in found)
    more = len(holds) > most or any(left for _, left in found)
    return FleetHistory(window, holds[-most:], more, journals, [host for host in hosts if host not in journals])


async def _candidates(mesh: Mesh, fleet: Fleet, look: float) -> list[HostName]:
    """Candidates on the mesh: links come one by one, so wait until no more appear."""
    hosts: set[HostName] = set()
    changed = asyncio.Event()

    def seen(token: Token, alive: bool) -> None:
        if alive and fleet.may_lead(token.host) and token.host not in hosts:
            hosts.add(token.host)
            changed.set()

    watch = mesh.watch(mesh.keys.alive_any(Role.CANDIDATE), seen)
    try:
        known = -1
        while known < len(hosts) <= MAX_CANDIDATES:
            known = len(hosts)
            changed.clear()
            await done_within(QUIET if hosts else look, changed.wait())
    finally:
        watch.close()
    return sorted(hosts)[:MAX_CANDIDATES]
