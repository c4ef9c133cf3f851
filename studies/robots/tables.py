"""What `python -m studies robots` prints for people."""

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
            [[*(f"{getattr(one, key):g}" for key in keys), *_cells(one)] for one in figures],
            title=title,
        )
        _print_account(keys, figures)
    if found.starts:
        terminal.print_table(
            ["building", "starts", "truly dark", "and facing the light", "seconds (10-90 %)", "bumps"],
            [
                [
                    one.building,
                    str(one.starts),
                    f"{one.dark} ({one.dark / one.starts:.0%})",
                    f"{one.good} ({one.good / one.starts:.0%})",
                    spread_text(one.seconds),
                    f"{one.bumped:.1f} s",
                ]
                for one in found.starts
            ],
            title="One robot, random starts: hidden within 120 s",
        )


def _print_account(keys: Sequence[str], figures: Sequence[FieldFigures]) -> None:
    """Where the crossings of placed robots went, and what share of them could have been in time."""
    told = [one for one in figures if sum(one.account.values())]
    if not told:
        return
    fates = [fate for fate in FATES if any(one.account[fate] for one in told)]
    rows = []
    for one in told:
        whole = sum(one.account.values())
        shares = (percent(one.account[fate] / whole) for fate in fates)
        least = percent(one.least), "-" if math.isinf(one.least_watch) else percent(one.least_watch)
        cells = [percent(one.best), percent(one.of_best), *least, spread_text(one.resumed, 1)]
        rows.append([*(f"{getattr(one, key):g}" for key in keys), str(whole), *shares, *cells])
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
    terminal.print_table(heads, rows, title="Where the crossings of placed robots went")


def _means(figures: Sequence[FieldFigures]) -> str:
    """`4 robots, 1 channel`; nothing for none."""
    return "".join(f"{one.robots} robots, {one.channels} channel{'s' * (one.channels != 1)}" for one in figures)


def _cells(one: FieldFigures) -> list[str]:
    return [
        spread_text(one.all_placed),
        percent(one.placed),
        percent(one.dark),
        f"{percent(one.noticed)} of {one.walks}",
        f"{percent(one.alerted)} of {one.crossings}",
        "-" if math.isnan(one.false_alarms) else f"{one.false_alarms:.1f}",
        f"{one.preemptions:.1f}",
        f"{one.turned_unheld:.1f} s",
        f"{one.longest_stop:.1f} s",
    ]


def percent(share: float) -> str:
    """`95 %`, or a dash where there was nothing to have a share of."""
    return "-" if math.isnan(share) else f"{share:.0%}"


def spread_text(spread: Quantiles, digits: int = 0) -> str:
    """`41 s (30-77)`; what never came to an end is `never`."""
    if math.isnan(spread.median):
        return "-"
    low, median, high = (
        f"{value:.{digits}f}" if math.isfinite(value) else "never" for value in (spread.low, spread.median, spread.high)
    )
    return f"{median}{' s' * (median != 'never')} ({low}-{high})"
