"""Hosts with interfaces that come and go: the time until the fleet is whole again, and the disturbed holds.

    python -m studies interfaces --cycles 20 --way connect      (needs root, network namespaces, iproute2)

A program on each of two hosts holds a device of its own host. Host a, which leads, has its address changed, starts
before its cable is plugged in, gets another interface, or loses all and gets them back. A hold whose holder and device
are on the leader's host need not be lost. Exit code 0: no such hold was lost; 1: one was; 2: it can't run here."""

from __future__ import annotations

import argparse
import asyncio
import itertools
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Collection, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final, Literal, NamedTuple, Self, TypeAlias

from studies.chaos import net
from studies.sites import Program, present
from tests.live.closed import make_keys

HOSTS: Final = {"a": "lan", "b": "lan", "d": "other"}
"""The network of each host. Hosts with a second interface in the network of d see it."""
CANDIDATES: Final = ("a", "b")
Change: TypeAlias = Literal["address", "cable", "added", "gone"]
CHANGES: Final[tuple[Change, ...]] = ("added", "address", "cable", "gone")
"""In this order, because a leads at first, and a leader on host b would not see d."""
Way: TypeAlias = Literal["multicast", "connect"]
DOWN: Final = 6.0
"""Seconds without a network: the other host leads by then."""
ROLES: Final = """
[security]
folder = "keys/ada"
[roles]
manager = ["a", "b"]
operator = ["ada"]
[roles.node]
a = ["cam/a"]
b = ["cam/b"]
d = ["cam/d"]
"""


class Net:
    """Two networks, and a host on each or both."""

    def __init__(self) -> None:
        self.mark = f"{net.PREFIX}{os.getpid()}"
        self._numbers = itertools.count(10)
        self.addresses = {host: f"10.{85 if lan == 'lan' else 86}.0.{ord(host)}" for host, lan in HOSTS.items()}

    def space(self, host: str) -> str:
        return f"{self.mark}-{host}"

    def on(self, host: str, *words: str) -> None:
        net.ip("-n", self.space(host), *words)

    def open(self) -> None:
        net.remove_leftovers()
        for space in (*HOSTS, *sorted(set(HOSTS.values()))):
            net.ip("netns", "add", self.space(space))
            self.on(space, "link", "set", "lo", "up")
        for lan in sorted(set(HOSTS.values())):
            self.on(lan, "link", "add", "lan", "type", "bridge", "mcast_snooping", "0")
            self.on(lan, "link", "set", "lan", "up")
        for host, lan in HOSTS.items():
            self.plug(host, "eth0", lan)
            self.name(host, "eth0", self.addresses[host])

    def plug(self, host: str, card: str, lan: str) -> None:
        """Add an interface with its cable to a host."""
        inner = ("peer", "name", card, "netns", self.space(host))
        self.on(lan, "link", "add", f"{host}{card}", "type", "veth", *inner)
        self.on(lan, "link", "set", f"{host}{card}", "master", "lan", "up")
        self.on(host, "link", "set", card, "up")

    def cable(self, host: str, state: Literal["up", "down"]) -> None:
        self.on(HOSTS[host], "link", "set", f"{host}eth0", state)

    def name(self, host: str, card: str, address: str) -> None:
        self.on(host, "addr", "add", f"{address}/24", "dev", card)
        self.on(host, "route", "replace", "224.0.0.0/4", "dev", card)

    def rename(self, host: str) -> None:
        old = self.addresses[host]
        self.addresses[host] = new = f"{old.rpartition('.')[0]}.{next(self._numbers)}"
        self.on(host, "addr", "del", f"{old}/24", "dev", "eth0")
        self.name(host, "eth0", new)

    def close(self) -> None:
        net.remove(self.mark)


class Fleet:
    """Nodes on these hosts, and a program beside two of them. Use as an async context manager."""

    def __init__(self, folder: Path, way: Way, *, secured: bool = False) -> None:
        self.folder, self.net, self.secured = folder, Net(), secured
        self.processes = net.Processes(self.net, folder)
        self.programs: dict[str, Program] = {}
        protocol = "tls" if secured else "tcp"
        mesh = ""
        if way == "connect":
            named = ", ".join(f'"{protocol}/{address}:7447"' for address in self.net.addresses.values())
            mesh = f"multicast = false\nconnect = [{named}]\n"
        if secured:
            make_keys(folder / "keys", "ada", *HOSTS, managers=CANDIDATES)
        (folder / "fleet.toml").write_text(
            f'[fleet]\nname = "interfaces-{self.net.mark}"\ncandidates = ["a", "b"]\n[mesh]\n{mesh}' + ROLES * secured
        )
        for host in HOSTS:
            text = f'[node]\nhost = "{host}"\nfleet = "fleet.toml"\nstate = "state-{host}"\n'
            text += f'[[rc]]\nname = "cam/{host}"\ndriver = "exclusive"\n'
            text += f'[security]\nfolder = "keys/{host}"\n' * secured
            if way == "connect":
                text += f'[mesh]\nlisten = ["{protocol}/0.0.0.0:7447"]\n'
            (folder / f"{host}.toml").write_text(text)

    async def __aenter__(self) -> Self:
        try:
            self.net.open()
            for host in CANDIDATES:
                self.node(host)
                await self.begins(host)
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def __aexit__(self, *exc: object) -> None:
        for program in self.programs.values():
            program.kill()
        await asyncio.gather(*(program.process.wait() for program in self.programs.values()))
        await asyncio.to_thread(self.processes.close)
        self.net.close()

    def node(self, host: str) -> None:
        self.processes.start(host, [sys.executable, "-m", "zscout.node", str(self.folder / f"{host}.toml")])

    async def begins(self, host: str) -> None:
        """Start the program of a host, which holds the device of its host."""
        env = {name: value for name, value in os.environ.items() if not name.startswith("ZSCOUT_")}
        with (self.folder / f"program-{host}.log").open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                *("ip", "netns", "exec", self.net.space(host), sys.executable, "-m", "tests.live.holder"),
                *(f"program-{host}", *(() if self.secured else (host,))),
                env=env | {"ZSCOUT_FLEET": str(self.folder / "fleet.toml")},
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=log,
            )
        program = self.programs[host] = Program(f"program-{host}", process)
        program.site = host
        await program.event("up")
        await program.works(program.name, f"cam/{host}")

    async def ends(self, host: str) -> None:
        program = self.programs.pop(host)
        program.kill()
        await program.process.wait()
        await asyncio.to_thread(self.processes.kill, host)

    async def whole(self, rcs: Collection[str], hosts: Sequence[str] = CANDIDATES, within: float = 30.0) -> str:
        """Wait until the programs of these hosts see the same leader with these devices. Return the leader's host."""
        async with asyncio.timeout(within):
            while True:
                states = await asyncio.gather(*(self.programs[host].state() for host in hosts))
                seen = {state.term: present(state) for state in states if state is not None}
                if (
                    None not in states
                    and len(seen) == 1
                    and states[0] is not None
                    and all(set(rcs) <= there for there in seen.values())
                ):
                    return states[0].host
                await asyncio.sleep(0.05)


class Cycle(NamedTuple):
    change: Change
    took: float
    """Seconds from the last change of the network until the fleet was whole."""
    trouble: list[dict[str, Any]]
    needless: bool
    """The hold of a program beside the leader was lost."""


async def cycle(fleet: Fleet, change: Change) -> Cycle:
    """A change at host a, from a whole fleet to a whole fleet."""
    rcs, hosts = {"cam/a", "cam/b"}, list(CANDIDATES)
    leads = "" if change == "added" else await fleet.whole(rcs)
    match change:
        case "address":
            fleet.net.rename("a")
        case "gone":
            fleet.net.on("a", "link", "set", "eth0", "down")
            fleet.net.on("a", "addr", "flush", "dev", "eth0")
            await asyncio.sleep(DOWN)
            fleet.net.on("a", "link", "set", "eth0", "up")
            fleet.net.name("a", "eth0", fleet.net.addresses["a"])
        case "cable":
            await fleet.ends("a")
            fleet.net.cable("a", "down")
            fleet.net.on("a", "addr", "flush", "dev", "eth0")
            fleet.node("a")
            await fleet.begins("a")
            await asyncio.sleep(DOWN / 2)
            leads = "ab"  # each is alone
            fleet.net.cable("a", "up")
            fleet.net.name("a", "eth0", fleet.net.addresses["a"])
        case "added":
            rcs, hosts = {*rcs, "cam/d"}, ["a"]
            if "d" not in fleet.processes.running:
                fleet.node("d")
                await asyncio.sleep(DOWN)
            fleet.net.plug("a", "eth1", HOSTS["d"])
            fleet.net.on("a", "addr", "add", "10.86.0.97/24", "dev", "eth1")
    changed = time.monotonic()
    await fleet.whole(rcs, hosts)
    took = time.monotonic() - changed
    trouble = [
        {"host": host, **event} for host, program in fleet.programs.items() for event in await program.works_on()
    ]
    if change == "added":
        fleet.net.on("a", "link", "del", "eth1")
    await asyncio.sleep(DOWN / 2)
    needless = any(event["host"] in (leads or "ab") for event in trouble)
    for host in {event["host"] for event in trouble}:
        program = fleet.programs.pop(host)
        program.kill()
        await program.process.wait()
        await fleet.begins(host)
    return Cycle(change, took, trouble, needless)


async def measure(asked: argparse.Namespace, folder: Path) -> bool:
    """Print the results. Return True if no hold beside its leader was lost."""
    found: list[Cycle] = []
    async with Fleet(folder, asked.way, secured=asked.secured) as fleet:
        await fleet.whole({"cam/a", "cam/b"})
        for change in asked.only or CHANGES:
            for number in range(asked.cycles):
                result = await cycle(fleet, change)
                found.append(result)
                what = f"LOST: {result.trouble}" if result.trouble else "no hold lost"
                print(
                    f"{asked.way:9}  {change:7}  {number + 1:3}  whole after {result.took:5.2f} s, {what}", flush=True
                )
    for change in asked.only or CHANGES:
        took = [result.took for result in found if result.change == change]
        print(f"{asked.way} {change}: median {median(took):.2f} s, at most {max(took):.2f} s ({len(took)})")
    needless = sum(result.needless for result in found)
    print(f"{asked.way}: {needless} of {len(found)} cycles cost a hold beside its leader")
    return not needless


def main() -> int:
    options = argparse.ArgumentParser(prog="python -m studies interfaces", description=__doc__.partition("\n\n")[0])
    options.add_argument("--cycles", type=int, default=20, help="of each change (20)")
    options.add_argument("--way", choices=["multicast", "connect"], default="multicast", help="how hosts meet")
    options.add_argument("--only", nargs="+", choices=CHANGES, help="these changes only")
    options.add_argument("--secured", action="store_true", help="with certificates and roles")
    asked = options.parse_args()
    try:
        net.check()
    except net.NoNamespaces as error:
        print(f"interfaces: {error}", file=sys.stderr)
        return 2
    net.end_on_signals()
    folder = Path(tempfile.mkdtemp(prefix="zscout-interfaces-"))
    well = asyncio.run(measure(asked, folder))
    print(f"{os.cpu_count()} cores, load average {os.getloadavg()[0]:.2f}")
    if not well:
        print(f"logs are in {folder}", file=sys.stderr)
        return 1
    shutil.rmtree(folder, ignore_errors=True)
    return 0
