"""Tables of `python -m studies robots`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from studies.robots.crossings import FATES
from studies.robots.study import FieldFigures, Quantiles, RobotsReport
from zscout import terminal

COLUMNS: Final = (
    "all placed (10-90 %)",
    "placed",
    "truly dark",
    "walks noticed",
    "crossings in 1 s",
    "false/h",
    "preempted",
    "unheld",
    "stands in",
)


def print_report(found: RobotsReport, names: Sequence[str], seeds: int, seconds: float) -> None:
    where = f"{seconds:g} s, {seeds} seed{'s' * (seeds != 1)} in each of {', '.join(names)}"
    receivers, radio, turns = found.receivers[:1], found.radio[:1], found.turns[:1]
    tables: list[tuple[str, tuple[str, ...], list[FieldFigures]]] = [
        (f"Robots and video channels: {where}", ("robots", "channels"), found.grid),
        (f"Framegrabbers, {_means(receivers)}: {where}", ("framegrabbers",), found.receivers),
        (f"The radio, {_means(radio)}: {where}", ("baud", "command_rate"), found.radio),
        (f"Turns, {_means(turns)}: {where}", ("slot",), found.turns),
    ]
    tables = [table for table in tables if table[2]]
    for number, (title, keys, figures) in enumerate(tables):
        if number:
            terminal.print_line("")
        terminal.print_table(
            [*(key.replace("command_rate", "commands/s") for key in keys), *COLUMNS],
            [[*(f"{getattr(row, key):g}" for key in keys), *_cells(row)] for row in figures],
            title=title,
        )
        _print_account(keys, figures)
    if found.starts:
        terminal.print_table(
            ["building", "starts", "truly dark", "and facing the light", "seconds (10-90 %)", "bumps"],
            [
                [
                    start.building,
                    str(start.starts),
                    f"{start.dark} ({start.dark / start.starts:.0%})",
                    f"{start.good} ({start.good / start.starts:.0%})",
                    spread_text(start.seconds),
                    f"{start.bumped:.1f} s",
                ]
                for start in found.starts
            ],
            title="One robot, random starts: hidden within 120 s",
        )


def _print_account(keys: Sequence[str], figures: Sequence[FieldFigures]) -> None:
    """The fates of crossings of placed robots, and the share that could have been in time."""
    counted = [figure for figure in figures if sum(figure.account.values())]
    if not counted:
        return
    fates = [fate for fate in FATES if any(figure.account[fate] for figure in counted)]
    rows = []
    for figure in counted:
        whole = sum(figure.account.values())
        shares = (percent(figure.account[fate] / whole) for fate in fates)
        least = percent(figure.least), "-" if math.isinf(figure.least_watch) else percent(figure.least_watch)
        cells = [percent(figure.best), percent(figure.of_best), *least, spread_text(figure.resumed, 1)]
        rows.append([*(f"{getattr(figure, key):g}" for key in keys), str(whole), *shares, *cells])
    terminal.print_line("")
    heads = [
        *(key.replace("command_rate", "commands/s") for key in keys),
        "crossings",
        *fates,
        "best",
        "of best",
        "least robot",
        "least watch",
        "resumes in",
    ]
    terminal.print_table(heads, rows, title="Fates of the crossings of placed robots")


def _means(figures: Sequence[FieldFigures]) -> str:
    """For example `4 robots, 1 channel`; empty without figures."""
    return "".join(
        f"{figure.robots} robots, {figure.channels} channel{'s' * (figure.channels != 1)}" for figure in figures
    )


def _cells(row: FieldFigures) -> list[str]:
    return [
        spread_text(row.all_placed),
        percent(row.placed),
        percent(row.dark),
        f"{percent(row.noticed)} of {row.walks}",
        f"{percent(row.alerted)} of {row.crossings}",
        "-" if math.isnan(row.false_alarms) else f"{row.false_alarms:.1f}",
        f"{row.preemptions:.1f}",
        f"{row.turned_unheld:.1f} s",
        f"{row.longest_stop:.1f} s",
    ]


def percent(share: float) -> str:
    """For example `95 %`; a dash for NaN."""
    return "-" if math.isnan(share) else f"{share:.0%}"


def spread_text(spread: Quantiles, digits: int = 0) -> str:
    """For example `41 s (30-77)`; infinite values are `never`."""
    if math.isnan(spread.median):
        return "-"
    low, median, high = (
        f"{value:.{digits}f}" if math.isfinite(value) else "never" for value in (spread.low, spread.median, spread.high)
    )
    return f"{median}{' s' * (median != 'never')} ({low}-{high})"
