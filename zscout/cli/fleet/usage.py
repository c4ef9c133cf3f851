"""`zscout usage`: hold and use times by user, group or device, from the journals of the candidates."""

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
"""Holds that are summed up, the latest."""
NO_GROUP = "(no group)"
MAX_NAMED = 8
"""Accounts named in the remark on unknown use."""


@click.command()
@click.option(
    "--by", type=click.Choice(["user", "group", "rc"]), default="user", show_default=True, help="Sum up by this."
)
@click.option("--since", type=journals.PAST, default="7d", show_default=True, help="Begin: 7d ago, or a date.")
@click.option("--until", type=journals.PAST, default="0s", help="End: 1d ago, or a date. Default: now.")
@journals.formats
@common.runs
async def usage(by: str, since: float, until: float, as_json: bool, as_csv: bool) -> None:
    """Sum up hold times, and the used part of them, between --since and --until. --json and --csv print seconds.

    \b
    HOLDS        number of holds in this interval
    HELD         their duration; two holds at one time count twice
    DEVICE TIME  the same for each device: 3 devices for 10 s are 30 s
    USED         the used part of it: at each device from the beginning of the first command of a hold
                 (or picture that it published) to the end of the last; for a direct hold its whole duration
    WAITED       time in the queue of holds that began in this interval; requests that never held a device are unknown
    PREEMPTED    holds taken for another request before their minimum runtime was over, and their duration
    THROWN AWAY  duration of holds that ended before their minimum runtime, preempted or lost

    In a secured fleet the user is the name of the certificate, else the name that programs give; a member of several
    groups is counted in each. Use that devices did not report is not counted; a line gives the number of such holds.

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
        answer = await journals.ask_journals(client, HistoryAsk(since=since, until=until), MAX_HOLDS)
    found = accounts(answer.holds, keys, answer.window, by_rc=by == "rc")
    names = [field.name for field in fields(Account)]
    if as_json:
        terminal.print_json(
            journals.as_json(answer, client.fleet.name, by=by, accounts=[_rounded(account) for account in found])
        )
    elif as_csv:
        journals.print_csv([by, *names[1:]], ([*_rounded(account).values()] for account in found))
        _print_remarks(answer, found, err=True)
    else:
        _table(found, by, answer).print()
        _print_remarks(answer, found)


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


def _table(found: list[Account], by: str, answer: FleetHistory) -> Table:
    rows = [
        (
            *(account.key, str(account.holds), span(account.held), span(account.rc_seconds)),
            *("?" if account.used is None else span(account.used), span(account.waited)),
            f"{account.preempted} ({span(account.preempted_seconds)})" if account.preempted else "-",
            span(account.thrown_away) if account.thrown_away else "-",
        )
        for account in found
    ]
    columns = (by.upper(), "HOLDS", "HELD", "DEVICE TIME", "USED", "WAITED", "PREEMPTED", "THROWN AWAY")
    title = f"Usage from {journals.local(answer.window.began)} to {journals.local(answer.window.ended)}"
    return Table(title, columns, rows)


def _unknown_use(found: list[Account]) -> str:
    some = [f"{account.key} {account.used_unknown} of {account.holds}" for account in found if account.used_unknown]
    more = f", and {len(some) - MAX_NAMED} more" if len(some) > MAX_NAMED else ""
    words = "holds whose devices did not all report their use, which is not counted"
    return f"{words}: {', '.join(some[:MAX_NAMED])}{more}" if some else ""


def _print_remarks(answer: FleetHistory, found: list[Account], *, err: bool = False) -> None:
    if words := _unknown_use(found):
        click.secho(terminal.clean(words), fg="yellow", err=err)
    if answer.more:
        click.secho(f"only the latest {MAX_HOLDS} holds are counted; ask for less time", fg="yellow", err=err)
    journals.print_remarks(answer, err=err)
