"""The `zscout` command: one group whose subcommands are imported when they are used.

`zscout --help` and completion need only the table below, so neither loads Zenoh, Rich or Rerun.
Every error becomes one line on stderr and an exit code:

0 done, 1 could not (refused, lost), 2 bad input, 3 no RCM on the mesh, 128 + n by signal n (130: Ctrl-C).
`zscout request -- COMMAND` has codes of its own; see its help.
"""

from __future__ import annotations

import difflib
import errno
import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Final

import click

from zscout import __version__
from zscout.cli.groups import Headings, InfraExit, LazyGroup, instead
from zscout.logs import shortage
from zscout.streams import escape_what_cannot_be_written

HEADINGS: Final[Headings] = {
    "Use devices": {
        "request": ("cli.requests.request:request", "Wait for devices; hold them, or run a command that needs them."),
        "acquire": ("cli.requests.acquire:acquire", "Hold devices for the commands that follow; print a token."),
        "renew": ("cli.requests.acquire:renew", "Hold the devices of a token for longer."),
        "run": ("cli.requests.acquire:run", "Run a command under the hold of a token."),
        "take": ("cli.operator.take:take", "Take devices at an operator's priority, preempting their holders."),
        "drive": ("cli.operator.drive:drive", "Take a robot and drive it from the keyboard, seeing what it sees."),
        "release": ("cli.requests.cancel:release", "End the hold of a request; leave what waits alone."),
        "cancel": ("cli.requests.cancel:cancel", "End a request, whether it holds or waits."),
    },
    "Look": {
        "status": ("cli.fleet.status:status", "Show devices, holders, the queue and the hosts."),
        "why": ("cli.requests.why:why", "Explain what a request waits for, and which others are in its way."),
        "view": ("cli.fleet.view:view", "Watch the fleet live on a timeline, or open a recording."),
        "history": ("cli.fleet.history:history", "List past holds, from the journals of the nodes."),
        "usage": ("cli.fleet.usage:usage", "Sum up hold times by user, group or device."),
    },
    "Book": {
        "book": ("cli.bookings.book:book", "Book devices together for a date."),
        "slots": ("cli.bookings.slots:slots", "List the first times at which devices are free together."),
        "booking": ("cli.groups:booking", "List, show, cancel, export and import bookings."),
        "maintain": ("cli.bookings.book:maintain", "Reserve devices for maintenance."),
    },
    "Components": {
        "component": ("cli.groups:component", "Start, stop, list and move programs that zscout keeps running.")
    },
    "Operate": {
        "node": ("node:main", "Run this host's part of a fleet (the same as zscout-node)."),
        "drain": ("cli.operator.drain:drain", "Empty a host of components and holds, and grant none there."),
        "uncordon": ("cli.operator.drain:uncordon", "Use a drained host again."),
        "doctor": ("cli.fleet.doctor:doctor", "Find out why there is no link, no leader or no device."),
        "cert": ("cli.fleet.cert:cert", "Make, renew and show the certificates of a secured fleet."),
        "completion": ("cli.completion:completion", "Print the completion script for bash, zsh or fish."),
    },
    "Try": {
        "demo": ("cli.simulation.demo:demo", "Show what zscout does, on a live mesh on this machine."),
        "simulate": ("cli.simulation.simulate:simulate", "Serve a simulated building with robots, radio and cameras."),
        "replay": ("cli.simulation.replay:replay", "Schedule a workload file under virtual time."),
        "motion": ("cli.operator.watch:motion", "Report motion in the pictures of a camera or video."),
    },
}
OLD: Final = {
    "bookings": "booking list",
    "unbook": "booking cancel",
    "calendar": "booking",
    **{name: f"component {name}" for name in ("start", "stop", "logs", "migrate")},
    "components": "component list",
    "keys": "doctor --keys",
    "watch": "motion",
}
"""The new words, by old spelling."""
HABITS: Final = """
status = ps list ls queue squeue sinfo who show info jobs stat state devices nodes hosts; status --watch = top htop
request = lock hold get grab claim alloc allocate salloc ask wait checkout submit
request DEVICE -- COMMAND = exec srun sbatch; book = reserve schedule; take = preempt steal seize takeover
release = unlock free return give drop yield; cancel = kill scancel abort end rm delete remove
component logs = log output tail; component migrate = move mv; component kinds = kinds types
why = explain reason; view = timeline viewer gui ui rerun; view --web = web dashboard
history = sacct events journal past; booking export = export ics; booking import = import
maintain = maintenance disable offline; booking cancel = enable; booking list = reservations; slots = when next
drain = cordon; uncordon = undrain resume; doctor = check diagnose debug ping health
node = daemon serve up agent server; cert = certs certificate login; simulate = sim simulator
motion = detect camera; --version = version; --help = help
"""
"""Commands, and names of other programs that people try for them."""
INSTEAD: Final = {
    **instead(HABITS),
    **OLD,
    "components --kinds": "component kinds",
    **{f"calendar {name}": f"booking {name}" for name in ("export", "import")},
}

OK, COULD_NOT, BAD_INPUT, NOBODY, INTERRUPTED = 0, 1, 2, 3, 130


class OneLineErrors(LazyGroup):
    """Prints errors on one line. If a command returns an int, that is the exit code."""

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        escape_what_cannot_be_written()
        own = super().main
        code = run_command(lambda: own(args, "zscout", complete_var, standalone_mode=False, **extra))
        if not standalone_mode:
            return code
        sys.exit(code if isinstance(code, int) else OK)


def run_command(call: Callable[[], Any], program: str = "zscout") -> Any:
    """For an error that users can fix print one line that begins with `program`, and return the exit code."""
    try:
        code = call()
        sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        infra_exit = error.code if isinstance(error, InfraExit) else None
        cause = error.__cause__ if isinstance(error, InfraExit) and error.__cause__ is not None else error
        known = explain(cause)
        if known is None and infra_exit is None:
            raise
        code, line = known or (COULD_NOT, "".join(traceback.format_exception(cause)))
        code = code if infra_exit is None else infra_exit
        if line:
            # If stderr is closed, the exit code remains.
            with suppress(OSError):
                click.echo(re.sub("^zscout:", f"{program}:", line), err=True)
    _drop_unwritten()
    return code


def explain(error: BaseException) -> tuple[int, str] | None:
    """Return exit code and line for an error that users can fix; None: a bug, printed with its traceback."""
    if isinstance(error, OSError) and _output_closed(error):
        return COULD_NOT, ""
    if why := shortage(error):
        return COULD_NOT, f"zscout: {why}"
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        return BAD_INPUT, error.format_message()
    if isinstance(error, click.UsageError):
        path = error.ctx.command_path if error.ctx is not None else "zscout"
        return BAD_INPUT, f"zscout: {_line(usage_words(error))} (see {path} --help)"
    if isinstance(error, click.ClickException):
        return error.exit_code, f"zscout: {_line(error.format_message())}"
    if isinstance(error, (click.Abort, KeyboardInterrupt)):
        return INTERRUPTED, ""
    if isinstance(error, ImportError):
        from zscout.config.packages import how_to_get

        missing = how_to_get(error)
        return (COULD_NOT, f"zscout: this command {missing}") if missing else None
    # Only a failing command pays for these imports, and most have made them already.
    from zscout.behaviors.client.bookings import RcmSilent
    from zscout.behaviors.client.client import CommandRefused, RequestRefused
    from zscout.behaviors.client.placer_client import PlacerSilent
    from zscout.behaviors.client.remedies import with_remedy
    from zscout.cli.common import REMEDIES, Failed, Interrupted
    from zscout.config.strict import BadInput
    from zscout.keyexpr import BadName
    from zscout.mesh import MeshError
    from zscout.messages import ADMISSION_CODES
    from zscout.simulation import DemoFailed

    words = f"zscout: {_line(str(error))}"
    match error:
        case Interrupted():
            return error.exit_code, ""
        case Failed():
            return error.exit_code, words
        case BadInput() | BadName():
            return BAD_INPUT, words
        case PlacerSilent() | RcmSilent():
            return NOBODY, words
        case RequestRefused(code=code) if code in ADMISSION_CODES:
            return BAD_INPUT, f"zscout: {_line(with_remedy(error.fault, error.remedy, REMEDIES))}"
        case RequestRefused() | CommandRefused() | MeshError() | DemoFailed():
            return COULD_NOT, words
    return None


def usage_words(error: click.UsageError) -> str:
    """Rewrite an error of click in the form of the others: option, fault, remedy."""
    words = error.message
    param, hint = getattr(error, "param", None), getattr(error, "param_hint", None)
    name = hint if isinstance(hint, str) else ""
    if isinstance(param, click.Option):
        name = max(param.opts, key=len)
    elif param is not None and error.ctx is not None:
        name = param.human_readable_name if param.metavar is None else param.make_metavar(error.ctx)
    match error:
        case click.MissingParameter():
            words = f"{name} is missing"
        case click.NoSuchOption(possibilities=near):
            words = f"there is no option {error.option_name}"
            words += _meant(error, near or ())
        case click.BadOptionUsage():
            words = f"{error.option_name} needs a value" if "requires an argument" in words else words
        case click.BadParameter() if name:
            words = f"{name}: {words}"
    for pattern, better in _CLICK_WORDS:
        words = re.sub(pattern, better, words)
    return words.removesuffix(".")


def _meant(error: click.NoSuchOption, near: Sequence[str]) -> str:
    """Suggest options for an unknown option; click's own suggestions are too loose."""
    params = error.ctx.command.params if error.ctx is not None else []
    known = {name for param in params for name in param.opts}
    meant = [name for name in OTHER_OPTIONS.get(error.option_name, ()) if name in known]
    meant = meant or difflib.get_close_matches(error.option_name, sorted(near), n=3, cutoff=0.7)
    return f"; did you mean {' or '.join(meant)}?" if meant else ""


OTHER_OPTIONS: Final = {
    "--for": ("--min-runtime", "--release-after"),
    "--device": ("--rc",),
    "--request": ("--arc",),
    "--from": ("--since",),
    "--reason": ("--comment",),
}
"""Options of other commands or programs, and the options here that may be meant."""

_CLICK_WORDS: Final = (
    (r"'((?:[^'\\]|\\.)*)'", r'"\1"'),
    (r"not a valid (?:integer range|integer)", "not a whole number"),
    (r"not a valid (?:float range|float)", "not a number"),
    (r"is not in the range (\S+?)<=?x<=?(\S+?)\.?$", r"is out of range; write \1 to \2"),
    (r"is not in the range x>=?(\S+?)\.?$", r"is too small; write at least \1"),
    (r"is not in the range x<=?(\S+?)\.?$", r"is too large; write at most \1"),
    (r"is not one of (.*?)\.?$", r"is unknown; write one of \1"),
    (r"Got unexpected extra arguments? \((.*)\)", r'too many arguments: "\1"'),
    (r"^No such command (\"[^\"]*\")", r"there is no command \1"),
    (r"^Option (\S+) does not take a value", r"\1 takes no value"),
)
"""Patterns in click's messages, and their replacements."""


def _line(text: str) -> str:
    from zscout.terminal import clean

    return " ".join(clean(text).split())


def _output_closed(error: OSError) -> bool:
    """Return True if writing our own output failed: its pipe was closed, or its terminal while SIGHUP is ignored."""
    if error.errno != errno.EIO:
        return isinstance(error, BrokenPipeError)
    return any(map(_terminal_closed, (sys.stdout, sys.stderr)))


def _terminal_closed(stream: IO[str]) -> bool:
    """Return True for a closed terminal; an open terminal has a size, other streams raise ENOTTY."""
    try:
        os.get_terminal_size(stream.fileno())
    except OSError as error:
        return error.errno == errno.EIO
    return False


def _drop_unwritten() -> None:
    """Drop output that can't be written: otherwise Python tries again at exit, and prints an error."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@click.group(
    cls=OneLineErrors,
    headings=HEADINGS,
    instead=INSTEAD,
    old=OLD,
    own={"keys": "cli.fleet.keys:keys"},
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True},
)
@click.option(
    "--fleet",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="The fleet file. Default: the file in $ZSCOUT_FLEET, else a fleet named zscout.",
)
@click.option("-v", "--verbose", is_flag=True, help="Log to stderr what the mesh client does.")
@click.version_option(__version__, "--version", message="%(prog)s %(version)s")
@click.pass_context
def main(ctx: click.Context, fleet: Path | None, verbose: bool) -> None:
    """Give each program all the devices it asked for, or none, over a Zenoh mesh.

    A fleet begins with a node on each host: `zscout node lab.toml` serves the devices that lab.toml lists.
    Then request devices from any host: your command starts as soon as it has them all.

    \b
    Examples:
      zscout node
      zscout request robot/scout33 radio/rf0:command_rate=5 -- bash
      zscout status --watch
      zscout why survey
    """
    if ctx.invoked_subcommand == "node":  # a node has its own log, and its file names the fleet
        if fleet is not None:
            raise click.UsageError('--fleet is for other commands; write fleet = "FILE" under [node] in the node file')
        return
    from zscout.logs import log_to_stderr

    log_to_stderr("INFO" if verbose else "ERROR")


if __name__ == "__main__":
    main()
