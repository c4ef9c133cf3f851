"""What the simulator sees of components: which of their processes act, and in which order."""

from __future__ import annotations

import pytest

from studies.faults.components import Deeds
from zscout.testing.virtual_time import Process


def deeds() -> tuple[Deeds, list[str]]:
    broken: list[str] = []
    return Deeds(broken.append, lambda: 10.0, lambda: False, {}), broken


def test_an_older_process_does_not_act_again_after_a_newer_one() -> None:
    seen, broken = deeds()
    older, newer = Process("h0/w.1001"), Process("h1/w.1002")
    for process, done, restored in ((older, 1, None), (older, 2, None), (newer, 3, 2), (newer, 4, 2)):
        seen.act("w", process, done, restored)
    assert broken == []
    seen.act("w", older, 3, None)
    assert broken == ["h0/w.1001 acts again after h1/w.1002"]


@pytest.mark.parametrize(
    ("restored", "text"), [(2, ""), (3, "h2/w.3001 continues from 3, which no other process had done")]
)
def test_one_that_died_does_not_act_where_another_has_its_number(restored: int, text: str) -> None:
    """Placers that did not see each other may have given a number twice, on one host: seed 1923."""
    seen, broken = deeds()
    seen.act("w", Process("h2/w.3001"), 1, None)
    seen.act("w", Process("h1/w.2004"), 2, None)
    seen.act("w", Process("h2/w.3001"), 3, restored)
    assert [one.partition(":")[0] for one in broken] == [text] * bool(text)
