"""Examples in --help: each parses."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Iterator

import click

from zscout import node
from zscout.cli.main import main

OPERATORS = {"|", "&&", "&", ";"}


def commands(command: click.Command, *path: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    yield path, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None
            if not found.hidden:
                yield from commands(found, *path, name)


def examples() -> dict[str, list[list[str]]]:
    """Each example, and the words of the programs of ours that are started in it."""
    found = {}
    for path, command in (*commands(main, "zscout"), (("zscout-node",), node.main)):
        _, _, text = (command.help or "").partition("Example")
        lines = [line.strip() for line in text.splitlines() if line.strip().startswith("zscout")]
        assert lines, f"{' '.join(path)} has no example"
        for line in lines:
            lexer = shlex.shlex(line, posix=True, punctuation_chars="|&;>")
            lexer.whitespace_split = True
            programs: list[list[str]] = [[]]
            for word in lexer:
                if word in OPERATORS:
                    programs.append([])
                else:
                    programs[-1].append(word)
            found[line] = [words for words in programs if words[0] in ("zscout", "zscout-node")]
    return found


EXAMPLES = examples()


def parse(command: click.Command, name: str, args: list[str], parent: click.Context | None = None) -> None:
    try:
        context = command.make_context(name, list(args), parent=parent)
    except click.exceptions.Exit:  # --help
        return
    if isinstance(command, click.Group) and (rest := [*context._protected_args, *context.args]):
        sub_name, sub, sub_args = command.resolve_command(context, rest)
        assert sub is not None
        parse(sub, sub_name or "", sub_args, context)


def test_all_commands_are_walked() -> None:
    assert {line.split()[1] for line in EXAMPLES if line.startswith("zscout ")} >= main.table.keys()
    assert "zscout-node" in EXAMPLES
    for program, *words in itertools.chain.from_iterable(EXAMPLES.values()):
        args = words[: words.index(">")] if ">" in words else words
        parse(node.main if program == "zscout-node" else main, program, args)
