"""The path of a grant: the modules that execute from `zscout request robot/x -- true` to its body, hop by hop.

One node leads, another runs the RC. Profilers in both and in the command record every call in their main threads;
Zenoh's threads only put arriving data into the inbox. Calls that also occur without requests (heartbeats, timers) are
left out. Messages are structs without functions, so the modules that define them don't appear.
"""

from __future__ import annotations

import asyncio
import json
import signal
import sys
import tempfile
from pathlib import Path

from benchmarks.grant_trace import Call
from tests.hang import HANG
from tests.live.lab import Lab

RC = "robot/x"
IDLE = 3.0
"""Seconds before the request in which calls don't count as part of a grant."""
MS = 1_000_000
ASKING = ("zscout.behaviors.client.rcm_link", "RcmLink.ask")
"""The call with which the request leaves the client."""


async def trace(folder: Path) -> dict[str, list[Call]]:
    """Record the calls in each of the three processes."""
    hook, traces = folder / "hook", folder / "traces"
    hook.mkdir()
    traces.mkdir()
    (hook / "sitecustomize.py").write_text(
        f"from pathlib import Path\nfrom benchmarks.grant_trace import install\ninstall(Path({str(traces)!r}))\n"
    )
    async with Lab(folder, candidates=["lead"]) as lab:
        lab.env = lab.env | {"PYTHONPATH": f"{hook}:{Path(__file__).parents[1]}"}
        quiet = "load = false"
        sides = {"leader": lab.node("lead", extra=quiet), "RC": lab.node("device", RC, extra=quiet)}
        client = await lab.client("watching")
        await lab.ready(client, RC)
        await client.close()
        lab.clients.clear()
        await asyncio.sleep(IDLE)
        zscout = str(Path(sys.executable).with_name("zscout"))
        command = lab.spawn([zscout, "request", RC, "--", "true"], log="client.log")
        code = await asyncio.to_thread(command.wait, HANG)
        assert code == 0, lab.log("client")
        for node in sides.values():
            node.send_signal(signal.SIGTERM)
            await asyncio.to_thread(node.wait, HANG)
        sides = {"client": command, **sides}
        return {side: json.loads((traces / f"{process.pid}.json").read_text()) for side, process in sides.items()}


def path(calls: dict[str, list[Call]]) -> list[tuple[float, str, str, str]]:
    """Return each module once per side, in order of time: ms since the request left, side, module, and its first
    function."""
    start = next(at for at, *where in calls["client"] if tuple(where) == ASKING)
    end = calls["client"][-1][0]
    found = []
    for side, some in calls.items():
        idle = {(module, name) for at, module, name in some if side != "client" and start - IDLE * 1e9 < at < start}
        seen = set()
        for at, module, name in some:
            if start <= at < end and (module, name) not in idle and module not in seen:
                seen.add(module)
                found.append(((at - start) / MS, side, module, name))
    return sorted(found)


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="zscout-path-") as name:
        calls = asyncio.run(trace(Path(name)))
    hops = path(calls)
    for at, side, module, function in hops:
        print(f"{at:7.1f} ms  {side:7}{module.removeprefix('zscout.').replace('.', '/') + '.py':46} {function}")
    before = {module for at, module, _ in calls["client"]} - {"", *(module for _, _, module, _ in hops)}
    print(f"{len({module for _, _, module, _ in hops})} modules from the query to the body")
    print(f"{len(before)} more in the command before its query: {', '.join(sorted(before))}")


if __name__ == "__main__":
    main()
