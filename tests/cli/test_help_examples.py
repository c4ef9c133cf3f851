"""Examples in --help: each parses, and names only files and commands that are there."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import click
import pytest

import zscout
from zscout import node
from zscout.cli.main import main

OPERATORS = {"|", "&&", "&", ";"}
OUTPUTS = {"--out", "--record", "--rrd", "--node"}
FILE = re.compile(r"^\.{0,2}/|\.(toml|rrd|py|sh|avi|mp4|txt|json|fish)$")
PACKAGE = Path(zscout.__file__).parent


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


def outputs(words: list[str]) -> list[str]:
    return [word for before, word in pairwise(words) if before in OUTPUTS or before == ">"]


MADE = {word for programs in EXAMPLES.values() for words in programs for word in outputs(words)}
"""Files that some example writes."""


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
    assert MADE, "some write files"


@pytest.mark.parametrize("line", list(EXAMPLES))
def test_an_example_parses_and_names_what_is_there(line: str) -> None:
    for program, *words in EXAMPLES[line]:
        made = outputs(words)
        args = words[: words.index(">")] if ">" in words else words
        parse(node.main if program == "zscout-node" else main, program, args)
        if "--" in args:
            name = args[args.index("--") + 1]
            assert shutil.which(name) is not None, f"there is no command {name}"
        for word in words:
            path = word.rpartition("=")[2]
            if path not in made and FILE.search(path) and not path.startswith("/dev/"):
                assert path in MADE or any(PACKAGE.rglob(path)), (
                    f"no {path} comes with zscout, and no example writes one"
                )
