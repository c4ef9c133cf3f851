"""`zscout history`: past holds, from the journals of the candidates."""

from __future__ import annotations

import time

import click

from zscout import terminal
from zscout.cli import common, completion, journals
from zscout.cli.requests.options import MAX_ARC_NAME
from zscout.config.strict import BadInput, quoted
from zscout.messages import HistoryAsk, PastHold

MAX_LIMIT = 100_000
COLUMNS = (
    *("began", "ended", "held", "waited", "arc", "id", "client", "user", "host", "command", "priority", "min_runtime"),
    *("rcs", "outcome", "reason", "by_arc", "by_client", "by_user", "late", "used", "used_rc_seconds"),
)


def parse_arc(text: str, option: str) -> str:
    """Raises BadInput."""
    if not 1 <= len(text) <= MAX_ARC_NAME:
        raise BadInput(f"{option}: {quoted(text)} can't be the name of a request; write 1 to {MAX_ARC_NAME} characters")
    return text


ARC = common.Parsed("text", parse_arc)


@click.command()
@click.argument("device", required=False, type=journals.RC, metavar="[DEVICE]", shell_complete=completion.needs)
@click.option("--rc", type=journals.RC, shell_complete=completion.needs, help="The same as DEVICE.")
@click.option("--user", "users", type=journals.WHO, multiple=True, help="Only holds of this user, person or host.")
@click.option("--group", help="Only holds of this group of the fleet file.")
@click.option("--arc", type=ARC, help="Only holds of this request: its name or id.")
@click.option("--since", type=journals.PAST, help="Leave out holds that ended before this time: 7d ago, or a date.")
@click.option("--until", type=journals.PAST, default="0s", help="Leave out holds that began after this time.")
@click.option(
    "--limit", type=click.IntRange(1, MAX_LIMIT), default=100, show_default=True, help="List only the latest holds."
)
@journals.formats
@common.runs
async def history(
    device: str | None,
    rc: str | None,
    users: tuple[str, ...],
    group: str | None,
    arc: str | None,
    since: float | None,
    until: float,
    limit: int,
    as_json: bool,
    as_csv: bool,
) -> None:
    """List past and present holds, newest last: holder, devices, duration, and how each ended. With DEVICE, a name or
    a pattern, only holds of that device.

    Every node that may lead keeps a journal; the command asks all of them, and shows a hold in several journals once.
    Times are by the clocks of those hosts. A line names each interval for which no journal is complete. A hold granted
    in the last second may be missing, and a request that never held a device is not listed.

    --json and --csv have `used`: the seconds for which each device was used, from the beginning of the first command
    that it carried out under the hold (or picture that it published) to the end of the last; for a direct hold its
    whole duration. It is null, or empty, if the device did not report it. `used_rc_seconds` is the sum.

    \b
    Examples:
      zscout history robot/arm1 --since yesterday
      zscout history 'robot/*' --user alice --limit 20
      zscout history --since 2025-11-01 --until 2025-12-01 --limit 100000 --csv > november.csv
      zscout history --json | jq -r '.holds[] | select(.outcome == "preempted") | .by.arc'
    """
    journals.check_formats(as_json=as_json, as_csv=as_csv)
    journals.check_window(since, until)
    if device is not None and rc is not None:
        raise BadInput("DEVICE and --rc are the same; use only one of them")
    rc = device or rc
    who = journals.names_of(common.the_fleet(), users, group)
    async with common.connected("history", need_rcm=False) as client:
        asked = HistoryAsk(arc=arc, rc=rc, who=who, since=since, until=until)
        answer = await journals.ask_journals(client, asked, limit)
        fleet = client.fleet
    now = time.time()
    if as_json:
        holds = [journals.hold_json(hold, now) for hold in answer.holds]
        terminal.print_json(journals.as_json(answer, fleet.name, holds=holds))
    elif as_csv:
        journals.print_csv(COLUMNS, (_cells(hold, now) for hold in answer.holds))
        journals.print_remarks(answer, err=True)
    else:
        title = f"Holds since {journals.local(answer.window.began)}"
        title += f", the latest {limit}: see --limit" if answer.more else ""
        if not answer.holds:
            terminal.print_line(f"no holds since {journals.local(answer.window.began)}")
        else:
            journals.holds_table(title, answer, answer.holds, proven=fleet.security is not None).print()
        journals.print_remarks(answer)


def _cells(hold: PastHold, now: float) -> tuple[object, ...]:
    who, by = hold.who, hold.by
    ended = "" if hold.ended is None else journals.utc(hold.ended)
    return (
        *(
            journals.utc(hold.began),
            ended,
            round(journals.held(hold, now), 3),
            hold.waited,
            hold.arc,
            hold.id,
            hold.client,
        ),
        *((who.user, who.host, who.command) if who is not None else ("", "", "")),
        *(hold.priority, hold.min_runtime, " ".join(hold.rcs), hold.outcome, hold.reason),
        *((by.arc, by.client, by.who.user if by.who is not None else "") if by is not None else ("", "", "")),
        int(hold.late),
        " ".join(f"{rc}={'' if seconds is None else seconds}" for rc, seconds in journals.used(hold, now).items()),
        journals.used_sum(hold, now),
    )
