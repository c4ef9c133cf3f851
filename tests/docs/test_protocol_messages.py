"""The generated page of the protocol's messages is up to date, and its generator believes structs more than pages."""

from __future__ import annotations

import importlib.util
import re

import pytest

from tests.protocol_pages import DOCS

SPEC = importlib.util.spec_from_file_location("protocol_messages", DOCS / "protocol_messages.py")
assert SPEC is not None
assert SPEC.loader is not None
protocol_messages = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(protocol_messages)
PAGE = protocol_messages.PAGE.read_text()


def rows(page: str, message: str) -> list[str]:
    section = re.search(rf"^### {message}\n.*?(?=^##|\Z)", page, re.DOTALL | re.MULTILINE)
    assert section is not None
    return re.findall(r"^\| `.*", section[0], re.MULTILINE)


def test_the_page_has_the_tables_of_the_structs() -> None:
    assert protocol_messages.render(PAGE) == PAGE, "run python docs/protocol_messages.py, and describe new fields"


@pytest.mark.parametrize("message", ["RcState", "Ballot"])
def test_a_message_or_field_that_the_page_lacks_is_added(message: str) -> None:
    *kept, last = rows(PAGE, message)
    page = protocol_messages.render(PAGE.replace(last, "", 1))
    assert len(rows(page, message)) == len(kept) + 1
    without = re.sub(rf"^### {message}\n.*?(?=^##|\Z)", "", PAGE, flags=re.DOTALL | re.MULTILINE)
    assert len(rows(protocol_messages.render(without), message)) == len(kept) + 1


@pytest.mark.parametrize(
    ("right", "wrong", "written"),
    [
        (
            "list of RCs | at most 64 entries |",
            "list of ints | at most 9 entries |",
            "list of text | at most 64 entries |",
        ),
        ("| `ttl` | float, s |  | 1 |", "| `ttl` | text | 1 to 2 | 5 |", "| `ttl` | float |  | 1 |"),
        ('`"queued"`, `"running"`, `"ended"` |', '`"queued"`, `"over"` |', '`"ended"`, `"queued"`, `"running"` |'),
    ],
)
def test_a_cell_that_contradicts_the_struct_is_replaced(right: str, wrong: str, written: str) -> None:
    assert right in PAGE
    assert protocol_messages.render(PAGE.replace(right, wrong, 1)) == PAGE.replace(right, written, 1)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (1e9, "10^9"),
        (0.001, "0.001"),
        (65_536, "65,536"),
        (2**52 - 1, "2^52 - 1"),
        (1 << 60, "2^60"),
        ((2**52 - 1) * 1000, "1,000 x (2^52 - 1)"),
    ],
)
def test_a_bound_is_written_as_people_read_it(value: float, words: str) -> None:
    assert protocol_messages.number(value) == words
