"""Shared by `demo` and `replay`: a group with a default command, and the option of a recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from zscout.config.strict import BadInput

F = TypeVar("F", bound=Callable[..., Any])


class DefaultGroup(click.Group):
    """A group that runs the command `default` if no subcommand is named."""

    def __init__(self, *args: Any, default: str, **more: Any) -> None:
        super().__init__(*args, **more)
        self.default = default

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        named = args and (not args[0].startswith("-") or args[0] in self.get_help_option_names(ctx))
        return super().parse_args(ctx, args if named else [self.default, *args])


def rrd_option(*names: str, what: str = " with plots") -> Callable[[F], F]:
    """`--rrd FILE`; `check_rrd` checks it."""
    return click.option(
        "--rrd",
        *names,
        "rrd",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help=f"Also write a Rerun recording{what}; open it with `zscout view FILE`.",
    )


def check_rrd(rrd: Path | None, *, writable: bool = True) -> None:
    """Check the option before the work begins; with `writable` also that the file can be written. Raises BadInput."""
    if rrd is None:
        return
    if rrd.suffix != ".rrd":
        raise BadInput(f"--rrd {rrd}: not the name of a recording; end it in .rrd")
    try:
        if writable:
            rrd.open("ab").close()
    except OSError as error:
        raise BadInput(f"--rrd {rrd}: can't be written ({error.strerror}); choose an existing folder") from None
