"""Hosts on one machine: network namespaces on one bridge, and a process in each. Needs root and iproute2."""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, Protocol

PREFIX: Final = "zc"
NOWHERE: Final = "02:00:00:00:ff:ff"
"""An unused address: packets to it are lost silently."""
ESTABLISHED: Final = "01"
COMMAND_TIMEOUT: Final = 20.0


class NoNamespaces(Exception):
    """Network namespaces are not possible here."""


def check() -> None:
    """Raises NoNamespaces."""
    if os.geteuid() != 0:
        raise NoNamespaces("network namespaces need root")
    if shutil.which("ip") is None:
        raise NoNamespaces("the command `ip` is missing: install iproute2")
    probe = f"{PREFIX}{os.getpid()}probe"
    try:
        ip("netns", "add", probe)
        ip("link", "add", f"{PREFIX}{os.getpid()}", "type", "bridge")
    except subprocess.SubprocessError as error:
        raise NoNamespaces(f"no network namespaces or bridges here: {getattr(error, 'stderr', error)}") from None
    finally:
        for undo in (("netns", "del", probe), ("link", "del", f"{PREFIX}{os.getpid()}")):
            subprocess.run(["ip", *undo], capture_output=True, check=False, timeout=COMMAND_TIMEOUT)


def end_on_signals() -> None:
    """Let SIGINT and SIGTERM raise KeyboardInterrupt, so that namespaces are removed. By default programs in the
    background of a shell ignore SIGINT, and SIGTERM ends a program at once."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)


def ip(*words: str) -> str:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=True, timeout=COMMAND_TIMEOUT)
    return done.stdout


class Spaces(Protocol):
    """The namespaces of hosts."""

    def space(self, host: str) -> str:
        """The namespace of a host."""


class Net:
    """All hosts on one bridge. Neighbours are static: a wrong hardware address cuts one way between hosts, silently."""

    def __init__(self, hosts: Sequence[str]) -> None:
        self.hosts = list(hosts)
        self.mark = f"{PREFIX}{os.getpid()}"
        self.cuts: set[tuple[str, str]] = set()
        """Cut ways: from, to."""
        self.unplugged: set[str] = set()
        self._addresses = {host: f"10.83.0.{number}" for number, host in enumerate(self.hosts, 1)}
        self._further = (f"10.83.{high}.{low}" for high in range(1, 255) for low in range(1, 255))
        """Addresses that no host has had."""

    def space(self, host: str) -> str:
        return f"{self.mark}-{host}"

    def address(self, host: str) -> str:
        return self._addresses[host]

    def _hardware(self, host: str) -> str:
        return f"02:00:00:00:00:{self.hosts.index(host) + 1:02x}"

    def _port(self, host: str) -> str:
        return f"{self.mark}p{self.hosts.index(host) + 1}"

    def open(self) -> None:
        remove_leftovers()
        ip("link", "add", self.mark, "type", "bridge", "mcast_snooping", "0")
        ip("link", "set", self.mark, "up")
        for host in self.hosts:
            space, port = self.space(host), self._port(host)
            ip("netns", "add", space)
            inner = ("peer", "name", "eth0", "address", self._hardware(host), "netns", space)
            ip("link", "add", port, "type", "veth", *inner)
            ip("link", "set", port, "master", self.mark, "up")
            ip("-n", space, "addr", "add", f"{self.address(host)}/16", "dev", "eth0")
            ip("-n", space, "link", "set", "lo", "up")
            ip("-n", space, "link", "set", "eth0", "up")
            self._configure(host)

    def _configure(self, host: str) -> None:
        """Set the routes and neighbours, which are lost when a link goes down."""
        ways = "".join(self._way(host, other, whole=True) for other in self.hosts if other != host)
        self._batch({host: f"route replace 224.0.0.0/4 dev eth0\n{ways}"})

    def _way(self, source: str, target: str, *, whole: bool) -> str:
        address = self._hardware(target) if whole else NOWHERE
        return f"neigh replace {self.address(target)} lladdr {address} dev eth0 nud permanent\n"

    def _batch(self, commands: dict[str, str]) -> None:
        started = []
        for host, text in commands.items():
            command = ["ip", "-n", self.space(host), "-batch", "-"]
            process = subprocess.Popen(command, stdin=subprocess.PIPE, text=True, stderr=subprocess.PIPE)
            assert process.stdin is not None
            process.stdin.write(text)
            process.stdin.close()
            process.stdin = None
            started.append(process)
        for process in started:
            _, errors = process.communicate(timeout=COMMAND_TIMEOUT)
            if process.returncode:
                raise RuntimeError(f"ip -batch: {errors}")

    def cut(self, ways: Iterable[tuple[str, str]]) -> None:
        """Restores others."""
        wanted = set(ways)
        changed: dict[str, str] = {}
        for source, target in sorted(wanted ^ self.cuts):
            whole = (source, target) not in wanted
            changed[source] = changed.get(source, "") + self._way(source, target, whole=whole)
        self._batch(changed)
        self.cuts = wanted

    def unplug(self, host: str) -> None:
        ip("link", "set", self._port(host), "down")
        self.unplugged.add(host)

    def plug_in(self, host: str) -> None:
        ip("link", "set", self._port(host), "up")
        self.unplugged.discard(host)
        self._configure(host)
        self.cuts = {way for way in self.cuts if way[0] != host}

    def take_address(self, host: str) -> None:
        ip("-n", self.space(host), "addr", "flush", "dev", "eth0")

    def give_address(self, host: str) -> None:
        self._addresses[host] = next(self._further)
        ip("-n", self.space(host), "addr", "add", f"{self.address(host)}/16", "dev", "eth0")
        self._configure(host)
        others = [other for other in self.hosts if other != host]
        self._batch({other: self._way(other, host, whole=(other, host) not in self.cuts) for other in others})
        self.cuts = {way for way in self.cuts if way[0] != host}

    def close(self) -> None:
        remove(self.mark)


def remove(mark: str) -> None:
    def run(*words: str) -> str:
        command = ["ip", *words]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=COMMAND_TIMEOUT).stdout

    # Delete the pairs first: with a removed namespace, its end of a pair disappears only some time later.
    for line in run("-brief", "link").splitlines():
        if line.startswith(f"{mark}p"):
            run("link", "del", line.split("@")[0])
    for line in run("netns", "list").splitlines():
        if line.split() and line.split()[0].startswith(f"{mark}-"):
            run("netns", "del", line.split()[0])
    run("link", "del", mark)


def remove_leftovers() -> None:
    """Remove the leftovers of runs that were killed."""
    for space in ip("netns", "list").splitlines():
        mark = space.split("-")[0]
        number = mark.removeprefix(PREFIX)
        if mark.startswith(PREFIX) and number.isdigit() and not Path(f"/proc/{number}").exists():
            remove(mark)


class Links:
    """Working TCP links between hosts, from the kernel's tables. A retransmitting link does not count as working."""

    def __init__(self, net: Net) -> None:
        self._net = net

    def standing(self, pids: dict[str, int]) -> dict[frozenset[str], frozenset[int]]:
        """The ports of the working links, by pair of hosts."""
        ends: dict[tuple[str, str], set[tuple[int, int]]] = {}
        names = {self._net.address(host): host for host in self._net.hosts}
        for host, pid in pids.items():
            for here, there, peer in self._connections(pid, names):
                ends.setdefault((host, peer), set()).add((here, there))
        found = {}
        for (host, peer), ports in ends.items():
            both = {pair for pair in ports if pair[::-1] in ends.get((peer, host), ())}
            if both:
                found[frozenset((host, peer))] = frozenset(port for pair in both for port in pair)
        return found

    @staticmethod
    def _connections(pid: int, names: Mapping[str, str]) -> Iterable[tuple[int, int, str]]:
        lines = []
        for table in ("tcp", "tcp6"):  # sockets for both protocols are in the second
            with suppress(OSError):
                lines += Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]
        for line in lines:
            words = line.split()
            peer = names.get(_address(words[2]))
            if words[3] == ESTABLISHED and peer is not None and int(words[6], 16) == 0:
                yield int(words[1].split(":")[1], 16), int(words[2].split(":")[1], 16), peer


def _address(text: str) -> str:
    number = bytes.fromhex(text.split(":")[0][-8:])
    return ".".join(str(byte) for byte in reversed(number))


_LIBC: Final = ctypes.CDLL(None)
_PR_SET_PDEATHSIG: Final = 1


def _dies_with_its_parent() -> None:
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


class Processes:
    """A process for each host, in its namespace. Its output goes to `<host>.log` in the folder."""

    def __init__(self, net: Spaces, folder: Path) -> None:
        self._net, self._folder = net, folder
        self._commands: dict[str, list[str]] = {}
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self.starts: Counter[str] = Counter()
        self._env = {name: value for name, value in os.environ.items() if not name.startswith("ZSCOUT_")}

    def start(self, host: str, command: Sequence[str] | None = None) -> None:
        """Start a host's process, or restart it."""
        if command is not None:
            self._commands[host] = list(command)
        self.starts[host] += 1
        whole = ["ip", "netns", "exec", self._net.space(host), *self._commands[host]]
        with (self._folder / f"{host}.log").open("ab") as log:
            self.running[host] = subprocess.Popen(
                whole,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=self._env,
                preexec_fn=_dies_with_its_parent,
                start_new_session=True,
            )

    def signal(self, host: str, number: signal.Signals) -> None:
        self.running[host].send_signal(number)

    def kill(self, host: str) -> None:
        self.running[host].kill()
        self.running[host].wait()

    def pids(self) -> dict[str, int]:
        return {host: process.pid for host, process in self.running.items() if process.poll() is None}

    def close(self, grace: float = 8.0) -> None:
        for process in self.running.values():
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
        deadline = time.monotonic() + grace
        for process in self.running.values():
            try:
                process.wait(max(0.05, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
