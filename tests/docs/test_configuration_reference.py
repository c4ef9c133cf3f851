"""docs/reference/configuration.md and node-file.md name every key of the fleet and the node file, with its default."""

from __future__ import annotations

import re
import tomllib
from decimal import Decimal
from pathlib import Path

import msgspec
import pytest
from msgspec import inspect

from tests.surface.files import known
from zscout.config import fleet, node

REFERENCE = Path(__file__).parents[2] / "docs" / "reference"
FLEET, NODE = ((REFERENCE / name).read_text() for name in ("configuration.md", "node-file.md"))


def documented(text: str) -> dict[str, str]:
    """`table.key`: the default as it is written."""
    found: dict[str, str] = {}
    for section in re.split(r"^## ", text, flags=re.MULTILINE)[1:]:
        table = section[: section.index("\n")].partition("]")[0].strip("[")
        for row in re.findall(r"^\| (`\w+` \|.*) \|$", section, re.MULTILINE):
            key, default, _unit, _meaning, example = (cell.strip(" `") for cell in row.split("|"))
            assert f"{table}.{key}" not in found, row
            found[f"{table}.{key}"] = default
            tomllib.loads(f"example = {example}")
    return found


@pytest.mark.parametrize(("file", "text"), [(fleet.FleetFile, FLEET), (node.NodeFile, NODE)])
def test_every_key_stands_in_the_reference_with_its_default(file: type, text: str) -> None:
    written, declared = documented(text), known(file)
    assert written.keys() == declared.keys()
    for key, field in declared.items():
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
