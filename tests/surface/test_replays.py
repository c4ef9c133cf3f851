"""Replays come out as they were recorded: a block of each; `python -m tests.surface.replays` plays all."""

from __future__ import annotations

import json

import pytest

from tests.surface.replays import BLOCK, NAMES, RECORDED, StrategyName, digests, families, printed
from tests.surface.tree import PACKAGE
from tests.surface.workloads import SEEDS

BLOCKS = {
    (family, strategy): number
    for number, (family, strategy) in enumerate((one, other) for one in families() for other in NAMES)
}
"""Each another one."""


@pytest.mark.parametrize(("family", "strategy"), BLOCKS)
def test_a_block_of_workloads_comes_out_as_before(family: str, strategy: StrategyName) -> None:
    blocks = json.loads(RECORDED.read_text())[family][strategy].split()
    assert len(blocks) == SEEDS // BLOCK
    block = BLOCKS[family, strategy]
    seeds = range(block * BLOCK, (block + 1) * BLOCK)
    assert list(digests(family, strategy, seeds)) == [blocks[block]]


@pytest.mark.parametrize("strategy", NAMES)
def test_table_1_as_it_is_shipped_comes_out_as_in_the_paper(strategy: str) -> None:
    (file,) = PACKAGE.rglob("table1.toml")
    holds = json.loads(printed(str(file), "--strategy", strategy, "--json"))["holds"]
    assert [f"{hold['arc']} {hold['start']:g}-{hold['end']:g} {hold['outcome']}" for hold in holds] == [
        "arc0 0-5 completed", "arc1 5-10 completed", "arc3 5-8 completed", "arc2 8-11 preempted",
        "arc4 11-14 completed", "arc2 14-18 completed",
    ]  # fmt: skip
