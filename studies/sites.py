"""A fleet over two sites whose hosts reach each other only through a relay: its cost, and whether the relay's failure
and return disturb a hold inside a site.

    python -m studies sites --merges 20 --frozen 5 --cut 5      (needs root, network namespaces, iproute2)

Two programs hold and command devices of their own sites during all merges. Exit code 0: neither was disturbed; 1: one
was; 2: it can't run here."""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any, Final, Literal, NamedTuple, Self, TypeAlias

import msgspec

from studies.chaos import net
from tests.hang import HANG
from tests.live.closed import make_keys
from tests.live.lab import HolderProcess, awaited
from zscout.messages import RcmState
from zscout.types import Grant, Ns

SITES: Final = ("a", "b")
GATE: Final = "gate"
"""The relay."""
SPARE: Final = "spare"
"""The second relay, if there are two."""
GATES: Final = (GATE, SPARE)
NODES: Final = {
    "a1": ("robot/a1",),
    "a2": ("robot/a2", "robot/a3"),
    "b1": ("robot/b1",),
    "b2": ("robot/b2", "robot/b3"),
}
"""The hosts of both sites, with their RCs. The first host of each site may lead."""
ALL: Final = frozenset(rc for rcs in NODES.values() for rc in rcs)
Fault: TypeAlias = Literal["killed", "frozen", "cut"]
"""A fault of the relay. `cut`: of its line to site b."""
INSIDE, ACROSS = "inside", "across"
WARM_UP: Final = 20
ROLES: Final = """
[security]
folder = "keys"
[roles]
manager = ["a1", "b1"]
operator = ["ada"]
relay = ["gate"]
[roles.node]
a1 = ["robot/a1"]
a2 = ["robot/a2", "robot/a3"]
b1 = ["robot/b1"]
b2 = ["robot/b2", "robot/b3"]
"""


class SitesNet:
    """A network with a bridge for each site, and relay hosts that are in both networks and forward no packets."""

    def __init__(self) -> None:
        self.hosts = {site: [host for host in (*NODES, f"{site}desk") if host[0] == site] for site in SITES}
        self.mark = f"{net.PREFIX}{os.getpid()}"

    def space(self, host: str) -> str:
        return f"{self.mark}-{host}"

    def address(self, host: str, site: str) -> str:
        number = 1 + GATES.index(host) if host in GATES else 3 + self.hosts[site].index(host)
        return f"10.84.{SITES.index(site)}.{number}"

    def open(self) -> None:
        net.remove_leftovers()
        for host in (*GATES, *self.hosts["a"], *self.hosts["b"]):
            net.ip("netns", "add", self.space(host))
            net.ip("-n", self.space(host), "link", "set", "lo", "up")
        for number, site in enumerate(SITES):
            # The bridge has its own namespace, and is removed with it.
            lan = self.space(f"lan{site}")
            net.ip("netns", "add", lan)
            net.ip("-n", lan, "link", "add", "lan", "type", "bridge", "mcast_snooping", "0")
            net.ip("-n", lan, "link", "set", "lan", "up")
            for host in (*GATES, *self.hosts[site]):
                space, card = self.space(host), f"eth{number if host in GATES else 0}"
                net.ip("-n", lan, "link", "add", host, "type", "veth", "peer", "name", card, "netns", space)
                net.ip("-n", lan, "link", "set", host, "master", "lan", "up")
                net.ip("-n", space, "addr", "add", f"{self.address(host, site)}/24", "dev", card)
                net.ip("-n", space, "link", "set", card, "up")
                net.ip("-n", space, "route", "append", "224.0.0.0/4", "dev", card)

    def plug(self, site: str, state: Literal["up", "down"]) -> None:
        """Set the relay's cable to a site up or down."""
        net.ip("-n", self.space(f"lan{site}"), "link", "set", GATE, state)

    def close(self) -> None:
        net.remove(self.mark)


class Program(HolderProcess):
    """`tests/live/holder.py` at the desk of a site."""

    site: str
    grant: Grant
    """Its last grant."""
    beats: int
    """Number of obeyed commands between the last two calls of `trouble`."""

    async def trouble(self) -> list[dict[str, Any]]:
        """The events of a disturbance since the last call."""
        await self.order("beats")
        assert self.process.stdout is not None
        found, self.disturbed = self.disturbed, []
        async with asyncio.timeout(HANG):
            while line := await self.process.stdout.readline():
                event = json.loads(line)
                if event["event"] == "beats":
                    self.beats = event["beats"]
                    return found
                if event["event"] != "running" or msgspec.convert(event["grant"], Grant) != self.grant:
                    found.append(event)
        raise AssertionError(f"{self.name} ended; its events: {found}")

    async def works_on(self) -> list[dict[str, Any]]:
        """Wait until its RCs have obeyed once more. Return its trouble until then."""
        found = await self.trouble()
        self.beats = 0
        while not (found or self.beats):
            found = await self.trouble()
        return found

    async def state(self) -> RcmState | None:
        await self.order("state")
        return msgspec.convert((await self.event("state"))["state"], RcmState | None)

    async def asks(self, arc: str, *rcs: str) -> None:
        await self.order("ask", arc=arc, needs={rc: {} for rc in rcs}, min_runtime=600)

    async def enters(self) -> Ns:
        """Wait until it enters its hold. Return when it did."""
        entered = await self.event("entered")
        self.grant = msgspec.convert(entered["grant"], Grant)
        at: Ns = entered["at"]
        return at

    async def works(self, arc: str, *rcs: str) -> None:
        await self.asks(arc, *rcs)
        await self.enters()
        self.disturbed = []
        await self.order("work", rcs=rcs)

    async def gives_back(self) -> None:
        await self.order("end")
        await self.event("given_up")


class Sites:
    """The fleet: two nodes and a desk for programs in each site. Use as an async context manager."""

    def __init__(self, folder: Path, *, secured: bool = False, lease: float = 1.0, relays: int = 1) -> None:
        self.folder, self.net, self.secured = folder, SitesNet(), secured
        self.gates = GATES[:relays]
        self.processes = net.Processes(self.net, folder)
        self.programs: list[Program] = []
        self.log_level = "info"
        name = f"sites-{self.net.mark}"
        self._write(
            "gate", f'relay = ["a", "b"]\nlisten = ["{self._endpoint("[::]")}"]\ninterface = "eth0,eth1"', name, lease
        )
        for site in SITES:
            gates = ", ".join(f'"{self._endpoint(self.net.address(gate, site))}"' for gate in self.gates)
            self._write(site, f'site = "{site}"\nconnect = [{gates}]\ninterface = "eth0"', name, lease)
        if secured:
            make_keys(folder / "certificates", GATE, "ada", *NODES, managers=("a1", "b1"))
        for host in (*self.gates, *NODES):
            rcs = "".join(f'[[rc]]\nname = "{rc}"\ndriver = "exclusive"\n' for rc in NODES.get(host, ()))
            more = f'[security]\nfolder = "certificates/{host}"\n' if secured else ""
            site = "a"
            if host in GATES:
                listen = self._endpoint("[::]")
                more += f'[mesh]\nrelay = ["a", "b"]\nlisten = ["{listen}"]\nconnect = []\ninterface = "eth0,eth1"\n'
            else:
                site = host[0]
            text = f'[node]\nhost = "{host}"\nfleet = "{site}.fleet.toml"\n{rcs}{more}'
            (folder / f"{host}.toml").write_text(text)

    def _endpoint(self, address: str) -> str:
        return f"{'tls' if self.secured else 'tcp'}/{address}:7447"

    def _write(self, name: str, mesh: str, fleet: str, lease: float) -> None:
        roles = ROLES.replace('"keys"', '"certificates/ada"') if self.secured else ""
        (self.folder / f"{name}.fleet.toml").write_text(
            f'[fleet]\nname = "{fleet}"\ncandidates = ["a1", "b1"]\n[mesh]\nlease = {lease}\n{mesh}\n'
            f"[timing]\nhold_lease = {3 * lease}\nrebuild = {lease / 5}\n{roles}"
        )

    async def __aenter__(self) -> Self:
        try:
            self.net.open()
            for host in (*self.gates, *NODES):
                command = [sys.executable, "-m", "zscout.node", str(self.folder / f"{host}.toml")]
                command += ["--log-level", self.log_level]
                self.processes.start(host, command)
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def __aexit__(self, *exc: object) -> None:
        for program in self.programs:
            program.kill()
        await asyncio.gather(*(program.process.wait() for program in self.programs))
        await asyncio.to_thread(self.processes.close)
        self.net.close()

    def env(self, site: str) -> dict[str, str]:
        """The environment for programs of a site."""
        env = {name: value for name, value in os.environ.items() if not name.startswith("ZSCOUT_")}
        return env | {"ZSCOUT_FLEET": str(self.folder / f"{site}.fleet.toml")}

    async def program(self, site: str, name: str) -> Program:
        """Start a program at the desk of a site, and wait until it is on the mesh."""
        with (self.folder / f"{name}.log").open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                *("ip", "netns", "exec", self.net.space(f"{site}desk"), sys.executable, "-m", "tests.live.holder"),
                *(name, *(() if self.secured else (f"{site}desk",))),
                env=self.env(site),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=log,
            )
        program = Program(name, process)
        program.site = site
        self.programs.append(program)
        await program.event("up")
        return program

    def lose_relay(self, fault: Fault) -> None:
        match fault:
            case "killed":
                self.processes.kill(GATE)
            case "frozen":
                self.processes.signal(GATE, signal.SIGSTOP)
            case "cut":
                self.net.plug("b", "down")

    def bring_relay_back(self, fault: Fault) -> None:
        match fault:
            case "killed":
                self.processes.start(GATE)
            case "frozen":
                self.processes.signal(GATE, signal.SIGCONT)
            case "cut":
                self.net.plug("b", "up")

    async def sees(self, program: Program, until: Callable[[RcmState], bool]) -> RcmState:
        """Wait until the RCM's state, as seen by this program, fulfils `until`, and return it."""

        def logs() -> str:
            return "\n".join(f"--- {host}\n{(self.folder / f'{host}.log').read_text()}" for host in (GATE, *NODES))

        seen = await awaited(program.state, lambda state: state is not None and until(state), logs)
        assert seen is not None
        return seen

    async def whole(self, *programs: Program) -> RcmState:
        """Wait until all these programs see the same RCM with the devices of both sites."""
        states = [await self.sees(program, lambda state: present(state) == ALL) for program in programs]
        while len({state.term for state in states}) > 1:
            states = [await self.sees(program, lambda state: present(state) == ALL) for program in programs]
        return states[0]

    async def apart(self, program: Program) -> RcmState:
        """Wait until the program's site has its own leader."""
        own = {rc for rc in ALL if rc.startswith(f"robot/{program.site}")}
        return await self.sees(program, lambda state: state.host[0] == program.site and present(state) == own)


def present(state: RcmState) -> set[str]:
    return {view.rc for view in state.rcs if view.present}


async def times(sites: Sites, rounds: int) -> dict[str, list[Ns]]:
    """Measure the times from a request to the confirmed grant. Two programs take turns: one in the site of the leader
    and the RC, one in the other site."""
    programs = {site: await sites.program(site, f"timer-{site}") for site in SITES}
    leads = (await sites.whole(*programs.values())).host[0]
    found: dict[str, list[Ns]] = {INSIDE: [], ACROSS: []}
    for number in range(rounds + WARM_UP):
        for site, program in programs.items():
            await program.order("time", rc=f"robot/{leads}3")
            took = (await program.event("timed"))["took"]
            if number >= WARM_UP:
                found[INSIDE if site == leads else ACROSS].append(took)
    for program in programs.values():
        program.kill()
    return found


async def successions(sites: Sites, rounds: int) -> list[Ns]:
    """Times from `kill -9` of a holder in one site until the next holder, in the other site, has entered its body.
    Another program stays at each desk: a leader that loses the last programs of two hosts within a quarter of a lease
    assumes that it is cut off itself, and does not release the next lost client for a lease."""
    found = []
    stay = [await sites.program(site, f"stays-{site}") for site in SITES]
    await sites.whole(*stay)
    rcs = "robot/a3", "robot/b3"
    for number in range(rounds):
        site, other = SITES[number % 2], SITES[number % 2 - 1]
        first, following = await sites.program(site, f"first-{number}"), await sites.program(other, f"next-{number}")
        await sites.whole(first, following)
        await first.works("first", *rcs)
        await following.asks("next", *rcs)
        await following.event("queued")
        killed = first.kill()
        found.append(await following.enters() - killed)
        await following.gives_back()
        following.kill()
    for program in stay:
        program.kill()
    return found


class Merge(NamedTuple):
    fault: Fault
    took: float
    """Seconds from the relay's return until programs of both sites saw one RCM with all devices."""
    trouble: list[dict[str, Any]]


async def merges(sites: Sites, faults: Sequence[Fault], down: float, report: Callable[[Merge], None]) -> list[Merge]:
    """`down`: seconds for which the sites are apart."""
    found: list[Merge] = []
    programs: list[Program] = []
    for number, fault in enumerate(faults):
        if not programs:
            programs = [await sites.program(site, f"holds-{site}-{number}") for site in SITES]
            await sites.whole(*programs)
            for program in programs:
                await program.works(program.name, f"robot/{program.site}1", f"robot/{program.site}2")
        lost = time.monotonic()
        sites.lose_relay(fault)
        for program in programs:
            await sites.apart(program)
        await asyncio.sleep(max(0, lost + down - time.monotonic()))
        back = time.monotonic()
        sites.bring_relay_back(fault)
        await sites.whole(*programs)
        took = time.monotonic() - back
        trouble = [event for program in programs for event in await program.works_on()]
        found.append(Merge(fault, took, trouble))
        report(found[-1])
        if trouble:
            for program in programs:
                program.kill()
            programs = []
    return found


async def measure(asked: argparse.Namespace, folder: Path) -> bool:
    """Print the results. Return True if no program was disturbed."""
    numbers = itertools.count(1)

    def report(merge: Merge) -> None:
        what = f"DISTURBED: {merge.trouble}" if merge.trouble else "not disturbed"
        print(
            f"{next(numbers):3}  relay {merge.fault}  one fleet {merge.took:5.2f} s after its return, {what}",
            flush=True,
        )

    async with Sites(folder, secured=asked.secured) as sites:
        if asked.grants:
            took = await times(sites, asked.grants)
            inside, across = (median(took[way]) / 1e6 for way in (INSIDE, ACROSS))
            print(f"grant inside {inside:.2f} ms, across {across:.2f} ms: {across / inside:.2f} times ({asked.grants})")
        if asked.kills:
            gaps = [gap / 1e6 for gap in await successions(sites, asked.kills)]
            print(f"kill -9, next across: median {median(gaps):.0f} ms, at most {max(gaps):.0f} ms ({len(gaps)})")
        faults: list[Fault] = [*["frozen"] * asked.frozen, *["cut"] * asked.cut]  # type: ignore[list-item]
        faults += ["killed"] * (asked.merges - len(faults))
        random.Random(asked.seed).shuffle(faults)  # noqa: S311
        found = await merges(sites, faults, asked.down, report)
        if found:
            well, waits = sum(not merge.trouble for merge in found), [merge.took for merge in found]
            print(
                f"{well} of {len(found)} merges disturbed no program; one fleet after {median(waits):.2f} s, at most "
                f"{max(waits):.2f} s"
            )
    return not any(merge.trouble for merge in found)


def main() -> int:
    options = argparse.ArgumentParser(prog="python -m studies sites", description=__doc__.partition("\n\n")[0])
    options.add_argument("--merges", type=int, default=20, help="number of times that the relay fails and returns (20)")
    options.add_argument("--frozen", type=int, default=0, help="of these, times that it is frozen, not killed (0)")
    options.add_argument("--cut", type=int, default=0, help="of these, times that a site's line to it is cut (0)")
    options.add_argument("--down", type=float, default=10.0, help="seconds without a relay (10)")
    options.add_argument("--grants", type=int, default=200, help="grants of each kind (200)")
    options.add_argument("--kills", type=int, default=10, help="holders killed (10)")
    options.add_argument("--secured", action="store_true", help="with certificates and roles")
    options.add_argument("--seed", type=int, default=1, help="order of the merges (1)")
    asked = options.parse_args()
    try:
        net.check()
    except net.NoNamespaces as error:
        print(f"sites: {error}", file=sys.stderr)
        return 2
    net.end_on_signals()
    folder = Path(tempfile.mkdtemp(prefix="zscout-sites-"))
    before = os.getloadavg()[0]
    well = asyncio.run(measure(asked, folder))
    print(f"{os.cpu_count()} cores, load average {before:.2f} before, {os.getloadavg()[0]:.2f} after")
    if not well:
        print(f"logs are in {folder}", file=sys.stderr)
        return 1
    shutil.rmtree(folder, ignore_errors=True)
    return 0
