"""The fleet file and the node file as they are declared: each key with its type, bounds and default."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, get_args

import msgspec
from msgspec import inspect

from zscout.config import devices, fleet, node

BUILT_IN: Final = get_args(devices.BuiltInRc)


def plain(kind: inspect.Type) -> inspect.Type:
    return kind.type if isinstance(kind, inspect.Metadata) else kind


def keys(table: Any, path: str = "") -> Iterator[tuple[str, inspect.Field]]:
    """All keys below a table of a file, with what the code knows of them."""
    for field in table.fields:
        whole = inner = plain(field.type)
        if isinstance(inner, inspect.VarTupleType):
            inner = inner.item_type
        if isinstance(whole, inspect.DictType) and not path:  # a table whose keys are names
            if isinstance(whole.value_type, inspect.StructType):
                yield from keys(whole.value_type, f"{field.encode_name}.")
            else:
                yield f"{field.encode_name}.{'host' if field.encode_name == 'devices' else 'name'}", field
            continue
        options = inner.types if isinstance(inner, inspect.UnionType) else (inner,)
        tables = [option for option in options if isinstance(option, inspect.StructType)]
        for struct in tables:
            if struct.tag_field is not None:
                yield f"{path}{field.encode_name}.{struct.tag_field}", field
            yield from keys(struct, f"{path}{field.encode_name}.")
        if not tables:
            yield path + field.encode_name, field


def known(file: type) -> dict[str, inspect.Field]:
    """All keys of a file, and those of each driver that comes with zscout."""
    found = dict(keys(inspect.type_info(file)))
    if rc := found.pop("rc", None):  # what its driver says
        found["rc.driver"] = rc
        for driver in BUILT_IN:
            found |= keys(inspect.type_info(driver), "rc.")
    return found


def files() -> dict[str, Any]:
    found = {
        "fleet file": keys(inspect.type_info(fleet.FleetFile)),
        "node file": keys(inspect.type_info(node.NodeFile)),
        **{f"driver {kind.__struct_config__.tag}": keys(inspect.type_info(kind), "rc.") for kind in BUILT_IN},
    }
    return {name: {key: _field(field) for key, field in some} for name, some in found.items()}


def _field(field: inspect.Field) -> dict[str, Any]:
    default = {} if field.default is msgspec.NODEFAULT else {"default": field.default}
    return _type(field.type) | default | ({"required": True} if field.required else {})


def _type(kind: inspect.Type) -> dict[str, Any]:
    """Without what is said of it."""
    if isinstance(kind, inspect.Metadata):
        bounds = {name: str(value) for name, value in (kind.extra or {}).items() if name in ("low", "high", "unit")}
        return _type(kind.type) | bounds
    shown = {name: value for name, value in msgspec.structs.asdict(kind).items() if value is not None}
    return {"type": type(kind).__name__.removesuffix("Type")} | {name: _value(value) for name, value in shown.items()}


def _value(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_value(one) for one in value]
    return _type(value) if isinstance(value, inspect.Type) else value
