"""Hostile text, from every text field of every message to the last sink: nothing draws, forges a line, or is lost."""

from __future__ import annotations

import io
import json
import logging
import re
import sys
from collections.abc import Callable, Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec import inspect
from prometheus_client.parser import text_string_to_metric_families

import zscout
from zscout.logs import LineFormatter
from zscout.messages.base import Message
from zscout.services.metrics.exposition import Exposition
from zscout.services.metrics.figures import FAMILIES
from zscout.services.recorder.drawing import clean_path, clean_text
from zscout.terminal import Table, print_json, print_line

HOSTILE = "\x1b[2J\nERROR forged\r\0\x9b31m\u202egnp\u2028\u200f\U000e0041\ud7ff\x7f\t\"'</script>{}%s\\"
"""ESC, newline, NUL, C1, bidi, a line separator, a tag, DEL."""
FIGURE = next(name for name, family in FAMILIES.items() if family.kind == "gauge" and len(family.labels) == 1)


def kinds(base: type[Message] = Message) -> Iterator[type[Message]]:
    for kind in base.__subclasses__():
        if kind.__module__.startswith("zscout.messages"):
            if not kind.__name__.startswith("_"):
                yield kind
            yield from kinds(kind)


KINDS: list[type[Message]] = sorted({*kinds()}, key=lambda kind: kind.__name__)


def filled(kind: inspect.Type) -> Any:
    """A value of a type, hostile wherever it holds text."""
    match kind:
        case inspect.StrType():
            return HOSTILE[: kind.max_length] if kind.pattern is None else None
        case inspect.AnyType():
            return {HOSTILE: HOSTILE}
        case inspect.StructType():
            given = {field.name: filled(field.type) for field in kind.fields}
            return kind.cls(**{name: value for name, value in given.items() if value is not None})
        case inspect.ListType() | inspect.VarTupleType() | inspect.SetType() | inspect.FrozenSetType():
            return [filled(kind.item_type)]
        case inspect.TupleType():
            return [filled(one) for one in kind.item_types]
        case inspect.NamedTupleType():
            return kind.cls(*(filled(field.type) for field in kind.fields))
        case inspect.DictType():
            return {filled(kind.key_type): filled(kind.value_type)}
        case inspect.UnionType():
            found = sorted(kind.types, key=lambda one: isinstance(one, inspect.NoneType))
            return filled(found[0])
        case inspect.LiteralType():
            return kind.values[0]
        case inspect.DecimalType():
            return Decimal(1)
        case inspect.IntType() | inspect.FloatType():
            return max(kind.ge or 0, 1)
        case inspect.BoolType():
            return True
        case inspect.BytesType():
            return b"x"
    return None


def texts(value: Any) -> Iterator[str]:
    match value:
        case str():
            yield value
        case dict():
            for name, one in value.items():
                yield from texts(name)
                yield from texts(one)
        case list() | tuple():
            for one in value:
                yield from texts(one)


def logged(text: str) -> str:
    try:
        raise ValueError(text)
    except ValueError:
        fault: Any = sys.exc_info()
    record = logging.LogRecord("zscout", logging.WARNING, "", 0, "robot/a did not vote: %s", (text,), fault)
    first, *others = LineFormatter("%(levelname)s %(message)s").format(record).split("\n")
    assert all(line.startswith("  ") for line in others)
    return first + "".join(others)


def printed(text: str) -> str:
    stream = io.StringIO()
    print_line(text, stream)
    return stream.getvalue().removesuffix("\n")


def tabled(text: str) -> str:
    table = Table("", ("A",), [(text,)])
    return "".join([*table.lines(), *(line for line, _ in table.fitted(40))])


def figured(text: str) -> str:
    page = Exposition().render({FIGURE: {(text,): 1.0, (text + "\x1b",): 1.0}}).decode()
    (family,) = [one for one in text_string_to_metric_families(page) if one.name == FIGURE]
    labels = [tuple(sample.labels.items()) for sample in family.samples]
    assert len(labels) == len({*labels})
    return page.replace("\n", "")


SINKS: dict[str, Callable[[str], str]] = {
    "log": logged,
    "terminal": printed,
    "table": tabled,
    "figures": figured,
    "timeline": clean_text,
    "entity": lambda text: clean_path("devices", text),
}


@pytest.mark.parametrize("sink", SINKS)
def test_text_of_every_field_of_every_message_draws_nothing(sink: str) -> None:
    assert len(KINDS) > 80
    seen = {text for kind in KINDS for text in texts(msgspec.to_builtins(filled(inspect.type_info(kind))))}
    hostile = {text for text in seen if not text.isprintable()}
    assert HOSTILE in hostile
    for text in hostile:
        assert SINKS[sink](text).isprintable(), repr(text)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_as_json_every_message_is_one_plain_line_with_all_of_its_text(kind: type[Message]) -> None:
    message, stream = filled(inspect.type_info(kind)), io.StringIO()
    print_json(message, stream)
    line = stream.getvalue().removesuffix("\n")
    assert line.isprintable()
    encoded = msgspec.json.Encoder(decimal_format="number").encode(message)
    assert json.loads(line) == json.loads(encoded)


def test_what_writes_past_the_edge_is_known() -> None:
    """Everything else is printed by `print_line` and `print_json`, or cleaned where it is written."""
    root = Path(zscout.__file__).parent
    found = set()
    writes = r"\b(?:click\.s?echo|(?<![.\w])(?<!def )print|std(?:out|err)\.write|logging\.basicConfig)"
    written = re.compile(writes + r"\((?!.*clean\()")
    for path in root.rglob("*.py"):
        if any(written.search(line) for line in path.read_text().splitlines()):
            found.add(str(path.relative_to(root)))
    assert found == {
        "behaviors/components/sensor_net.py",  # a component's output
        "behaviors/components/shipped.py",
        "behaviors/launch.py",  # the user's own command
        "cli/booked.py",  # figures alone
        "cli/completion.py",
        "cli/components/logs.py",  # a component's output, cleaned at a terminal
        "cli/fleet/usage.py",
        "cli/groups.py",
        "cli/main.py",
        "logs.py",  # the formatter
        "node.py",  # the user's own files
        "services/recorder/__main__.py",
        "simulation/demo/arc.py",
        "simulation/plots/replay_report.py",  # the user's own file
    }
