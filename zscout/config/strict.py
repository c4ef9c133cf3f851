"""Strict reading of files that people write: TOML in; typed structs, or a one-line error, out.

Every error is a `BadInput` of the form `FILE: KEY.PATH: fault; remedy`. Keys are written as in TOML, items of a list
are counted from 0, and an item's name follows in brackets:
`lab.toml: rc[2].driver (robot/scout33): is the text "fast"; write "exclusive" or "capacity"`.

msgspec converts the data, but its errors do not name keys of tables (`$.needs[...]`) or suggest known keys, it accepts
a text for a Decimal, and it makes 1e400 infinite. So the data is checked here first, along the same types."""

from __future__ import annotations

import difflib
import os
import re
import stat
import tomllib
from collections.abc import Iterable, Mapping
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import msgspec
from msgspec import Meta, inspect

from zscout.keyexpr import MAX_NAME, NAME

T = TypeVar("T")

MAX_SECONDS: Final = Decimal(1_000_000_000)
"""Longest duration in a file, about 31 years; whole ns stay within 63 bits."""
_MAX_MAGNITUDE: Final = 18
"""Numbers are below this power of ten, so that exact sums stay fast."""
_MAX_PLACES: Final = 100
_MAX_SHOWN: Final = 60
_MAX_DEPTH: Final = 32

_BARE_KEY: Final = re.compile(rf"[A-Za-z0-9_-]{{1,{_MAX_SHOWN}}}")
_AT: Final = re.compile(r"(.*?) \(at (?:line (\d+), column (\d+)|end of document)\)", re.DOTALL)
_PART: Final = r"""(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')"""
_DEEP_KEY: Final = re.compile(rf"""(?<![\w"'\\-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{_MAX_DEPTH}}}""")
"""A dotted key longer than any valid key. tomllib takes hours over a key that fills the file."""
_NUMBER: Final = r"([0-9]{1,19}(?:\.[0-9]{1,18})?|\.[0-9]{1,18})"
_DURATION: Final = re.compile(
    f"{_NUMBER}|(?:{_NUMBER} ?d ?)?(?:{_NUMBER} ?h ?)?(?:{_NUMBER} ?m(?:in|(?!s)) ?)?(?:{_NUMBER} ?s ?)?"
    f"(?:{_NUMBER} ?ms)?"
)
_UNITS: Final = tuple(map(Decimal, ("1", "86400", "3600", "60", "1", "0.001")))
DURATIONS: Final = "a number of seconds, or with units: 1.5, 300ms, 90s, 5m, 2h, 1d12h"
"""Forms of a duration, for errors."""
_NAME_RULE: Final = f'1 to {MAX_NAME} letters A to Z, digits, "_", "." or "-"'


class BadInput(Exception):
    """Invalid input of a person. One line: place, fault and remedy. The CLI exits with 2."""

    def __init__(self, line: str) -> None:
        super().__init__(_one_line(line))


class Where(NamedTuple):
    """A place in a file. `where / "key"` and `where.item(2, "its name")` are places below it."""

    source: str
    path: tuple[str | int, ...] = ()
    item_name: str = ""

    def __truediv__(self, key: str) -> Where:
        return Where(self.source, (*self.path, key), self.item_name)

    def item(self, number: int, name: object = "") -> Where:
        """An item of a list, counted from 0; its `name` is shown if it is a text."""
        return Where(self.source, (*self.path, number), name if isinstance(name, str) else self.item_name)

    @property
    def key(self) -> str:
        """The path in TOML syntax: `arc[0].needs."robot/scout33".command_rate`."""
        steps = (part if isinstance(part, int) or _BARE_KEY.fullmatch(part) else quoted(part) for part in self.path)
        return "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in steps).removeprefix(".")

    def bad(self, what: str, remedy: str) -> BadInput:
        """The error about this place."""
        key = self.key
        if self.item_name and self.path[-1] != "name":
            key += f" ({_short(self.item_name)})"
        return BadInput(": ".join(filter(None, (self.source, key, f"{what}; {remedy}"))))


def quoted(text: str) -> str:
    """A text for an error: in quotes, on one line, shortened."""
    escaped = _short(text).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{_one_line(escaped)}"'


def read_bytes(path: Path, *, max_bytes: int) -> bytes:
    """The content of a regular file of at most `max_bytes` bytes. Raises BadInput."""
    where = Where(str(path))
    try:
        # O_NONBLOCK: a FIFO without a writer would block forever.
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        with open(fd, "rb") as file:  # noqa: PTH123 - a descriptor
            if not stat.S_ISREG(os.fstat(fd).st_mode):
                raise where.bad("is not a regular file", "name a file on disk")
            data = file.read(max_bytes + 1)
    except FileNotFoundError:
        raise where.bad("there is no such file", "check the path") from None
    except IsADirectoryError:
        raise where.bad("is a directory", "name a file in it") from None
    except PermissionError:
        raise where.bad("may not be read by this user", "change its permissions, or run as another user") from None
    except OSError as error:
        raise where.bad(f"can't be read: {error.strerror}", "check the path") from None
    except ValueError:  # a NUL or a lone surrogate
        raise where.bad("is not a file name", "check the path") from None
    if len(data) > max_bytes:
        raise where.bad(f"has more than {max_bytes:,} bytes", "shorten or split it")
    return data


def read_text(path: Path, *, max_bytes: int) -> str:
    """The text of a regular UTF-8 file of at most `max_bytes` bytes. Raises BadInput."""
    data = read_bytes(path, max_bytes=max_bytes)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise Where(str(path)).bad(f"line {line} is not UTF-8", "save the file as UTF-8") from None


def read_toml(path: Path, type: type[T], *, max_bytes: int = 1_000_000) -> T:  # noqa: A002 - msgspec's word
    """Read a TOML file of at most `max_bytes` bytes into a struct type. Raises BadInput."""
    return parse_toml(read_text(path, max_bytes=max_bytes), str(path), type)


def parse_toml(text: str, source: str, type: type[T]) -> T:  # noqa: A002 - msgspec's word
    """`source` names the file in errors. Raises BadInput, also for unknown keys. Numbers with a point are exact, as
    Decimal. Fields may be Decimal, float, int, str, bool, Literal, lists and tables of these, Any, structs,
    dataclasses."""
    where = Where(source)
    if deep := _DEEP_KEY.search(text):
        line = text.count("\n", 0, deep.start()) + 1
        raise where.bad(f"line {line} has a dotted key of more than {_MAX_DEPTH} parts", "shorten it")
    try:
        data = tomllib.loads(text, parse_float=_decimal)
    except tomllib.TOMLDecodeError as error:
        found = _AT.fullmatch(str(error))
        what = found[1] if found else str(error)
        if found and found[2]:
            place = f"line {found[2]}, column {found[3]}"
        else:
            line = text.count("\n") + 1
            place = f"line {line}, column {len(text) - text.rfind(chr(10))}, the end"
        raise BadInput(f"{source}: {place}: {what}; fix the TOML there or just before") from None
    except RecursionError:
        raise where.bad("is nested too deep", "use fewer levels") from None
    except ValueError:  # Python's limit of digits, which tomllib does not turn into its own error
        raise where.bad("a whole number has thousands of digits", "shorten it") from None
    return convert(data, type, where)


def convert(data: object, type: type[T], where: Where) -> T:  # noqa: A002 - msgspec's word
    """Convert parsed TOML or JSON into a struct or dataclass. Raises BadInput, TypeError for an unsupported type."""
    kind: Any = type
    try:
        return msgspec.convert(_checked(_type_info(kind), data, where), type)
    except msgspec.ValidationError as error:  # a check that only msgspec does, such as bounds not given by `key`
        raise where.bad(str(error), "correct it") from None


@cache
def _type_info(type: Any) -> inspect.Type:  # noqa: A002 - msgspec's word
    # Takes some 10 ms for a type, and a node file converts each of its `[[rc]]` tables.
    return inspect.type_info(type)


def check_name(value: str, where: Where) -> None:
    """Raises BadInput for a name that is not valid in a mesh key (`[A-Za-z0-9_.-]+`, at most 64)."""
    if not NAME.fullmatch(value):
        raise where.bad(f"{quoted(value)} is not a name", f"write {_NAME_RULE}")


def check_folder_name(value: str, where: Where) -> None:
    """`check_name` for a name that is also a folder's: "." and ".." would be the folder itself and its parent."""
    check_name(value, where)
    if not value.strip("."):
        raise where.bad(f"{quoted(value)} can't be a folder's name", "use a letter or a digit")


def check_rc_name(value: str, where: Where, of: str = "") -> None:
    """Raises BadInput unless `value` is `kind/name`, both valid names, and of kind `of` if given."""
    kind, _, name = value.partition("/")
    if not (NAME.fullmatch(kind) and NAME.fullmatch(name)):
        remedy = f'write kind/name, as in "robot/scout33", each of {_NAME_RULE}'
        raise where.bad(f"{quoted(value)} is not the name of a device", remedy)
    if of not in ("", kind):
        raise where.bad(f"{quoted(value)} is not a {of}", f'name one, as in "{of}/..."')


def check_names(values: Iterable[str], where: Where) -> None:
    """`check_name` for a list without duplicates."""
    for number, value in enumerate(values):
        check_name(value, where.item(number))
    check_unique(values, where)


def check_unique(values: Iterable[str], where: Where, key: str = "") -> None:
    """Raises BadInput for duplicates in a list (of texts, or of the key `key` in tables)."""
    first: dict[str, int] = {}
    for number, value in enumerate(values):
        earlier = first.setdefault(value, number)
        if earlier != number:
            here = where.item(number, value) / key if key else where.item(number)
            what = f"{quoted(value)} is already at {where.item(earlier).key}"
            raise here.bad(what, "rename or remove one of the two")


def seconds_to_ns(value: Decimal, where: Where, *, low: Decimal = Decimal(0), high: Decimal = MAX_SECONDS) -> int:
    """Convert seconds to whole nanoseconds, halves to even. Raises BadInput outside `low`..`high` s."""
    if not (value.is_finite() and low <= value <= high):
        raise where.bad(f"is {value} s", f"write {low:f} to {high:f} seconds")
    return round(Fraction(value) * 1_000_000_000)


def key(
    description: str,
    low: float | None = None,
    high: float | None = None,
    *,
    unit: str = "",
    example: object = None,
    most: int | None = None,
    remedy: str = "",
) -> Meta:
    """Description and bounds of a field. `most`: entries at most; `remedy`: in the error if it is missing."""
    extra = {name: text for name, text in (("unit", unit), ("remedy", remedy)) if text}
    bounds: dict[str, Any] = {"ge": low, "le": high, "max_length": most}
    examples = None if example is None else [example]
    return Meta(**bounds, description=description, examples=examples, extra=extra or None)


def secret(wanted: str) -> Meta:
    """Mark a key whose value errors must not show. `wanted`: the expected form, for the remedy."""
    return Meta(extra={"secret": wanted})


def parse_duration(text: str) -> Decimal | None:
    """Seconds from `5`, `1.5`, `90s`, `300ms`, `5m`, `2h`, `1d12h`, or `1 min 30 s` as in messages; else None."""
    found = _DURATION.fullmatch(text)
    if found is None or not any(found.groups()):
        return None
    return sum((Decimal(part) * unit for part, unit in zip(found.groups(), _UNITS, strict=True) if part), Decimal(0))


def seconds(low: str, high: str, description: str) -> Meta:
    """Description and bounds (in s) of a duration, written as for `parse_duration` and converted to whole ns."""
    return Meta(description=description, extra={"unit": "s", "low": Decimal(low), "high": Decimal(high)})


def amounts(values: Mapping[str, Decimal], where: Where) -> dict[str, Fraction]:
    """Exactly, so that 0.1 + 0.2 is 0.3. Raises BadInput for a negative value."""
    for name, value in values.items():
        if value < 0:
            raise (where / name).bad(f"is {value}", "write 0 or more")
    return {name: Fraction(value) for name, value in values.items()}


def _decimal(text: str) -> Decimal:
    try:
        return Decimal(text)
    except InvalidOperation:  # an exponent too large for Decimal; `_check_leaf` refuses infinity
        return Decimal("Infinity")


_LEAVES: Final[Mapping[type[inspect.Type], tuple[tuple[type, ...], str]]] = {
    inspect.IntType: ((int,), "a whole number"),
    inspect.FloatType: ((int, float, Decimal), "a number"),
    inspect.DecimalType: ((int, Decimal), "a number"),
    inspect.StrType: ((str,), "a text in quotes"),
    inspect.BoolType: ((bool,), "true or false"),
}
"""By type of a field: the accepted Python types of parsed TOML or JSON, and their name in errors."""


def _checked(kind: inspect.Type, value: object, where: Where) -> object:
    """Check parsed TOML against a type; return it with durations in ns. Raises BadInput."""
    match kind:
        case inspect.Metadata(extra={"low": low, "high": high}):
            value = _seconds(value, where)
            _check_leaf(inspect.DecimalType(), value, where)
            return seconds_to_ns(Decimal(str(value)), where, low=low, high=high)
        case inspect.Metadata(type=of, extra={"secret": wanted}):
            try:
                return _checked(of, value, where)
            except BadInput:
                raise where.bad("has the wrong form (not shown, it may be a secret)", f"write {wanted}") from None
        case inspect.Metadata(type=inspect.FloatType() as of, extra={"unit": "s"}):
            return _checked(of, _seconds(value, where), where)
        case inspect.Metadata(type=of):
            return _checked(of, value, where)
        case inspect.LiteralType(values=values):
            _check_choice(values, value, where)
        case inspect.UnionType(types=(inspect.BoolType(), inspect.LiteralType(values=values))):
            _check_choice((True, False, *values), value, where)
        case inspect.UnionType(types=(inspect.StructType(), inspect.StructType(), *_) as structs):
            table = _expect(dict, value, where, "a table")
            return _checked_struct(_tagged(structs, table, where), table, where)
        case inspect.UnionType(types=kinds):  # else only X | None: absent in TOML, or X
            kind, *others = (kind for kind in kinds if not isinstance(kind, inspect.NoneType))
            if others:
                raise TypeError(f"{where.key} has several types, which is not supported")
            return _checked(kind, value, where)
        case inspect.StructType() | inspect.DataclassType():
            wanted = "a table" if where.key.endswith("]") else f"a table, under [{where.key}]"
            return _checked_struct(kind, _expect(dict, value, where, wanted), where)
        case inspect.DictType(value_type=of):
            table = _expect(dict, value, where, "a table")
            _check_count(len(table), kind.max_length, where)
            return {key: _checked(of, inner, where / key) for key, inner in table.items()}
        case inspect.AnyType():
            return value
        case inspect.ListType(item_type=of) | inspect.VarTupleType(item_type=of):
            tables = isinstance(of, inspect.StructType | inspect.DataclassType | inspect.UnionType | inspect.DictType)
            items = _expect(list, value, where, f"tables, each under [[{where.key}]]" if tables else "a list")
            _check_count(len(items), kind.max_length, where)
            return [
                _checked(of, inner, where.item(number, inner.get("name") if isinstance(inner, dict) else None))
                for number, inner in enumerate(items)
            ]
        case _:
            _check_leaf(kind, value, where)
    return value


def _seconds(value: object, where: Where) -> object:
    """Parse a duration given as text into seconds; return any other value unchanged."""
    if not isinstance(value, str):
        return value
    found = parse_duration(value)
    if found is None:
        raise where.bad(f"{quoted(value)} is not a duration", f"write {DURATIONS}")
    return found


def _tagged(structs: Iterable[inspect.Type], table: Mapping[str, object], where: Where) -> inspect.StructType:
    known = {str(struct.tag): struct for struct in structs if isinstance(struct, inspect.StructType)}
    tag_field = str(next(iter(known.values())).tag_field)
    if tag_field not in table:
        raise (where / tag_field).bad("is missing", "add it")
    tag = table[tag_field]
    _check_choice(sorted(known), tag, where / tag_field)
    for key in table:
        others = [name for name, struct in known.items() if any(key == field.encode_name for field in struct.fields)]
        if others and tag not in others:
            raise (where / key).bad(
                f"{tag_field} {quoted(str(tag))} does not take it",
                f"remove it, or write {tag_field} = {_either(map(quoted, others))}",
            )
    return known[str(tag)]


def _checked_struct(
    kind: inspect.StructType | inspect.DataclassType, table: Mapping[str, object], where: Where
) -> dict[str, object]:
    fields = {field.encode_name: field for field in kind.fields}
    found: dict[str, object] = {}
    if isinstance(kind, inspect.StructType) and kind.tag_field:
        found[kind.tag_field] = kind.tag
    for key in table:
        if key not in fields and key not in found:
            near = difflib.get_close_matches(key[:MAX_NAME], fields, n=3)
            known = ", ".join(sorted((*fields, *found))) or "none"
            raise (where / key).bad("unknown key", f"did you mean {_either(near)}?" if near else f"known here: {known}")
    for name, field in fields.items():
        if name in table:
            found[name] = _checked(field.type, table[name], where / name)
        elif field.required:
            extra = field.type.extra if isinstance(field.type, inspect.Metadata) else None
            raise (where / name).bad("is missing", (extra or {}).get("remedy", "add it"))
    return found


def _expect(types: type | tuple[type, ...], value: object, where: Where, wanted: str) -> Any:
    # bool is an int in Python, but not to the author of a file.
    if not isinstance(value, types) or (isinstance(value, bool) and types != (bool,)):
        raise where.bad(f"is {_shown(value)}", f"write {wanted}")
    return value


def _check_count(count: int, most: int | None, where: Where) -> None:
    if most is not None and count > most:
        raise where.bad(f"has {count:,} entries", f"at most {most:,} are allowed")


def _check_choice(values: Iterable[object], value: object, where: Where) -> None:
    # 1 == True in Python, but not to the author of a file.
    if not any(value == choice and type(value) is type(choice) for choice in values):
        words = [str(choice).lower() if isinstance(choice, bool) else quoted(str(choice)) for choice in values]
        raise where.bad(f"is {_shown(value)}", f"write {_either(words)}")


def _check_leaf(kind: inspect.Type, value: object, where: Where) -> None:
    """Check type and bounds; refuse NaN, infinities and numbers with too many digits. Raises BadInput."""
    if type(kind) not in _LEAVES:
        raise TypeError(f"{where.key} has an unsupported type: {kind}")
    types, wanted = _LEAVES[type(kind)]
    low, high = getattr(kind, "ge", None), getattr(kind, "le", None)
    if low is not None and high is not None:
        wanted += f" from {low} to {high}"
    _expect(types, value, where, wanted)
    if not isinstance(value, int | float | Decimal) or isinstance(value, bool):
        return
    number = Decimal(value)
    if not number.is_finite():
        raise where.bad("is not a finite number", f"write {wanted}")
    if (low is not None and number < Decimal(str(low))) or (high is not None and number > Decimal(str(high))):
        raise where.bad(f"is {_shown(value)}", f"write {wanted}")
    exponent = number.as_tuple().exponent
    if number.adjusted() >= _MAX_MAGNITUDE:
        raise where.bad("is too large", f"write a number below 1e{_MAX_MAGNITUDE}")
    if isinstance(exponent, int) and exponent < -_MAX_PLACES:
        raise where.bad(f"has more than {_MAX_PLACES} decimal places", "round it")


def _shown(value: object) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            return f"the text {quoted(value)}"
        case None:
            return "null"
        case int() | float() | Decimal():
            return _short(str(value))
        case dict():
            return "a table"
        case list():
            return "a list"
        case _:
            return "a date or a time"


def _either(words: Iterable[str]) -> str:
    *most, last = words
    return f"{', '.join(most)} or {last}" if most else last


def _short(text: str) -> str:
    return text if len(text) <= _MAX_SHOWN else text[:_MAX_SHOWN] + "..."


def _one_line(text: str) -> str:
    """Escape control characters, line ends and stray bytes, so that a hostile file can't draw on the terminal."""
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)
