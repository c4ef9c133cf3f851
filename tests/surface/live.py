"""What commands print for programs on a mesh: each field of `--json`, and what stands in it.

    python -m tests.surface.live           plays the story once and says what is not as recorded
    python -m tests.surface.live --record  writes `live.json` from ten runs

A field is recorded with its values where these are the same in each run, numbers and random names aside. What
not every run has may be missing. What commands print for people is not recorded.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Final, Self

from tests.cli.tools import end
from tests.hang import HANG
from tests.ports import free_port
from tests.surface.commands import plain, printed, scripts
from tests.surface.compare import SEPARATOR, Difference
from tests.surface.record import text as as_text
from tests.surface.tree import PROJECT

RECORDED: Final = Path(__file__).with_name("live.json")
RUNS: Final = 10
SECTION: Final = "live"

Shape = dict[str, set[str]]
"""Values or types by the path of a field."""


def _anything(_: str) -> bool:
    return True


class Story:
    """Two nodes, programs that ask for devices, an operator, and a component that moves."""

    def __init__(self) -> None:
        self.shown: dict[str, Shape] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._stack.enter_context(plain(ZSCOUT_HOST="desk", LOGNAME="root"))
        self.folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory()))
        address = f'"tcp/127.0.0.1:{free_port()}"'
        name = f"surface-{os.getpid()}"
        # No lease is to end, and no vote to be late, where a process does not run for a while.
        self._file(
            "fleet",
            f'[fleet]\nname = "{name}"\n[mesh]\nmulticast = false\nlease = 10\nconnect = [{address}]\n'
            "[timing]\nhold_lease = 30\nrebuild = 2\nvote_timeout = 2\n",
        )
        self._file(
            "anvil",
            f'[node]\nhost = "anvil"\nfleet = "fleet.toml"\n[mesh]\nlisten = [{address}]\nconnect = []\n'
            '[[rc]]\nname = "robot/a"\ndriver = "exclusive"\n'
            '[[rc]]\nname = "radio/rf0"\ndriver = "capacity"\ncapacity = { rate = 10 }\n',
        )
        self._file("bellows", '[node]\nhost = "bellows"\nfleet = "fleet.toml"\ncandidate = false\n')
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def play(self) -> dict[str, Shape]:
        for host in ("anvil", "bellows"):
            self.start("zscout-node", str(self.folder / f"{host}.toml"))
        self._until(lambda state: len(state["rcs"]) == 2 and _reported(state) == {"anvil", "bellows"})
        self._requests()
        self._components()
        return self.shown

    def _requests(self) -> None:
        holder = self._ask("holder", "request", "robot/a", "--min-runtime", "300", "--json")
        holder.until("granted")
        waiter = self._ask("waiter", "request", "robot/a", "radio/rf0:rate=1", "--json")
        waiter.until("waits")
        for words in ("status", "why waiter", "why holder", "request robot/a --dry-run"):
            self.call(*words.split())
        # A command that has just joined hears of one host after the other.
        self.call("keys", until=_whole)
        taker = self._ask("taker", "take", "robot/a", "--yes", "--json")
        taker.until("granted")
        holder.end(self)
        self.call("cancel", "waiter")
        waiter.end(self)
        self.call("release", "taker")
        taker.end(self)
        script = 'env | sed -n \'s/^\\(ZSCOUT_[A-Z_]*\\)=.*/{"variable": "\\1"}/p\'; exit 7'
        job = self._ask("job", "request", "radio/rf0:rate=1", "--", "sh", "-c", script)
        job.end(self)

    def _components(self) -> None:
        self.call("components", "--kinds")
        self.call("start", "counter", "--host", "anvil", "--host", "bellows")
        host = self.call("components", until=_measured)["components"][0]["host"]
        other = ({"anvil", "bellows"} - {host}).pop()
        self.call("migrate", "counter", "--to", other)
        self.call("drain", other)
        self.call("uncordon", other)
        self.call("stop", "counter")

    # Running commands

    def _file(self, name: str, text: str) -> None:
        (self.folder / f"{name}.toml").write_text(text)

    def start(self, script: str, *words: str, out: int | None = subprocess.DEVNULL) -> subprocess.Popen[str]:
        """A process of the project that is ended with the story."""
        module, _, name = PROJECT["scripts"][script].partition(":")
        code = f"from {module} import {name}; {name}()"
        process = subprocess.Popen(
            [sys.executable, "-c", code, *words],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=self.folder,
        )
        self._stack.callback(end, process)
        return process

    def _ask(self, name: str, command: str, *words: str) -> Program:
        """A request by an ARC of this name."""
        line = ("--fleet", str(self.folder / "fleet.toml"), command, "--name", name, *words)
        process = self.start("zscout", *line, out=subprocess.PIPE)
        # Nothing that it waits for takes so long: its end is seen where its lines are read.
        limit = threading.Timer(2 * HANG, process.kill)
        limit.start()
        self._stack.callback(limit.cancel)
        return Program(name, process)

    def _say(self, *words: str, until: Callable[[str], bool] = _anything) -> tuple[int, str]:
        """Runs a command here until what it prints is so; returns its exit code and that."""
        end = time.monotonic() + HANG
        while True:
            told = printed("zscout", scripts()["zscout"], ["--fleet", str(self.folder / "fleet.toml"), *words])
            # What went wrong, where nothing was printed.
            code, out = int(told["exit"]), "\n".join(told.get("out", told.get("err", [])))
            if until(out):
                return code, out
            assert time.monotonic() < end, f"{words} printed in vain; last {out}"

    def call(self, *words: str, until: Callable[[str], bool] = _anything) -> Any:
        """Runs a command here and notes the JSON that it prints; returns it."""
        code, out = self._say(*words, "--json", until=until)
        assert out.startswith("{"), f"{words} with exit code {code}: {out}"
        found = json.loads(out)
        # Which host is drained may differ.
        self.note(words[0] if words[0] in ("drain", "uncordon", "migrate") else " ".join(words), [found], code)
        return found

    def note(self, name: str, printed: Sequence[Any], code: int) -> None:
        shape = self.shown.setdefault(name, {"exit code": {str(code)}})
        for one in printed:
            # The lines of a request differ by their event.
            top = f"{one['event']} " if isinstance(one, dict) and "event" in one else ""
            for path, leaf in _leaves(one, top):
                shape.setdefault(path, set()).add(leaf)

    def _until(self, come: Callable[[Any], bool]) -> None:
        self._say("status", "--json", until=lambda out: out.startswith("{") and come(json.loads(out)))


class Program:
    """A request that goes on, and the lines that it prints."""

    def __init__(self, name: str, process: subprocess.Popen[str]) -> None:
        self._name, self._process = name, process
        self._lines: list[Any] = []
        assert process.stdout is not None
        self._out: IO[str] = process.stdout

    def until(self, event: str) -> None:
        for line in self._out:
            self._lines.append(json.loads(line))
            if self._lines[-1]["event"] == event:
                return
        raise AssertionError(f"{self._name} ended without {event}: {self._lines}")

    def end(self, story: Story) -> None:
        """Reads what comes until it ends."""
        self._lines += map(json.loads, self._out)
        story.note(self._name, self._lines, self._process.wait(HANG))


def _reported(state: Any) -> set[str]:
    return {host["host"] for host in state["hosts"] if host.get("load")}


def _measured(out: str) -> bool:
    """Whether its host has reported that it can be moved, and in a load report what it uses."""
    shown = json.loads(out)["components"] if out.startswith("{") else []
    return bool(shown) and all(one["cpu"] is not None and one["movable"] for one in shown)


def _whole(keys: str) -> bool:
    """Whether each host's keys are listed: those of its node, and of what reports its load."""
    return all(f"host/{host}/{key}" in keys for host in ("anvil", "bellows") for key in ("component", "load"))


def masked(text: str) -> str:
    """Without numbers and random names; spans of time and sizes in one unit each."""
    text = re.sub(r"\b[0-9a-f]{12,32}\b|[0-9]+([.,][0-9]+)*", "#", text)
    text = re.sub(r"# (d|h|min)\b( # (h|min|s)\b)?", "# s", text)
    return text.replace("GiB", "MiB").replace("# GB", "# MB")


def _leaves(value: Any, path: str) -> Iterator[tuple[str, str]]:
    if isinstance(value, dict):
        for name, one in value.items():
            yield from _leaves(one, f"{path}.{name}")
    elif isinstance(value, list):
        for one in value:
            yield from _leaves(one, f"{path}[]")
    elif isinstance(value, str):
        yield path, masked(value)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield path, "a number"
    else:
        yield path, json.dumps(value)


# Comparing


def recorded(runs: Sequence[Mapping[str, Shape]]) -> dict[str, Any]:
    """By command and field: values where each run has the same, None where they differ; and whether each run
    has the field."""
    names = {name for run in runs for name in run}
    return {name: dict(_merged([run[name] for run in runs])) for name in sorted(names)}


def _merged(shapes: Sequence[Shape]) -> Iterator[tuple[str, Any]]:
    for path in sorted({path for shape in shapes for path in shape}):
        found = [shape[path] for shape in shapes if path in shape]
        always = {} if len(found) == len(shapes) else {"always": False}
        same = {"values": sorted(found[0])} if all(one == found[0] for one in found) else {}
        yield path, same | always


def differences(before: Mapping[str, Any], now: Mapping[str, Shape]) -> list[Difference]:
    """What is not as it was."""
    found: list[Difference] = []
    for name in sorted(before.keys() | now.keys()):
        was, shape = before.get(name, {}), now.get(name, {})
        for path in sorted(was.keys() | shape.keys()):
            where = SEPARATOR.join((SECTION, name, path))
            values = sorted(shape[path]) if path in shape else None
            if path not in was:
                found.append(Difference(where, None, values))
            elif values is None:
                if was[path].get("always", True):
                    found.append(Difference(where, was[path].get("values", "anything"), None))
            elif was[path].get("values", values) != values:
                found.append(Difference(where, was[path]["values"], values))
    return found


def play() -> dict[str, Shape]:
    with Story() as story:
        return story.play()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.surface.live", description=__doc__)
    parser.add_argument("--record", action="store_true")
    if parser.parse_args().record:
        RECORDED.write_text(as_text(recorded([play() for _ in range(RUNS)])) + "\n")
        return 0
    found = differences(json.loads(RECORDED.read_text()), play())
    print("\n".join(map(str, found)) or "All as recorded.")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
