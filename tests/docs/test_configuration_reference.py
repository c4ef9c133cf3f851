"""docs/reference/configuration.md names every key of the fleet and the node file, with its default."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest
from msgspec import inspect

from zscout.config import devices, fleet, node

REFERENCE = (Path(__file__).parents[2] / "docs" / "reference" / "configuration.md").read_text()
FLEET, NODE = REFERENCE.split("\n## Node file\n")


def documented(text: str) -> dict[str, str]:
    """`table.key`: the default as it is written."""
    found: dict[str, str] = {}
    for section in re.split(r"^### ", text, flags=re.MULTILINE)[1:]:
        table = section[: section.index("\n")].partition("]")[0].strip("[")
        for row in re.findall(r"^\| (`\w+` \|.*) \|$", section, re.MULTILINE):
            key, default, _unit, _meaning, example = (cell.strip(" `") for cell in row.split("|"))
            assert f"{table}.{key}" not in found, row
            found[f"{table}.{key}"] = default
            tomllib.loads(f"example = {example}")
    return found


def _plain(kind: inspect.Type) -> inspect.Type:
    return kind.type if isinstance(kind, inspect.Metadata) else kind


def keys(table: Any, path: str = "") -> Iterator[tuple[str, inspect.Field]]:
    """All keys below a table of a file, with what the code knows of them."""
    for field in table.fields:
        inner = _plain(field.type)
        if isinstance(inner, inspect.VarTupleType):
            inner = inner.item_type
        whole = _plain(field.type)
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


@pytest.mark.parametrize(("file", "text"), [(fleet.FleetFile, FLEET), (node.NodeFile, NODE)])
def test_every_key_stands_in_the_reference_with_its_default(file: type, text: str) -> None:
    written, known = documented(text), dict(keys(inspect.type_info(file)))
    if rc := known.pop("rc", None):  # what its driver says
        for driver in get_args(devices.BuiltInRc):
            known |= {"rc.driver": rc, **dict(keys(inspect.type_info(driver), "rc."))}
    assert written.keys() == known.keys()
    for key, field in known.items():
        if written[key] == "required":
            assert field.required or key == "rc.driver", key
            continue
        if field.default is not msgspec.NODEFAULT and field.default is not None:
            default = tomllib.loads(f"value = {written[key]}", parse_float=Decimal)["value"]
            default = tuple(default) if isinstance(default, list) else default
            known_default = field.default
            if isinstance(field.type, inspect.Metadata) and "low" in (field.type.extra or {}):
                known_default = Decimal(known_default) / 1_000_000_000  # a duration: held in ns
            assert default == (Decimal(repr(known_default)) if isinstance(known_default, float) else known_default), key
