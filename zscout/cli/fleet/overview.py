"""What people see: coloured tables at a terminal, plain lines in a pipe. And the fleet as `zscout status`
shows it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from zscout import terminal
from zscout.cli import common
from zscout.cli.fleet.fleet_view import FleetView, Host
from zscout.keyexpr import Role, Token
from zscout.mesh import clock
from zscout.messages import HoldView, RcmState
from zscout.types import SECOND

if TYPE_CHECKING:
    from rich.console import Group
    from rich.text import Text

MAX_ROWS: Final = 500
"""Of one table at a terminal."""
MAX_NAMED: Final = 8
"""Components in the row of a host."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of texts; `styles` has Rich's style for each, `spare` the columns that a narrow terminal omits."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    styles: Sequence[str]
    spare: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Overview:
    """A line, and tables below it. `alarm`: the line is about something that is wrong."""

    headline: str
    tables: Sequence[Table]
    alarm: bool = False


def _headline(fleet_view: FleetView, state: RcmState | None) -> str:
    fleet, links = fleet_view.client.fleet.name, fleet_view.client.mesh.links()
    if state is None:
        return f"Fleet {fleet}: nobody leads; nothing is granted until a node does ({_many(links, 'link')})"
    return f"Fleet {fleet}: {state.host} leads, term {state.term.counter} ({_many(links, 'link')})"


def _tables(fleet_view: FleetView, state: RcmState | None, lost: frozenset[str]) -> Iterator[Table]:
    if state is not None:
        yield _rc_table(fleet_view, state, lost)
        yield _running_table(fleet_view, state)
        yield _waiting_table(state)
    yield _host_table(fleet_view)


def _rc_table(fleet_view: FleetView, state: RcmState, lost: frozenset[str]) -> Table:
    homes = {token.name: token.host for token in fleet_view.tokens(Role.RC)}
    rows, styles = [], []
    for view in state.rcs:
        holders = [hold for hold in state.holds if view.rc in hold.needs]
        there = "held" if holders else "free"
        words = there if view.present else "lost" if view.rc in lost else "absent"
        kind = "shared" if view.sharable else "exclusive"
        names = ", ".join(_with_params(hold, view.rc) for hold in holders)
        rows.append((view.rc, kind, words, homes.get(view.rc, "-"), names))
        styles.append({"absent": "red", "lost": "red", "held": "yellow", "free": "green"}[words])
    return Table("RCs", ("RC", "USE", "STATE", "HOST", "HELD BY"), rows, styles)


def _with_params(hold: HoldView, rc: str) -> str:
    amounts = common.amount_text(hold.needs[rc])
    return f"{hold.arc} ({amounts})" if amounts else hold.arc


def _running_table(fleet_view: FleetView, state: RcmState) -> Table:
    rows, styles = [], []
    for hold in sorted(state.holds, key=lambda hold: (-hold.priority, -hold.held)):
        left = terminal.span(hold.remaining) if hold.remaining > 0 else "over"
        rows.append(
            (
                hold.arc,
                str(hold.priority),
                terminal.span(hold.held),
                f"{left}, keeps" if hold.keep else left,
                hold.client,
                " ".join(sorted(hold.needs)),
            )
        )
        styles.append("bold red" if hold.priority >= fleet_view.client.fleet.operator_priority else "")
    return Table("Running", ("ARC", "PRIORITY", "SINCE", "LEFT", "CLIENT", "RCS"), rows, styles, ("CLIENT",))


def _waiting_table(state: RcmState) -> Table:
    rows = [
        (
            str(number),
            wait.arc,
            str(wait.priority),
            terminal.span(wait.waited),
            terminal.span(float(wait.min_runtime)),
            "?" if wait.starts_in is None else f"in {terminal.span(wait.starts_in)}",
            str(wait.preemptions),
            wait.client,
            wait.reason,
        )
        for number, wait in enumerate(state.queue, 1)
    ]
    title = f"Waiting, and {state.more} more" if state.more else "Waiting"
    columns = ("#", "ARC", "PRIORITY", "SINCE", "RUNTIME", "STARTS", "PREEMPTED", "CLIENT", "WHY")
    return Table(title, columns, rows, [""] * len(rows), ("RUNTIME", "PREEMPTED", "CLIENT"))


def _host_table(fleet_view: FleetView) -> Table:
    rows, styles = [], []
    for name, host in fleet_view.all_hosts().items():
        words, style = _condition(fleet_view, name, host)
        load, cpu, memory = "-", "-", "-"
        if host.load is not None:
            load = f"{host.load.load_average[0]:.2f} of {host.load.cores}"
            cpu = f"{host.load.cpu:.0f} %"
            memory = f"{host.load.memory_available / 2**30:.1f} of {host.load.memory_total / 2**30:.1f} GiB"
        rows.append((name, words, load, cpu, memory, _doing(host)))
        styles.append(style)
    return Table("Hosts", ("HOST", "STATE", "LOAD", "CPU", "MEMORY FREE", "RUNS"), rows, styles)


def _condition(fleet_view: FleetView, name: str, host: Host) -> tuple[str, str]:
    if host.gone is not None:
        return f"gone for {terminal.span((clock.now() - host.gone) / SECOND)}", "red"
    if not host.tokens:
        return "not there", "red"
    if fleet_view.stale(host):
        return "no load report", "yellow"
    words, style = ("leads", "bold") if host.has(Role.RCM) else ("alive", "")
    return (f"{words}, cordoned", "yellow") if name in fleet_view.cordoned else (words, style)


def _doing(host: Host) -> str:
    counts = {role: sum(1 for token in host.tokens if token.role == role) for role in (Role.RC, Role.CLIENT)}
    parts = ["node"] if host.has(Role.NODE) else []
    parts += ["recorder"] if host.has(Role.RECORDER) else []
    parts += [_many(counts[Role.RC], "RC")] if counts[Role.RC] else []
    components = host.components
    # Each component is a client too, and is named below.
    clients = counts[Role.CLIENT] - sum(1 for token in host.tokens if _of_component(token, components))
    parts += [_many(clients, "client")] if clients > 0 else []
    parts += components[:MAX_NAMED]
    parts += [f"{len(components) - MAX_NAMED} more components"] if len(components) > MAX_NAMED else []
    return ", ".join(parts)


def _of_component(token: Token, components: Sequence[str]) -> bool:
    """Whether this is the client of one of these: `<component>.<incarnation>`."""
    name, _, number = token.name.rpartition(".")
    return token.role == Role.CLIENT and number.isdigit() and name in components


def _many(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def fleet_overview(
    fleet_view: FleetView, state: RcmState | None, lost: frozenset[str] = frozenset()
) -> Overview:
    """RCs, what runs and waits, and the hosts. `lost`: RCs that are there and say that they can't serve."""
    return Overview(_headline(fleet_view, state), list(_tables(fleet_view, state, lost)), alarm=state is None)


def print_overview(overview: Overview) -> None:
    if terminal.at_terminal():
        terminal.console().print(rich_overview(overview))
        return
    terminal.print_line(terminal.clean(overview.headline))
    for table in overview.tables:
        rows = [[terminal.clean(cell) for cell in row] for row in table.rows]
        if rows:
            terminal.print_line("")
            for line in terminal.plain_table(table.columns, rows, table.title):
                terminal.print_line(line)


def rich_overview(overview: Overview, *after: Text) -> Group:
    """The picture for a terminal."""
    from rich import table as rich_table
    from rich.console import Group
    from rich.text import Text

    narrow = terminal.narrow()
    parts: list[Any] = [
        Text(terminal.clean(overview.headline), style="bold red" if overview.alarm else "bold")
    ]
    for table in overview.tables:
        if not table.rows:
            continue
        shown = rich_table.Table(
            title=table.title, title_justify="left", title_style="bold cyan", box=None, padding=(0, 2, 0, 0)
        )
        kept = [at for at, name in enumerate(table.columns) if not (narrow and name in table.spare)]
        for at in kept:
            shown.add_column(table.columns[at], header_style="dim", overflow="fold")
        for row, style in zip(table.rows[:MAX_ROWS], table.styles, strict=False):
            shown.add_row(*(Text(terminal.clean(row[at])) for at in kept), style=style)
        parts += [Text(""), shown]
        if len(table.rows) > MAX_ROWS:
            parts.append(Text(f"... {len(table.rows) - MAX_ROWS} more rows: --json has all", style="dim"))
    return Group(*parts, *after)
