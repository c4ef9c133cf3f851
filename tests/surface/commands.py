"""The commands: what `click` knows of each, and what they print where no mesh is needed."""

from __future__ import annotations

import io
import json
import os
import tempfile
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


# What is printed

BAD_FILES: Final = {
    "bad.toml": "[fleet]\nnam = 1\n",
    "workload.toml": '[[rc]]\nname = "robot/a"\n[[arc]]\nname = "x"\nat = 0\npriority = 1\n'
    'min_runtime = 1\n[arc.needs]\n"robot/a" = {}\n[[arc]]\nname = "y"\nat = 0\npriority = 1\n'
    'min_runtime = 2\n[arc.needs]\n"robot/b" = {}\n',
    "twice.toml": '[[arc]]\nname = "x"\nat = 0\npriority = 1\nmin_runtime = 1\n[arc.needs]\n',
    "not.rrd": "no recording",
    "node.toml": '[[rc]]\nname = "robot/a"\ndriver = "robot"\n',
    "run.sh": "true\n",
}
CALLS: Final = (
    "", "--version", "nonsense", "reqest robot/a", "--fleet none.toml status", "--fleet bad.toml status", "request",
    "request robot", "request robot/a robot/a", "request robot/a:rate", "request robot/a:rate=x",
    "request robot/a:rate=1,rate=2", "request robot/*#0", "request robot/*:rate=1 robot/*:rate=2",
    "request robot/a --min-runtime never", "request robot/a --min-runtime 0", "request robot/a --timeout -1",
    "request robot/a --priority 1.5", "request robot/a --name a/b", "request robot/a -- no-such-command-anywhere",
    "request robot/a -- ./run.sh", "request true -- true", "take", "take robot/a:=", "take robot/a --min-runtime 0",
    "drive", "drive radio/rf0", "drive robot/a --speed 9", "watch", "watch --source none.avi",
    "watch --source none.avi --limit 0", "release", "cancel", "cancel \x07", "status --once", "why", "start",
    "start a/b", "start counter --set x", "start counter --host a/b", "start counter --memory much",
    "start counter --restart seldom", "stop", "stop a/b", "components a/b", "logs", "logs a/b", "migrate",
    "migrate counter --to a/b", "drain", "drain a/b", "uncordon", "uncordon a/b", "keys --all --json",
    "cert ca --days 0", "cert issue anvil", "cert issue a/b", "cert renew none", "cert show", "cert show none",
    "view none.rrd", "view not.rrd", "view --bind somewhere", "view --port 0", "replay", "replay none.toml",
    "replay bad.toml", "replay twice.toml", "replay workload.toml", "replay workload.toml --json",
    "replay workload.toml --strategy best", "replay workload.toml --rrd picture.png", "simulate --list",
    "simulate nowhere", "simulate office --http x:y", "simulate office --speed 0", "demo nothing",
    "demo table1 --out picture.png", "demo placement --policy best", "demo robots --building nowhere",
    "component start", "component list a/b", "component kinds x", "component logs a/b", "booking show",
    "booking import", "doctor --keys x", "motion --source none.avi", "ps",
    "completion bash", "completion tcsh", "node none.toml", "node bad.toml", "node node.toml", "node --log-level loud",
    "node --check node.toml",
)  # fmt: skip
"""Words after `zscout` (or, after `node`, those of `zscout-node`), parted by spaces."""


def calls() -> dict[str, Any]:
    """Of each call of `CALLS` its exit code, and what it prints: JSON as it is, and else in how many lines. Help and
    the words of errors are no surface."""
    programs = scripts()
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder, plain(), _inside(folder):
        for name, text in BAD_FILES.items():
            Path(name).write_text(text)
        for words in CALLS:
            name, _, rest = words.partition(" ")
            program, args = ("zscout-node", rest) if name == "node" else ("zscout", words)
            told = printed(program, programs[program], args.split())
            found[f"{program} {args}".rstrip()] = {name: _printed(value) for name, value in told.items()}
    return found


def _printed(told: Any) -> Any:
    if not isinstance(told, list):
        return told
    if told[0].startswith("{"):
        return [json.loads(line) for line in told]
    return "a line" if len(told) == 1 else "lines"


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


@contextmanager
def _inside(folder: str) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
