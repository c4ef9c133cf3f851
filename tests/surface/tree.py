"""Where things stand in the tree that is looked at: nothing else here depends on how modules are laid out."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import zscout

PACKAGE: Final = Path(zscout.__file__).parent
PROJECT: Final[dict[str, Any]] = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]


@cache
def sources() -> dict[str, str]:
    """The text of every module of the package by its dotted name."""
    found: dict[str, str] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = path.read_text()
    return found


@cache
def homes(name: str) -> tuple[str, ...]:
    """The modules at whose top level a class or function of this name is defined."""
    defined = re.compile(rf"^(?:class|def|async def) {name}\b", re.MULTILINE)
    return tuple(module for module, text in sources().items() if defined.search(text))


def find(*names: str, within: str = "zscout") -> Any:
    """The first of these classes or functions that there is; a name that was changed is added here."""
    for name in names:
        for module in homes(name):
            if module.startswith(within):
                return getattr(import_module(module), name)
    raise LookupError(f"{within} has none of {', '.join(names)}")
