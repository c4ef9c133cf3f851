"""A real mesh for live tests: `zscout-node` processes and client processes of a fleet of their own."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import psutil
from msgspec.structs import replace

from tests.cli.tools import zscout_soon
from tests.hang import HANG
from tests.live.holder import linked
from tests.live.rights import EYE, PERSON, Certificates, Present
from zscout.behaviors.client import confirmation
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.identity import this_program
from zscout.config.fleet import Fleet, load_fleet
from zscout.config.scheduling_policy import StrategyName
from zscout.keyexpr import Role, Sender, Token, new_instance
from zscout.mesh import Mesh, Reply, ZenohMesh, clock
from zscout.messages import Done, RcAsk, RcmState, RcState
from zscout.types import Grant, Ns

T = TypeVar("T")
R = TypeVar("R")
PATIENT = 10.0
"""Seconds of leases where none is to end: on a busy machine a process may not run for a second or two."""
VOTE_TIMEOUT = 2.0
"""Seconds, for the same reason, where no vote is to be late."""
CONFIRM_TIMEOUT = 5.0
"""Seconds that clients give an RC to confirm a grant: after one, as the product has it, they give the grant back."""
NO_RCM = 3
"""The exit code of a command that saw none."""
TTL = 60.0
"""Seconds, as long as a command can be good."""


async def awaited(ask: Callable[[], Awaitable[T]], so: Callable[[T], object], besides: Callable[[], str] = str) -> T:
    """The answer, as soon as it is so. Fails after HANG seconds, with the last one and what is known besides."""
    seen: T | None = None
    try:
        async with asyncio.timeout(HANG):
            while True:
                seen = await ask()
                if so(seen):
                    return seen
                await asyncio.sleep(0.02)
    except TimeoutError:
        raise AssertionError(f"waited in vain; last {seen}\n{besides()}") from None


async def answered(ask: Callable[[], Awaitable[Reply[R] | None]]) -> R:
    """The first message that is answered: a link may come later."""
    reply = await awaited(ask, lambda reply: reply is not None and reply.message is not None)
    assert reply is not None
    assert reply.message is not None
    return reply.message


class PatientClient(Client):
    """A client whose commands wait for an RC that does not run for a while, unless they say how long."""

    async def command(
        self, rc: str, grant: Grant, do: Mapping[str, Any], *, ttl: float = TTL, timeout: float = HANG
    ) -> Done:
        return await super().command(rc, grant, do, ttl=ttl, timeout=timeout)


class Lab:
    """Nodes of one fleet on this machine, apart from every other mesh by name and multicast port.

    Use as an async context manager; everything that was started is gone afterwards.
    """

    own_rights: ClassVar[bool] = False
    """Whether the test itself says who has which role; others are on the kind of fleet that `tests/fleets.py` says."""

    def __init__(
        self,
        folder: Path,
        *,
        lease: float | None = None,
        candidates: Sequence[str] = (),
        extra: str = "",
        strategy: StrategyName = "adaptive",
    ) -> None:
        self.folder = folder
        self.nodes: dict[str, subprocess.Popen[bytes]] = {}
        self.others: list[subprocess.Popen[bytes]] = []
        self.clients: list[Client] = []
        self.holders: list[HolderProcess] = []
        self.sessions = 0
        """Of this process, besides those of `clients`."""
        self.fleet_file = folder / "fleet.toml"
        names = ", ".join(f'"{name}"' for name in candidates)
        self._port = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._port.bind(("127.0.0.1", 0))  # held, so that no other lab on this machine is given its number
        port = self._port.getsockname()[1]
        if lease is None:
            lease = 1.0 if "hold_lease" in extra else PATIENT
        if "[placement]" not in extra:
            extra += f"\n[placement]\nstart_timeout = {HANG}"
        # As much longer as in the default fleet; but each may be said.
        timing = {"hold_lease": 3 * lease, "rebuild": lease / 5, "vote_timeout": VOTE_TIMEOUT}
        lines = "".join(f"{name} = {seconds}\n" for name, seconds in timing.items() if f"{name} = " not in extra)
        before, _, after = extra.partition("[timing]\n")
        extra = f"{before}\n[timing]\n{lines}{after}"
        secured = Present.secured and not self.own_rights
        self._certificates = Certificates(folder / "keys", candidates) if secured else None
        if self._certificates:
            extra = self._certificates.secured(extra)
        self.fleet_file.write_text(
            f'[fleet]\nname = "test-{new_instance()}"\ncandidates = [{names}]\nstrategy = "{strategy}"\n'
            f'[mesh]\nmulticast_address = "224.0.0.224:{port}"\n'
            f'interface = "lo"\nlease = {lease}\n{extra}'
        )
        self.fleet: Fleet = load_fleet(self.fleet_file)
        self.env = os.environ | {"ZSCOUT_FLEET": str(self.fleet_file), "XDG_STATE_HOME": str(folder / "state")}
        self._rcs: set[str] = set()
        """Of its nodes."""
        self.cwd: Path | None = None
        """Of what is started. `python -m` looks there first."""
        self._confirm_timeout = confirmation.CONFIRM_TIMEOUT
        self._eye: ZenohMesh | None = None

    def fleet_of(self, name: str) -> Fleet:
        """The fleet as this person or machine joins it."""
        return replace(self.fleet, security=self._certificates.of(name)) if self._certificates else self.fleet

    def security_of(self, host: str) -> str:
        """The table of its node file."""
        return f'[security]\nfolder = "{self._certificates.of(host)}"\n' if self._certificates else ""

    def node(self, host: str, *rcs: str, extra: str = "") -> subprocess.Popen[bytes]:
        """Starts a node. `rcs` are names, or `name:param=bound` for a sharable one with a capacity."""
        text = f'[node]\nhost = "{host}"\nfleet = "fleet.toml"\n{extra}\n'
        text += self.security_of(host)
        for rc in rcs:
            name, _, bounds = rc.partition(":")
            self._rcs.add(name)
            text += f'[[rc]]\nname = "{name}"\ndriver = "{"capacity" if bounds else "exclusive"}"\n'
            if bounds:
                text += f"capacity = {{ {bounds} }}\n"
        file = self.folder / f"{host}.toml"
        file.write_text(text)
        self.nodes[host] = self.spawn([sys.executable, "-m", "zscout.node", str(file)], log=f"{host}.log")
        return self.nodes[host]

    def spawn(self, command: Sequence[str], *, log: str | None = None) -> subprocess.Popen[bytes]:
        """Starts a process in this fleet; its output goes to a file of the folder."""
        out: Any = subprocess.DEVNULL
        if log is not None:
            out = (self.folder / log).open("ab")
        process = subprocess.Popen(list(command), env=self.env, cwd=self.cwd, stdout=out, stderr=subprocess.STDOUT)
        if log is not None:
            out.close()
        self.others.append(process)
        return process

    async def zscout(self, *args: object, env: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
        """Runs a command to its end; anew where it saw no RCM in the few seconds for which it looks, as a node that
        does not run then has no link to it: it has done nothing."""
        return await awaited(lambda: zscout_soon(*args, env=env or self.env), lambda done: done.returncode != NO_RCM)

    def log(self, host: str) -> str:
        return (self.folder / f"{host}.log").read_text()

    async def client(self, name: str | None = None) -> Client:
        client = await PatientClient.connect(name, fleet=self.fleet, host=PERSON)
        client.who = this_program(PERSON)  # not of this machine, whose name each machine has its own
        self.clients.append(client)
        return client

    async def begun(self, name: str | None = None) -> Client:
        """A client, once somebody leads and all RCs of all nodes are there for it."""
        client = await self.client(name)
        await self.ready(client, *self._rcs)
        return client

    def signal(self, host: str, number: signal.Signals) -> Ns:
        """Sends a signal to a node; returns when, on this host's clock."""
        self.nodes[host].send_signal(number)
        return clock.now()

    async def candidates(self, client: Client, *hosts: str) -> None:
        """Waits until these hosts may lead, and have links to all other nodes, to holders, and to all sessions of this
        process: one that has none to an RC yet would lead without it."""
        await self.living(client, Role.CANDIDATE, lambda found: set(hosts) <= set(found))
        async with asyncio.timeout(HANG):
            while True:
                if all(self._is_linked(host) for host in hosts):
                    return
                await asyncio.sleep(0.02)

    def _is_linked(self, host: str) -> bool:
        ends = {one.raddr for one in _connections(self.nodes[host].pid)}
        wanted = {node.pid: 1 for name, node in self.nodes.items() if name != host and node.poll() is None}
        wanted |= {one.process.pid: 1 for one in self.holders if one.process.returncode is None}
        wanted[os.getpid()] = len(self.clients) + self.sessions
        return all(sum(one.laddr in ends for one in _connections(pid)) >= number for pid, number in wanted.items())

    async def logged(self, host: str, text: str) -> None:
        """Waits until a node has written `text` to its log."""
        async with asyncio.timeout(HANG):
            while True:
                if text in self.log(host):
                    return
                await asyncio.sleep(0.02)

    async def living(self, client: Client, role: str, until: Callable[[list[str]], bool]) -> None:
        """Waits until the hosts that have a token of this role are as they should be."""
        key = client.mesh.keys.alive_any(role)
        await awaited(
            lambda: client.mesh.living(key, timeout=1), lambda tokens: until([token.host for token in tokens])
        )

    async def holder(self, name: str) -> HolderProcess:
        """Starts a client process (`tests/live/holder.py`) and waits until it is on the mesh."""
        with (self.folder / f"{name}.log").open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                "tests.live.holder",
                name,
                PERSON,
                env=self.env,
                cwd=self.cwd,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=log,
            )
        holder = HolderProcess(name, process)
        self.holders.append(holder)
        await holder.event("up")
        return holder

    async def manager(self, client: Client) -> Mesh:
        """A session that may ask and publish what a leader does, but is none: on a plain fleet this client's."""
        if not self._certificates:
            return client.mesh
        if self._eye is None:
            self._eye = await ZenohMesh.open(self.fleet_of(EYE), Sender(EYE, "watcher"))
            self.sessions += 1
        return self._eye

    async def rc(self, client: Client, name: str) -> RcState:
        """An RC's own word about itself."""
        mesh = await self.manager(client)
        return await answered(lambda: mesh.ask_one(mesh.keys.rc_state(name), RcAsk(), RcState, timeout=PATIENT))

    async def held_by(self, client: Client, name: str, *arcs: str) -> None:
        """Waits until an RC names exactly these ARCs as its holders: it may hear of them after the client."""
        wanted = sorted(arcs)
        await awaited(
            lambda: self.rc(client, name), lambda state: sorted(holder.arc for holder in state.holders) == wanted
        )

    async def state(self, client: Client, until: Callable[[RcmState], bool]) -> RcmState:
        """The RCM's state as soon as `until` holds of it; fails after HANG seconds."""

        def logs() -> str:
            return "\n".join(f"--- {host}\n{self.log(host)}" for host in self.nodes)

        seen = await awaited(client.state, lambda state: state is not None and until(state), logs)
        assert seen is not None
        return seen

    async def ready(self, client: Client, *rcs: str) -> RcmState:
        """Waits until somebody leads and all these RCs are there, for the RCM and for `client`."""
        state = await self.state(client, lambda state: set(rcs) <= {view.rc for view in state.rcs if view.present})
        async with asyncio.timeout(HANG):
            await linked(client.mesh, rcs)
        return state

    async def __aenter__(self) -> Self:
        confirmation.CONFIRM_TIMEOUT = CONFIRM_TIMEOUT
        return self

    async def __aexit__(self, *exc: object) -> None:
        confirmation.CONFIRM_TIMEOUT = self._confirm_timeout
        for holder in self.holders:
            holder.kill()
        await asyncio.gather(*(holder.process.wait() for holder in self.holders))
        await asyncio.gather(*(client.close() for client in self.clients), return_exceptions=True)
        if self._eye is not None:
            await self._eye.close()
        for process in self.others:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in self.others:
            try:
                await asyncio.to_thread(process.wait, 10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._port.close()


def _connections(pid: int) -> list[Any]:
    found = psutil.Process(pid).net_connections("tcp")
    return [one for one in found if one.status == psutil.CONN_ESTABLISHED]


class HolderProcess:
    """A client process: what it is told, and what it has told and nobody has looked at yet."""

    def __init__(self, name: str, process: asyncio.subprocess.Process) -> None:
        self.name, self.process = name, process
        self.disturbed: list[dict[str, Any]] = []
        """What it has said, once, when its work ended: it counts also where another event was awaited."""

    async def order(self, order: str, **details: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"order": order, **details}).encode() + b"\n")
        await self.process.stdin.drain()

    async def event(self, *names: str) -> dict[str, Any]:
        """The next event of one of these names; what comes before it is skipped."""
        assert self.process.stdout is not None
        skipped: list[dict[str, Any]] = []
        try:
            async with asyncio.timeout(HANG):
                while line := await self.process.stdout.readline():
                    event: dict[str, Any] = json.loads(line)
                    if event["event"] in names:
                        return event
                    skipped.append(event)
                    self.disturbed += [event] if event["event"] == "disturbed" else []
        except TimeoutError:
            pass
        raise AssertionError(f"{self.name} did not say {names}; it said {skipped}")

    def signal(self, number: signal.Signals) -> Ns:
        """Sends a signal; returns when, on this host's clock."""
        self.process.send_signal(number)
        return clock.now()

    def kill(self) -> Ns:
        """Kills it with -9, stopped or not."""
        return self.signal(signal.SIGKILL) if self.process.returncode is None else clock.now()


class LeaderWatch:
    """When leaders' liveliness tokens came and went, as one client saw it."""

    def __init__(self, client: Client) -> None:
        self.came: dict[Token, Ns] = {}
        self.gone: dict[Token, Ns] = {}
        self._news = asyncio.Event()
        client.mesh.watch(client.mesh.keys.alive_any(Role.RCM), self._seen)

    def _seen(self, token: Token, alive: bool) -> None:
        (self.came if alive else self.gone)[token] = clock.now()
        self._news.set()

    async def lost(self, host: str) -> Ns:
        """Waits until the token of a leader at `host` has gone; returns when it did."""
        async with asyncio.timeout(HANG):
            while True:
                self._news.clear()
                for token, at in self.gone.items():
                    if token.host == host:
                        return at
                await self._news.wait()
