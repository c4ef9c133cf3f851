"""What the journals of all candidates tell: asked side by side, and merged."""

from __future__ import annotations

import asyncio
import csv
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

import click
from msgspec import structs

from zscout.cli.common import LOOK_FOR_RCM, F, Failed, Parsed, see_rcm, until
from zscout.config.fleet import MAX_CANDIDATES, Fleet
from zscout.config.strict import DURATIONS, BadInput, parse_duration, quoted
from zscout.keyexpr import MAX_NAME, Role, Token, check_need
from zscout.messages import MAX_ASKED_NAMES, MAX_PAGE, History, HistoryAsk, PastHold
from zscout.services.journal.merging import Span, enough, merged, unknown_to, unknown_to_all
from zscout.terminal import Table, clean, many, span
from zscout.types import HostName

if TYPE_CHECKING:
    from zscout.behaviors.client.client import Client

ASK: Final = 5.0
"""Seconds that a candidate has for a page."""
QUIET: Final = 0.3
"""Seconds without another candidate after which all are seen."""
AT_ONCE: Final = 16
"""Candidates that are asked at one time."""
MAX_AGO: Final = 1e9
CAUSES: Final[Mapping[str, str]] = {
    "off": "did not run",
    "silent": "heard no RCM",
    "missed": "missed publications",
    "dropped": "could not keep all",
}
PAST_FORMS: Final = f"{DURATIONS}, or a date as in 2026-11-20 or 2026-11-20T14:30"
FORMULA: Final = ("=", "+", "-", "@")
"""How a cell begins that a spreadsheet would compute."""


def parse_past(text: str, option: str) -> float:
    """Seconds ago, from a duration or a time of this host's clock and zone. Raises BadInput."""
    ago: float | None = None
    if (seconds := parse_duration(text)) is not None:
        ago = float(seconds)
    else:
        try:
            ago = time.time() - datetime.fromisoformat(text).astimezone().timestamp()
        except (ValueError, OverflowError):
            raise BadInput(f"{option}: {quoted(text)} is no time; write {PAST_FORMS}") from None
    if option == "--until":
        ago = max(0.0, ago)  # up to now
    if not 0 <= ago <= MAX_AGO:
        raise BadInput(
            f"{option}: {quoted(text)} is {'in the future' if ago < 0 else 'too long ago'}; write {PAST_FORMS}"
        )
    return ago


PAST: Final = Parsed("time", parse_past)


def parse_who(text: str, option: str) -> str:
    """A user, or a name of a certificate or host. Raises BadInput."""
    if not 1 <= len(text) <= MAX_NAME:
        raise BadInput(f"{option}: {quoted(text)} is no name; write 1 to {MAX_NAME} characters")
    return text


def parse_rc_pattern(text: str, _option: str) -> str:
    """An RC, or a pattern. Raises BadName."""
    return check_need(text)


WHO: Final = Parsed("text", parse_who)
RC: Final = Parsed("text", parse_rc_pattern)


def formats(command: F) -> F:
    """`--json` and `--csv`; the parameters are `as_json` and `as_csv`."""
    command = click.option("--csv", "as_csv", is_flag=True, help="Print CSV, with a line of names.")(command)
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")(command)


def check_formats(*, as_json: bool, as_csv: bool) -> None:
    """Raises UsageError."""
    if as_json and as_csv:
        raise click.UsageError("--json and --csv: write one of them")


def check_window(since: float | None, until: float) -> None:
    """Raises BadInput."""
    if since is not None and since <= until:
        raise BadInput("--since: it is not before --until; write a longer time ago")


def names_of(fleet: Fleet, users: Sequence[str], group: str | None) -> list[str]:
    """These users, and those of a group of the fleet file. Raises BadInput."""
    names = [*users]
    if group is not None:
        if not fleet.access.groups.get(group):
            known = f"known: {', '.join(sorted(fleet.access.groups)[:8])}" if fleet.access.groups else "it has none"
            raise BadInput(f"--group: {quoted(group)} is no group of the fleet file that has members; {known}")
        names += fleet.access.groups[group]
    if len(names) > MAX_ASKED_NAMES:
        raise BadInput(f"{len(names)} names are too many to ask for; {MAX_ASKED_NAMES} are allowed")
    return names


@dataclass(frozen=True, slots=True)
class Told:
    """What the journals tell of a window."""

    window: Span
    holds: Sequence[PastHold]
    """In the order in which they began: of more than were wanted the latest."""
    more: bool
    """Whether there are earlier ones."""
    journals: Mapping[HostName, History]
    """The first page of each candidate that answered."""
    without: Sequence[HostName]
    """Candidates that did not: they keep no journal, are older than journals, or too slow."""

    @property
    def unknown(self) -> list[Span]:
        """Times of which no journal knows all."""
        return unknown_to_all([*self.journals.values()], self.window)

    def causes(self, unknown: Span) -> str:
        """Why none knows of it, by candidate."""
        words = []
        for host, journal in sorted(self.journals.items()):
            found = [
                CAUSES[gap.cause]
                for gap in journal.gaps
                if gap.began < unknown.ended and (gap.ended is None or gap.ended > unknown.began)
            ]
            if not found and any(one.ended > unknown.began for one in unknown_to(journal, unknown)):
                found = ["has nothing of then"]
            words += [f"{host} {', '.join(dict.fromkeys(found))}"] if found else []
        return "; ".join(words)

    def remarks(self) -> Iterable[str]:
        """What is not known, in lines."""
        for one in self.unknown:
            yield f"from {local(one.began)} to {local(one.ended)} not all is known: {self.causes(one)}"
        if self.without:
            yield f"no journal of {', '.join(self.without)}: off, older than 0.3.0, or too slow"

    def as_json(self, fleet: str, **told: object) -> dict[str, Any]:
        """As `--json` prints it, with what it has `told` of the window."""
        candidates: list[dict[str, Any]] = [
            {
                "host": host,
                "since": None if one.since is None else utc(one.since),
                "gaps": [structs.asdict(gap) | _times(gap.began, gap.ended) for gap in one.gaps],
            }
            for host, one in sorted(self.journals.items())
        ]
        return {
            "fleet": fleet,
            "since": utc(self.window.began),
            "until": utc(self.window.ended),
            **told,
            "more": self.more,
            "gaps": [_times(one.began, one.ended) | {"why": self.causes(one)} for one in self.unknown],
            "candidates": candidates + [{"host": host, "since": None, "gaps": None} for host in self.without],
        }


async def ask_journals(client: Client, asked: HistoryAsk, most: int) -> Told:
    """The latest holds, `most` at most, from as few journals as know all that any knows. Raises Failed where none
    answers."""
    mesh = client.mesh
    hosts = await _candidates(client)
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
                raise Failed(f"{host} did not go on to tell its journal; try again")
            found += answer.holds
            # What does not go on would never end.
            ahead = answer.next is not None and answer.next != question.before
            question = structs.replace(question, before=answer.next) if ahead else None
        return found, question is not None

    firsts = await asyncio.gather(*(page(host, structs.replace(asked, limit=1)) for host in hosts))
    journals = {host: first for host, first in zip(hosts, firsts, strict=True) if first is not None}
    if not journals:
        seen = f"none of its {many(len(hosts), 'candidate')} answers" if hosts else "no candidate is seen"
        raise Failed(
            f"fleet {client.fleet.name} has no journal that could be asked: {seen}; see [journal] of a node file"
        )
    now = time.time()
    begins = [one.since for one in journals.values() if one.since is not None]
    began = now - asked.since if asked.since is not None else min(begins, default=now)
    window = Span(began, now - asked.until)
    found = await asyncio.gather(*map(pages, enough(journals, window)))
    holds = merged(some for some, _ in found)
    more = len(holds) > most or any(left for _, left in found)
    return Told(window, holds[-most:], more, journals, [host for host in hosts if host not in journals])


async def _candidates(client: Client) -> list[HostName]:
    """Those that are there: links are made one after another, so until no more come into sight. Raises NobodyThere."""
    hosts: set[HostName] = set()
    changed = asyncio.Event()

    def seen(token: Token, alive: bool) -> None:
        if alive and client.fleet.may_lead(token.host):
            hosts.add(token.host)
            changed.set()

    watch = client.mesh.watch(client.mesh.keys.alive_any(Role.CANDIDATE), seen)
    try:
        if not await until(lambda: bool(hosts), changed, LOOK_FOR_RCM):
            await see_rcm(client, 0.0)
        known = -1
        while known < len(hosts) <= MAX_CANDIDATES:
            known = len(hosts)
            await until(lambda: len(hosts) > known, changed, QUIET)  # noqa: B023 - awaited
    finally:
        watch.close()
    return sorted(hosts)[:MAX_CANDIDATES]


# Words


def utc(at: float) -> str:
    """For programs: `2026-11-20T14:30:05.123Z`."""
    return datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def local(at: float) -> str:
    """For people, by this host's zone: `2026-11-20 14:30:05`."""
    return f"{datetime.fromtimestamp(at).astimezone():%Y-%m-%d %H:%M:%S}"


def person(hold: PastHold, *, proven: bool) -> str:
    """Whose a hold was: the name of the certificate where those are `proven`, else the user that its program told; of
    one that told none the host."""
    told = hold.who.user if hold.who is not None else ""
    return hold.client.partition("/")[0] if proven or not told else told


def held(hold: PastHold, now: float) -> float:
    """Seconds for which it stood, or has stood until now."""
    return max(0.0, (now if hold.ended is None else hold.ended) - hold.began)


def ending(hold: PastHold) -> str:
    """How it ended, in a few words."""
    if hold.ended is None:
        return "stands"
    words = {"unheard": "end not heard", "client_lost": "client lost", "handed_over": "handed over"}
    by = ""
    if hold.by is not None:
        user = hold.by.who.user if hold.by.who is not None else ""
        by = f" by {hold.by.arc}" + (f" of {user}" if user else "")
    return words.get(hold.outcome, hold.outcome) + by


def hold_json(hold: PastHold, now: float) -> dict[str, Any]:
    """As `--json` prints it: times in UTC, spans in seconds."""
    return structs.asdict(hold) | _times(hold.began, hold.ended) | {"held": round(held(hold, now), 3)}


def _times(began: float, ended: float | None) -> dict[str, str | None]:
    return {"began": utc(began), "ended": None if ended is None else utc(ended)}


def print_csv(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """CSV whose texts no spreadsheet computes."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_cell(cell) for cell in row])


def _cell(cell: object) -> object:
    if not isinstance(cell, str):
        return cell
    return f"'{clean(cell)}" if cell.startswith(FORMULA) else clean(cell)


def print_remarks(told: Told, *, err: bool = False) -> None:
    for line in told.remarks():
        click.secho(clean(line), fg="yellow", err=err)


def holds_table(title: str, told: Told, holds: Sequence[PastHold], *, proven: bool) -> Table:
    rows, styles = [], []
    for hold in holds:
        waited = "?" if hold.waited is None else span(hold.waited)
        lasted = span(held(hold, told.window.ended)) + (" or more" if hold.late or hold.outcome == "unheard" else "")
        whose = person(hold, proven=proven)
        rows.append(
            (local(hold.began), lasted, hold.arc, whose, str(hold.priority), waited, ending(hold), " ".join(hold.rcs))
        )
        styles.append(
            {"preempted": "red", "lost": "red", "client_lost": "red"}.get(hold.outcome, "" if hold.ended else "bold")
        )
    columns = ("BEGAN", "HELD", "ARC", "WHO", "PRIORITY", "WAITED", "END", "RCS")
    return Table(title, columns, rows, styles, spare={"PRIORITY", "WAITED"}, cut={"END"})
