"""What is written behind `zscout start` and its like: read strictly, before anybody is asked."""

from __future__ import annotations

import pytest

from zscout.cli.components.logs import last
from zscout.cli.components.placing import state_words, tail_of, unknown
from zscout.cli.components.start import gather_params, parse_size
from zscout.config.strict import BadInput
from zscout.messages import ComponentSpec, Placement


@pytest.mark.parametrize(
    ("text", "size"),
    [("1", 1), ("500M", 500 << 20), ("1.5G", 3 << 29), ("2k", 2048), ("1GiB", 1 << 30), ("1TB", 1 << 40)],
)
def test_sizes(text: str, size: int) -> None:
    assert parse_size(text, "--memory") == size


@pytest.mark.parametrize("text", ["", "0", "M", "-1", "1e3", "5P", "1 M", "0.0001", "9" * 30, "2000000T", "٣"])
def test_what_is_no_size_is_refused(text: str) -> None:
    with pytest.raises(BadInput, match=r"--memory: .* is not a size; write bytes, or with a unit"):
        parse_size(text, "--memory")


def test_parameters_are_json_or_else_text() -> None:
    settings = ["a=1", "b=0.5", "c=true", "d=robot/a", 'e="1"', "f=[1, 2]", "g=", "h=x=y", "i=NaN"]
    assert gather_params('{"a": 7, "z": null}', settings) == {
        "a": 1, "b": 0.5, "c": True, "d": "robot/a", "e": "1", "f": [1, 2], "g": "", "h": "x=y", "i": "NaN", "z": None,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("given", "settings", "words"),
    [
        ("[1]", [], "is not a JSON object"),
        ("{", [], "is not a JSON object"),
        ('{"a": 1e999}', [], "is not a JSON object"),
        ("{'a': 1}", [], "is not a JSON object"),
        ("[" * 100_000, [], "is not a JSON object"),
        (None, ["a"], '--set: "a" has no value; write KEY=VALUE'),
        (None, ["=1"], '--set: "=1" has no value'),
        (None, ["a=1", "a=2"], '"a" is given twice'),
        (None, ["a=" + "x" * 17_000], "at most 16384 are allowed"),
    ],
)
def test_bad_parameters(given: str | None, settings: list[str], words: str) -> None:
    with pytest.raises(BadInput) as error:
        gather_params(given, settings)
    assert words in str(error.value)


def test_how_a_component_stands_in_words() -> None:
    spec = ComponentSpec("counter")

    def words(state: str, **more: object) -> str:
        return state_words(Placement("c", spec, state, **more))  # type: ignore[arg-type]

    assert words("running", host="anvil", reason="best of 3") == "runs on anvil"
    assert words("waiting", reason="no host has gpu") == "waits for a host: no host has gpu"
    assert words("moving", host="anvil", to="bellows") == "is moving from anvil to bellows"
    assert words("backing_off", reason="exit code 3") == "failed, and will be restarted: exit code 3"
    assert words("ended") == "has ended"
    assert words("given_up", reason="exit code 3") == "is given up: exit code 3"


def test_what_a_component_wrote_can_not_draw() -> None:
    assert tail_of(Placement("c", ComponentSpec("k"), "given_up", tail="a\tb\n\x1b[31mred\n")) == [
        "a       b",
        " [31mred",
    ]


def test_the_last_lines() -> None:
    assert last("a\nb\nc", None) == "a\nb\nc"
    assert last("a\nb\nc\n", 2) == "b\nc\n"
    assert last("a\nb", 1) == "b"
    assert last("a\n", 0) == ""
    assert last("", 5) == ""


def test_an_unknown_name_is_told_what_there_is() -> None:
    assert str(unknown("cuonter", ["spin", "counter"])).endswith("did you mean counter?")
    assert str(unknown("x", [])).endswith("and there are none; see zscout component start")
    many = str(unknown("zzz", [f"a{number}" for number in range(10)]))
    assert many.endswith("known: a0, a1, a2, a3, a4, a5, a6, a7 and 2 more")
