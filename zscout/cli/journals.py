"""Shared by `zscout history` and `usage`: options, the query of the candidates' journals, and words for past holds."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, Final

import click
from msgspec import structs

from zscout.cli.common import FIND_RCM_S, F, Failed, Parsed, see_rcm
from zscout.config.fleet import Fleet
from zscout.config.strict import DURATIONS, BadInput, parse_duration, quoted
from zscout.keyexpr import MAX_NAME, check_need
from zscout.messages import MAX_ASKED_NAMES, HistoryAsk, PastHold, ReasonParty
from zscout.services.journal import asking
from zscout.services.journal.asking import FleetHistory
from zscout.terminal import Table, clean, span
from zscout.types import whole_second

if TYPE_CHECKING:
    from zscout.behaviors.client.client import Client

MAX_AGO: Final = 1e9
PAST_FORMS: Final = f"{DURATIONS}, or a date as in yesterday, 2026-11-20 or 2026-11-20T14:30"
FORMULA: Final = ("=", "+", "-", "@")
"""Beginnings of cells that a spreadsheet would compute."""


def parse_past(text: str, option: str) -> float:
    """Parse a duration, or a time of this host's clock and zone; return seconds ago. Raises BadInput."""
    ago: float | None = None
    if (seconds := parse_duration(text)) is not None:
        ago = float(seconds)
    else:
        try:
            ago = time.time() - _date(text).astimezone().timestamp()
        except (ValueError, OverflowError):
            raise BadInput(f"{option}: {quoted(text)} is not a time; write {PAST_FORMS}") from None
    if option == "--until":
        ago = max(0.0, ago)  # up to now
    if ago < 0:
        raise BadInput(f"{option}: {quoted(text)} is in the future; write an earlier date")
    if ago > MAX_AGO:
        raise BadInput(f"{option}: {quoted(text)} is too far back; write a later date")
    return ago


def _date(text: str) -> datetime:
    """Parse a date and time; `today` and `yesterday` mean the midnight at their start. Raises ValueError."""
    days = {"today": 0, "yesterday": 1}.get(text.lower())
    if days is None:
        return datetime.fromisoformat(text)
    return datetime.combine(datetime.now().astimezone().date() - timedelta(days), datetime.min.time())


PAST: Final = Parsed("time", parse_past)


def parse_who(text: str, option: str) -> str:
    """Raises BadInput."""
    if not 1 <= len(text) <= MAX_NAME:
        raise BadInput(f"{option}: {quoted(text)} is not a name; write 1 to {MAX_NAME} characters")
    return text


def parse_rc_pattern(text: str, _option: str) -> str:
    """Raises BadName."""
    return check_need(text)


WHO: Final = Parsed("text", parse_who)
RC: Final = Parsed("text", parse_rc_pattern)


def formats(command: F) -> F:
    """`--json` and `--csv`; the parameters are `as_json` and `as_csv`."""
    command = click.option("--csv", "as_csv", is_flag=True, help="Print CSV, with a header line.")(command)
    return click.option("--json", "as_json", is_flag=True, help="Print one JSON object.")(command)


def check_formats(*, as_json: bool, as_csv: bool) -> None:
    """Raises UsageError."""
    if as_json and as_csv:
        raise click.UsageError("--json and --csv exclude each other; use only one of them")


def check_window(since: float | None, until: float) -> None:
    """Raises BadInput."""
    if since is not None and since <= until:
        raise BadInput("--since is not before --until; write an earlier --since")


def names_of(fleet: Fleet, users: Sequence[str], group: str | None) -> list[str]:
    """These users, and those of a group of the fleet file. Raises BadInput."""
    names = [*users]
    if group is not None:
        if not fleet.access.groups.get(group):
            known = f"known: {', '.join(sorted(fleet.access.groups)[:8])}" if fleet.access.groups else "there are none"
            raise BadInput(f"--group: the fleet file has no group {quoted(group)} with members; {known}")
        names += fleet.access.groups[group]
    if len(names) > MAX_ASKED_NAMES:
        raise BadInput(f"{len(names)} names are too many; at most {MAX_ASKED_NAMES} are allowed")
    return names


async def ask_journals(client: Client, asked: HistoryAsk, most: int) -> FleetHistory:
    """The latest holds, at most `most`, from as few journals as hold all entries. Raises Failed if no journal answers,
    NobodyThere if no candidate is seen."""
    try:
        return await asking.ask_journals(client.mesh, client.fleet, asked, most, look=FIND_RCM_S)
    except asking.NoCandidate as error:
        await see_rcm(client, 0.0)
        raise Failed(str(error)) from None
    except asking.NoJournal as error:
        raise Failed(str(error)) from None


def remarks(answer: FleetHistory) -> Iterable[str]:
    for gap in answer.unknown:
        yield f"from {local(gap.began)} to {local(gap.ended)} the journals are incomplete: {answer.causes(gap)}"
    if answer.without:
        yield f"no journal of {', '.join(answer.without)}: off, older than 0.3.0, or too slow"


def as_json(answer: FleetHistory, fleet: str, **of: object) -> dict[str, Any]:
    candidates: list[dict[str, Any]] = [
        {
            "host": host,
            "since": None if journal.since is None else utc(journal.since),
            "gaps": [structs.asdict(gap) | _times(gap.began, gap.ended) for gap in journal.gaps],
        }
        for host, journal in sorted(answer.journals.items())
    ]
    return {
        "fleet": fleet,
        "since": utc(answer.window.began),
        "until": utc(answer.window.ended),
        **of,
        "more": answer.more,
        "gaps": [_times(gap.began, gap.ended) | {"why": answer.causes(gap)} for gap in answer.unknown],
        "candidates": candidates + [{"host": host, "since": None, "gaps": None} for host in answer.without],
    }


def utc(at: float) -> str:
    return datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def local(at: float) -> str:
    return f"{datetime.fromtimestamp(whole_second(at)).astimezone():%Y-%m-%d %H:%M:%S}"


def person(hold: PastHold, *, proven: bool) -> str:
    """The holder: its certificate's name if those are `proven`, else the user that its program named, else its host."""
    return hold.client.partition("/")[0] if proven else _owner(hold)


def _owner(of: PastHold | ReasonParty) -> str:
    return (of.who.user if of.who is not None else "") or of.client.partition("/")[0]


def held(hold: PastHold, now: float) -> float:
    return max(0.0, (now if hold.ended is None else hold.ended) - hold.began)


def used(hold: PastHold, now: float) -> dict[str, float | None]:
    """Return the seconds of use by RC, bounded by the hold's known length; None: the RC reported no use."""
    most = held(hold, now)
    return {rc: round(min(hold.used[rc], most), 3) if rc in hold.used else None for rc in hold.rcs}


def used_sum(hold: PastHold, now: float) -> float | None:
    """Return the RC-seconds of use; None unless all RCs reported theirs."""
    reported = [seconds for seconds in used(hold, now).values() if seconds is not None]
    return round(sum(reported), 3) if len(reported) == len(hold.rcs) else None


def ending(hold: PastHold) -> str:
    if hold.ended is None:
        return "in force"
    words = {"unheard": "end not seen", "client_lost": "client lost", "handed_over": "handed over"}
    by = ""
    if hold.by is not None:
        by = f" by {hold.by.arc} of {_owner(hold.by)}"
    return words.get(hold.outcome, hold.outcome) + by


def hold_json(hold: PastHold, now: float) -> dict[str, Any]:
    spans = {"held": round(held(hold, now), 3), "used": used(hold, now), "used_rc_seconds": used_sum(hold, now)}
    return structs.asdict(hold) | _times(hold.began, hold.ended) | spans


def _times(began: float, ended: float | None) -> dict[str, str | None]:
    return {"began": utc(began), "ended": None if ended is None else utc(ended)}


def print_csv(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print CSV; texts that a spreadsheet would compute are quoted."""
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_cell(cell) for cell in row])


def _cell(cell: object) -> object:
    if not isinstance(cell, str):
        return cell
    return f"'{clean(cell)}" if cell.startswith(FORMULA) else clean(cell)


def print_remarks(answer: FleetHistory, *, err: bool = False) -> None:
    for line in remarks(answer):
        click.secho(clean(line), fg="yellow", err=err)


def holds_table(title: str, answer: FleetHistory, holds: Sequence[PastHold], *, proven: bool) -> Table:
    rows, styles = [], []
    for hold in holds:
        waited = "?" if hold.waited is None else span(hold.waited)
        lasted = span(held(hold, answer.window.ended)) + (" or more" if hold.late or hold.outcome == "unheard" else "")
        whose = person(hold, proven=proven)
        rows.append(
            (local(hold.began), lasted, hold.arc, whose, str(hold.priority), waited, ending(hold), " ".join(hold.rcs))
        )
        styles.append(
            {"preempted": "red", "lost": "red", "client_lost": "red"}.get(hold.outcome, "" if hold.ended else "bold")
        )
    columns = ("BEGAN", "HELD", "REQUEST", "WHO", "PRIORITY", "WAITED", "END", "DEVICES")
    return Table(title, columns, rows, styles, spare=("PRIORITY", "WAITED"), cut={"END"})
