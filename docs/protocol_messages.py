"""Rewrites the tables of `docs/protocol/messages.md` from the message structs: `python docs/protocol_messages.py`.

The structs give the fields, types, bounds and defaults, and how many bytes a message may have. The page itself keeps
what no struct has: the meaning of a field, a closer name of its type (`RC` for a text that names one, `float, s`), and
what a default means (`absent: any`). A closer name that contradicts the struct is replaced.
`tests/docs/test_protocol_messages.py` fails while the page is out of date.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec import inspect

from zscout import messages
from zscout.messages.base import LIMITS
from zscout.types import Grant, Place, Term

PAGE: Final = Path(__file__).parent / "protocol" / "messages.md"
HEAD: Final = "| field | type | bounds | default | meaning |\n|---|---|---|---|---|"
KINDS: Final[dict[str, type[messages.Message]]] = {
    name: kind
    for name, kind in vars(messages).items()
    if isinstance(kind, type) and issubclass(kind, messages.Message) and kind is not messages.Message
}
ARRAYS: Final[dict[type, str]] = {Term: "term", Grant: "grant", Place: "place"}
TEXTS: Final = (
    "`<host>/<client>`",
    "RC or pattern",
    *("name", "RC", "host", "id", "instance", "need", "pattern", "group", "date", "path"),
)
"""Closer names of a text."""
FINITE: Final = 1e9
"""Bounds of floats that the table leaves out: the head of the page has them."""


def plain_type(kind: inspect.Type) -> str:
    """A type as the page names it, without its bounds."""
    match kind:
        case inspect.Metadata(type=inner):
            return plain_type(inner)
        case inspect.CustomType(cls=cls):
            return ARRAYS[cls]
        case inspect.StructType(cls=cls):
            return f"[{cls.__name__}](#{cls.__name__.lower()})"
        case inspect.NamedTupleType(cls=cls):
            return ARRAYS[cls]
        case inspect.UnionType(types=types):
            names = [plain_type(kind) for kind in types if not isinstance(kind, inspect.NoneType)]
            return "float" if names == ["int", "float"] else " or ".join(names)
        case inspect.LiteralType(values=values):
            return ", ".join(f'`"{value}"`' for value in values)
        case inspect.ListType(item_type=item) | inspect.VarTupleType(item_type=item):
            return f"list of {plain_type(item)}"
        case inspect.TupleType(item_types=types):
            return f"[{', '.join(map(plain_type, types))}]"
        case inspect.DictType(key_type=key, value_type=value):
            if isinstance(value, inspect.AnyType):
                return "object"
            words = f"object: {plain_type(key)} -> {plain_type(value)}"
            return "amounts" if words == "object: text -> decimal" else words
    return {
        inspect.StrType: "text",
        inspect.BytesType: "base64",
        inspect.IntType: "int",
        inspect.FloatType: "float",
        inspect.DecimalType: "decimal",
        inspect.BoolType: "bool",
        inspect.AnyType: "anything",
    }[type(kind)]


def reduced(closer: str) -> str:
    """A closer name of a type, as `plain_type` names the type."""
    plain = re.sub(r"(?<=float), [^\]]*$|(?<=int), [^\]]*$|(?<=decimal), .*", "", closer).replace("wall time", "float")
    plain = plain.replace("float in s", "float")
    for text in TEXTS:
        plain = re.sub(rf"(?<![\w`#/.]){re.escape(text)}s?(?![\w`])", "text", plain)
    return re.sub(r"\b(list|float|text)s\b", r"\1", plain)


def agree(closer: str, plain: str) -> bool:
    """Return True if a closer name, or another order of the same words, names the type `plain`."""
    words = reduced(closer).removesuffix(" or null")
    return words == plain or (words.startswith("`") and sorted(words.split(", ")) == sorted(plain.split(", ")))


def number(value: float) -> str:
    whole = int(value)
    if whole != value:
        return f"{value:g}"
    if abs(whole) >= 1_000_000 and str(abs(whole)).strip("0") == "1":
        return f"{'-' if whole < 0 else ''}10^{len(str(abs(whole))) - 1}"
    for step, words in ((1, "{}"), (1_000, "1,000 x ({})")):
        part = whole // step
        if whole % step == 0 and part >= 2**40:
            for off, power in ((0, "2^{}"), (1, "2^{} - 1")):
                if (part + off) & (part + off - 1) == 0:
                    return words.format(power.format((part + off).bit_length() - 1))
    return f"{whole:,}"


def between(low: str | None, high: str | None, unit: str = "") -> str:
    if low is not None and high is not None:
        return f"{low} to {high}{unit}"
    return f"at most {high}{unit}" if high is not None else f"at least {low}{unit}" if low is not None else ""


def bounds(kind: inspect.Type) -> str:
    """The bounds of a value, and of each value in it."""
    match kind:
        case inspect.Metadata(type=inner):
            return bounds(inner)
        case inspect.IntType(ge=ge, gt=gt, le=le) | inspect.FloatType(ge=ge, gt=gt, le=le):
            if (ge, gt, le) == (-FINITE, None, FINITE):
                return ""
            if gt is not None:
                return f"above {number(gt)}" + ("" if le is None else f", at most {number(le)}")
            return between(None if ge is None else number(ge), None if le is None else number(le))
        case inspect.StrType(min_length=least, max_length=most) | inspect.BytesType(min_length=least, max_length=most):
            unit = " characters" if isinstance(kind, inspect.StrType) else " bytes"
            return between(number(least) if least else None, None if most is None else number(most), unit)
        case inspect.UnionType(types=types):
            return next(filter(None, map(bounds, types)), "")
        case (
            inspect.ListType(item_type=item, min_length=least, max_length=most)
            | inspect.VarTupleType(item_type=item, min_length=least, max_length=most)
            | inspect.DictType(key_type=item, min_length=least, max_length=most)
        ):
            entries = between(number(least) if least else None, None if most is None else number(most), " entries")
            parts = [entries, each(item)]
            if isinstance(kind, inspect.DictType):
                parts.append(each(kind.value_type))
            return ", ".join(filter(None, parts))
        case inspect.TupleType(item_types=types):
            return ", ".join(filter(None, map(bounds, types)))
    return ""


def each(kind: inspect.Type) -> str:
    found = bounds(kind)
    return f"each {found}" if found else ""


def default(field: inspect.Field) -> str:
    """The default as JSON, `required`, or `absent`."""
    if field.required:
        return "required"
    value = field.default if field.default_factory is msgspec.NODEFAULT else field.default_factory()
    if value is None:
        return "absent"
    text = msgspec.json.encode(value).decode().replace(",", ", ")
    if isinstance(value, float) and value.is_integer():
        return f"{value:.0f}"
    return text if isinstance(value, int | float) and not isinstance(value, bool) else f"`{text}`"


def row(field: inspect.Field, kept: list[str]) -> str:
    """`kept`: type, default and meaning that the page has."""
    closer, comment, meaning = kept
    plain = plain_type(field.type)
    none = isinstance(field.type, inspect.UnionType) and any(
        isinstance(kind, inspect.NoneType) for kind in field.type.types
    )
    name = closer if agree(closer, plain) else plain
    if none and field.required and not name.endswith(" or null"):
        name += " or null"
    start, end = default(field), comment.partition(": ")[2]
    start = f"{start}: {end}" if end else start
    return f"| `{field.encode_name}` | {name} | {bounds(field.type)} | {start} | {meaning} |"


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip()[1:-1].split("|")]


def table(kind: type[messages.Message], old: list[str]) -> str:
    """The table of a message. `old`: the rows that the page has, whose order and words are kept."""
    info: Any = inspect.type_info(kind)
    fields = {field.encode_name: field for field in info.fields}
    kept: dict[str, list[str]] = {}
    for line in old:
        name, closer, _, comment, meaning = cells(line)
        kept[name.strip("`")] = [closer, comment, meaning.strip()]
    rows = []
    if info.tag_field is not None:
        rows.append(f'| `{info.tag_field}` | `"{info.tag}"` |  | required |  |')
    known = [name for name in kept if name in fields]
    rows += [row(fields[name], kept.get(name, ["", "", ""])) for name in [*known, *(fields.keys() - kept.keys())]]
    return "\n".join([HEAD, *rows])


def section(name: str, text: str) -> str:
    """The section of a message, below its heading, with its table and its size as the struct has them."""
    kind = KINDS[name]
    text = re.sub(r"\n\*At most [\d,]+ bytes\.\*\n", "", text)
    found = re.search(r"^\| field \|.*(?:\n\|.*)*", text, re.MULTILINE)
    if found is not None:
        text = text[: found.start()] + table(kind, found[0].splitlines()[2:]) + text[found.end() :]
    elif kind.__struct_fields__:
        text = f"{text.rstrip()}\n\n{table(kind, [])}\n\n"
    limit = LIMITS.get(kind)
    return text if limit is None else f"\n*At most {limit:,} bytes.*\n{text}"


def render(page: str) -> str:
    """The page with the tables of today's structs; a message without a section gets one at the end."""
    start, *parts = re.split(r"^### (\w+)\n", page, flags=re.MULTILINE)
    names, texts = parts[::2], parts[1::2]
    for name in KINDS.keys() - set(names):
        names.append(name)
        texts.append("")
    written = [f"### {name}\n{section(name, text)}" for name, text in zip(names, texts, strict=True) if name in KINDS]
    return start + "".join(written).rstrip("\n") + "\n"


if __name__ == "__main__":
    PAGE.write_text(render(PAGE.read_text()))
