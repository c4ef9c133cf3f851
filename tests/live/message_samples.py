"""Messages of the version that this Python finds, as JSON: `write` prints some of each kind, with all fields and with
the fewest; `read` takes such from stdin, and prints what it does not take. It runs under the first version as well."""

from __future__ import annotations

import base64
import json
import sys
from typing import Any, Final

from msgspec import inspect

from zscout import messages

TURNS: Final = 9
"""Samples of each kind: each turn takes other ones of a field's choices, the last as few fields as may be."""


def kinds() -> dict[str, type]:
    return {
        name: kind
        for name, kind in vars(messages).items()
        if isinstance(kind, type) and issubclass(kind, messages.Message) and kind is not messages.Message
    }


def sample(kind: inspect.Type, turn: int) -> Any:
    match kind:
        case inspect.Metadata(type=of):
            return sample(of, turn)
        case inspect.StructType(fields=fields, tag=tag, tag_field=tag_field):
            found = {one.encode_name: sample(one.type, turn) for one in fields if one.required or turn < TURNS - 1}
            return found if tag_field is None else {tag_field: tag, **found}
        case inspect.NamedTupleType(fields=fields):
            return [sample(one.type, turn) for one in fields]
        case inspect.UnionType(types=types):
            return sample(types[turn % len(types)], turn)
        case inspect.LiteralType(values=values):
            return values[turn % len(values)]
        case inspect.ListType(item_type=of, min_length=least) | inspect.VarTupleType(item_type=of, min_length=least):
            return [sample(of, turn)] * max(1, least or 0)
        case inspect.TupleType(item_types=types):
            return [sample(of, turn) for of in types]
        case inspect.DictType(key_type=named, value_type=of):
            return {"1" if isinstance(named, inspect.IntType) else "robot/x": sample(of, turn)}
        case inspect.StrType():
            return "a/b"
        case inspect.BytesType():
            return base64.b64encode(b"state").decode()
        case inspect.IntType() | inspect.FloatType() | inspect.DecimalType():
            return 1
        case inspect.BoolType():
            return True
        case inspect.NoneType():
            return None
        case inspect.AnyType():
            return "x"
    raise TypeError(f"no sample of a {kind}")


def write() -> dict[str, list[str]]:
    """As they are sent: without what is as by default."""
    told: dict[str, list[str]] = {}
    for name, kind in kinds().items():
        texts = (json.dumps(sample(inspect.type_info(kind), turn)) for turn in range(TURNS))
        told[name] = [messages.encode(messages.decode(text.encode(), kind)).decode() for text in texts]
    return told


def read(told: dict[str, list[str]]) -> list[str]:
    """What is not taken, and why; kinds that are not known here are nobody's."""
    known, wrong = kinds(), []
    for name in told.keys() & known.keys():
        for payload in told[name]:
            try:
                messages.decode(payload.encode(), known[name], messages.MAX_STATE)
            except messages.Malformed as error:
                wrong.append(f"{name}: {error}: {payload}")
    return sorted(wrong)


if __name__ == "__main__":
    json.dump(write() if sys.argv[1] == "write" else read(json.load(sys.stdin)), sys.stdout)
