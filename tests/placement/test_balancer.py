"""The balancer names the host that a person would, none that does not fit, and counts what is pending."""

from __future__ import annotations

import math
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.thorough import times
from zscout.messages import ComponentUse, LoadReport
from zscout.placement import balancer as core
from zscout.placement.balancer import SHOWN, Balancer
from zscout.placement.model import STALE, Profile, RankQuery
from zscout.types import METRICS, POLICIES, SECOND, Metric, Policy

GIGABYTE = 1_000_000_000
SPEEDS = {"slow": 1.0, "middle": 2.0, "fast": 4.0}
MEMORY = {"slow": 1, "middle": 4, "fast": 2}


def report(host: str, number: int = 1, load: float = 0.0, *uses: ComponentUse, **more: object) -> LoadReport:
    figures = {
        "cores": 1.0,
        "cpu": 0.0,
        "memory_available": 4 * GIGABYTE,
        "memory_total": 8 * GIGABYTE,
        "load_average": (load, load, load),
        "components": uses,
    }
    return LoadReport(host=host, number=number, **(figures | more))  # type: ignore[arg-type]


def fleet(loads: dict[str, float], seed: int = 0) -> Balancer:
    """Speeds 1, 2, 4 with 1, 4, 2 GB, and this load."""
    balancer = Balancer(Random(seed))  # noqa: S311
    for host, speed in SPEEDS.items():
        memory = MEMORY[host] * GIGABYTE
        balancer.reported(0, report(host, 1, loads.get(host, 0.0), speed=speed, memory_available=memory))
    return balancer


@pytest.mark.parametrize(
    ("metric", "loads", "profile", "best_first"),
    [
        ("load_average", {"slow": 0.1, "middle": 0.5, "fast": 0.9}, None, "slow middle fast"),
        ("load_average", {"slow": 3, "middle": 2, "fast": 1}, None, "fast middle slow"),
        ("processor_speed", {"fast": 9}, None, "fast middle slow"),
        ("available_memory", {"middle": 9}, None, "middle fast slow"),
        ("composite", {}, None, "fast middle slow"),
        # A quarter of a processor of speed 4 is as good as a free one of speed 1; a tenth is not.
        ("composite", {"fast": 9}, Profile(1, 0), "middle slow fast"),
        ("composite", {}, Profile(1, 3 * GIGABYTE), "middle fast slow"),
    ],
)
def test_each_metric_names_the_host_that_a_person_would(
    metric: Metric, loads: dict[str, float], profile: Profile | None, best_first: str
) -> None:
    balancer = fleet(loads)
    balancer.profiles["job"] = profile or Profile()
    ranking = balancer.rank(0, RankQuery("job", metric))
    assert " ".join(one.host for one in ranking.hosts) == best_first
    assert (ranking.metric, ranking.why) == (metric, "as asked")
    assert all(one.reason for one in ranking.hosts)


@pytest.mark.parametrize("policy", POLICIES)
def test_a_host_that_can_not_be_used_is_left_out_with_the_reason(policy: Policy) -> None:
    balancer, now = Balancer(Random(1)), STALE + 1  # noqa: S311
    balancer.reported(0, report("stale", labels=("camera",)))
    balancer.reported(1, report("fresh", labels=("camera",)))
    balancer.reported(now, report("cordoned", labels=("camera",)))
    balancer.reported(now, report("unlabelled"))
    balancer.reported(now, report("small", labels=("camera",), memory_available=5))
    balancer.cordoned.add("cordoned")
    names = frozenset({"stale", "fresh", "cordoned", "unlabelled", "small", "silent"})
    query = RankQuery(policy=policy, labels=frozenset({"camera"}), memory=1_000, hosts=names)
    ranking = balancer.rank(now, query)
    assert [one.host for one in ranking.hosts] == ["fresh"]
    assert {host: str(why) for host, why in ranking.left_out.items()} == {
        "stale": "its last report is 3.5 s old",
        "cordoned": "it is cordoned",
        "unlabelled": "it has no label camera",
        "small": "5 bytes available, 1,000 required",
        "silent": "no report of it",
    }


def test_only_the_hosts_asked_for_are_ranked() -> None:
    ranking = fleet({}).rank(0, RankQuery(hosts=frozenset({"slow"})))
    assert ([one.host for one in ranking.hosts], ranking.left_out) == (["slow"], {})


@pytest.mark.parametrize(("policy", "sees"), [("least_loaded", False), ("two_choices", True), ("pending", True)])
def test_policies_count_what_no_report_shows(policy: Policy, sees: bool) -> None:
    balancer = fleet({})
    balancer.placed(0, "one", "job", "fast")
    scores = {one.host: one.score for one in balancer.rank(0, RankQuery("job", "load_average", policy)).hosts}
    assert scores["slow"] == scores["middle"] == 0
    assert (scores["fast"] < 0) is sees


def test_pending_lets_go_as_the_load_average_shows_it() -> None:
    balancer = fleet({})
    balancer.profiles["job"] = Profile(4.0, GIGABYTE)
    balancer.placed(0, "one", "job", "fast")
    assert balancer.outlook(0, "fast", pending=True).load == 1.0
    assert balancer.outlook(0, "fast", pending=True).memory == 3 * GIGABYTE - 2 * GIGABYTE
    use = ComponentUse("one", "job", 1, 1.0, GIGABYTE, served=1.0)
    for at in range(1, SHOWN // SECOND + 1):
        shown = 1 - math.exp(-at / 60)
        balancer.reported(at * SECOND, report("fast", at + 1, shown, use, speed=4.0))
        # What the reports show and what they do not show yet are always the one core that it wants.
        assert balancer.outlook(at * SECOND, "fast", pending=True).load == pytest.approx(1.0, abs=0.001)
        assert balancer.outlook(at * SECOND, "fast", pending=True).memory == 4 * GIGABYTE
    assert balancer.outlook(SHOWN, "fast", pending=True).load == balancer.outlook(SHOWN, "fast", pending=False).load


@pytest.mark.parametrize("end", ["gone", "moved", "lost"])
def test_what_ended_moved_or_was_lost_is_not_pending(end: str) -> None:
    balancer = fleet({})
    balancer.placed(0, "one", "job", "fast")
    if end == "gone":
        balancer.gone("one")
    elif end == "moved":
        balancer.placed(0, "one", "job", "slow")
        assert balancer.outlook(0, "slow", pending=True).load > 0
    else:
        balancer.lost("fast")
        balancer.reported(0, report("fast"))
    assert balancer.outlook(0, "fast", pending=True).load == 0


def test_required_memory_counts_what_is_on_its_way() -> None:
    balancer = fleet({})
    balancer.profiles["large"] = Profile(0.1, 3 * GIGABYTE)
    question = RankQuery("large", memory=3 * GIGABYTE)
    assert [one.host for one in balancer.rank(0, question).hosts] == ["middle"]
    balancer.placed(0, "one", "large", "middle")
    assert balancer.rank(0, question).hosts == ()


def test_two_choices_names_the_better_of_two_and_any_but_the_worst() -> None:
    balancer = fleet({"slow": 3, "middle": 2, "fast": 1})
    question = RankQuery(metric="load_average", policy="two_choices")
    first = {balancer.rank(0, question).hosts[0].host for _ in range(100)}
    assert first == {"middle", "fast"}


def test_randomized_names_any_of_those_that_are_nearly_equal() -> None:
    balancer = fleet({"slow": 0.1, "middle": 0.0, "fast": 9})
    question = RankQuery(metric="load_average", policy="randomized")
    assert {balancer.rank(0, question).hosts[0].host for _ in range(100)} == {"slow", "middle"}


def test_profiles_are_learnt_from_settled_components_and_heavy_ones_go_first() -> None:
    balancer = fleet({})
    for kind, cpu in (("light", 0.02), ("heavy", 0.5)):
        balancer.placed(0, kind, kind, "fast")
        use = ComponentUse(kind, kind, 1, cpu, 100, served=0.5)
        balancer.reported(2 * SECOND, report("fast", 2 + (kind == "heavy"), 0.0, use, speed=4.0))
        assert balancer.profile(kind) == Profile()
        balancer.reported(3 * SECOND, report("fast", 4 + (kind == "heavy"), 0.0, use, speed=4.0))
    # It had a processor for half of the time that it wanted one, of speed 4.
    assert balancer.profile("heavy") == Profile(0.5 / 0.5 * 4, 100, 1, 1)
    assert balancer.profile("light").cpu == pytest.approx(0.16)
    asked = [("a", "light"), ("b", "new"), ("c", "heavy"), ("d", "heavy")]
    assert balancer.heaviest_first(asked) == ["c", "d", "b", "a"]


def test_what_an_earlier_balancer_placed_is_learnt_from_and_not_pending() -> None:
    balancer = fleet({})
    for number in range(2, 7):
        use = ComponentUse("old", "job", 1, 0.8, 500, served=1.0)
        balancer.reported(number * SECOND, report("slow", number, 0.8, use))
    assert balancer.profile("job").memory == 500
    assert balancer.outlook(6 * SECOND, "slow", pending=True).load == 0.8


def test_an_older_report_is_dropped_unless_the_host_was_silent() -> None:
    balancer = Balancer(Random(0))  # noqa: S311
    balancer.reported(0, report("a", 9, 1.0))
    balancer.reported(SECOND, report("a", 8, 2.0))
    assert balancer.reports["a"] == (0, report("a", 9, 1.0))
    balancer.reported(STALE, report("a", 1, 3.0))
    assert balancer.reports["a"][1].number == 1


def test_limits_hold_and_silent_hosts_make_room(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, limit in (("MAX_HOSTS", 2), ("MAX_PLACED", 3), ("MAX_KINDS", 1)):
        monkeypatch.setattr(core, name, limit)
    balancer = Balancer(Random(0))  # noqa: S311
    for host in "abc":
        balancer.reported(0, report(host))
    assert set(balancer.reports) == {"a", "b"}
    for number in range(9):
        balancer.placed(0, f"c{number}", f"k{number}", "a")
    assert balancer.outlook(0, "a", pending=True).load == 3 * Profile().cpu
    uses = [ComponentUse(f"c{number}", f"k{number}", 1, 0.1, 1) for number in range(3)]
    balancer.reported(STALE, report("a", 2, 0.0, *uses))
    assert set(balancer.profiles) == {"k0"}
    balancer.reported(STALE + 1, report("c"))
    assert set(balancer.reports) == {"a", "c"}


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("load_average", (math.inf, 0.0, 0.0)),
        ("memory_available", -1),
        ("memory_available", 2**64),
        ("cores", 1e-300),
        ("load_average", (math.nan, 0.0, 0.0)),
    ],
)
def test_a_report_that_no_host_can_send_is_refused(field: str, value: object) -> None:
    with pytest.raises(ValueError, match=field):
        Balancer(Random(0)).reported(0, report("a", **{field: value}))  # type: ignore[arg-type]  # noqa: S311


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("metric", [metric for metric in METRICS if metric != "auto"])
def test_the_few_that_are_named_are_the_first_of_all(metric: Metric, policy: Policy) -> None:
    few, all_ = (Balancer(Random(7)) for _ in range(2))  # noqa: S311
    for balancer in (few, all_):
        for number in range(40):
            balancer.reported(0, report(f"h{number}", 1, number % 5, memory_available=number % 3 * GIGABYTE))
        balancer.placed(0, "one", "job", "h5")
    question = RankQuery("job", metric, policy, memory=1)
    first, every = few.rank(0, question, 3), all_.rank(0, question)
    assert (first.hosts, first.more, first.left_out) == (every.hosts[:3], 23, every.left_out)
    assert (len(every.hosts), every.more) == (26, 0)


@given(
    cores=st.floats(0.1, 64),
    load=st.floats(0, 100),
    speed=st.floats(0.1, 8),
    memory=st.integers(0, 2_000),
    profile=st.builds(Profile, st.floats(0, 16), st.integers(0, 2_000), st.just(1), st.integers(1, 8)),
)
def test_composite_is_speed_shared_by_all_who_want_it(
    cores: float, load: float, speed: float, memory: int, profile: Profile
) -> None:
    balancer = Balancer(Random(0))  # noqa: S311
    balancer.profiles["job"] = profile
    balancer.reported(0, report("a", 1, load, cores=cores, speed=speed, memory_available=memory))
    (found,) = balancer.rank(0, RankQuery("job")).hosts
    wanting = load + max(profile.wants(speed), 0.01)
    share = 1.0 if memory >= profile.memory else max(0.05, (memory / profile.memory) ** 2)
    assert found.score == pytest.approx(speed * min(1.0, cores / wanting) * share)


LABELS = st.frozensets(st.sampled_from(["camera", "gpu"]))
REPORTS = st.builds(
    LoadReport,
    host=st.sampled_from("abcdef"),
    number=st.integers(1, 5),
    cores=st.floats(0.1, 64),
    load_average=st.tuples(*[st.floats(0, 100)] * 3),
    cpu=st.floats(0, 1),
    memory_available=st.integers(0, 2_000),
    memory_total=st.just(2_000),
    speed=st.floats(0.1, 8),
    labels=st.builds(tuple, LABELS),
)


@settings(max_examples=times(80))
@given(
    reports=st.lists(st.tuples(st.integers(0, 8), REPORTS), max_size=12),
    cordoned=st.sets(st.sampled_from("abcdef"), max_size=2),
    placed=st.lists(st.sampled_from("abcdef"), max_size=6),
    metric=st.sampled_from(METRICS),
    policy=st.sampled_from(POLICIES),
    labels=LABELS,
    memory=st.integers(0, 1_000),
    hosts=st.none() | st.frozensets(st.sampled_from("abcdefg")),
)
def test_no_ranking_names_a_host_that_does_not_fit(
    reports: list[tuple[int, LoadReport]],
    cordoned: set[str],
    placed: list[str],
    metric: Metric,
    policy: Policy,
    labels: frozenset[str],
    memory: int,
    hosts: frozenset[str] | None,
) -> None:
    balancer, now = Balancer(Random(0)), 8 * SECOND  # noqa: S311
    balancer.cordoned |= cordoned
    for at, one in sorted(reports, key=lambda pair: pair[0]):
        balancer.reported(at * SECOND, one)
    for number, host in enumerate(placed):
        balancer.placed(now, f"c{number}", "job", host)
    ranking = balancer.rank(now, RankQuery("job", metric, policy, labels, memory, hosts))
    named = [one.host for one in ranking.hosts]
    for host in named:
        at, last = balancer.reports[host]
        assert now - at <= STALE
        assert host not in cordoned
        assert labels <= set(last.labels)
        assert memory <= last.memory_available
    asked = set(balancer.reports) if hosts is None else hosts
    assert sorted([*named, *ranking.left_out]) == sorted(asked)
    if policy != "two_choices":
        assert [one.score for one in ranking.hosts] == sorted((one.score for one in ranking.hosts), reverse=True)
