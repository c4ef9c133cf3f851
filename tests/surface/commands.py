"""The commands: what `click` knows of each, and how one is run here."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from decimal import Decimal
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

import click

from tests.surface.tree import PROJECT

WIDTH: Final = 100
"""Columns of the terminal for which help is written."""


@cache
def scripts() -> dict[str, click.Command]:
    """The console scripts of the project by name."""
    found = PROJECT["scripts"].items()
    return {name: EntryPoint(name, value, "console_scripts").load() for name, value in sorted(found)}


def commands() -> dict[str, Any]:
    """Every command by its full name: its usage, and what its options and arguments take. Help is no surface."""
    with plain():
        return dict(found for name, script in scripts().items() for found in _walk(script, name))


def _walk(
    command: click.Command, name: str, parent: click.Context | None = None
) -> Iterator[tuple[str, dict[str, Any]]]:
    context = click.Context(command, parent, name, max_content_width=WIDTH, **_settings(command))
    options = [param for param in command.get_params(context) if isinstance(param, click.Option)]
    arguments = [param for param in command.params if isinstance(param, click.Argument)]
    yield (
        context.command_path,
        {
            "usage": command.get_usage(context),
            "commands": command.list_commands(context) if isinstance(command, click.Group) else [],
            "options": {max(param.opts, key=len): _param(param) for param in options},
            "arguments": {param.make_metavar(context): _param(param) for param in arguments},
        },
    )
    if isinstance(command, click.Group):
        for below in command.list_commands(context):
            child = command.get_command(context, below)
            assert child is not None, f"{context.command_path} lists {below} and has none"
            yield from _walk(child, below, context)


def _settings(command: click.Command) -> dict[str, Any]:
    return {key: value for key, value in command.context_settings.items() if key != "max_content_width"}


def _param(param: click.Parameter) -> dict[str, Any]:
    """What `click` knows of a parameter, but for what only the code sees and what is usual."""
    told = param.to_info_dict()
    kind = told["type"]
    default = told["default"]
    path = kind.get("file_okay") and kind.get("dir_okay")
    shown = {
        "names": sorted([*param.opts, *param.secondary_opts]) if isinstance(param, click.Option) else None,
        "default": str(default) if isinstance(default, (Path, Decimal)) else default,
        "nargs": told["nargs"] if told["nargs"] != 1 else None,
        **{key: told.get(key) for key in ("required", "multiple", "envvar", "is_flag", "count", "hidden")},
        "takes": kind["name"],
        **{key: kind.get(key) for key in ("choices", "min", "max", "min_open", "max_open", "exists")},
        "only": None if path or "exists" not in kind else "files" if kind["file_okay"] else "folders",
    }
    return {key: value for key, value in shown.items() if value is not None and value is not False and value != ""}


def printed(program: str, command: click.Command, args: list[str]) -> dict[str, Any]:
    out, err = io.StringIO(), io.StringIO()
    code: object = None
    with redirect_stdout(out), redirect_stderr(err):
        try:
            command.main(args, prog_name=program)
        except SystemExit as ended:
            code = ended.code or 0
    told = {"exit": code, "out": out.getvalue().splitlines(), "err": err.getvalue().splitlines()}
    return {key: value for key, value in told.items() if value != []}


@contextmanager
def plain(**more: str) -> Iterator[None]:
    """Nothing of this terminal and of this user's environment is seen, but `more`."""
    clean = {key: value for key, value in os.environ.items() if "ZSCOUT" not in key}
    clean |= {"COLUMNS": str(WIDTH), "SHELL": "/bin/sh"}
    with patch.dict(os.environ, clean | more, clear=True):
        yield
