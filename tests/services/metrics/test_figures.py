"""What is counted of waits and holds, and that labels have bounds."""

from __future__ import annotations

from zscout.config.access import AccessPolicy
from zscout.mesh.exchange import MAX_CODES, Tally
from zscout.scheduling.model import ArcRequest, Outcome
from zscout.services.metrics.figures import ERRORS, MAX_RCS, MAX_WAITERS, WAITS, Distribution, HoldFigures, Value
from zscout.services.rcm.digest import Began, Over
from zscout.types import SECOND, Ns


def began(
    arc: str = "one",
    rcs: tuple[str, ...] = ("robot/a",),
    *,
    at: float = 0,
    waited: float | None = 0.0,
    late: float | None = None,
    priority: int = 0,
    client: str = "desk/c",
) -> Began:
    request = ArcRequest(f"{client}/{arc}", client, {rc: {} for rc in rcs}, priority, SECOND)

    def ns(seconds: float | None) -> Ns | None:
        return None if seconds is None else round(seconds * SECOND)

    return Began(request, rcs, round(at * SECOND), ns(waited), ns(late))


def over(what: Began, at: float, outcome: Outcome | None = Outcome.RELEASED) -> Over:
    return Over(what, round(at * SECOND), outcome, None, requeued=False)


def count(value: Value) -> int:
    assert isinstance(value, Distribution)
    return value.counts[-1]


def test_waits_are_counted_by_priority_and_group() -> None:
    figures = HoldFigures(AccessPolicy(groups={"arms": ("bob", "eve"), "others": ("eve",)}))
    for owner, waited in (("bob", 0.0), ("eve", 30.0), ("desk", 100_000.0), ("bob", None)):
        figures.on_began(began(client=f"{owner}/c", waited=waited, priority=3))
    found = figures.samples(0, leading=True)["zscout_wait_seconds"]
    assert found.keys() == {("3", "arms"), ("3", "")}
    arms, others = found["3", "arms"], found["3", ""]
    assert isinstance(arms, Distribution)
    assert isinstance(others, Distribution)
    assert arms == Distribution(WAITS, (1, 1, 1, 1, 1, *[2] * (len(WAITS) - 4)), 30.0)
    # Beyond the last bound.
    assert others.counts[-2:] == (0, 1)


def test_a_wait_that_a_client_makes_up_is_bounded() -> None:
    figures = HoldFigures(AccessPolicy())
    figures.on_began(began(waited=1e12))
    (value,) = figures.samples(0, leading=True)["zscout_wait_seconds"].values()
    assert isinstance(value, Distribution)
    assert value.sum == 90 * 86_400


def test_errors_of_forecasts_have_a_sign() -> None:
    figures = HoldFigures(AccessPolicy())
    for late in (-20.0, 0.5, 20.0, None):
        figures.on_began(began(late=late))
    (value,) = figures.samples(0, leading=True)["zscout_forecast_error_seconds"].values()
    assert isinstance(value, Distribution)
    up_to = dict(zip(ERRORS, value.counts, strict=False))
    assert [up_to[bound] for bound in (-60.0, -15.0, 0.0, 1.0, 15.0, 60.0)] == [0, 1, 1, 2, 2, 3]


def test_use_counts_what_runs_and_goes_on_growing() -> None:
    figures = HoldFigures(AccessPolicy())
    first, second = began("one", ("robot/a", "radio/r"), at=10), began("two", ("radio/r",), at=12)
    figures.on_began(first)
    figures.on_began(second)

    def use(at: float) -> list[object]:
        found = figures.samples(round(at * SECOND), leading=True)
        return [found[of][rc,] for of in ("zscout_held_seconds_total", "zscout_holds") for rc in ("robot/a", "radio/r")]

    assert use(15) == [5, 8, 1, 2]
    figures.on_over(over(first, 20, Outcome.PREEMPTED))
    assert use(20) == [10, 18, 0, 1]
    figures.on_over(over(second, 22, None))
    assert use(30) == [10, 20, 0, 0]
    found = figures.samples(0, leading=False)
    assert found["zscout_preemptions_total"] == {("0", ""): 1}
    assert "zscout_holds" not in found


def test_labels_have_bounds() -> None:
    figures = HoldFigures(AccessPolicy())
    for number in range(MAX_RCS + 50):
        figures.on_began(began(f"arc{number}", (f"robot/r{number}",), priority=number))
    found = figures.samples(0, leading=True)
    assert len(found["zscout_wait_seconds"]) == MAX_WAITERS + 1
    assert count(found["zscout_wait_seconds"]["other", "other"]) == MAX_RCS + 50 - MAX_WAITERS
    assert len(found["zscout_holds"]) == MAX_RCS + 1
    assert found["zscout_holds"]["other",] == 50


def test_codes_of_refusals_have_bounds() -> None:
    tally = Tally()
    many = [f"code_{chr(97 + n // 26)}{chr(97 + n % 26)}" for n in range(90)]
    for code in ("busy", "busy", "Not a code", "x" * 33, *many):
        tally.refuse(code)
    found = tally.refused()
    assert found["busy"] == 2
    assert len(found) <= MAX_CODES + 1
    assert sum(found.values()) == 94
