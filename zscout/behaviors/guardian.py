"""Guard a command that holds devices, such as the command of `zscout request`: run this file as a program.

    python -I -S guardian.py CHANNEL[,KEPT] TTY GRACE COMMAND [ARG]...

The guardian starts COMMAND in a process group of its own and gives it the terminal (TTY: an open descriptor, or -1). As
subreaper it becomes the parent of all orphans among its descendants, so it also finds processes in other sessions. All
descendants get SIGTERM, and SIGKILL after GRACE (ns), as soon as one of these happens:

- the client asks for it, or closes CHANNEL (a socket) by ending;
- the client's last deadline passes, for example because the client is frozen;
- COMMAND itself has ended.

CHANNEL carries lines. The client sends:

- `until NS`: the deadline, by the clock of `now`. The first is sent before the guardian starts.
- `end NS`: end all; the grace period starts at NS.
- `kill`: end all, without grace.
- `continue`: SIGCONT to the command's group.
- `signal NUMBER`: send this signal to COMMAND once COMMAND has a handler for it; sooner it would be killed.

The guardian sends:

- `started PID`, and `stopped SIGNAL` when COMMAND is stopped.
- `ending WHY`: `deadline`, `client`, or `signal` (the guardian received one).
- `exited CODE`: COMMAND's exit code; negative: the signal that ended it. Descendants may still live.
- `stuck PID`: this process of another user can't be ended. 0: /proc shows no processes, but some live.
- `gone`: the last process of the tree has ended.

If the client can't report to the RCs that all has ended, as it is gone or frozen, the guardian executes the program
LEFT, which does. With KEPT it doesn't: it keeps that descriptor open until all has ended, and the process at its other
end, which may run more commands under the same hold, reports. The guardian imports nothing of zscout, to start quickly.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import socket
import sys
import time
from contextlib import suppress

PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36
NOT_EXECUTABLE, NOT_FOUND = 126, 127
GUARD = (sys.executable, "-I", "-S", __file__)
"""Command line up to CHANNEL."""
LEFT = (sys.executable, "-P", "-m", "zscout.behaviors.client.left")
ROUND, SLOWEST = 20_000_000, 500_000_000
"""Nanoseconds between two rounds of SIGKILL: first and longest."""
LONGEST_WAIT = 250_000_000
"""Nanoseconds of the longest wait: `poll` doesn't count time in which the host sleeps, while deadlines do."""
END_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGQUIT, signal.SIGHUP)
STOP_SIGNALS = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
CGROUP_ROOTS = ("/sys/fs/cgroup", "/sys/fs/cgroup/unified")


def now() -> int:
    """Nanoseconds by the clock of zscout's programs on this host, which also counts while the host sleeps."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


class Ending:
    """Decides when the tree gets SIGTERM and SIGKILL. Pure: times, in ns, are passed in."""

    def __init__(self, grace: int) -> None:
        self._grace = grace
        self._until: int | None = None
        self._kill: int | None = None
        """Time of SIGKILL; None before SIGTERM."""

    @property
    def begun(self) -> bool:
        return self._kill is not None

    def renew(self, until: int) -> None:
        """Another deadline, unless the end has begun."""
        if not self.begun:
            self._until = until

    def due(self, at: int) -> bool:
        """Return True if the deadline has passed and the end has not begun."""
        return not self.begun and self._until is not None and at >= self._until

    def begin(self, at: int) -> None:
        """Schedule SIGKILL for the end of the grace period, which starts at `at`, or at an earlier deadline."""
        if self._kill is None:
            self._kill = (at if self._until is None else min(at, self._until)) + self._grace

    def hurry(self, at: int) -> None:
        """Schedule SIGKILL for `at`, unless it is due sooner."""
        self._kill = at if self._kill is None else min(at, self._kill)

    def kills(self, at: int) -> bool:
        return self._kill is not None and at >= self._kill

    def next(self) -> int | None:
        """Return the time of the next deadline or SIGKILL, if any."""
        return self._until if self._kill is None else self._kill


class Descendant:
    """A process in /proc, identified by pid and start time, as a pid may be reused. Raises OSError, ValueError."""

    def __init__(self, pid: int) -> None:
        with open(f"/proc/{pid}/stat", "rb") as file:  # noqa: PTH123 - pathlib takes long to import
            text = file.read()
        fields = text[text.rindex(b")") + 2 :].split()
        self.pid, self.parent, self.group, self.start = pid, int(fields[1]), int(fields[2]), int(fields[19])
        self.dead = fields[0] in (b"Z", b"X")

    def signal(self, number: int) -> None:
        """Send a signal; ignore a process that has ended. Raises PermissionError."""
        try:
            handle = os.pidfd_open(self.pid)
        except OSError:
            return
        try:
            if Descendant(self.pid).start == self.start:
                signal.pidfd_send_signal(handle, number)
        except PermissionError:
            raise
        except (OSError, ValueError):
            pass
        finally:
            os.close(handle)


def descendants(root: int) -> list[Descendant]:
    """Return all living descendants, parents before their children."""
    children: dict[int, list[Descendant]] = {}
    names: list[str] = []
    with suppress(OSError):  # /proc is hidden: no descendant can be named
        names = os.listdir("/proc")  # noqa: PTH208
    for name in names:
        if name.isdigit():
            try:
                process = Descendant(int(name))
            except (OSError, ValueError):
                continue
            children.setdefault(process.parent, []).append(process)
    found: list[Descendant] = []
    pids = [root]
    for pid in pids:
        found += children.get(pid, ())
        pids += [child.pid for child in children.get(pid, ())]
    return [process for process in found if not process.dead]


def caught_by(pid: int) -> int:
    """Return the signals for which a process has handlers (bit 0 is signal 1); 0 if /proc does not show them."""
    with suppress(OSError, ValueError), open(f"/proc/{pid}/status") as file:  # noqa: PTH123
        return next((int(line[7:], 16) for line in file if line.startswith("SigCgt:")), 0)
    return 0


def is_hidden() -> bool:
    """Return True if /proc shows not even this process: then processes in other sessions can't be found and ended."""
    return not os.path.exists(f"/proc/{os.getpid()}/stat")  # noqa: PTH110


def be_subreaper() -> None:
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


class ControlGroup:
    """A control group (v2), if this host permits: it kills all its processes at once, also other users' and ones that
    fork faster than /proc is searched."""

    def __init__(self) -> None:
        self.folder: str | None = None
        try:
            with open("/proc/self/cgroup") as file:  # noqa: PTH123
                own = next((line[3:].strip("/\n") for line in file if line.startswith("0::")), None)
        except OSError:
            own = None
        for root in CGROUP_ROOTS if own is not None else ():
            # Nodes remove abandoned groups with this name.
            self.folder = os.path.join(root, own or "", f"zscout.{os.getpid()}.request")  # noqa: PTH118
            try:
                os.mkdir(self.folder)  # noqa: PTH102
            except OSError:
                self.folder = None
                continue
            if os.path.exists(f"{self.folder}/cgroup.kill"):  # noqa: PTH110
                return
            self.close()

    def __bool__(self) -> bool:
        return self.folder is not None

    def enter(self) -> None:
        self._write("cgroup.procs", "0")

    def kill(self) -> None:
        self._write("cgroup.kill", "1")

    def close(self) -> None:
        """Remove the group, which is empty by now."""
        if self.folder is not None:
            with suppress(OSError):
                os.rmdir(self.folder)  # noqa: PTH106
        self.folder = None

    def _write(self, name: str, text: str) -> None:
        if self.folder is not None:
            with suppress(OSError), open(f"{self.folder}/{name}", "w") as file:  # noqa: PTH123
                file.write(text)


class Guardian:
    def __init__(self, channel: socket.socket, grace: int) -> None:
        self._channel: socket.socket | None = channel
        self._ending = Ending(grace)
        self._received = b""
        self._why = ""
        """Reason to end the tree, if it is being ended."""
        self._since, self._terminated = 0, False
        self._group = ControlGroup()
        self._leader = self._command = 0
        """Pid of the command, 0 once it was waited for, as the pid may then be reused; and its process group."""
        self._signals: set[int] = set()
        """Signals for COMMAND, sent once it has handlers for them."""
        self._pause, self._round = ROUND, 0
        """Nanoseconds until the round of SIGKILL after the next, and time of the next."""
        self._stuck: set[int] = set()

    def run(self, tty: int, command: list[str]) -> None:
        """Run the command; return once its whole tree has ended, or without starting it if its end is already due."""
        self._receive()
        if self._ending.due(now()):
            self._send("ending deadline")
        elif self._channel is not None and not self._why and not self._ending.begun:
            be_subreaper()
            self._start(tty, command)
            self._watch()
        self._group.close()
        self._send("gone")

    @property
    def reports_end(self) -> bool:
        """Return True if the client is gone or frozen, so that the guardian must report the end to the RCs."""
        return self._channel is None or self._why == "deadline"

    def _start(self, tty: int, command: list[str]) -> None:
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGCHLD, *END_SIGNALS})
        guardian = os.getpid()
        self._leader = self._command = os.fork()
        if self._leader == 0:
            try:
                self._become(guardian, tty, command, mask)
            except OSError as error:
                os.write(2, f"zscout: {command[0]} can't be run: {error.strerror}; check the path\n".encode())
                os._exit(NOT_FOUND if isinstance(error, FileNotFoundError) else NOT_EXECUTABLE)
            finally:
                os._exit(NOT_EXECUTABLE)
        with suppress(OSError):
            os.setpgid(self._leader, self._leader)  # the child does the same; either may be first
        self._wake, write = os.pipe()
        os.set_blocking(write, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        for number in END_SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._on_signal)
        for number in STOP_SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        # Readers of the command's output must see its end when the command ends, not when the guardian does.
        null = os.open(os.devnull, os.O_RDWR)
        for fd in (0, 1):
            os.dup2(null, fd)
        os.close(null)
        if tty >= 0:
            os.close(tty)
        self._send(f"started {self._leader}")

    def _become(self, guardian: int, tty: int, command: list[str], mask: set[int | signal.Signals]) -> None:
        """Raises OSError."""
        os.setpgid(0, 0)
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != guardian:
            os._exit(NOT_EXECUTABLE)  # the guardian was killed before prctl
        self._group.enter()
        # The command must not inherit the signal handlers that Python has set.
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
        if tty >= 0:
            # Its group is still in the background: without this, SIGTTOU would stop it.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTOU})
            with suppress(OSError):
                os.tcsetpgrp(tty, os.getpgrp())
            os.close(tty)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        os.execvp(command[0], command)  # noqa: S606 - the purpose of this program

    def _watch(self) -> None:
        poll = select.poll()
        poll.register(self._wake, select.POLLIN)
        listened = self._channel.fileno() if self._channel is not None else -1
        poll.register(listened, select.POLLIN)
        while self._reap():
            if self._ending.due(now()):
                self._begin_end("deadline")
            if (self._why or self._leader == 0) and not self._terminated:
                self._terminate()
            if self._signals and self._leader:
                self._signal_command()
            at = now()
            if self._ending.kills(at) and at >= self._round:
                self._kill()
                self._round, self._pause = at + self._pause, min(2 * self._pause, SLOWEST)
            times = [at + LONGEST_WAIT, self._round if self._ending.kills(at) else self._ending.next()]
            ready = poll.poll(max(0, min(moment for moment in times if moment is not None) - at) / 1e6)
            for fd, _ in ready:
                if fd == self._wake:
                    os.read(fd, 4096)
                else:
                    self._receive()
                    if self._channel is None:
                        poll.unregister(listened)

    def _reap(self) -> bool:
        """Return False if no child is left. Does not block."""
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG | os.WUNTRACED)
            except ChildProcessError:
                return False  # nor are there other descendants: as orphans they would be children
            if pid == 0:
                return True
            if pid != self._leader:
                continue
            if os.WIFSTOPPED(status):
                self._send(f"stopped {os.WSTOPSIG(status)}")
            else:
                self._leader = 0
                self._send(f"exited {os.waitstatus_to_exitcode(status)}")

    def _terminate(self) -> None:
        self._terminated = True
        self._ending.begin(self._since or now())
        if self._why:
            self._send(f"ending {self._why}")
        # To the whole group at once: a shell must have got the signal before it sees its command die.
        group = self._command if self._to_group(signal.SIGTERM) else 0
        rest = [process for process in descendants(os.getpid()) if process.group != group]
        for number in (signal.SIGTERM, signal.SIGCONT):  # a stopped process gets SIGTERM only after SIGCONT
            for process in rest:
                with suppress(PermissionError):
                    process.signal(number)
        self._to_group(signal.SIGCONT)

    def _kill(self) -> None:
        """Send SIGKILL to all descendants; processes forked meanwhile get it in the next round."""
        self._group.kill()
        if not self._to_group(signal.SIGKILL) and not self._stuck and is_hidden():
            self._stuck.add(0)
            self._send("stuck 0")
        for process in descendants(os.getpid()):
            try:
                process.signal(signal.SIGKILL)
            except PermissionError:
                if process.pid not in self._stuck:
                    self._stuck.add(process.pid)
                    self._send(f"stuck {process.pid}")

    def _signal_command(self) -> None:
        caught = caught_by(self._leader)
        for number in [number for number in self._signals if caught >> (number - 1) & 1]:
            self._signals.discard(number)
            with suppress(OSError):
                os.kill(self._leader, number)

    def _to_group(self, number: int) -> bool:
        """Signal the command's group while a child of the guardian is in it: an empty group's number may be reused."""
        with suppress(ChildProcessError, ProcessLookupError, PermissionError):
            if not self._leader:
                os.waitid(os.P_PGID, self._command, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            os.killpg(self._command, number)
            return True
        return False

    def _begin_end(self, why: str, since: int = 0) -> None:
        """The first reason counts."""
        if not self._why:
            self._why, self._since = why, since or now()

    def _on_signal(self, *_: object) -> None:
        self._begin_end("signal")

    def _send(self, words: str) -> None:
        if self._channel is not None:
            with suppress(OSError):
                self._channel.send(f"{words}\n".encode())

    def _receive(self) -> None:
        """Obey all lines that have arrived; drop the channel once the client has closed it."""
        while self._channel is not None:
            try:
                text = self._channel.recv(4096)
            except BlockingIOError:
                return
            except OSError:
                text = b""
            if not text:
                self._channel.close()
                self._channel = None
                self._begin_end("client")
            *lines, self._received = (self._received + text).split(b"\n")
            for line in lines:
                self._obey(*line.decode().split())

    def _obey(self, word: str, number: str = "") -> None:
        if word == "until":
            self._ending.renew(int(number))
        elif word == "end":
            self._begin_end("client", int(number))
        elif word == "kill":
            self._begin_end("client")
            self._ending.hurry(now())
        elif word == "continue":
            self._to_group(signal.SIGCONT)
        elif word == "signal":
            self._signals.add(int(number))


def main() -> None:
    for fd in range(3):
        try:
            os.fstat(fd)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # open() takes the lowest free number
    (channel, *kept), tty, grace = map(int, sys.argv[1].split(",")), int(sys.argv[2]), int(sys.argv[3])
    command = sys.argv[4:]
    for fd in (channel, *kept):
        os.set_inheritable(fd, False)
    connection = socket.socket(fileno=channel)
    connection.setblocking(False)
    guardian = Guardian(connection, grace)
    guardian.run(tty, command)
    if guardian.reports_end and not kept:
        os.execv(LEFT[0], LEFT)  # noqa: S606 - our own interpreter


if __name__ == "__main__":
    main()
