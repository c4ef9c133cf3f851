"""A fleet over two sites, whose hosts reach each other by a relay alone: what that costs, and whether a hold inside a
site feels that the relay dies and comes back.

    python -m tests.live.sites --merges 20      (needs root, network namespaces, iproute2; --help for more)

Exit code 0: no hold inside a site was disturbed; 1: else; 2: it can't run here."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import msgspec

from tests.chaos import net
from tests.hang import HANG
from tests.live.closed import make_keys
from tests.live.lab import HolderProcess
from zscout.messages import RcmState
from zscout.types import Grant, Ns

SITES: Final = ("a", "b")
GATE: Final = "gate"
"""The relay."""
NODES: Final = {
    "a1": ("robot/a1",),
    "a2": ("robot/a2", "robot/a3"),
    "b1": ("robot/b1",),
    "b2": ("robot/b2", "robot/b3"),
}
"""The hosts of both sites, with their RCs. The first of each may lead."""
ALL: Final = frozenset(rc for rcs in NODES.values() for rc in rcs)
LOOK: Final = 0.02
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
    """A network for each site, bridge and all, and a host that has a foot in both and forwards nothing."""

    def __init__(self) -> None:
        self.hosts = {site: [host for host in (*NODES, f"{site}desk") if host[0] == site] for site in SITES}
        self.mark = f"{net.PREFIX}{os.getpid()}"

    def space(self, host: str) -> str:
        return f"{self.mark}-{host}"

    def address(self, host: str, site: str) -> str:
        number = 1 if host == GATE else 2 + self.hosts[site].index(host)
        return f"10.84.{SITES.index(site)}.{number}"

    def open(self) -> None:
        net.remove_leftovers()
        for host in (GATE, *self.hosts["a"], *self.hosts["b"]):
            net.ip("netns", "add", self.space(host))
            net.ip("-n", self.space(host), "link", "set", "lo", "up")
        for number, site in enumerate(SITES):
            # The bridge in a namespace of its own: it goes with that.
            lan = self.space(f"lan{site}")
            net.ip("netns", "add", lan)
            net.ip("-n", lan, "link", "add", "lan", "type", "bridge", "mcast_snooping", "0")
            net.ip("-n", lan, "link", "set", "lan", "up")
            for host in (GATE, *self.hosts[site]):
                space, card = self.space(host), f"eth{number if host == GATE else 0}"
                net.ip("-n", lan, "link", "add", host, "type", "veth", "peer", "name", card, "netns", space)
                net.ip("-n", lan, "link", "set", host, "master", "lan", "up")
                net.ip("-n", space, "addr", "add", f"{self.address(host, site)}/24", "dev", card)
                net.ip("-n", space, "link", "set", card, "up")
                net.ip("-n", space, "route", "append", "224.0.0.0/4", "dev", card)

    def close(self) -> None:
        net.remove(self.mark)


class Program(HolderProcess):
    """`tests/live/holder.py` at a desk of one site."""

    site: str
    grant: Grant
    """Its last."""
    beats: int
    """How often its RCs had obeyed, from one `trouble` to the next."""

    async def trouble(self) -> list[dict[str, Any]]:
        """What it has said, since it was asked last, that it would not say if it had been left alone."""
        await self.order("beats")
        assert self.process.stdout is not None
        found: list[dict[str, Any]] = []
        async with asyncio.timeout(HANG):
            while line := await self.process.stdout.readline():
                event = json.loads(line)
                if event["event"] == "beats":
                    self.beats = event["beats"]
                    return found
                if event["event"] != "running" or msgspec.convert(event["grant"], Grant) != self.grant:
                    found.append(event)
        raise AssertionError(f"{self.name} ended; it said {found}")

    async def works_on(self) -> list[dict[str, Any]]:
        """Waits until its RCs have obeyed once more. Returns the trouble that it had until then."""
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
        """Returns when it did."""
        entered = await self.event("entered")
        self.grant = msgspec.convert(entered["grant"], Grant)
        at: Ns = entered["at"]
        return at

    async def works(self, arc: str, *rcs: str) -> None:
        """Asks, enters, and commands these RCs from now on."""
        await self.asks(arc, *rcs)
        await self.enters()
        await self.order("work", rcs=rcs)

    async def gives_back(self) -> None:
        await self.order("end")
        await self.event("given_up")


class Sites:
    """The fleet: in each site two nodes and a desk for programs. Use as an async context manager."""

    def __init__(self, folder: Path, *, secured: bool = False, lease: float = 1.0) -> None:
        self.folder, self.net, self.secured = folder, SitesNet(), secured
        self.processes = net.Processes(self.net, folder)
        self.programs: list[Program] = []
        name = f"sites-{self.net.mark}"
        self._write(
            "gate", f'relay = ["a", "b"]\nlisten = ["{self._endpoint("[::]")}"]\ninterface = "eth0,eth1"', name, lease
        )
        for site in SITES:
            gate = self._endpoint(self.net.address(GATE, site))
            self._write(site, f'site = "{site}"\nconnect = ["{gate}"]\ninterface = "eth0"', name, lease)
        if secured:
            make_keys(folder / "certificates", GATE, "ada", *NODES)
        for host in (GATE, *NODES):
            rcs = "".join(f'[[rc]]\nname = "{rc}"\ndriver = "exclusive"\n' for rc in NODES.get(host, ()))
            more = f'[security]\nfolder = "certificates/{host}"\n' if secured else ""
            fleet = "gate" if host == GATE else host[0]
            text = f'[node]\nhost = "{host}"\nfleet = "{fleet}.fleet.toml"\n{rcs}{more}'
            (folder / f"{host}.toml").write_text(text)

    def _endpoint(self, address: str) -> str:
        return f"{'tls' if self.secured else 'tcp'}/{address}:7447"

    def _write(self, name: str, mesh: str, fleet: str, lease: float) -> None:
        roles = ROLES.replace('"keys"', '"certificates/ada"') if self.secured else ""
        (self.folder / f"{name}.fleet.toml").write_text(
            f'[fleet]\nname = "{fleet}"\ncandidates = ["a1", "b1"]\n[mesh]\nlease = {lease}\n{mesh}\n'
            f"[timing]\nhold_lease = {3 * lease}\n{roles}"
        )

    async def __aenter__(self) -> Self:
        try:
            self.net.open()
            for host in (GATE, *NODES):
                command = [sys.executable, "-m", "zscout.node", str(self.folder / f"{host}.toml")]
                self.processes.start(host, command)
        except BaseException:
            await self.__aexit__(None, None, None)
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for program in self.programs:
            program.kill()
        await asyncio.gather(*(program.process.wait() for program in self.programs))
        await asyncio.to_thread(self.processes.close)
        self.net.close()

    def env(self, site: str) -> dict[str, str]:
        """For programs of a site."""
        env = {name: value for name, value in os.environ.items() if not name.startswith("ZSCOUT_")}
        return env | {"ZSCOUT_FLEET": str(self.folder / f"{site}.fleet.toml")}

    async def program(self, site: str, name: str) -> Program:
        """Starts a program at the desk of a site, and waits until it is on the mesh."""
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

    def lose_relay(self, *, frozen: bool = False) -> None:
        if frozen:
            self.processes.signal(GATE, signal.SIGSTOP)
        else:
            self.processes.kill(GATE)

    def bring_relay_back(self) -> None:
        if self.processes.running[GATE].poll() is None:
            self.processes.signal(GATE, signal.SIGCONT)
        else:
            self.processes.start(GATE)

    async def sees(self, program: Program, until: Callable[[RcmState], bool]) -> RcmState:
        """The RCM's state, as this program is told it, as soon as `until` holds of it."""
        seen = None
        try:
            async with asyncio.timeout(HANG):
                while True:
                    seen = await program.state() or seen
                    if seen is not None and until(seen):
                        return seen
                    await asyncio.sleep(LOOK)
        except TimeoutError:
            logs = "\n".join(f"--- {host}\n{(self.folder / f'{host}.log').read_text()}" for host in (GATE, *NODES))
            raise AssertionError(f"{program.name} waited in vain; last seen {seen}\n{logs}") from None

    async def whole(self, *programs: Program) -> RcmState:
        """Waits until one RCM has the devices of both sites, for all of these programs."""
        states = [await self.sees(one, lambda state: present(state) == ALL) for one in programs]
        while len({state.term for state in states}) > 1:
            states = [await self.sees(one, lambda state: present(state) == ALL) for one in programs]
        return states[0]

    async def apart(self, program: Program) -> RcmState:
        """Waits until a program's site leads itself."""
        own = {rc for rc in ALL if rc.startswith(f"robot/{program.site}")}
        return await self.sees(program, lambda state: state.host[0] == program.site and present(state) == own)


def present(state: RcmState) -> set[str]:
    return {view.rc for view in state.rcs if view.present}
