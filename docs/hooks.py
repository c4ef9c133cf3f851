"""The hook of mkdocs that builds the command reference from the help of each command."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import click

from zscout import node
from zscout.cli import main

WIDTH = 80
"""Columns that a block of text has on a page."""


def helps(command: click.Command, parent: click.Context | None, name: str) -> Iterator[tuple[str, str]]:
    """The full name of a command and of each below it, with what `--help` prints."""
    settings = command.context_settings | {"terminal_width": WIDTH, "max_content_width": WIDTH}
    context = click.Context(command, parent, name, **settings)
    yield context.command_path, command.get_help(context)
    if isinstance(command, click.Group):
        for below in command.list_commands(context):
            if (found := command.get_command(context, below)) is not None and not found.hidden:
                yield from helps(found, context, below)


def block(text: str) -> str:
    return f"```text\n{text}\n```\n"


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    if page.file.src_uri != "reference/commands.md":
        return markdown
    every = [f"## {name}\n\n{block(text)}" for name, text in helps(main.main, None, "zscout")]
    (_, text), *_ = helps(node.main, None, "zscout-node")
    return markdown.replace("<!-- commands -->", "\n".join(every)).replace("<!-- node -->", block(text))
