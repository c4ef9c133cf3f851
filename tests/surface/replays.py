"""500 random workloads under each strategy, against what came of them when they were recorded.

    python -m tests.surface.replays              compares with `replays.json` in two minutes
    python -m tests.surface.replays --each FILE  writes a digest of each replay, to find which differs
    python -m tests.surface.replays --record     writes `replays.json`

Three families: what `zscout replay --json` prints, what it prints for people, and the same workloads with
kept holds, few clients and other policies, which no workload file has. A digest is the SHA-256 of what came
of ten workloads, cut to 8 digits. Exit code 1: something differs.
"""

from __future__ import annotations

import argparse
import dataclasses
import io
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from hashlib import sha256
from pathlib import Path
from random import Random
from typing import Any, Final, Literal, TypeAlias

from msgspec import structs

from tests.surface.commands import scripts
from tests.surface.record import text as as_text
from tests.surface.tree import find
from tests.surface.workloads import SEEDS, workload
from zscout.scheduling.strategies import STRATEGIES
from zscout.simulation.replay import replay
from zscout.simulation.workload import parse_workload

StrategyName: TypeAlias = Literal["priority", "optimal", "adaptive"]

RECORDED: Final = Path(__file__).with_name("replays.json")
NAMES: Final[tuple[StrategyName, ...]] = ("priority", "optimal", "adaptive")
BLOCK: Final = 10
"""Workloads of one digest."""
DIGITS: Final = 8
SECOND: Final = 1_000_000_000
POLICIES: Final[Sequence[Mapping[str, Any]]] = (
    {},
    {"preempt": "after_min_runtime"},
    {"patience": None},
    {"patience": 4 * SECOND},
    {"patience": 4 * SECOND, "promise": "all", "operator_priority": 3},
    {"max_running_per_host": 2},
)


class _Printed:
    """What the command prints."""

    def __init__(self, *options: str) -> None:
        self._options = options
        self._folder = tempfile.TemporaryDirectory()
        self._file = Path(self._folder.name) / "workload.toml"

    def __call__(self, text: str, _seed: int, strategy: StrategyName) -> str:
        self._file.write_text(text)
        return printed(str(self._file), "--strategy", strategy, *self._options)


def printed(*words: str) -> str:
    """What `zscout replay` prints. Raises AssertionError where it fails."""
    out = io.StringIO()
    with redirect_stdout(out):
        code = scripts()["zscout"].main(["replay", *words], standalone_mode=False)
    assert not code, f"zscout replay {' '.join(words)}: exit code {code}"
    return out.getvalue()


def kept(text: str, seed: int, strategy: StrategyName) -> str:
    """The same workload with kept holds, three hosts and a policy of its own."""
    random = Random(f"kept/{seed}")  # noqa: S311 - workloads, not secrets
    policy = find("Policy", "SchedulingPolicy")(**random.choice(POLICIES))
    asked = parse_workload(text, "workload")
    arrivals = tuple(
        dataclasses.replace(
            arrival,
            request=structs.replace(
                arrival.request, keep=random.random() < 0.3, client=f"host{random.randrange(3)}/client"
            ),
        )
        for arrival in asked.arrivals
    )
    played = replay(dataclasses.replace(asked, arrivals=arrivals), strategy=STRATEGIES[strategy](), policy=policy)
    holds = [(hold.arc, hold.start, hold.end, str(hold.outcome.value), sorted(hold.rcs)) for hold in played.holds]
    return json.dumps([holds, sorted(played.unserved)])


def families() -> dict[str, Callable[[str, int, StrategyName], str]]:
    """How each family is played: from a workload file's text, its seed and a strategy to the outcome."""
    return {"json": _Printed("--json"), "table": _Printed(), "kept": kept}


def digests(
    family: str, strategy: StrategyName, seeds: Sequence[int], each: Callable[[str], None] = lambda _: None
) -> Iterator[str]:
    """A digest for every `BLOCK` of the seeds."""
    play = families()[family]
    for begin in range(0, len(seeds), BLOCK):
        block = sha256()
        for seed in seeds[begin : begin + BLOCK]:
            one = sha256(play(workload(seed), seed, strategy).encode())
            each(f"{family} {strategy} {seed} {one.hexdigest()}\n")
            block.update(one.digest())
        yield block.hexdigest()[:DIGITS]


def total(found: Sequence[str]) -> str:
    return sha256("".join(found).encode()).hexdigest()[:DIGITS]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.surface.replays", description=__doc__)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--each", type=Path, metavar="FILE")
    given = parser.parse_args()
    lines: list[str] = []
    found: dict[str, dict[str, str]] = {}
    for family in families():
        for strategy in NAMES:
            blocks = list(digests(family, strategy, range(SEEDS), lines.append))
            found.setdefault(family, {})[strategy] = " ".join(blocks)
            print(f"{family:<6}{strategy:<9} {SEEDS} workloads  {total(blocks)}", flush=True)
    if given.each is not None:
        given.each.write_text("".join(lines))
    if given.record:
        RECORDED.write_text(as_text(found) + "\n")
        return 0
    recorded = json.loads(RECORDED.read_text())
    wrong = [
        f"{family}, {strategy}: a workload of seeds {at * BLOCK} to {at * BLOCK + BLOCK - 1} differs"
        for family, by_strategy in found.items()
        for strategy, blocks in by_strategy.items()
        for at, block in enumerate(blocks.split())
        if block != recorded[family][strategy].split()[at]
    ]
    print("\n".join(wrong) or "All as before.")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
