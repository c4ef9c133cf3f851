"""`zscout booking export` and `import`: bookings as iCalendar files, and iCalendar events as bookings."""

from __future__ import annotations

import asyncio
import re
import sys
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal
from itertools import groupby, islice
from pathlib import Path
from typing import Any, Final
from zoneinfo import ZoneInfo

import click
from msgspec.structs import replace

from zscout import terminal
from zscout.behaviors.client.bookings import BookingsClient, RcmSilent
from zscout.behaviors.client.client import Client, RequestRefused
from zscout.cli import common, completion
from zscout.cli.booked import ask_bookings, utc, zone_option
from zscout.cli.bookings.calendar_file import MAX_BYTES, read_calendar
from zscout.cli.bookings.calendar_plan import ImportOptions, ImportPlan, Pairs, Wanted, plan_import
from zscout.cli.common import Failed, NobodyThere, Parsed
from zscout.cli.dates import date_words, every_words, host_zone
from zscout.cli.requests.options import MAX_PRIORITY, gather_needs, parse_duration, parse_need
from zscout.config.state_folder import write_durably
from zscout.config.strict import BadInput, quoted, read_bytes
from zscout.keyexpr import Role, check_rc, host_in, is_pattern
from zscout.messages import Book, BookingView, Unbook
from zscout.services.bookings.calendar_text import CalendarSelection, calendar_text
from zscout.terminal import Table, clean, many

MAX_WORDS: Final = 200
CONCURRENT_BOOKINGS: Final = 8
"""Bookings sent at once: a host writes bookings that arrive together to its disk in one step."""
SHOW_PROGRESS_AFTER_S: Final = 1.0
FIND_RCS_S: Final = 1.0
"""Within this time the tokens of all RCs are seen."""
_NEXT_NEED: Final = re.compile(r",(?=[^,=]*/)")


@click.command()
@click.option(
    "--rc",
    type=Parsed("rc", lambda text, _: check_rc(text)),
    shell_complete=completion.needs,
    help="Only bookings of this device.",
)
@click.option("--owner", metavar="NAME", help="Only bookings of a host, or of a person by certificate.")
@click.option("--out", metavar="FILE", help="The file to write. Default, or -: stdout.")
@click.option("--folder", type=click.Path(path_type=Path), help="Write all calendars below this folder.")
@common.runs
async def export(rc: str | None, owner: str | None, out: str | None, folder: Path | None) -> None:
    """Write the bookings that are not over as an iCalendar file.

    With --folder the command writes fleet.ics, rc/KIND/NAME.ics for each device and owner/NAME.ics for each owner, for
    a web server; a device or owner without bookings keeps an empty file. Files are replaced as a whole, and only if
    bookings changed. To let calendar programs subscribe to a node, see [calendar] of the node file.

    \b
    Examples:
      zscout booking export > fleet.ics
      zscout booking export --rc robot/arm1 --out arm1.ics
      zscout booking export --folder calendars
    """
    if folder is not None and (rc or owner or out):
        raise BadInput("--folder writes all calendars; leave --rc, --owner and --out out")
    async with common.connected("calendar") as client:
        bookings = (await ask_bookings(client)).bookings
        rcs = set[str]()
        if folder is not None:
            tokens = await client.mesh.living(client.mesh.keys.alive_any(Role.RC), timeout=FIND_RCS_S)
            rcs = {token.name for token in tokens}
        fleet = client.fleet.name
    if folder is not None:
        written, total = _write_all(folder, fleet, bookings, rcs)
        terminal.print_line(f"{many(total, 'calendar')} in {folder}, {written} of them changed")
        return
    text = calendar_text(fleet, bookings, CalendarSelection(owner, rc))
    if out in (None, "-"):
        sys.stdout.buffer.write(text)
        return
    _write(Path(str(out)), text)


def _write_all(folder: Path, fleet: str, bookings: list[BookingView], rcs: Iterable[str]) -> tuple[int, int]:
    """Return how many files changed, and how many there are. Raises Failed."""
    bound = {rc for booking in bookings for date in booking.dates for rc in date.bound.values()}
    maintained = {rc for booking in bookings for rc in booking.maintained}
    named = {need for booking in bookings for need in booking.needs if not is_pattern(need) and host_in(need) is None}
    selections = {CalendarSelection(), *(CalendarSelection(booking.owner) for booking in bookings if booking.owner)}
    selections |= {CalendarSelection(rc=rc) for rc in {*rcs, *bound, *named, *maintained}}
    selections |= {CalendarSelection(path.stem) for path in folder.glob("owner/*.ics")}
    selections |= {CalendarSelection(rc=f"{path.parent.name}/{path.stem}") for path in folder.glob("rc/*/*.ics")}
    # A kind may consist of dots.
    safe = [chosen for chosen in selections if ".." not in chosen.path.split("/")]
    return sum(_write(folder / chosen.path, calendar_text(fleet, bookings, chosen)) for chosen in safe), len(safe)


def _write(path: Path, text: bytes) -> bool:
    """Return True if the text changed. Raises Failed."""
    try:
        if path.exists() and not path.is_file():  # a device, a pipe
            path.write_bytes(text)
            return True
        if path.exists() and path.read_bytes() == text:
            return False
        path.parent.mkdir(parents=True, exist_ok=True)
        write_durably(path, text)
    except OSError as error:
        raise Failed(f"{path} can't be written: {error.strerror}") from None
    return True


def parse_needs(text: str, option: str) -> Pairs:
    """Parse `robot/arm1,framegrabber/*,radio/rf0:command_rate=5`; a repeated pattern: one more. Raises BadInput."""
    if not text:
        raise BadInput(f"{option}: names no device; write one, as in robot/arm1")
    return tuple(gather_needs([parse_need(need, option) for need in _NEXT_NEED.split(text)]).items())


def _parse_mapping(text: str, option: str) -> tuple[str, Pairs]:
    """Parse `Arm 1=robot/arm1`. Raises BadInput."""
    words, equals, needs = text.partition("=")
    if not equals or not 1 <= len(words.strip()) <= MAX_WORDS:
        raise BadInput(f"{option}: {quoted(text)} is not a mapping; write WORDS=DEVICE, as in 'Arm 1=robot/arm1'")
    return " ".join(words.split()), parse_needs(needs, option)


@dataclass(slots=True)
class Row:
    """The result for one booking of the calendar."""

    title: str
    result: str
    why: str = ""
    book: Book | BookingView | None = None
    failed: bool = False


@dataclass(slots=True)
class _Import:
    client: Client
    options: ImportOptions
    known: list[BookingView]
    dry_run: bool
    again: bool
    rows: list[Row] = field(default_factory=list)
    makes_room: bool = False
    """True if bookings or dates are cancelled, or would be, before the rest is booked."""
    line: terminal.LiveLine = field(default_factory=lambda: terminal.LiveLine(sys.stderr))
    done: int = 0
    """Number of events processed."""

    async def run(self, plan: ImportPlan, *, sync: bool) -> None:
        """Import the plan; show the progress at a terminal, and on Ctrl-C what stays booked. Raises NobodyThere."""
        with self.line:
            try:
                await self._run(plan, sync=sync)
            except asyncio.CancelledError:
                self.line.hide()
                if not self.dry_run:
                    terminal.print_line(
                        f"{self.done} of {many(len(plan.wanted), 'event')} imported; they stay booked; "
                        "import the file again for the rest: nothing is booked twice",
                        sys.stderr,
                    )
                raise

    async def _run(self, plan: ImportPlan, *, sync: bool) -> None:
        gone = [view for view in self.known if view.id.endswith(self.options.suffix) and view.id not in plan.ids]
        for view in gone:
            if not view.unbooked and view.owner == self.client.mesh.me.host:
                words = view.who.comment if view.who is not None and view.who.comment else view.name
                if sync and any(event.failed for event in plan.skipped):
                    self.rows.append(Row(words, "kept", "an event could not be read; it may be this booking", view))
                elif sync:
                    await self._unbook(view, words)
                else:
                    self.rows.append(Row(words, "kept", "it is no longer in the calendar; --sync cancels it", view))
        by_id = {view.id: view for view in self.known if not view.unbooked}
        wants = [(wanted, next((by_id[id_] for id_ in wanted.ids if id_ in by_id), None)) for wanted in plan.wanted]
        began = time.monotonic()
        # A booking that drops dates is sent alone: later bookings may need the room. A dry run has nothing to batch.
        for alone, some in groupby(wants, lambda item: self.dry_run or bool(item[0].dropped)):
            while part := list(islice(some, 1 if alone else CONCURRENT_BOOKINGS)):
                if time.monotonic() - began > SHOW_PROGRESS_AFTER_S:
                    self.line.draw(f"{self.done} of {len(wants)} events")
                try:
                    async with asyncio.TaskGroup() as group:
                        for item in part:
                            group.create_task(self._want(*item))
                except* NobodyThere as errors:
                    raise errors.exceptions[0] from None

    async def _want(self, wanted: Wanted, known: BookingView | None) -> None:
        if known is not None or wanted.book is not None:
            await self._take(wanted, known)
        self.done += 1

    async def _take(self, wanted: Wanted, known: BookingView | None) -> None:
        row = Row(wanted.title, "already there", book=known or wanted.book)
        self.rows.append(row)
        if known is None and wanted.book is not None:
            row.result = "would be booked" if self.dry_run else "booked"
            if self.dry_run:
                await self._check_free(wanted.book, row)
                return
            known = await self._book(wanted.ids, wanted.book, row)
        if known is None:
            return
        last = known.start if known.until is None else known.until
        given_up = {*known.dropped, *(date.start for date in known.dates if date.state == "unbooked")}
        dropped = [at for at in wanted.dropped if known.start <= at <= last and at not in given_up]
        self.makes_room |= bool(dropped)
        for at in dropped:
            if not self.dry_run:
                await self._ask(Unbook(known.id, at, self.client.who), row)
        row.why = row.why or (f"without {many(len(dropped), 'date')} dropped in the calendar" if dropped else "")

    async def _check_free(self, book: Book, row: Row) -> None:
        """Check whether the first date is free, and write the reason in the row if not. Raises NobodyThere."""
        start = datetime.fromtimestamp(book.start, UTC)
        try:
            client = BookingsClient(self.client)
            answer = await client.slots(book.needs, book.runtime, 1.0, start=start, priority=book.priority, limit=1)
        except RcmSilent as silent:
            raise NobodyThere(str(silent)) from None
        except RequestRefused as refused:
            row.result, row.why, row.failed = "refused", str(refused), True
            return
        if book.maintenance or [slot.start for slot in answer.slots] == [book.start]:
            return
        if self.makes_room:
            row.why = "if the cancelled dates make room for it"
        else:
            row.result, row.why, row.failed = "not free", "zscout slots lists free times", True

    async def _book(self, ids: tuple[str, ...], book: Book, row: Row) -> BookingView | None:
        """None: not booked, with the reason in the row. Raises NobodyThere."""
        for booking in ids if self.again else ids[:1]:
            made = await self._ask(replace(book, id=booking), row)
            if made is None or not made.unbooked:
                row.book = made or row.book
                return made
        row.result, row.why = "given up before", "it was cancelled after its import; --again books it again"
        return None

    async def _unbook(self, view: BookingView, words: str) -> None:
        row = Row(words, "would be given up" if self.dry_run else "given up", "it is no longer in the calendar", view)
        self.rows.append(row)
        self.makes_room = True
        if not self.dry_run:
            await self._ask(Unbook(view.id, who=self.client.who), row)

    async def _ask(self, operation: Book | Unbook, row: Row) -> BookingView | None:
        """None: refused, with the reason in the row. Raises NobodyThere."""
        try:
            return await BookingsClient(self.client).ask(operation, BookingView)
        except RcmSilent as silent:
            raise NobodyThere(f"{silent}; import the file again: nothing is booked twice") from None
        except RequestRefused as refused:
            row.result = "not free" if refused.code == "not_free" else "refused"
            row.why, row.failed = str(refused), True
            return None


@click.command("import")
@click.argument("file", type=click.Path(path_type=Path, allow_dash=True))
@click.option(
    "--needs",
    "needs",
    multiple=True,
    type=Parsed("needs", parse_needs),
    help="Devices for every event: robot/a,'camera/*'.",
)
@click.option(
    "--map",
    "mapped",
    multiple=True,
    metavar="WORDS=DEVICES",
    type=Parsed("mapping", _parse_mapping),
    help="Devices for events with these words in title, place or resources.",
)
@zone_option
@click.option("--priority", type=click.IntRange(-MAX_PRIORITY, MAX_PRIORITY), default=0, help="The bookings' priority.")
@click.option("--patience", type=Parsed("duration", parse_duration), help="Patience of every booking. Default: 15 min.")
@click.option("--maintenance", is_flag=True, help="Make each booking a maintenance, as an operator.")
@click.option("--calendar", "name", metavar="NAME", help="Name of this calendar. Default: the file's name.")
@click.option("--sync", is_flag=True, help="Cancel bookings whose events are no longer in the calendar.")
@click.option("--again", is_flag=True, help="Book again events that were imported and cancelled since.")
@click.option("--dry-run", is_flag=True, help="Print what would be done, and do nothing.")
@common.json_option("Print one JSON object.")
@common.runs
async def import_(
    file: Path,
    needs: tuple[Pairs, ...],
    mapped: tuple[tuple[str, Pairs], ...],
    zone: ZoneInfo | None,
    priority: int,
    patience: Decimal | None,
    maintenance: bool,
    name: str | None,
    sync: bool,
    again: bool,
    dry_run: bool,
    as_json: bool,
) -> int:
    """Book the events of an iCalendar FILE (- is stdin), from Google, Outlook, Nextcloud and others.

    --needs and --map give the devices of an event; without either, its resources name them. Events without devices are
    left out, as are events that are over, cancelled, or marked as free. Importing again books nothing twice; a
    changed event becomes another booking, so use --sync then. Times without a zone, and whole days, are in --zone.

    Exit code 1: an event could not be booked.

    \b
    Examples:
      zscout booking import lab.ics --map 'Arm 1=robot/arm1' --map 'Camera=framegrabber/*' --dry-run
      curl -s URL | zscout booking import - --calendar lab --needs robot/arm1 --sync
      zscout booking import service.ics --needs robot/arm1 --maintenance
    """
    if str(file) == "-" and name is None:
        raise BadInput("stdin has no file name; name the calendar with --calendar, the same each time")
    data = sys.stdin.buffer.read(MAX_BYTES + 1) if str(file) == "-" else read_bytes(file, max_bytes=MAX_BYTES)
    events = read_calendar(data, "stdin" if str(file) == "-" else str(file))
    zone = zone or host_zone()
    async with common.connected("calendar") as client:
        answer = await ask_bookings(client)
        options = ImportOptions(
            client.fleet.name,
            name or file.stem,
            zone,
            tuple(gather_needs([pair for pairs in needs for pair in pairs]).items()),
            _merged(mapped),
            client.fleet.operator_priority if maintenance else priority,
            patience,
            maintenance,
            client.who,
        )
        plan = plan_import(events, options, answer.time)
        work = _Import(client, options, answer.bookings, dry_run, again)
        await work.run(plan, sync=sync)
    rows = [
        *work.rows,
        *(Row(event.title, "not booked", event.why, failed=True) for event in plan.skipped if event.failed),
    ]
    left_out = Counter(event.why for event in plan.skipped if not event.failed)
    if as_json:
        terminal.print_json(
            {"fleet": options.fleet, "calendar": options.calendar, "dry_run": dry_run}
            | {"events": [_row_json(row) for row in rows], "left_out": dict(left_out)}
        )
    else:
        _print(rows, left_out, zone, options.calendar)
    return int(any(row.failed for row in rows))


def _merged(mapped: Iterable[tuple[str, Pairs]]) -> dict[str, Pairs]:
    found: dict[str, Pairs] = {}
    for words, needs in mapped:
        found[words] = (*found.get(words, ()), *needs)
    return found


def _row_json(row: Row) -> dict[str, Any]:
    found: dict[str, Any] = {"title": row.title, "result": row.result, "why": row.why, "failed": row.failed}
    if (book := row.book) is not None:
        until = None if book.until is None else utc(book.until)
        found |= {"id": book.id, "name": book.name, "needs": book.needs, "start": utc(book.start), "every": book.every}
        found |= {"until": until, "runtime": book.runtime, "zone": book.zone, "priority": book.priority}
    return found


def _print(rows: list[Row], left_out: Counter[str], zone: ZoneInfo, name: str) -> None:
    if rows:
        cells = [
            (
                clean(row.title),
                "-" if row.book is None else _when(row.book, zone),
                "-" if row.book is None else clean(", ".join(sorted(row.book.needs))),
                clean(f"{row.result}: {row.why}" if row.why else row.result),
            )
            for row in rows
        ]
        Table(f"Calendar {clean(name)}", ("EVENT", "DATE", "DEVICES", "RESULT"), cells).print()
    else:
        terminal.print_line(f"calendar {clean(name)} has nothing to book")
    for why, number in sorted(left_out.items()):
        terminal.print_line(f"left out, {why}: {number}")


def _when(book: Book | BookingView, zone: ZoneInfo) -> str:
    begin = date_words(book.start, zone)
    return (
        f"{begin}, {every_words(book.every)} until {date_words(book.until or book.start, zone)[4:14]}"
        if book.every
        else begin
    )
