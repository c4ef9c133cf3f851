"""Workload files: exact when good, one exact line when bad."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.thorough import times
from zscout.config.strict import BadInput
from zscout.scheduling.model import ArcRequest
from zscout.simulation.replay import replay
from zscout.simulation.workload import MAX_ARCS, MAX_NEEDS, MAX_RCS, Arrival, Workload, WorkloadRc, parse_workload

RC = '[[rc]]\nname = "robot/a"\n'
RADIO = '[[rc]]\nname = "radio/r"\nsharable = true\n'
TWICE = "rename or remove one of the two"


def arc(arc_name: str = "arc0", /, **keys: str) -> str:
    """An ARC in TOML; a key given replaces the good value, an empty one leaves the key out."""
    good = {"name": f'"{arc_name}"', "at": "0.0", "priority": "1", "min_runtime": "5.0", "needs": '{"robot/a" = {}}'}
    return "[[arc]]\n" + "".join(f"{key} = {value}\n" for key, value in (good | keys).items() if value)


BAD = {
    "[[arc]": "line 1, column 6: Expected ']]' at the end of an array declaration; fix the TOML there or just before",
    # Keys
    "[[arcs]]": "arcs: unknown key; did you mean arc or rc?",
    "[rc]": "rc: is a table; write tables, each under [[rc]]",
    RC + "capcity = {}": "rc[0].capcity (robot/a): unknown key; did you mean capacity?",
    arc() + "keep = true": ("arc[0].keep (arc0): unknown key; known here: at, min_runtime, name, needs, priority"),
    arc(name=""): "arc[0].name: is missing; add it",
    arc(needs=""): "arc[0].needs (arc0): is missing; add it",
    # Names
    RC + RC: f'rc[1].name: "robot/a" is already at rc[0]; {TWICE}',
    arc() + arc("arc1") + arc(): f'arc[2].name: "arc0" is already at arc[0]; {TWICE}',
    '[[rc]]\nname = ""': 'rc[0].name: "" is not a name; write 1 to 130 printable characters',
    '[[rc]]\nname = "a\\tb"': r'rc[0].name: "a\tb" is not a name; write 1 to 130 printable characters',
    arc("a" * 131): f'arc[0].name: "{"a" * 60}..." is not a name; write 1 to 130 printable characters',
    "[[rc]]\nname = 3": "rc[0].name: is 3; write a text in quotes",
    arc(needs='{"" = {}}'): ('arc[0].needs (arc0): "" is not a name; write 1 to 130 printable characters'),
    arc(needs='{"robot/a" = {"" = 1}}'): (
        'arc[0].needs."robot/a" (arc0): "" is not a name; write 1 to 130 printable characters'
    ),
    # Times and priority
    arc(at="-1"): "arc[0].at (arc0): is -1 s; write 0 to 1000000000 seconds",
    arc(at="nan"): "arc[0].at (arc0): is not a finite number; write a number",
    arc(at="1e10"): "arc[0].at (arc0): is 1E+10 s; write 0 to 1000000000 seconds",
    arc(at="1e999999999"): "arc[0].at (arc0): is too large; write a number below 1e18",
    arc(at='"0"'): 'arc[0].at (arc0): is the text "0"; write a number',
    arc(min_runtime="0"): "arc[0].min_runtime (arc0): is 0 s; write 0.000000001 to 1000000000 seconds",
    arc(min_runtime="1e-10"): "arc[0].min_runtime (arc0): is 1E-10 s; write 0.000000001 to 1000000000 seconds",
    arc(priority="1.5"): "arc[0].priority (arc0): is 1.5; write a whole number from 0 to 1000000000",
    arc(priority="-1"): "arc[0].priority (arc0): is -1; write a whole number from 0 to 1000000000",
    # Needs and capacities
    arc(needs="{}"): "arc[0].needs (arc0): a request needs at least one device; name one, with {} for no parameters",
    arc(needs='{"robot/a" = 5}'): 'arc[0].needs."robot/a" (arc0): is 5; write a table',
    arc(needs='{"robot/a" = {rate = -1}}'): 'arc[0].needs."robot/a".rate (arc0): is -1; write 0 or more',
    arc() + arc("arc1", needs='{"robot/a" = {rate = "5"}}'): (
        'arc[1].needs."robot/a".rate (arc1): is the text "5"; write a number'
    ),
    RC + "sharable = 1": "rc[0].sharable (robot/a): is 1; write true or false",
    RC + "capacity = {rate = 1}": (
        "rc[0].capacity (robot/a): an exclusive device has no capacity; add sharable = true, or remove it"
    ),
    RADIO + "capacity = {rate = -0.1}": "rc[0].capacity.rate (radio/r): is -0.1; write 0 or more",
    RADIO + "capacity = {rate = 1e-101}": ("rc[0].capacity.rate (radio/r): has more than 100 decimal places; round it"),
    # Counts
    arc(needs="{" + ",".join(f"r{i}={{}}" for i in range(MAX_NEEDS + 1)) + "}"): (
        "arc[0].needs (arc0): has 1,001 entries; at most 1,000 are allowed"
    ),
    RADIO + "capacity = {" + ",".join(f"p{i}=1" for i in range(65)) + "}": (
        "rc[0].capacity (radio/r): has 65 entries; at most 64 are allowed"
    ),
    "rc = [" + "{}," * (MAX_RCS + 1) + "]": "rc: has 10,001 entries; at most 10,000 are allowed",
    "arc = [" + "{}," * (MAX_ARCS + 1) + "]": "arc: has 100,001 entries; at most 100,000 are allowed",
}


def short(text: str) -> str:
    return re.sub(r"\s+", " ", text)[:60]


@pytest.mark.parametrize(("text", "line"), BAD.items(), ids=map(short, BAD))
def test_bad_workload_file(text: str, line: str) -> None:
    with pytest.raises(BadInput) as caught:
        parse_workload(text, "w.toml")
    assert str(caught.value) == f"w.toml: {line}"


def test_a_good_file_is_read_exactly_and_in_its_order() -> None:
    text = """
        [[rc]]
        name = "robot/scout33"
        [[rc]]
        name = "radio/rf0"
        sharable = true
        capacity = { command_rate = 0.3, slots = 2 }
        [[rc]]
        name = "video/ch1"
        sharable = true

        [[arc]]
        name = "late"
        at = 0.1
        priority = 1
        min_runtime = 0.2
        [arc.needs]
        "radio/rf0" = { command_rate = 0.1 }
        "video/ch1" = {  }

        [[arc]]
        name = "an early one"
        at = 0
        priority = 0
        min_runtime = 1
        [arc.needs]
        "robot/scout33" = {}
        "nowhere/to_be_found" = { command_rate = 1e-3 }
    """
    radio = {"command_rate": Fraction(3, 10), "slots": Fraction(2)}
    late = {"radio/rf0": {"command_rate": Fraction(1, 10)}, "video/ch1": {}}
    early = {"robot/scout33": {}, "nowhere/to_be_found": {"command_rate": Fraction(1, 1000)}}
    assert parse_workload(text, "w.toml") == Workload(
        rcs=(
            WorkloadRc("robot/scout33"),
            WorkloadRc("radio/rf0", sharable=True, capacity=radio),
            WorkloadRc("video/ch1", sharable=True),
        ),
        arrivals=(
            Arrival(100_000_000, ArcRequest("late", "late", late, 1, 200_000_000)),
            Arrival(0, ArcRequest("an early one", "an early one", early, 0, 1_000_000_000)),
        ),
    )


def test_sums_are_exact() -> None:
    """0.1 + 0.2 fits a capacity of 0.3, which it would not as floats; 1e-18 more does not."""

    def holds_at_once(second: str) -> int:
        text = RADIO + "capacity = {rate = 0.3}\n"
        text += arc("one", needs='{"radio/r" = {rate = 0.1}}')
        text += arc("two", needs=f'{{"radio/r" = {{rate = {second}}}}}')
        return sum(hold.start == 0 for hold in replay(parse_workload(text, "w")).holds)

    assert holds_at_once("0.2") == 2
    assert holds_at_once("0.200000000000000001") == 1


def test_times_are_exact() -> None:
    """0.1 s and 0.2 s of waiting end at the very ns at which 0.3 s do."""
    text = RC + arc("one", at="0.1", min_runtime="0.2") + arc("two", at="0.3", min_runtime="0.7")
    held = [(hold.arc, hold.start, hold.end) for hold in replay(parse_workload(text, "w")).holds]
    assert held == [("one", 100_000_000, 300_000_000), ("two", 300_000_000, 1_000_000_000)]


def test_an_empty_file_is_an_empty_workload() -> None:
    assert parse_workload("", "w") == Workload((), ())


# With a star a need would be a pattern.
NAMES = st.text(st.characters(exclude_categories=("C", "Z"), exclude_characters="*"), min_size=1, max_size=20)
AMOUNTS = st.dictionaries(NAMES, st.integers(0, 10**20).map(lambda n: Fraction(n, 10**9)), max_size=3)
TIMES = st.integers(1, 10**18)


@st.composite
def workloads(draw: st.DrawFn) -> Workload:
    rcs = draw(st.lists(st.tuples(NAMES, st.booleans(), AMOUNTS), max_size=4, unique_by=lambda rc: rc[0]))
    names = draw(st.lists(NAMES, max_size=4, unique=True))
    needs = st.dictionaries(NAMES, AMOUNTS, min_size=1, max_size=3)
    return Workload(
        tuple(WorkloadRc(name, sharable, capacity if sharable else {}) for name, sharable, capacity in rcs),
        tuple(
            Arrival(draw(TIMES), ArcRequest(name, name, draw(needs), draw(st.integers(0, 10**9)), draw(TIMES)))
            for name in names
        ),
    )


def quoted(name: str) -> str:
    return json.dumps(name, ensure_ascii=False)


def decimal(value: Fraction) -> str:
    whole, rest = divmod(int(value * 10**9), 10**9)
    return f"{whole}.{rest:09}"


def table(values: Mapping[str, Fraction]) -> str:
    return "{" + ", ".join(f"{quoted(name)} = {decimal(value)}" for name, value in values.items()) + "}"


def toml(workload: Workload) -> str:
    lines: list[str] = []
    for rc in workload.rcs:
        lines += ["[[rc]]", f"name = {quoted(rc.name)}"]
        if rc.sharable:
            lines += ["sharable = true", f"capacity = {table(rc.capacity)}"]
    for arrival in workload.arrivals:
        request = arrival.request
        lines += ["[[arc]]", f"name = {quoted(request.arc)}", f"at = {decimal(Fraction(arrival.at, 10**9))}"]
        lines += [f"priority = {request.priority}"]
        lines += [f"min_runtime = {decimal(Fraction(request.min_runtime, 10**9))}", "[arc.needs]"]
        lines += [f"{quoted(rc)} = {table(amounts)}" for rc, amounts in request.needs.items()]
    return "\n".join(lines)


@settings(max_examples=times(50))
@given(workloads())
def test_whatever_is_written_is_read_back_the_same(workload: Workload) -> None:
    assert parse_workload(toml(workload), "w") == workload


ODD = ["", "0", "-1", "nan", "1e999", "true", '""', '"x"', "[]", "[{}]", "{}", "{a = {}}", "{a = {b = -1}}", "07:32:00"]


@given(
    st.lists(st.sampled_from(["[[rc]]", "[[arc]]", "[arc]", "[arc.needs]", "rc", "a.b", "x = '"]), max_size=2),
    st.dictionaries(
        st.sampled_from(["name", "at", "priority", "min_runtime", "needs", "sharable", "capacity", "x"]),
        st.sampled_from(ODD) | st.text(max_size=5),
    ),
)
@settings(max_examples=times(100))
def test_no_file_ends_in_another_error(heads: list[str], keys: dict[str, str]) -> None:
    text = "\n".join([*heads, *(f"{key} = {value}" for key, value in keys.items())])
    try:
        parse_workload(text, "w")
    except BadInput as error:
        line = str(error)
        assert line.isprintable()
        assert re.match(r"w: .+; .+", line)
