"""Which kinds of components are installed: the entry points of the group `zscout.components`."""

from __future__ import annotations

import importlib
from importlib import metadata
from typing import Any, Final

from zscout.behaviors.components.component import Component
from zscout.keyexpr import BadName, check_name

GROUP: Final = "zscout.components"


class BadKind(Exception):
    """This kind can't be had; one line that says why."""


def installed() -> dict[str, str]:
    """Where each kind is: its name, and `module:class`. Reads the metadata of all packages: some 10 ms.

    A kind that two packages bring, in different places, is none: which one is meant nobody knows."""
    found: dict[str, set[str]] = {}
    for entry in metadata.entry_points(group=GROUP):
        try:
            found.setdefault(check_name(entry.name, "kind"), set()).add(entry.value)
        except BadName:
            continue
    return {name: values.pop() for name, values in sorted(found.items()) if len(values) == 1}


def load(kind: str, where: str) -> type[Component]:
    """The class of a kind at `where`, as `installed` gives it. Raises BadKind, and what its import raises."""
    module_name, _, attributes = where.partition(":")
    found: Any = importlib.import_module(module_name.strip())
    for attribute in attributes.partition("[")[0].strip().split("."):
        found = getattr(found, attribute, None)
    if not (isinstance(found, type) and issubclass(found, Component)):
        raise BadKind(
            f"kind {kind}: {where} is no subclass of zscout.behaviors.components.component.Component; "
            f"mend the entry point in the group {GROUP}"
        )
    return found
