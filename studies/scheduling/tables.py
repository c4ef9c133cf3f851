"""Tables of `python -m studies schedule`, `bookings` and `shares`."""

from __future__ import annotations

from studies.scheduling.bookings import BookingsReport
from studies.scheduling.families import FAMILIES
from studies.scheduling.shares import BURSTY, RISE, STEADY, Changes, SharesReport
from studies.scheduling.summary import Degeneracy, FamilyReport, SchedulingReport, StrategyReport
from zscout.terminal import print_line, print_table


def print_report(report: SchedulingReport) -> None:
    for family in report.families:
        _family(family)
    judged = [(family.family, family.degenerate) for family in report.families if family.degenerate]
    if judged:
        print_table(
            ["family", "situations", "behind", "of the best", "where behind", "worst", "at first", "worst"],
            [[name, *_degeneracy(found, FAMILIES[name].at_once)] for name, found in judged],
            title="Strategy priority against the best set in the same situation (RCs in use)",
        )
        print_line("")
    if any(value is not None for value in report.correlations.values()):
        ordered = sorted(report.correlations.items(), key=lambda pair: -abs(pair[1] or 0.0))
        print_table(
            ["feature", "correlation"],
            [[name, "-" if value is None else f"{value:+.2f}"] for name, value in ordered],
            title="Features that predict that priority is behind",
        )
        print_line("")
    if report.rule is not None:
        rule = report.rule
        print_line(f"Rule: priority is behind where {rule}")
        print_line(
            f"On {rule.situations} situations of other seeds it is right in {rule.hit_rate:.1%} "
            f'(always answering "never", or "always": {rule.base_rate:.1%}). It names {rule.named:.1%} of them, '
            f"{rule.precision:.1%} of these rightly, and finds {rule.found:.1%} of those behind."
        )


def print_bookings(report: BookingsReport) -> None:
    columns = ["booked", "of a run", "in use", "lost", "thrown away", "at their dates", "later by", "without"]
    for family, rows in report.families.items():
        shown = [
            [
                f"{row.share:.0%}",
                f"{row.booked:.1f}",
                f"{row.in_use:.1%}",
                f"{row.lost:.1%}",
                f"{row.thrown_away:.1%}",
                *(
                    (f"{row.at_date:.1%}", f"{row.moved:.1f} s", f"{row.at_once:.1%}")
                    if row.booked
                    else ("-", "-", "-")
                ),
                f"{row.wait:.1f} s",
                f"{row.longest:.0f} s",
            ]
            for row in rows
        ]
        print_table([*columns, "mean wait", "longest"], shown, title=f"{family}: {FAMILIES[family].summary}")
        print_line("")


def print_shares(report: SharesReport) -> None:
    """Both tables of `python -m studies shares`."""
    rows = []
    for week in report.weeks:
        cells = [f"{week.uses[name].charged:,.0f}" for name in (STEADY, BURSTY)]
        waits = [f"{week.uses[name].mean_wait:.0f}, {week.uses[name].longest:.0f} s" for name in (STEADY, BURSTY)]
        rows.append([str(week.seed), "yes" if week.fair else "no", *cells, f"{week.apart:.1%}", *waits])
    columns = ["seed", "fair shares", STEADY, BURSTY, "apart", f"wait of {STEADY} (longest)", f"wait of {BURSTY}"]
    print_table(columns, rows, title="RC-seconds in a week that others waited for")
    if not report.ways:
        return
    print_line("")
    columns = ["a group", "cases", "rose", "beyond", "fell", "mean", "most", "without: rose", "beyond", "fell", "mean"]
    ways = [
        [way.way, str(way.cases), *_changed(way.on), f"{way.on.greatest:+.0%} (seed {way.on.seed})", *_changed(way.off)]
        for way in report.ways
    ]
    print_table(columns, ways, title=f"Its part of all useful RC-seconds: cases in which it changed by over {RISE:.0%}")


def _changed(changes: Changes) -> list[str]:
    return [f"{changes.rose:.1%}", f"{changes.beyond:.1%}", f"{changes.fell:.1%}", f"{changes.mean:+.1%}"]


def _family(family: FamilyReport) -> None:
    together = FAMILIES[family.family].at_once
    columns = ["strategy", "in use", "mean wait", "p99", "longest", "preempted", "thrown away"]
    columns += ["last end", "pass", "p99"] + (["at first", "first pass", "p99"] if together else [])
    seeds = f"{family.family}: {family.summary}"
    print_table(columns, [_strategy(strategy, together) for strategy in family.strategies], title=seeds)
    print_line("")


def _strategy(strategy: StrategyReport, together: bool) -> list[str]:
    took = strategy.decision_us
    cells = [
        strategy.strategy,
        f"{strategy.in_use:.1%}",
        f"{strategy.wait_mean:.1f} s",
        f"{strategy.wait_p99:.0f} s",
        f"{strategy.wait_longest:.0f} s",
        f"{strategy.preemptions:.1f}",
        f"{strategy.thrown_away:.1%}",
        f"{strategy.end:.0f} s",
        f"{took.median:.0f} us",
        f"{took.p99:.0f} us",
    ]
    return (
        [*cells, f"{strategy.first:.1%}", f"{took.first_median:.0f} us", f"{took.first_p99:.0f} us"]
        if together
        else cells
    )


def _degeneracy(found: Degeneracy, together: bool) -> list[str]:
    first = [f"{found.first_mean:.3f}", f"{found.first_worst:.3f}"] if together else ["", ""]
    return [
        str(found.situations),
        f"{found.behind / found.situations:.1%}",
        f"{found.ratio_mean:.3f}",
        "-" if found.ratio_behind is None else f"{found.ratio_behind:.3f}",
        f"{found.ratio_worst:.3f}",
        *first,
    ]
