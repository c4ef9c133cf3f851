"""`zscout usage`: accounts of who held and used what for how long, from the journals of the candidates."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, fields

import click

from zscout import terminal
from zscout.cli import common, journals
from zscout.config.fleet import Fleet
from zscout.config.strict import BadInput
from zscout.messages import HistoryAsk, PastHold
from zscout.services.journal.accounts import Account, accounts
from zscout.services.journal.asking import FleetHistory
from zscout.terminal import Table, span

MAX_HOLDS = 200_000
"""That are added up; of more the latest."""
NO_GROUP = "(no group)"
MAX_NAMED = 8
"""Accounts of which one line tells what is not known."""


@click.command()
@click.option("--by", type=click.Choice(["user", "group", "rc"]), default="user", show_default=True, help="Accounts.")
@click.option("--since", type=journals.PAST, default="7d", show_default=True, help="A time ago (7d) or a date.")
@click.option("--until", type=journals.PAST, default="0s", help="A time ago or a date. Default: now.")
@journals.formats
@common.runs
async def usage(by: str, since: float, until: float, as_json: bool, as_csv: bool) -> None:
    """Sum up hold times, and how much of them was used. Only times within --since and --until count; --json and
    --csv print seconds.

    \b
    HOLDS        number of holds within the time
    HELD         their duration; two holds at one time count twice
    DEVICE TIME  the same for each device: 3 devices for 10 s are 30 s
    USED         how much of that: at each device from the beginning of the first command of a hold
                 (or picture that it published) to the end of the last; for a direct hold all of it
    WAITED       time in the queue before holds that began within it; requests that never held anything are unknown
    PREEMPTED    holds taken for another request before their minimum runtime was over, and their duration
    THROWN AWAY  duration of holds that ended before their minimum runtime, preempted or lost

    A user is the name of the certificate in a secured fleet, else the name that programs give; a member of several
    groups is counted in each. Use that devices did not report is not counted; a line says for how many holds.

    \b
    Examples:
      zscout usage --since 7d
      zscout usage --by rc --since 2025-11-01 --until 2025-12-01 --csv > november.csv
      zscout usage --by group --since 30d --json | jq '.accounts[] | {key, rc_seconds, used}'
    """
    journals.check_formats(as_json=as_json, as_csv=as_csv)
    journals.check_window(since, until)
    keys = _keys(common.the_fleet(), by)
    async with common.connected("usage", need_rcm=False) as client:
        told = await journals.ask_journals(client, HistoryAsk(since=since, until=until), MAX_HOLDS)
    found = accounts(told.holds, keys, told.window, by_rc=by == "rc")
    names = [field.name for field in fields(Account)]
    if as_json:
        terminal.print_json(journals.as_json(told, client.fleet.name, by=by, accounts=[_rounded(one) for one in found]))
    elif as_csv:
        journals.print_csv([by, *names[1:]], ([*_rounded(one).values()] for one in found))
        _print_remarks(told, found, err=True)
    else:
        _table(found, by, told).print()
        _print_remarks(told, found)


def _keys(fleet: Fleet, by: str) -> Callable[[PastHold], Iterable[str]]:
    """Raises BadInput."""
    proven = fleet.security is not None
    if by == "rc":
        return lambda hold: hold.rcs
    if by == "user":
        return lambda hold: [journals.person(hold, proven=proven)]
    if not fleet.access.groups:
        raise BadInput("--by group: the fleet file has no [groups]; name some there, or write --by user")
    return lambda hold: fleet.access.groups_of(journals.person(hold, proven=proven)) or [NO_GROUP]


def _rounded(account: Account) -> dict[str, object]:
    return {name: round(value, 3) if isinstance(value, float) else value for name, value in asdict(account).items()}


def _table(found: list[Account], by: str, told: FleetHistory) -> Table:
    rows = [
        (
            *(one.key, str(one.holds), span(one.held), span(one.rc_seconds)),
            *("?" if one.used is None else span(one.used), span(one.waited)),
            f"{one.preempted} ({span(one.preempted_seconds)})" if one.preempted else "-",
            span(one.thrown_away) if one.thrown_away else "-",
        )
        for one in found
    ]
    columns = (by.upper(), "HOLDS", "HELD", "DEVICE TIME", "USED", "WAITED", "PREEMPTED", "THROWN AWAY")
    title = f"Usage from {journals.local(told.window.began)} to {journals.local(told.window.ended)}"
    return Table(title, columns, rows)


def _unknown_use(found: list[Account]) -> str:
    some = [f"{one.key} {one.used_unknown} of {one.holds}" for one in found if one.used_unknown]
    more = f", and {len(some) - MAX_NAMED} more" if len(some) > MAX_NAMED else ""
    words = "holds whose devices did not all report their use, which is not counted"
    return f"{words}: {', '.join(some[:MAX_NAMED])}{more}" if some else ""


def _print_remarks(told: FleetHistory, found: list[Account], *, err: bool = False) -> None:
    if words := _unknown_use(found):
        click.secho(terminal.clean(words), fg="yellow", err=err)
    if told.more:
        click.secho(f"only the latest {MAX_HOLDS} holds are counted; ask for less time", fg="yellow", err=err)
    journals.print_remarks(told, err=err)
