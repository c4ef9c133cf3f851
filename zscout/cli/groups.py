"""Groups of commands, whose modules are imported on use, and the groups below `zscout`.

`--help` and completion need only these tables, so neither loads Zenoh, Rich or Rerun."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Mapping
from copy import copy
from importlib import import_module
from typing import Any, Final, TypeAlias

import click
from click.shell_completion import CompletionItem

Headings: TypeAlias = Mapping[str, Mapping[str, tuple[str, str]]]
"""By heading and name: the command, as `module:attribute` below `zscout`, and its line in the help."""
MAX_SHOWN: Final = 40
"""Characters of an unknown command that the error repeats."""


class InfraExit(Exception):
    """zscout itself failed (the exception's cause) in a command with `--infra-exit CODE`."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def at_terminal() -> bool:
    return sys.stderr.isatty()


def instead(text: str) -> dict[str, str]:
    """Parse a text such as `status = ps queue; book = reserve`: {"ps": "status", ...}."""
    parts = (part.strip().partition(" = ") for part in text.replace("\n", ";").split(";"))
    return {name: words for words, _, names in parts for name in names.split()}


class LazyGroup(click.Group):
    """The commands of `headings`, and hidden commands for `old` spellings (name: the new words). own: old spellings
    with a command of their own, by name. instead: the words to write for old spellings, with or without an option, and
    for names of other programs."""

    def __init__(
        self,
        *args: Any,
        headings: Headings,
        instead: Mapping[str, str],
        old: Mapping[str, str] | None = None,
        own: Mapping[str, str] | None = None,
        **more: Any,
    ) -> None:
        super().__init__(*args, **more)
        self.headings, self.instead, self.old, self.own = headings, instead, old or {}, own or {}
        self.table = {name: entry for part in headings.values() for name, entry in part.items()}

    def list_commands(self, ctx: click.Context) -> list[str]:
        return [*self.table, *self.old]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        command: Any = self
        if cmd_name in self.table or cmd_name in self.own:
            module, _, attribute = (self.own.get(cmd_name) or self.table[cmd_name][0]).partition(":")
            command = getattr(import_module(f"zscout.{module}"), attribute)
        elif cmd_name in self.old:
            for word in self.old[cmd_name].split():
                command = command.get_command(ctx, word)
        else:
            return None
        if cmd_name in self.old:
            command = copy(command)
            command.hidden = True
        return command  # type: ignore[no-any-return]

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name, path = args[0], ctx.command_path
        if name in self.old and not ctx.resilient_parsing and at_terminal():
            exactly = next((new for arg in args[1:] if (new := self.instead.get(f"{name} {arg}"))), None)
            click.echo(f"{path} {name} is now called {path} {exactly or self.instead[name]}", err=True)
        if name not in self.table and name not in self.old and not name.startswith("-"):
            raise click.UsageError(f'there is no command "{name[:MAX_SHOWN]}"{self._hint(path, name)}', ctx)
        return super().resolve_command(ctx, args)

    def _hint(self, path: str, name: str) -> str:
        if (words := self.instead.get(name.lower())) is not None:
            return f"; use {path} {words}"
        near = difflib.get_close_matches(name.lower()[:MAX_SHOWN], (*self.table, *self.instead), n=3, cutoff=0.7)
        meant = dict.fromkeys(found if found in self.table else self.instead[found] for found in near)
        return f"; did you mean {' or '.join(meant)}?" if meant else ""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        width = max(map(len, self.table))
        for heading, commands in self.headings.items():
            with formatter.section(heading):
                formatter.write_dl([(name.ljust(width), text) for name, (_, text) in commands.items()])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        found = [
            CompletionItem(name, help=text) for name, (_, text) in self.table.items() if name.startswith(incomplete)
        ]
        return found + click.Command.shell_complete(self, ctx, incomplete)


component = LazyGroup(
    "component",
    headings={
        "Commands": {
            "start": ("cli.components.start:start", "Run a component on the best host, and keep it running."),
            "stop": ("cli.components.start:stop", "End components for good."),
            "list": ("cli.components.components:components", "List components: where each runs, and what it uses."),
            "logs": ("cli.components.logs:logs", "Print or follow the output of a component."),
            "migrate": ("cli.components.moves:migrate", "Move a running component to another host."),
            "kinds": ("cli.components.components:kinds", "List the kinds that can be started, and on which hosts."),
        }
    },
    instead=instead("""
list = ls ps status show top; logs = log output tail; stop = kill rm remove delete end cancel
start = run add create launch place; migrate = move mv; kinds = kind types available
"""),
    help="""Start programs by name on the best host, keep them running, and move them.

    \b
    Examples:
      zscout component kinds
      zscout component start counter --set rc=robot/scout33
      zscout component list
    """,
)

booking = LazyGroup(
    "booking",
    headings={
        "Commands": {
            "list": ("cli.bookings.listing:bookings", "List bookings: owner, devices and times."),
            "show": ("cli.bookings.listing:show", "Show one booking with all its dates."),
            "cancel": ("cli.bookings.listing:unbook", "Cancel a booking, or one date of it."),
            "export": ("cli.bookings.calendar:export", "Write bookings as iCalendar files."),
            "import": ("cli.bookings.calendar:import_", "Book the events of an iCalendar file."),
        }
    },
    instead=instead("list = ls all; show = info get; cancel = rm remove delete unbook end"),
    help="""List, show and cancel bookings, and exchange them with calendar programs.

    To book devices: zscout book.

    \b
    Examples:
      zscout booking list --mine
      zscout booking cancel survey --date 2026-12-08
      zscout booking export --out fleet.ics
      zscout booking import lab.ics --map 'Arm 1=robot/arm1' --dry-run
    """,
)
