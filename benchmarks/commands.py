"""`python -m benchmarks.commands`: duration of commands from start to exit, compared with their bare Zenoh queries.

A bare query is a Python program that only joins the mesh as a plain Zenoh peer, sends the queries of the command, and
leaves. Commands and bare queries are run in turn, so that both find the machine in the same state."""

from __future__ import annotations

import argparse
import asyncio
import os
import subprocess
import sys
import tempfile
import time
from decimal import Decimal
from pathlib import Path

from benchmarks.loop import run
from benchmarks.stats import Row, Samples, table
from tests.live.lab import Lab
from zscout import messages
from zscout.keyexpr import Keys, Sender
from zscout.messages import Ask, Release, StateAsk

STATUS_AIM = 0.3
"""Seconds."""
BARE = """
import secrets, sys, time, zenoh
address, *queries = sys.argv[1:]
config = zenoh.Config()
for key, value in {"mode": "peer", "scouting/multicast/address": address, "scouting/multicast/interface": "lo"}.items():
    config.insert_json5(key, f'"{value}"')
until = time.monotonic() + 20
with zenoh.open(config) as session:
    own = secrets.token_hex(6)
    for key, payload in zip(queries[::2], queries[1::2]):
        payload = payload.replace("bare-request", own)
        while not [reply for reply in session.get(key, payload=payload.encode(), timeout=5.0) if reply.ok or reply.err]:
            if time.monotonic() > until:
                sys.exit(f"no answer on {key}")
"""


MODULES = """
import contextlib, io, sys
before = set(sys.modules)
from zscout.cli.main import main
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main(["status"], standalone_mode=False)
print(*(name for name in sys.modules if name not in before and all(map(str.isidentifier, name.split(".")))))
"""
"""Prints the modules that `zscout status` imports, in order."""


def text_of(message: object) -> str:
    return messages.encode(message).decode()  # type: ignore[arg-type]


async def measure(rounds: int) -> list[Row]:
    with tempfile.TemporaryDirectory(prefix="zscout-bench-") as name:
        async with Lab(Path(name)) as lab:
            lab.node("anvil", "robot/a", "robot/b", "radio/rf0:rate=10")
            client = await lab.client("bench")
            await lab.ready(client, "robot/a", "robot/b", "radio/rf0")
            held = await client.request("survey", {"robot/a": {}}, min_runtime=3600)
            # With bytecode, like an installed zscout.
            env = {key: value for key, value in lab.env.items() if key != "PYTHONDONTWRITEBYTECODE"}
            env |= {"PYTHONPYCACHEPREFIX": f"{name}/bytecode", "PYTHONPATH": os.pathsep.join(sys.path)}
            rows = await asyncio.to_thread(in_turn, commands_of(lab), env, rounds)
            rows += await asyncio.to_thread(parts_of_status, env, rounds)
            await client.end(held)
            return rows


def commands_of(lab: Lab) -> dict[str, tuple[list[str], list[str]]]:
    """Return by name each command and its bare query."""
    keys, address = Keys(lab.fleet.name), lab.fleet.mesh.multicast_address
    zscout = [sys.executable, "-m", "zscout.cli.main"]
    bare = [sys.executable, "-c", BARE, address]
    schedule = keys.schedule(Sender("test", "bare"))
    asked = Ask("bare-request", "bare", {"robot/b": {}}, 0, Decimal(60))
    request = [schedule, text_of(asked), schedule, text_of(Release(id="bare-request"))]
    return {
        "status": ([*zscout, "status"], [*bare, keys.rcm_state, text_of(StateAsk(forecast=True))]),
        "why": ([*zscout, "why", "survey"], [*bare, keys.rcm_state, text_of(StateAsk(arc="survey", forecast=True))]),
        "request": ([*zscout, "request", "robot/b", "--", "true"], [*bare, *request]),
    }


def in_turn(commands: dict[str, tuple[list[str], list[str]]], env: dict[str, str], rounds: int) -> list[Row]:
    """The first round only warms up."""
    samples = {name: (Samples(), Samples()) for name in commands}
    for number in range(-1, rounds):
        for name, both in commands.items():
            for command, found in zip(both, samples[name], strict=True):
                start = time.perf_counter()
                done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
                took = time.perf_counter() - start
                if done.returncode:
                    raise RuntimeError(f"{name} ended with {done.returncode}: {done.stderr}")
                if number >= 0:
                    found.add(took)
    rows = []
    for name, (whole, bare) in samples.items():
        rows.append(Row(f"bare query of {name}, start to exit", bare.median, "s", bare.p99, rounds=rounds))
        ratio = f"{whole.median / bare.median:.1f} x its bare query"
        aim = STATUS_AIM if name == "status" else None
        rows.append(Row(f"zscout {name} ({ratio})", whole.median, "s", whole.p99, aim=aim, rounds=rounds))
    return rows


def parts_of_status(env: dict[str, str], rounds: int) -> list[Row]:
    """Where the time of `zscout status` goes: Python itself, imports, and the rest, which is to join the mesh, to ask,
    to print and to leave. The first round only warms up."""
    status = [sys.executable, "-m", "zscout.cli.main", "status"]
    used = subprocess.run([sys.executable, "-c", MODULES], env=env, capture_output=True, text=True, check=True).stdout
    commands = {
        "Python": [sys.executable, "-c", "pass"],
        "imports": [sys.executable, "-c", f"import {', '.join(used.split())}"],
        "status": status,
    }
    samples = {name: Samples() for name in commands}
    for number in range(-1, rounds):
        for name, command in commands.items():
            start = time.perf_counter()
            subprocess.run(command, env=env, capture_output=True, check=True)
            if number >= 0:
                samples[name].add(time.perf_counter() - start)
    python, imports, whole = (samples[name].median for name in commands)
    parts = {"Python": python, "imports": imports - python, "joins, asks, prints, leaves": whole - imports}
    return [Row(f"zscout status: {name}", seconds, "s", rounds=rounds) for name, seconds in parts.items()]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.commands", description=__doc__)
    parser.add_argument("--rounds", type=int, default=15, help="runs of each command (default: 15)")
    args = parser.parse_args()
    if args.rounds < 1:
        parser.error("at least 1 round")
    print(table(run(measure(args.rounds))))
    print("\nMedians from start to exit, commands and bare queries in turn.")


if __name__ == "__main__":
    main()
