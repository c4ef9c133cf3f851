"""For how long an RC was used under a grant: what counts as use, and how much is kept of it."""

from __future__ import annotations

import pytest

from tests.drivers.rcs import TERM
from zscout.drivers.use import MAX_ENDED, PUBLISH_ENDED_FOR, UseCounter
from zscout.messages import MAX_USES, HoldUse, RcState, decode, encode
from zscout.types import SECOND, Grant, Ns


def grant(number: int = 1) -> Grant:
    return Grant(TERM, number)


def at(seconds: float) -> Ns:
    return round(seconds * SECOND)


def held() -> UseCounter:
    """An RC that is held under grant 1."""
    use = UseCounter()
    use.hold_began(grant())
    return use


def told(use: UseCounter, now: float) -> dict[int, float]:
    return {one.grant.seq: one.seconds for one in use.report(at(now))}


def test_a_hold_without_a_command_was_not_used() -> None:
    use = held()
    assert told(use, 5) == {1: 0.0}
    use.hold_ended(grant(), at(10))
    assert told(use, 11) == {1: 0.0}


def test_use_is_from_the_first_command_to_the_last() -> None:
    use = held()
    use.carried_out(grant(), at(3), at(3.25))
    assert told(use, 7) == {1: 0.25}
    use.carried_out(grant(), at(8), at(8.5))
    # A picture takes no time.
    use.carried_out(grant(), at(9), at(9))
    assert told(use, 20) == {1: 6.0}
    # One that began before all others, and whose answer took longer.
    use.carried_out(grant(), at(2), at(8.75))
    assert told(use, 20) == {1: 7.0}


def test_nothing_counts_after_the_end() -> None:
    use = held()
    use.carried_out(grant(), at(1), at(2))
    use.hold_ended(grant(), at(5))
    use.unpublished = False
    use.carried_out(grant(), at(4), at(8))
    assert use.unpublished
    assert told(use, 9) == {1: 4.0}
    use.carried_out(grant(7), at(4), at(8))
    late = held()
    late.hold_ended(grant(), at(5))
    late.carried_out(grant(), at(6), at(7))
    assert told(late, 9) == {1: 0.0}


def test_all_of_a_direct_hold_is_used_from_its_beginning_at_the_driver() -> None:
    use = held()
    use.direct_began(grant(), at(2))
    assert told(use, 5) == {1: 3.0}
    use.carried_out(grant(), at(6), at(7))
    use.hold_ended(grant(), at(10))
    assert told(use, 11) == told(use, 20) == {1: 8.0}
    use.direct_began(grant(), at(12))
    assert told(use, 13) == {1: 8.0}


def test_only_an_end_is_news() -> None:
    use = held()
    use.carried_out(grant(), at(1), at(2))
    assert not use.unpublished
    use.hold_ended(grant(7), at(3))
    assert not use.unpublished
    use.hold_ended(grant(), at(3))
    assert use.unpublished


def test_what_is_over_is_told_for_a_while_and_not_without_bound() -> None:
    use = UseCounter()
    for number in range(2 * MAX_ENDED):
        use.hold_began(grant(number))
        use.hold_ended(grant(number), at(number))
    last = 2 * MAX_ENDED - 1
    assert ([*told(use, last - 1)][-1], len(told(use, last))) == (last, PUBLISH_ENDED_FOR // SECOND + 1)
    assert told(use, last + PUBLISH_ENDED_FOR / SECOND + 1) == {}
    for number in range(1_000):
        use.hold_began(grant(number))
    for number in range(MAX_ENDED + 5):
        use.hold_ended(grant(number), at(500))
    words = use.report(at(500))
    assert len(words) == MAX_USES
    assert [word.grant.seq for word in words[:MAX_ENDED]] == [*range(5, MAX_ENDED + 5)]
    state = RcState("robot/x", "host", "i", sharable=True, used=words)
    assert decode(encode(state), RcState) == state


@pytest.mark.parametrize("seconds", ["-1", "1e10", "NaN", "Infinity", '"1"'])
def test_no_absurd_use_is_read(seconds: str) -> None:
    text = f'{{"grant": [[1, "a"], 1], "seconds": {seconds}}}'
    with pytest.raises(ValueError, match="not a valid HoldUse"):
        decode(text.encode(), HoldUse)
