"""`zscout completion`: the script that makes a shell complete `zscout`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import click
from click.shell_completion import get_completion_class

SHELLS: Final = ("bash", "zsh", "fish")


@click.command()
@click.argument("shell", required=False, type=click.Choice(SHELLS))
@click.pass_context
def completion(ctx: click.Context, shell: str | None) -> None:
    """Print the completion script for a shell; without SHELL, for the one in $SHELL.

    \b
    Examples:
      zscout completion bash > ~/.local/share/bash-completion/completions/zscout
      zscout completion zsh > ~/.zfunc/_zscout
      zscout completion fish > ~/.config/fish/completions/zscout.fish
    """
    name = shell or Path(os.environ.get("SHELL", "")).name
    found = get_completion_class(name) if name in SHELLS else None
    if found is None:
        raise click.UsageError(
            f"$SHELL names no shell that is known here; write one of {', '.join(SHELLS)}", ctx
        )
    click.echo(found(ctx.find_root().command, {}, "zscout", "_ZSCOUT_COMPLETE").source())
