"""What programs import and exchange with zscout: the Python interface, messages, keys, exit codes."""

from __future__ import annotations

import ast
import inspect
import re
import sys
import textwrap
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import EntryPoint
from pkgutil import walk_packages
from typing import Any, Final

import click
import msgspec

import zscout
from tests.surface.tree import PROJECT, find, homes, sources
from zscout import keyexpr, messages

ENTERED: Final = ("__aenter__", "__aexit__", "__aiter__", "__await__", "__enter__", "__exit__", "__iter__")
MADE: Final = ("zscout.Component", "zscout.Lab")
"""Classes that people make themselves; all others they are given."""


# The Python interface


def python() -> dict[str, Any]:
    """Every name in `zscout.__all__`, and the attributes of what some of them give."""
    named = {f"zscout.{name}": getattr(zscout, name) for name in sorted(zscout.__all__)}
    given = {"what Client.request gives": _given(zscout.Client.request), "what hold gives": _given(zscout.hold)}
    module = "zscout.components.component"
    # The address that docs/components.md names.
    authors = {name: getattr(import_module(module), name) for name in ("Component", "Stage")}
    return (
        {name: _described(name, thing) for name, thing in named.items()}
        | {name: {"attributes": _class(kind)["attributes"]} for name, kind in given.items()}
        | {"what Lab.hold gives": _class(_given(zscout.Lab.hold))}
        | {f"{module}.{name}": value is getattr(zscout, name) for name, value in authors.items()}
    )


def _described(name: str, thing: Any) -> Any:
    if isinstance(thing, type):
        return _class(thing) | ({"made by": _signature(thing)} if name in MADE else {})
    return _signature(thing) if callable(thing) else type(thing).__name__


def _class(kind: type) -> dict[str, Any]:
    ours = [one for one in reversed(kind.__mro__) if one.__module__.startswith("zscout.")]
    members = {name: value for one in ours for name, value in vars(one).items()}
    shown = {name: value for name, value in members.items() if not name.startswith("_") or name in ENTERED}
    methods = {
        name: _signature(getattr(kind, name))
        for name, value in shown.items()
        if callable(value) or isinstance(value, (classmethod, staticmethod))
    }
    fields = {name for one in ours for name in _fields(one)}
    return {
        "is an Exception": issubclass(kind, Exception),
        "methods": dict(sorted(methods.items())),
        "attributes": sorted(fields | shown.keys() - methods.keys()),
    }


def _fields(kind: type) -> set[str]:
    """Attributes that a class declares, or that its `__init__` sets."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind))).body[0]
    assert isinstance(tree, ast.ClassDef)
    declared = {
        node.target.id for node in tree.body if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)
    }
    init = next((node for node in tree.body if getattr(node, "name", "") == "__init__"), None)
    for node in ast.walk(init) if init is not None else ():
        match node:
            case ast.Attribute(value=ast.Name(id="self"), attr=name, ctx=ast.Store()):
                declared.add(name)
    return {name for name in declared if not name.startswith("_")}


def _signature(called: Any) -> dict[str, Any]:
    signature = inspect.signature(called)
    shown: dict[str, str] = {}
    for name, param in signature.parameters.items():
        if name == "self":
            continue
        words: dict[Any, str] = {param.KEYWORD_ONLY: "by name: ", param.VAR_POSITIONAL: "*", param.VAR_KEYWORD: "**"}
        text = words.get(param.kind, "") + str(param.annotation)
        shown[name] = text if param.default is param.empty else f"{text} = {param.default!r}"
    awaited = "awaited: " if inspect.iscoroutinefunction(called) else ""
    return {"takes": shown, "gives": f"{awaited}{signature.return_annotation}"}


def _given(called: Callable[..., Any]) -> type:
    """The class of zscout in what a function says that it gives: `Iterator[BlockingHeld]` is that."""
    words = re.findall(r"\w+", str(inspect.signature(called).return_annotation))
    name = next(word for word in words if homes(word))
    module = sys.modules[called.__module__]
    found = getattr(module, name, None) or find(name)
    assert isinstance(found, type)
    return found


# Messages


def wire() -> dict[str, Any]:
    """Every message by its schema: the fields as JSON Schema, and which are required."""
    for module in walk_packages(messages.__path__, "zscout.messages."):
        import_module(module.name)
    kinds = {kind.__name__: kind for kind in _subclasses(messages.Message)}
    # msgspec gives two types of one name other names.
    _, shapes = msgspec.json.schema_components(kinds.values(), ref_template="#{name}")
    return {
        messages.schema(kinds[name]): {
            "required": sorted(shapes[name].get("required", [])),
            "fields": {field: _shape(told, shapes, kinds) for field, told in _sorted(shapes[name]["properties"])},
        }
        for name in sorted(kinds)
    }


def _subclasses(kind: type) -> set[type]:
    children: list[type] = kind.__subclasses__()
    below = {one for child in children for one in (child, *_subclasses(child))}
    return {one for one in below if one.__module__.startswith("zscout.messages") and not one.__name__.startswith("_")}


def _shape(told: Any, shapes: dict[str, Any], kinds: dict[str, type]) -> Any:
    """Without texts about it; what is not a message itself stands where it is used."""
    if isinstance(told, list):
        return [_shape(one, shapes, kinds) for one in told]
    if not isinstance(told, dict):
        return told
    name = told.get("$ref", "").removeprefix("#")
    if name in kinds:
        return {**told, "$ref": f"zscout.{name}.v1"}
    if name:
        return _shape({**shapes[name], **{key: value for key, value in told.items() if key != "$ref"}}, shapes, kinds)
    unseen = ("title", "description")
    return {key: _shape(value, shapes, kinds) for key, value in told.items() if key not in unseen}


def _sorted(table: dict[str, Any]) -> list[tuple[str, Any]]:
    return sorted(table.items())


# Keys


def keys(*, closed: bool = False) -> list[str]:
    """Every key and key expression of a fleet, and a token of each role."""
    made = keyexpr.Keys("FLEET", closed=closed)
    roles = sorted(value for name, value in vars(keyexpr.Role).items() if name.isupper())
    samples: dict[str, Any] = {
        "Sender": keyexpr.Sender("HOST", "CLIENT"),
        "rc": "KIND/NAME",
        "host": "HOST",
        "role": "*",
    }
    tokens = [keyexpr.Token("HOST", role, "KIND/NAME" if role == "rc" else "NAME", "INSTANCE") for role in roles]
    found = {made.alive(token) for token in tokens} | {made.alive_any(role) for role in roles}
    for name, value in vars(keyexpr.Keys).items():
        if hasattr(value, "__get__") and not callable(value) and name not in ("fleet", "closed"):
            found.add(getattr(made, name))
        elif (
            callable(value)
            and not name.startswith("_")
            and name not in ("alive", "fleet", "closed")
            and not name.endswith("_of")
        ):
            params = list(inspect.signature(value).parameters.values())[1:]
            given = [samples.get(str(param.annotation), samples.get(param.name)) for param in params]
            made_of_it = getattr(made, name)(*given)
            found |= {made_of_it} if isinstance(made_of_it, str) else {*made_of_it}
    return sorted(found)


# The rest


def components() -> dict[str, Any]:
    """The entry points of the group `zscout.components`: what components come with zscout."""
    found = PROJECT["entry-points"]["zscout.components"].items()
    loaded = {name: EntryPoint(name, value, "zscout.components").load() for name, value in sorted(found)}
    return {name: {"a Component": issubclass(kind, zscout.Component)} for name, kind in loaded.items()}


def exit_codes() -> dict[str, int]:
    """What `zscout` exits with when a command ends in one of these errors."""
    problem = messages.Problem("code", "words")
    raised = {
        "it could not be done": find("Failed", within="zscout.cli")("words"),
        "no RCM": find("NobodyThere", within="zscout.cli")("words"),
        "a signal, 15": find("Interrupted", within="zscout.cli")(15),
        "Ctrl-C": KeyboardInterrupt(),
        "a prompt is left": click.Abort(),
        "wrong words": click.UsageError("words"),
        "bad input": find("BadInput")("words"),
        "a bad name": keyexpr.BadName("words"),
        "a request is refused": zscout.RequestRefused(problem),
        "a command is refused": zscout.CommandRefused("robot/a", problem),
        "the mesh fails": find("MeshError")("words"),
    }
    explain = find("explain", within="zscout.cli")
    return {name: explain(error)[0] for name, error in raised.items()}


def variables() -> list[str]:
    """Environment variables that the code names."""
    return sorted({word for text in sources().values() for word in re.findall(r"\b_?ZSCOUT_[A-Z_]*[A-Z]\b", text)})
