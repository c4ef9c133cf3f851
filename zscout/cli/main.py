"""The `zscout` command: one group whose subcommands are imported when they are used.

The table below is all that `zscout --help` and completion need, so that neither loads Zenoh, Rich or Rerun.
Every error ends here as one line on stderr and an exit code:

0 done, 1 could not (refused, lost), 2 bad input, 3 no RCM on the mesh, 128 + n by signal n (130: Ctrl-C).
`zscout request -- COMMAND` has codes of its own; see its help.
"""

from __future__ import annotations

import difflib
import errno
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import IO, Any, Final

import click
from click.shell_completion import CompletionItem

from zscout import __version__

COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "request": ("requests.request", "Wait for devices; hold them, or run a command that needs them."),
    "take": ("operator.take", "Take devices at an operator's priority, preempting who holds them."),
    "book": ("bookings.book", "Book devices together, from a date on."),
    "slots": ("bookings.slots", "List the first times at which devices are free together."),
    "bookings": ("bookings.listing", "List who has booked what."),
    "unbook": ("bookings.listing", "Give up a booking, or one date of it."),
    "maintain": ("bookings.book", "Keep RCs free of everybody, from a date on."),
    "drive": ("operator.drive", "Take a robot and drive it from the keyboard, seeing what it sees."),
    "watch": ("operator.watch", "Tell when something moves in the pictures of a camera or video."),
    "release": ("requests.cancel", "End the hold of a running ARC."),
    "cancel": ("requests.cancel", "End an ARC, running or waiting."),
    "status": ("fleet.status", "Show devices, holders, the queue and the hosts."),
    "why": ("requests.why", "Tell the story of an ARC: what it waits for, and who is in its way."),
    "history": ("fleet.history", "List who held what, from the journals of the candidates."),
    "usage": ("fleet.usage", "Sum up who held what for how long, by user, group or RC."),
    "start": ("components.start", "Have a component run on the best host, and keep it running."),
    "stop": ("components.start", "End components for good."),
    "calendar": ("bookings.calendar", "Write bookings as iCalendar files, and book what such files have."),
    "components": ("components.components", "List components: where each runs, and what it uses."),
    "logs": ("components.logs", "Print or follow the output of a component."),
    "migrate": ("components.moves", "Move a running component to another host."),
    "drain": ("components.moves", "Empty a host of components, and place none there any more."),
    "uncordon": ("components.moves", "Use a drained host again."),
    "keys": ("fleet.keys", "List what is alive on the mesh, and the keys it serves."),
    "doctor": ("fleet.doctor", "Find out why there is no link, no leader or no device."),
    "cert": ("fleet.cert", "Make, renew and show the certificates of a secured fleet."),
    "view": ("fleet.view", "Watch the fleet live on a timeline, or open a recording."),
    "replay": ("simulation.replay", "Schedule a workload file under virtual time."),
    "simulate": ("simulation.simulate", "Serve a simulated building with robots, radio and cameras."),
    "demo": ("simulation.demo", "Show what zscout does, on a live mesh on this machine."),
    "completion": ("completion", "Print the completion script for bash, zsh or fish."),
}
"""Name: the module below zscout.cli that has the click command of that name, and its line in the help."""

OK, COULD_NOT, BAD_INPUT, NOBODY, INTERRUPTED = 0, 1, 2, 3, 130


class LazyGroup(click.Group):
    """The commands of `COMMANDS`. An int that a command returns is the exit code."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = getattr(import_module(f"zscout.cli.{COMMANDS[cmd_name][0]}"), cmd_name)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name = args[0]
        if name not in COMMANDS and not name.startswith("-"):
            near = difflib.get_close_matches(name[:40], COMMANDS, n=3)
            hint = f"did you mean {' or '.join(near)}?" if near else f"known: {', '.join(COMMANDS)}"
            raise click.UsageError(f"there is no command {name[:40]!r}; {hint}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in COMMANDS.items()])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        names = [name for name in COMMANDS if name.startswith(incomplete)]
        found = [CompletionItem(name, help=COMMANDS[name][1]) for name in names]
        return found + click.Command.shell_complete(self, ctx, incomplete)

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        for name in ("stdout", "stderr"):
            if getattr(sys, name) is None:  # closed by whoever started it (`>&-`)
                setattr(sys, name, open(os.devnull, "w"))  # noqa: PTH123, SIM115 - open to the end
        own = super().main
        code = run_command(lambda: own(args, "zscout", complete_var, standalone_mode=False, **extra))
        if not standalone_mode:
            return code
        sys.exit(code if isinstance(code, int) else OK)


def run_command(call: Callable[[], Any]) -> Any:
    """Return what `call` returns; print an error that people can mend as one line, and return its exit code."""
    try:
        code = call()
        sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        known = explain(error)
        if known is None:
            raise
        code, line = known
        if line:
            # Where nobody reads it, the code still tells.
            with suppress(OSError):
                click.echo(line, err=True)
    _drop_unwritten()
    return code


def explain(error: BaseException) -> tuple[int, str] | None:
    """The exit code and the line for an error that people can mend; None: a bug, to be shown in full."""
    if isinstance(error, OSError) and _nobody_reads(error):
        return COULD_NOT, ""
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        return COULD_NOT, f"zscout: {error.strerror}{f': {error.filename}' if error.filename else ''}; free some"
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        return BAD_INPUT, error.format_message()
    if isinstance(error, click.UsageError):
        path = error.ctx.command_path if error.ctx is not None else "zscout"
        # Click's own words for a bounded number say that the text is no range.
        words = _line(error.format_message()).replace("not a valid integer range", "not a whole number")
        return BAD_INPUT, f"{path}: {words.removesuffix('.')} (see {path} --help)"
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
    from zscout.cli.common import Failed, Interrupted
    from zscout.config.strict import BadInput
    from zscout.keyexpr import BadName
    from zscout.mesh import MeshError
    from zscout.messages import DOOR_CODES
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
        case RequestRefused(code=code) if code in DOOR_CODES:
            return BAD_INPUT, words
        case RequestRefused() | CommandRefused() | MeshError() | DemoFailed():
            return COULD_NOT, words
    return None


def _line(text: str) -> str:
    from zscout.terminal import clean

    return " ".join(clean(text).split())


def _nobody_reads(error: OSError) -> bool:
    """Whether it came of our own output: its pipe was closed, or its terminal, while SIGHUP is ignored (nohup)."""
    if error.errno != errno.EIO:
        return isinstance(error, BrokenPipeError)
    return any(map(_gone, (sys.stdout, sys.stderr)))


def _gone(stream: IO[str]) -> bool:
    """Whether it is a terminal that was closed; others have a size, or ENOTTY."""
    try:
        os.get_terminal_size(stream.fileno())
    except OSError as error:
        return error.errno == errno.EIO
    return False


def _drop_unwritten() -> None:
    """What can't be written is dropped: Python tries again at exit, and would complain."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


@click.group(
    cls=LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100, "show_default": True},
)
@click.option(
    "--fleet",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="The fleet file. Default: the one that $ZSCOUT_FLEET names, else a fleet named zscout.",
)
@click.option("-v", "--verbose", is_flag=True, help="Log to stderr what the mesh client does.")
@click.version_option(__version__, "--version", message="%(prog)s %(version)s")
def main(verbose: bool, **_: Any) -> None:
    """All the devices a program asked for, or none, over a Zenoh mesh.

    \b
    Examples:
      zscout request robot/scout33 radio/rf0:command_rate=5 -- bash
      zscout take robot/scout33
      zscout status --watch
      zscout why survey
    """
    import logging

    level = logging.INFO if verbose else logging.ERROR
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)s %(message)s", stream=sys.stderr)


if __name__ == "__main__":
    main()
