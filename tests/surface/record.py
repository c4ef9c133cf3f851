"""Writes what programs and people see of zscout, as one JSON text, into `surface.json` beside this. Its difference
in a commit is what that commit changes for them: read it before you commit it.

    python -m tests.surface.record
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from tests.surface import commands, files, interfaces
from tests.surface.compare import SEPARATOR

RECORDED: Final = Path(__file__).with_name("surface.json")
SECTIONS: Final[Mapping[str, Callable[[], Any]]] = {
    "commands": commands.commands, "exit codes": interfaces.exit_codes,
    "environment variables": interfaces.variables, "files": files.files, "components": interfaces.components,
    "python": interfaces.python, "keys": interfaces.keys, "messages": interfaces.wire,
}  # fmt: skip
WIDTH: Final = 110


def text(value: Any, indent: int = 0, before: int = 0) -> str:
    """JSON with what fits on one line there. `before`: columns that are written on this line already."""
    line = json.dumps(value, ensure_ascii=False)
    if not isinstance(value, (dict, list)) or indent + before + len(line) < WIDTH:
        return line
    pad = " " * (indent + 1)
    if isinstance(value, list):
        parts = [pad + text(one, indent + 1) for one in value]
        return "[\n" + ",\n".join(parts) + "\n" + " " * indent + "]"
    names = [json.dumps(name, ensure_ascii=False) + ": " for name in value]
    parts = [pad + name + text(one, indent + 1, len(name)) for name, one in zip(names, value.values(), strict=True)]
    return "{\n" + ",\n".join(parts) + "\n" + " " * indent + "}"


def flat(value: Any, path: str) -> Iterator[tuple[str, object]]:
    """Everything in a recorded value by its path. Texts in a list count by themselves, in whatever order."""
    if isinstance(value, dict) and value:
        for name, one in value.items():
            yield from flat(one, f"{path}{SEPARATOR}{name}")
    elif isinstance(value, list) and value:
        for number, one in enumerate(value):
            if isinstance(one, str):
                yield f"{path}{SEPARATOR}{one}", True
            else:
                yield from flat(one, f"{path}{SEPARATOR}{number}")
    else:
        yield path, "null" if value is None else value


def main() -> None:
    RECORDED.write_text(text({name: collect() for name, collect in SECTIONS.items()}) + "\n")


if __name__ == "__main__":
    main()
