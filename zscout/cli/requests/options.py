"""The options of all commands that hold something, and what they come to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any, TypeVar

import click

from zscout.cli.common import json_option
from zscout.cli.requests.arguments import Duration, Needs, gather_needs
from zscout.cli.requests.run_command import check_command
from zscout.config.strict import BadInput
from zscout.keyexpr import check_name, valid_name

F = TypeVar("F", bound=Callable[..., Any])


class CommandAfterDashes(click.Command):
    """A click command that takes `-- COMMAND [ARG]...` at its end, untouched, as `ctx.meta["command"]`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta["command"] = ()
        if "--" in args:
            at = args.index("--")
            args, command = args[:at], args[at + 1 :]
            if not command and not ctx.resilient_parsing:
                raise click.UsageError("no command follows the --; write one, or leave the -- out", ctx)
            ctx.meta["command"] = tuple(command)
        return super().parse_args(ctx, args)

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        return [*super().collect_usage_pieces(ctx), "[-- COMMAND [ARG]...]"]


@dataclass(frozen=True, slots=True)
class HoldOptions:
    """What was asked for on the command line. `timeout` and `grace` in seconds."""

    name: str
    needs: Needs
    priority: int
    min_runtime: Decimal
    keep: bool
    timeout: Decimal | None
    grace: Decimal
    command: tuple[str, ...]
    again: bool
    as_json: bool


def hold_options(command: F) -> F:
    """The options of all commands that hold something."""
    options: list[Callable[[F], F]] = [
        click.option(
            "--name",
            help="What the ARC is called. Default: the command's name, else request (take: operator).",
        ),
        click.option(
            "--min-runtime",
            type=Duration(),
            default="60",
            show_default=True,
            help="For how long, from the grant: 5, 1.5, 300ms, 2m, 1h.",
        ),
        click.option(
            "--timeout", type=Duration(), help="Wait at most so long for a grant, then exit with 1."
        ),
        click.option(
            "--grace",
            type=Duration(zero=True),
            default="5",
            show_default=True,
            help="Between SIGTERM and SIGKILL to the command.",
        ),
        click.option("--again", is_flag=True, help="Wait and run the command again after a preemption."),
        json_option("Print JSON lines, one for each event."),
    ]
    for option in reversed(options):
        command = option(command)
    return command


def gather(
    ctx: click.Context, needs: Any, name: str | None, default_name: str = "request", **rest: Any
) -> HoldOptions:
    """Checks what can be checked before anybody is asked. Raises BadInput, BadName, Failed."""
    command: tuple[str, ...] = ctx.meta["command"]
    if command:
        check_command(command)
        default_name = valid_name(Path(command[0]).name)
    if rest["again"] and not command:
        raise BadInput("--again runs a command again; add one after --")
    return HoldOptions(
        name=check_name(name or default_name, "--name"), needs=gather_needs(needs), command=command, **rest
    )
