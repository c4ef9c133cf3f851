"""`zscout demo placement`: the paper's Figure 3 on three live nodes, with components that really work."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from zscout.cli import common
from zscout.cli.lab.demo_screen import keep_recording
from zscout.config.strict import BadInput
from zscout.types import POLICIES, Policy

if TYPE_CHECKING:
    from zscout.lab.demo.placement_run import PlacementTrial

GAP: Final = 5.0
SCENARIOS: Final = {"at-once": 0.0, "staggered": GAP}
TITLES: Final = {"at-once": "all at once", "staggered": f"one net every {GAP:g} s"}


@click.command()
@click.option(
    "--policy",
    "policies",
    multiple=True,
    type=click.Choice(POLICIES),
    help="A policy; repeat it for several. Default: all.",
)
@click.option(
    "--when",
    "scenarios",
    multiple=True,
    type=click.Choice(list(SCENARIOS)),
    help="All components at once, or net by net. Default: both.",
)
@click.option(
    "--out",
    metavar="FOLDER",
    type=click.Path(path_type=Path, file_okay=False),
    help="Keep a Rerun recording of each trial there.",
)
@common.json_option("Print one JSON object.")
def placement(
    policies: tuple[Policy, ...], scenarios: tuple[str, ...], out: Path | None, as_json: bool
) -> int:
    """Place three Place Sensor Nets on three live nodes under each policy (Figure 3 of the paper).

    Each trial starts three nodes on this machine, apart from every other fleet; each reports the load of what
    it started itself. Twelve components, which really use the processor, are started all at once or net by
    net. A trial takes about 12 seconds. Exit code 1: `pending` did not come within one component of even, or
    a policy that was given time did not use all hosts.

    \b
    Examples:
      zscout demo placement
      zscout demo placement --policy least_loaded --policy pending --when at-once
      zscout demo placement --out runs/figure3 --json
    """
    chosen = [
        (scenario, policy)
        for scenario in SCENARIOS
        if scenario in (scenarios or SCENARIOS)
        for policy in POLICIES
        if policy in (policies or POLICIES)
    ]
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInput(f"--out {out}: can't be made ({error.strerror}); give another folder") from None
    return common.run(_trials(chosen, out, as_json=as_json))


async def _trials(chosen: list[tuple[str, Policy]], out: Path | None, *, as_json: bool) -> int:
    # Zenoh is loaded here: the help needs none of it.
    from zscout.lab.demo.placement_run import PlacementDemo, PlacementTrial, as_object

    began, done = time.monotonic(), []

    def show(at: float, text: str) -> None:
        if not as_json:
            common.print_line(f"{at:7.2f} s  {common.clean(text)}")

    for number, (scenario, policy) in enumerate(chosen, start=1):
        if not as_json:
            title = f"{policy}, {TITLES[scenario]}"
            common.print_line(f"Trial {number} of {len(chosen)}: {title}; starting three nodes")
        with tempfile.TemporaryDirectory(prefix="zscout-demo-") as folder:
            trial = PlacementTrial(policy, SCENARIOS[scenario])
            async with PlacementDemo(Path(folder), trial, show) as demo:
                await demo.run()
            if out is not None:
                keep_recording(Path(folder), out / f"{scenario}-{policy}.rrd")
        done.append((scenario, trial))
    failures = [why for scenario, trial in done if (why := _failure(scenario, trial))]
    if as_json:
        trials = [{"scenario": scenario, **as_object(trial)} for scenario, trial in done]
        common.print_json({"trials": trials, "failures": failures})
        return 1 if failures else 0
    common.print_line("")
    _table(done)
    common.print_line("")
    for why in failures:
        common.print_line(why)
    if not failures:
        common.print_line(f"As Figure 3 has it, and its cure ({time.monotonic() - began:.0f} s).")
    if out is not None:
        common.print_line(f"Recordings: {out}; look at one: zscout view {out}/at-once-pending.rrd")
    return 1 if failures else 0


def _failure(scenario: str, trial: PlacementTrial) -> str:
    """What is not as it must be; empty if all is."""
    counts = "-".join(map(str, trial.counts().values()))
    if trial.policy == "pending" and trial.spread() > 1:
        return f"pending, {TITLES[scenario]}: {counts} is not within one component"
    if trial.policy == "least_loaded" and scenario == "at-once" and max(trial.counts().values()) < 12:
        return f"least_loaded, all at once: {counts}, where the paper has all on one host"
    if scenario == "staggered" and not all(trial.counts().values()):
        return f"{trial.policy}, {TITLES[scenario]}: {counts} leaves a host unused"
    return ""


def _table(done: list[tuple[str, PlacementTrial]]) -> None:
    hosts = list(done[0][1].counts())
    rows = []
    for scenario, trial in done:
        counts = trial.counts()
        rows.append(
            [
                TITLES[scenario],
                trial.policy,
                *(str(counts[host]) for host in hosts),
                str(trial.spread()),
                f"{trial.apart():.2f}",
            ]
        )
    common.print_table(
        ["started", "policy", *hosts, "spread", "load apart"],
        rows,
        title="Components of three Place Sensor Nets on each host; load apart in cores, at the end",
    )
