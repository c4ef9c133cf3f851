"""Replays come out as they were recorded: a block of each; `python -m tests.surface.replays` plays all."""

from __future__ import annotations

import json

import pytest

from tests.surface.replays import BLOCK, NAMES, RECORDED, StrategyName, digests, families
from tests.surface.workloads import SEEDS

BLOCKS = {
    (family, strategy): number
    for number, (family, strategy) in enumerate((one, other) for one in families() for other in NAMES)
}
"""Each another one."""
DEAR = ("json", "adaptive")


@pytest.mark.parametrize(
    ("family", "strategy"), [pytest.param(*of, marks=pytest.mark.slow if of == DEAR else ()) for of in BLOCKS]
)
def test_a_block_of_workloads_comes_out_as_before(family: str, strategy: StrategyName) -> None:
    blocks = json.loads(RECORDED.read_text())[family][strategy].split()
    assert len(blocks) == SEEDS // BLOCK
    block = BLOCKS[family, strategy]
    seeds = range(block * BLOCK, (block + 1) * BLOCK)
    assert list(digests(family, strategy, seeds)) == [blocks[block]]
