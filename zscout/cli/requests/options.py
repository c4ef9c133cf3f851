"""Parse the command line strictly: durations, needs, options of commands that hold devices."""

from __future__ import annotations

import os
import re
import shlex
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any, Final

import click
from msgspec.structs import replace

from zscout import messages
from zscout.behaviors.client.identity import bounded, checked_comment
from zscout.cli import completion
from zscout.cli.common import F, Failed, Interrupted, Parsed, json_option
from zscout.cli.groups import InfraExit
from zscout.cli.requests.run_command import COMMAND_CODES, check_command
from zscout.config import strict
from zscout.config.strict import DURATIONS, BadInput, quoted
from zscout.keyexpr import BadName, check_name, check_need, check_new_name, is_pattern, valid_name
from zscout.messages import MAX_NEEDS, MAX_PARAMS, MAX_SECONDS, Who
from zscout.scheduling.needs import check_patterns
from zscout.terminal import json_text, span

Needs = dict[str, dict[str, Decimal]]

INFRA_EXIT: Final = "--infra-exit"
EXIT_CODES: Final = range(1, 256)
MAX_PRIORITY: Final = 1_000_000
DEFAULT_NAMES: Final = ("request", "operator", "acquire")
"""Names of ARCs of `zscout request`, `take` and `acquire` without a command."""
MAX_ARC_NAME: Final = 200
"""Characters of `<host>/<client>/<id>`, the longest name of an ARC."""
_NUMBER: Final = re.compile(r"[0-9]{1,19}(\.[0-9]{1,18})?|\.[0-9]{1,18}")


def parse_duration(text: str, what: str, *, zero: bool = False) -> Decimal:
    """Parse `5`, `1.5`, `300ms`, `90s`, `5m`, `2h` or `1d12h`; return seconds. Raises BadInput."""
    seconds = strict.parse_duration(text)
    if seconds is None:
        raise BadInput(f"{what}: {quoted(text)} is not a duration; write {DURATIONS}")
    if zero and seconds == 0:
        return seconds
    try:
        messages.duration(seconds, what)
    except ValueError as error:
        raise BadInput(f"{error}; write more than 0, at most {span(float(MAX_SECONDS))}") from None
    return seconds


def timeout_option(help: str, *, zero: bool = False) -> Callable[[F], F]:  # noqa: A002 - click's word
    """The `--timeout` option, in seconds. `zero`: 0 is allowed."""
    return click.option("--timeout", type=SECONDS_OR_0 if zero else SECONDS, help=help)


def seconds_within(low: float, high: float) -> Parsed[float]:
    """A parameter type for a duration between `low` and `high` seconds."""

    def parse(text: str, option: str) -> float:
        seconds = float(parse_duration(text, option, zero=low == 0))
        if not low <= seconds <= high:
            raise BadInput(f"{option}: {span(seconds)} is out of range; write {span(low)} to {span(high)}")
        return seconds

    return Parsed("duration", parse)


SECONDS: Final = Parsed("duration", lambda text, option: float(parse_duration(text, option)))
"""A parameter type for a duration above 0, in seconds."""
SECONDS_OR_0: Final = Parsed("duration", lambda text, option: float(parse_duration(text, option, zero=True)))


def parse_comment(text: str, option: str) -> str:
    """As other users see it. Raises BadInput."""
    try:
        return checked_comment(text)
    except ValueError as error:
        raise BadInput(f"{option}: {error}") from None


def parse_rc(text: str, kind: str, *, pattern: bool = False, other_kinds: bool = False) -> str:
    """Parse an RC of `kind`: `robot/scout33`, `scout33`, with `pattern` also `robot/*`, with `other_kinds` also
    `camera/door`. Raises BadInput, BadName."""
    rc = text if "/" in text else f"{kind}/{text}"
    if (rc.partition("/")[0] != kind and not other_kinds) or (is_pattern(rc) and not pattern):
        raise BadInput(f"{quoted(text)} is not a {kind}; name one, as in {kind}/NAME")
    check_need(rc)
    return rc


def parse_need(text: str, _option: str = "") -> tuple[str, dict[str, Decimal]]:
    """Parse `robot/scout33`, `framegrabber/*` or `radio/rf0:command_rate=5,other=1`. Raises BadInput."""
    rc, colon, rest = text.partition(":")
    params: dict[str, Decimal] = {}
    try:
        check_need(rc)
        for part in rest.split(",") if colon else []:
            name, equals, number = part.partition("=")
            remedy = f"write parameter=number, as in {rc}:command_rate=5"
            try:
                check_name(name, "parameter")
            except BadName as error:
                raise ValueError(f"{error}; {remedy}") from None
            if name in params:
                raise ValueError(f"{name} is given twice; give it once")
            if _NUMBER.fullmatch(number) is None:
                raise ValueError(f"{name} {f'is {quoted(number)}' if equals else 'has no number'}; {remedy}")
            params[name] = Decimal(number)
        if len(params) > MAX_PARAMS:
            raise ValueError(f"{len(params)} parameters; at most {MAX_PARAMS} are allowed")
        messages.exact_amounts(params)
    except ValueError as error:
        context = click.get_current_context(silent=True)
        no_dashes = "/" not in text and context is not None and context.meta.get("command") == ()
        raise BadInput(f"{error}{'; a command goes after --' if no_dashes else ''}") from None
    return rc, params


def gather_needs(pairs: Sequence[tuple[str, dict[str, Decimal]]]) -> Needs:
    """A repeated pattern is numbered: `framegrabber/*#2` is the second. Raises BadInput for too many needs, an RC named
    twice, or patterns that contradict each other."""
    if len(pairs) > MAX_NEEDS:
        raise BadInput(f"{len(pairs)} devices; at most {MAX_NEEDS} are allowed in one request")
    needs: Needs = {}
    # Don't reuse numbers that the user wrote.
    written = {need for need, _ in pairs}
    for need, params in pairs:
        name = need
        if need in needs:
            if not is_pattern(need):
                raise BadInput(f"{need} is named twice; name each device once, with all its parameters after one colon")
            if "#" in need:
                raise BadInput(f"{need} is named twice; leave the numbers out: zscout numbers them")
            numbered = (f"{need}#{number}" for number in range(2, MAX_NEEDS + 2))
            name = next(free for free in numbered if free not in needs and free not in written)
        needs[name] = params
    try:
        check_patterns({need: messages.exact_amounts(params) for need, params in needs.items()})
    except ValueError as error:
        raise BadInput(str(error)) from None
    return needs


def is_descriptor(target: str) -> bool:
    return target.isascii() and target.isdigit()


class EventFile:
    """The target of `--json-file`: a file, a FIFO with a reader, or an open descriptor."""

    def __init__(self, target: str) -> None:
        """Raises BadInput if it can't be written."""
        self.given = is_descriptor(target)
        try:
            if self.given:
                self.fd = int(target)
                os.fstat(self.fd)
            else:
                # Don't block on a FIFO: without a reader it is refused, and a full FIFO loses events.
                flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NONBLOCK
                self.fd = os.open(target, flags, 0o666)
            os.write(self.fd, b"")
        except (OSError, OverflowError) as error:
            why = error.strerror if isinstance(error, OSError) else "no such descriptor"
            raise BadInput(f"--json-file {quoted(target)} can't be written ({why}); give another file") from None

    def close_given(self) -> None:
        """Close a descriptor that the caller passed: its reader waits for the end."""
        if self.given:
            os.close(self.fd)

    def write(self, event: Mapping[str, Any]) -> None:
        """Write one event as a line; errors are ignored, so a reader can't disturb the command."""
        with suppress(OSError):
            os.write(self.fd, f"{json_text(event)}\n".encode())


class HoldCommand(click.Command):
    """A command with `--infra-exit` and `--json-file`, which apply to all its failures."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta["infra_exit"] = _infra_exit_in(args)
        with _own_failures(ctx):
            return super().parse_args(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        with _own_failures(ctx):
            return super().invoke(ctx)


def _infra_exit_in(args: Sequence[str]) -> int | None:
    """--infra-exit before other options are parsed, as any may be wrong. None: missing, or bad (click reports it)."""
    for at, arg in enumerate(args):
        name, equals, value = arg.partition("=")
        if name == INFRA_EXIT:
            value = value if equals else "".join(args[at + 1 : at + 2])
            return int(value) if re.fullmatch("[0-9]{1,3}", value) and int(value) in EXIT_CODES else None
    return None


@contextmanager
def _own_failures(ctx: click.Context) -> Iterator[None]:
    """Write a failure to --json-file, and raise InfraExit for it, if these options are given."""
    try:
        yield
    except (click.exceptions.Exit, click.Abort, Interrupted):
        raise
    except Exception as error:
        from zscout.cli.main import explain

        code, line = explain(error) or (1, repr(error))
        if (events := ctx.meta.get("events")) is not None:
            events.write({"event": "failed", "code": code, "reason": line.removeprefix("zscout: ")})
        infra_exit = ctx.meta["infra_exit"]
        if infra_exit is None or (isinstance(error, Failed) and code in COMMAND_CODES):
            raise
        raise InfraExit(infra_exit) from error


class CommandAfterDashes(HoldCommand):
    """A click command that takes `-- COMMAND [ARG]...` at its end, untouched, as `ctx.meta["command"]`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        ctx.meta["command"] = ()
        if "--" in args:
            at = args.index("--")
            args, command = args[:at], args[at + 1 :]
            if not command and not ctx.resilient_parsing:
                raise click.UsageError("no command follows the --; write a command, or leave the -- out", ctx)
            ctx.meta["command"] = tuple(command)
        return super().parse_args(ctx, args)

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        return [*super().collect_usage_pieces(ctx), "[-- COMMAND [ARG]...]"]


@dataclass(frozen=True, slots=True)
class HoldOptions:
    """The options of a command that holds devices. `timeout` and `grace` in seconds."""

    name: str
    needs: Needs
    priority: int
    min_runtime: Decimal | None
    """None: the fleet's default."""
    keep: bool
    timeout: float | None
    grace: Decimal | None
    command: tuple[str, ...]
    again: bool
    as_json: bool
    comment: str = ""
    wait_for_device: bool = False
    tolerate: float | None = None
    """Seconds for which devices may be unwell under the hold; None: each device's setting."""
    booking: str = ""
    """Id of the booking to take up."""
    infra_exit: int | None = None
    notify_signal: int | None = None
    """Signal to the command when a notice announces the end of the hold."""
    events: EventFile | None = None
    direct: bool = False
    """True if programs access the devices directly, past zscout; commands do."""

    def own_code(self, code: int) -> int:
        """Return the exit code for a failure of zscout's own: --infra-exit, else `code`."""
        return code if self.infra_exit is None else self.infra_exit

    def asked_by(self, who: Who | None) -> Who:
        """Complete `who`, which has only zscout's own command, with the user's command or the request's name."""
        who = who or Who()
        called = f"--booking {self.name}" if self.booking else f"--name {self.name}"
        own = f"{who.command} {called}" if self.name not in DEFAULT_NAMES else who.command
        return replace(who, command=bounded(shlex.join(self.command) if self.command else own))

    def terms(self) -> dict[str, Any]:
        terms = {"priority": self.priority, "min_runtime": self.min_runtime, "keep": self.keep}
        return terms | {"wait_for_device": self.wait_for_device}


def hold_options(command: F, *, needs_required: bool = True, runs_command: bool = True) -> F:
    """Add needs and options of commands that hold devices; `runs_command`: also the options for a command."""
    of_commands = (
        click.option("--again", is_flag=True, help="Repeat request and command if the devices were taken away."),
        click.option(
            "--release-after",
            type=Parsed("duration", parse_duration),
            help="Release the devices after this time, even if no request waits; instead of --min-runtime.",
        ),
        grace_option,
        notify_signal_option,
        click.option(
            "--min-runtime",
            type=Parsed("duration", parse_duration),
            help="Protect the hold this long from requests of equal priority: 90s, 5m, 2h, 1d12h. Default: the "
            "fleet's, 60 s; with a command an hour, or until the next booking of a device.",
        ),
    )
    for option in (
        click.argument(
            "needs",
            nargs=-1,
            required=needs_required,
            type=Parsed("need", parse_need),
            metavar="DEVICE...",
            shell_complete=completion.needs,
        ),
        json_option("Print one JSON object on a line for each event."),
        click.option("--wait-for-device", is_flag=True, help="Also wait for unknown devices."),
        *(of_commands if runs_command else ()),
        infra_exit_option,
        click.option(
            "--json-file", metavar="PATH|FD", help="Also write the events of --json to this file or open descriptor."
        ),
        timeout_option("Wait this long for a grant, then exit with 1; 0: try once.", zero=True),
        click.option(
            "--comment",
            type=Parsed("text", parse_comment),
            default="",
            help="A comment, shown in status and to requests that wait for the devices.",
        ),
        click.option(
            "--name", help=f"Name of the request. Default: {NAMES_OF_COMMANDS if runs_command else DEFAULT_NAMES[2]}."
        ),
    ):
        command = option(command)
    return command


NAMES_OF_COMMANDS: Final = "the command's name, else request (take: operator)"
grace_option: Final = click.option(
    "--grace",
    type=Parsed("duration", partial(parse_duration, zero=True)),
    help="Time from SIGTERM to SIGKILL for the command: at most, and by default, nine tenths of the devices' settling "
    "time (`settle`, 5 s).",
)


def parse_signal(text: str, option: str) -> int:
    """Parse `USR1`, `SIGUSR1` or a number. Raises BadInput."""
    name = text.upper().removeprefix("SIG")
    known = {found.name.removeprefix("SIG"): int(found) for found in signal.Signals}
    number = int(name) if name.isascii() and name.isdigit() else known.get(name, 0)
    if number not in known.values() or number in (signal.SIGKILL, signal.SIGSTOP):
        raise BadInput(f"{option}: {quoted(text)} is not a signal that a command can catch; write USR1, USR2 or HUP")
    return number


notify_signal_option: Final = click.option(
    "--notify-signal",
    metavar="NAME",
    type=Parsed("signal", parse_signal),
    help="Send the command this signal when another request waits for the devices, or a booking or maintenance will "
    "end the hold: USR1. Only once the command catches it.",
)
infra_exit_option: Final = click.option(
    INFRA_EXIT,
    type=click.IntRange(EXIT_CODES[0], EXIT_CODES[-1]),
    metavar="N",
    help="Exit with N if zscout fails, not the command: instead of 1, 2, 3, 75 and 124.",
)
priority_option: Final = click.option(
    "--priority",
    type=click.IntRange(-MAX_PRIORITY, MAX_PRIORITY),
    default=0,
    help="Higher priorities preempt lower ones.",
)
tolerate_option: Final = click.option(
    "--tolerate", type=SECONDS, help="Keep a device that stops working, as in a reboot, for this long each time."
)


def grace_within(asked: Decimal | None, most: float) -> tuple[float, str]:
    """Return the grace in seconds, and a line for the user if it is less than `asked`."""
    if asked is None or asked <= most:
        return most if asked is None else float(asked), ""
    text = f"--grace {span(float(asked))} is more than the devices allow: SIGKILL follows {span(most)} after SIGTERM"
    return most, text


def gather(
    needs: Any,
    name: str | None,
    default_name: str = DEFAULT_NAMES[0],
    *,
    keep: bool,
    release_after: Any,
    json_file: str | None,
    **rest: Any,
) -> HoldOptions:
    """Check the options that need no fleet. Raises UsageError, BadInput, BadName, Failed."""
    context = click.get_current_context()
    if json_file is not None:
        rest["events"] = context.meta["events"] = EventFile(json_file)
    if not needs and not rest.get("booking"):
        raise click.UsageError("DEVICE... is missing", context)
    if release_after is not None:
        if rest["min_runtime"] is not None:
            raise BadInput("--release-after and --min-runtime exclude each other; use only one of them")
        keep, rest["min_runtime"] = False, release_after
    command: tuple[str, ...] = context.meta.get("command") or ()
    if command:
        check_command(command)
        default_name = valid_name(Path(command[0]).name)
    if rest.get("notify_signal") is not None and not command:
        raise BadInput("--notify-signal is for a command; add one after --")
    if rest["again"] and not command:
        raise BadInput("--again repeats a command; add one after --")
    return HoldOptions(
        name=check_new_name(name or default_name, "--name"),
        needs=gather_needs(needs),
        command=command,
        keep=keep,
        **rest,
    )


def arc_named(text: str, _option: str) -> str:
    """Raises BadInput."""
    if not text or len(text) > MAX_ARC_NAME or not text.isprintable():
        raise BadInput(f"{quoted(text)} can't be the name of a request; see zscout status")
    return text


arc_argument = click.argument("arc", metavar="REQUEST", type=Parsed("text", arc_named), shell_complete=completion.arcs)
