"""Hostile messages: a plausible one of any struct, spoilt in a few places; JSON of another shape; and bytes.

All of it comes from a `random.Random`, so that what failed once fails again."""

from __future__ import annotations

import base64
import json
import random
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cache
from typing import Any, Final

import zenoh
from msgspec import inspect

from tests.fuzz.key_table import Row
from zscout import messages
from zscout.keyexpr import Role
from zscout.messages import Malformed

LONG: Final = (300, 100_000)
"""Entries of a list or table that is much too long."""
DEEP: Final = 20_000
LARGE: Final = 300_000
"""Bytes."""

TEXTS: Final = (
    *("", " ", "x" * 64, "x" * 65, "x" * 131, "x" * 5_000, "*", "**", "$*", "*/*", "robot/*", "robot/$*", "robot/a#2"),
    *("a/b/c", "/", "//", "..", "../../etc/passwd", "\0", "robot/a\0", "x\ny", "\x1b[2J", "\u202ex", "\U0001f916", "é"),
    *("\ud800", "\udfff\ud800", "NaN", "sNaN", "-Infinity", "1e999999", "1E-999999", "0.1", "-1", "null", "true"),
    *("%s%n", "{0}", "__class__", "zscout/test/rcm/grants", "@/router", "?", "#"),
)
NUMBERS: Final = (
    *("0", "-0", "-1", "0.5", "1e-320", "1e308", "-1e308", "1e309", "1e999999", "-1e999999", "1E-999999"),
    *("1e99999999999999999999", "2147483648", "4503599627370494", "4503599627370495", "4503599627370496"),
    *("9007199254740993", "1000000000000", "1000000001", "-1000000001", "9223372036854775807", "9223372036854775808"),
    *("18446744073709551616", "-9223372036854775809", "1" + "0" * 30, "9" * 400, "9" * 5_000, "0." + "1" * 60),
    *('"NaN"', '"sNaN"', '"Infinity"', '"-Infinity"', '"1e999999"', '"1E-999999"', "NaN", "Infinity"),
)
"""As they are written."""

ODD: Final = ("*", "$*", "r$*", "the boss", "é", "x" * 65, "x" * 3_000, "..", "-", "a:b", "\0", "\n", "@x")
"""Of a key: what stands there in place of a name, where Zenoh lets it."""


class Raw(str):
    """Stands in the JSON as it is."""

    __slots__ = ()


class Table(list[tuple[str, Any]]):
    """An object of JSON, in which a name may stand twice."""


def write(value: Any) -> str:
    match value:
        case Raw():
            return str(value)
        case Table():
            return "{" + ",".join(f"{json.dumps(name)}:{write(one)}" for name, one in value) + "}"
        case list():
            return "[" + ",".join(map(write, value)) + "]"
        case _:
            return json.dumps(value)


def many(value: Any, number: int, *, named: bool = False) -> Raw:
    """A list of `number` times this value, or a table with it under as many names; fewer, where it is LARGE."""
    one = write(value)
    number = max(2, min(number, LARGE // len(one)))
    if named:
        return Raw("{" + ",".join(f'"robot/x{number}":{one}' for number in range(number)) + "}")
    return Raw("[" + ",".join([one] * number) + "]")


def is_key(key: str) -> bool:
    """Whether the network takes it."""
    with suppress(zenoh.ZError):
        zenoh.KeyExpr(key)
        return True
    return False


def is_one(payload: bytes, kind: type, limit: int) -> bool:
    """Whether a payload is taken for such a message."""
    with suppress(Malformed):
        messages.decode(payload, kind, limit)
        return True
    return False


@dataclass(slots=True)
class Names:
    """What those who are to be fooled may take for their own. `terms`: [counter, rcm]; `by_field`: texts, by the field
    in which they stand."""

    terms: Sequence[tuple[int, str]] = ((1, "x"),)
    by_field: Mapping[str, Sequence[str]] = field(default_factory=dict)


_type_info: Callable[[Any], inspect.Type] = cache(inspect.type_info)


@dataclass(slots=True)
class Hostile:
    rng: random.Random
    names: Names

    def payload(self, kinds: Sequence[type], faults: int = 1) -> bytes:
        """One of these structs with so many `faults`, or what is none of them."""
        rng = self.rng
        match rng.randrange(10) if kinds and faults else 0:
            case 9:
                return rng.randbytes(rng.choice((0, 1, 7, 100, 3_000)))
            case 8:
                return self._encoded(self._any(3))
            case 7:
                whole = self._message(kinds, 0)
                return whole[: rng.randrange(len(whole))]
            case 6:
                spoilt = bytearray(self._message(kinds, 0))
                for _ in range(faults):
                    spoilt[rng.randrange(len(spoilt))] ^= 1 << rng.randrange(8)
                return bytes(spoilt)
            case _:
                return self._message(kinds, faults) if kinds else rng.randbytes(rng.choice((0, 9, 500)))

    def key(self, row: Row, faults: int) -> str:
        """One of a row's keys, below `zscout/<fleet>/`; with `faults` maybe one where no name stands."""
        rng, known = self.rng, self.names.by_field
        kind, _, name = rng.choice(known["rc"]).partition("/")
        host, _, client = rng.choice(known["client"]).partition("/")
        role = rng.choice([value for word, value in vars(Role).items() if word.isupper()])
        words = {"kind": kind, "name": name, "client": client, "role": role, "instance": rng.choice(("f", "1-f", "g"))}
        words["host"] = host if "client" in row.words else rng.choice(known["host"])
        if "role" in row.words:
            words["name"] = f"{kind}/{name}" if role == Role.RC else rng.choice(("node", client, "w1"))
        if faults and row.words and rng.randrange(4) == 0:
            words[rng.choice(row.words)] = rng.choice(ODD)
        key = row.filled(**words)
        return key if is_key(key) else row.filled(**words | dict.fromkeys(row.words, "x"))

    def _message(self, kinds: Sequence[type], faults: int) -> bytes:
        tree = [self._plausible(_type_info(self.rng.choice(kinds)), "")]
        for _ in range(faults):
            self._spoil(tree)
        return self._encoded(tree[0])

    @staticmethod
    def _encoded(tree: Any) -> bytes:
        return write(tree).encode(errors="surrogatepass")

    # What would be taken

    def _plausible(self, kind: inspect.Type, name: str) -> Any:
        rng = self.rng
        match kind:
            case inspect.Metadata(type=of):
                return self._plausible(of, name)
            case inspect.StructType(fields=fields, tag=tag, tag_field=tag_field):
                found = Table([] if tag_field is None else [(tag_field, tag)])
                for one in fields:
                    if one.required or rng.random() < 0.5:
                        found.append((one.encode_name, self._plausible(one.type, one.encode_name)))
                return found
            case inspect.NamedTupleType(cls=cls, fields=fields):
                if cls.__name__ == "Term":
                    return list(rng.choice(self.names.terms))
                return [self._plausible(one.type, one.encode_name) for one in fields]
            case inspect.UnionType(types=types):
                return self._plausible(rng.choice(types), name)
            case inspect.ListType(item_type=of) | inspect.VarTupleType(item_type=of):
                return [self._plausible(of, name) for _ in range(rng.randrange(3))]
            case inspect.TupleType(item_types=types):
                return [self._plausible(of, name) for of in types]
            case inspect.DictType(value_type=of):
                return Table((self._text(name), self._plausible(of, name)) for _ in range(rng.randrange(1, 3)))
            case inspect.LiteralType(values=values):
                return rng.choice(values)
            case inspect.StrType():
                return self._text(name)
            case inspect.BytesType():
                return base64.b64encode(rng.randbytes(20)).decode()
            case inspect.IntType():
                return rng.randrange(1, 12)
            case inspect.FloatType() | inspect.DecimalType():
                return Raw(rng.choice((Decimal("0.5"), 1, 2, 30)))
            case inspect.BoolType():
                return rng.random() < 0.5
            case inspect.NoneType():
                return None
            case inspect.AnyType():
                return rng.choice(("x", 1, None, [], Table([("x", 1)])))
        raise TypeError(f"{name} is a {kind}, which no message has had so far: say here what it may be")

    def _text(self, name: str) -> str:
        return self.rng.choice(self.names.by_field.get(name, ("x", "ok", "w1")))

    # What should not be

    def _spoil(self, tree: list[Any]) -> None:
        """Spoils one place of a tree, whose root is its only item."""
        rng = self.rng
        places: list[tuple[list[Any], int]] = []
        left: list[list[Any]] = [tree]
        while left:
            inside = left.pop()
            for number, one in enumerate(inside):
                places.append((inside, number))
                value = one[1] if isinstance(inside, Table) else one
                if isinstance(value, list):
                    left.append(value)
        inside, number = rng.choice(places)
        if not isinstance(inside, Table):
            inside[number] = self._spoilt(inside[number])
            return
        name, value = inside[number]
        match rng.randrange(12):
            case 0:
                del inside[number]
            case 1:
                inside.append((name, self._spoilt(value)))
            case 2:
                inside.append((rng.choice(TEXTS), self._any(1)))
            case 3:
                inside[number] = rng.choice(TEXTS), value
            case _:
                inside[number] = name, self._spoilt(value)

    def _spoilt(self, value: Any) -> Any:
        rng = self.rng
        if rng.randrange(8) == 0:
            return self._any(2)
        match value:
            case Table():
                some = value[0][1] if value else None
                return rng.choice(
                    (
                        Table(),
                        many(some, rng.choice(LONG), named=True),
                        Table((text, some) for text in TEXTS),
                        self._deep(),
                    )
                )
            case list():
                return rng.choice(
                    ([], value[:1], value * 2, many(value[0] if value else None, rng.choice(LONG)), self._deep())
                )
            case bool():
                return not value
            case str() if not isinstance(value, Raw):
                return rng.choice(TEXTS)
            case _:
                return Raw(rng.choice(NUMBERS))

    def _deep(self) -> Raw:
        one, other = self.rng.choice((("[", "]"), ('{"x":', "}")))
        return Raw(one * DEEP + ("0" if one != "[" else "") + other * DEEP)

    def _any(self, depth: int) -> Any:
        rng = self.rng
        match rng.randrange(8 if depth else 5):
            case 0:
                return rng.choice(TEXTS)
            case 1 | 2:
                return Raw(rng.choice(NUMBERS))
            case 3:
                return rng.choice((None, True, False))
            case 4:
                return self._deep()
            case 5 | 6:
                return [self._any(depth - 1) for _ in range(rng.randrange(4))]
            case _:
                return Table((rng.choice(TEXTS), self._any(depth - 1)) for _ in range(rng.randrange(4)))
