"""Seeds of a random test in parts: a few in the quick tier, the others in longer parts that are slow."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import pytest
from _pytest.mark import ParameterSet


def in_parts(seeds: Sequence[int], quick: int, size: int) -> list[ParameterSet]:
    """Parameters of a test that takes `seeds`: the first `quick` of them, and the others by `size`."""
    ends = [*range(0, quick, max(1, quick)), *range(quick, len(seeds), size), len(seeds)]
    return [
        pytest.param(seeds[first:end], id=f"{seeds[first]}-{seeds[end - 1]}", marks=[pytest.mark.slow] * (end > quick))
        for first, end in pairwise(ends)
    ]
