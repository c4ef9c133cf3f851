"""Guards a command that holds devices, as that of `zscout request`: run as a program beside the client.

    python -I -S guardian.py CHANNEL[,KEPT] TTY GRACE COMMAND [ARG]...

It starts COMMAND in a process group of its own, gives it the terminal (TTY, an open descriptor, or -1), and is the
subreaper of all that comes of it: whoever of its descendants loses its parent becomes a child of the guardian, so that
a process in a session of its own is found as well. All of them get SIGTERM, and SIGKILL after GRACE (ns), when the
client says so or is gone (CHANNEL, a socket, has ended), at the deadline that it gave last, though it is frozen, and
when COMMAND itself has ended. `gone` is said when the last process of the tree is no more.

Words on CHANNEL are lines. From the client: `until NS` (the deadline, by the clock of `now`; the first stands there
before the guardian starts), `end NS` (the grace counts from then), `kill` (without grace), `continue`, `signal NUMBER`
(to COMMAND, once it catches that signal: else it would be killed, perhaps before it could). To it:
`started PID`, `stopped SIGNAL`, `ending WHY` (`deadline`, `client`, `signal`: sent to the guardian), `exited CODE` (of
COMMAND alone; negative: by that signal), `stuck PID` (it runs as another user, and can't be ended; 0: /proc shows no
process, and something lives), `gone`.

Where the client can't, being gone or frozen, the guardian becomes the program that tells the RCs that all is gone; not
with KEPT, a descriptor that it keeps open until all is gone: its other end tells them, which may have more commands
under that hold. The guardian imports nothing of zscout itself, to start quickly.
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
"""What stands before CHANNEL."""
LEFT = (sys.executable, "-P", "-m", "zscout.behaviors.client.left")
ROUND, SLOWEST = 20_000_000, 500_000_000
"""ns between two rounds of SIGKILL: at first, and at last."""
LOOK = 250_000_000
"""ns, the longest wait for anything: `poll` doesn't count the time for which the host sleeps, the deadline does."""
ENDS_US = (signal.SIGTERM, signal.SIGINT, signal.SIGQUIT, signal.SIGHUP)
STOPS_US = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
CGROUP_ROOTS = ("/sys/fs/cgroup", "/sys/fs/cgroup/unified")


def now() -> int:
    """ns by the clock of a fleet's programs on this host; it goes on while the host sleeps."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


class Ending:
    """When the tree gets which signal. Pure: times, in ns, are passed in."""

    def __init__(self, grace: int) -> None:
        self._grace = grace
        self._until: int | None = None
        self._kill: int | None = None
        """When SIGKILL is due; None: SIGTERM was not yet."""

    @property
    def begun(self) -> bool:
        return self._kill is not None

    def renew(self, until: int) -> None:
        """Another deadline, unless the end has begun."""
        if not self.begun:
            self._until = until

    def due(self, at: int) -> bool:
        """Whether the deadline has come, and the end has not begun."""
        return not self.begun and self._until is not None and at >= self._until

    def begin(self, at: int) -> None:
        """SIGTERM is sent, or should have been then: SIGKILL follows after the grace."""
        if self._kill is None:
            self._kill = (at if self._until is None else min(at, self._until)) + self._grace

    def hurry(self, at: int) -> None:
        """SIGKILL is due."""
        self._kill = at if self._kill is None else min(at, self._kill)

    def kills(self, at: int) -> bool:
        return self._kill is not None and at >= self._kill

    def next(self) -> int | None:
        """When to look again, if nothing happens."""
        return self._until if self._kill is None else self._kill


class Descendant:
    """One in /proc, by its pid and start: the pid alone may pass to another. Raises OSError, ValueError."""

    def __init__(self, pid: int) -> None:
        with open(f"/proc/{pid}/stat", "rb") as file:  # noqa: PTH123 - pathlib takes long to import
            text = file.read()
        fields = text[text.rindex(b")") + 2 :].split()
        self.pid, self.parent, self.group, self.start = pid, int(fields[1]), int(fields[2]), int(fields[19])
        self.dead = fields[0] in (b"Z", b"X")

    def signal(self, number: int) -> None:
        """Raises PermissionError. One that has gone meanwhile is no failure."""
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
    """All that live, parents before their children."""
    children: dict[int, list[Descendant]] = {}
    names: list[str] = []
    with suppress(OSError):  # /proc is hidden: no descendant can be named
        names = os.listdir("/proc")  # noqa: PTH208
    for name in names:
        if name.isdigit():
            try:
                one = Descendant(int(name))
            except (OSError, ValueError):
                continue
            children.setdefault(one.parent, []).append(one)
    found: list[Descendant] = []
    pids = [root]
    for pid in pids:
        found += children.get(pid, ())
        pids += [one.pid for one in children.get(pid, ())]
    return [one for one in found if not one.dead]


def caught_by(pid: int) -> int:
    """The signals that a process catches: bit 0 is signal 1. 0 where /proc does not show them."""
    with suppress(OSError, ValueError), open(f"/proc/{pid}/status") as file:  # noqa: PTH123
        return next((int(line[7:], 16) for line in file if line.startswith("SigCgt:")), 0)
    return 0


def is_hidden() -> bool:
    """Whether /proc shows no process, not even this one: those in sessions of their own can't be found and ended."""
    return not os.path.exists(f"/proc/{os.getpid()}/stat")  # noqa: PTH110


def be_subreaper() -> None:
    """Descendants that lose their parent become children of this process."""
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


class ControlGroup:
    """A group (v2) of the command's own, where this host lets us make one: all in it are killed at once, those that
    run as another user and those that fork faster than one can look as well."""

    def __init__(self) -> None:
        self.folder: str | None = None
        try:
            with open("/proc/self/cgroup") as file:  # noqa: PTH123
                own = next((line[3:].strip("/\n") for line in file if line.startswith("0::")), None)
        except OSError:
            own = None
        for root in CGROUP_ROOTS if own is not None else ():
            # Nodes remove what is named so, and was left.
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
        """Removes it. It is empty."""
        if self.folder is not None:
            with suppress(OSError):
                os.rmdir(self.folder)  # noqa: PTH106
        self.folder = None

    def _write(self, name: str, text: str) -> None:
        if self.folder is not None:
            with suppress(OSError), open(f"{self.folder}/{name}", "w") as file:  # noqa: PTH123
                file.write(text)


class Guardian:
    """The command's tree, from its start to the end of its last process."""

    def __init__(self, channel: socket.socket, grace: int) -> None:
        self._channel: socket.socket | None = channel
        self._ending = Ending(grace)
        self._received = b""
        self._why = ""
        """Why all of it is to end, once it is."""
        self._since, self._told = 0, False
        self._group = ControlGroup()
        self._leader = self._command = 0
        """The command, until it was waited for; from then on its number may be another's. And its group."""
        self._signals: set[int] = set()
        """Signals for COMMAND, which it gets once it catches them."""
        self._pause, self._round = ROUND, 0
        """Between two rounds of SIGKILL, and when the next one is."""
        self._stuck: set[int] = set()

    def run(self, tty: int, command: list[str]) -> None:
        """Returns when nothing of the command is left, or where it was too late to start it."""
        self._receive()
        if self._ending.due(now()):
            self._say("ending deadline")
        elif self._channel is not None and not self._why and not self._ending.begun:
            be_subreaper()
            self._start(tty, command)
            self._watch()
        self._group.close()
        self._say("gone")

    @property
    def speaks(self) -> bool:
        """Whether the client does not say that all is gone."""
        return self._channel is None or self._why == "deadline"

    # The start

    def _start(self, tty: int, command: list[str]) -> None:
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGCHLD, *ENDS_US})
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
            os.setpgid(self._leader, self._leader)  # whoever of both is first
        self._wake, write = os.pipe()
        os.set_blocking(write, False)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        for number in ENDS_US:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._on_signal)
        for number in STOPS_US:
            signal.signal(number, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        # Who reads what the command writes waits for its end, not for ours.
        null = os.open(os.devnull, os.O_RDWR)
        for fd in (0, 1):
            os.dup2(null, fd)
        os.close(null)
        if tty >= 0:
            os.close(tty)
        self._say(f"started {self._leader}")

    def _become(self, guardian: int, tty: int, command: list[str], mask: set[int | signal.Signals]) -> None:
        """The child becomes the command. Raises OSError."""
        os.setpgid(0, 0)
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != guardian:
            os._exit(NOT_EXECUTABLE)  # it was killed before that could be asked for
        self._group.enter()
        # What Python changed at its start must not be inherited.
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
        if tty >= 0:
            # Its group is still a background one: it would be stopped for touching the terminal.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTOU})
            with suppress(OSError):
                os.tcsetpgrp(tty, os.getpgrp())
            os.close(tty)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        os.execvp(command[0], command)  # noqa: S606 - this is what it is for

    # Until nothing is left

    def _watch(self) -> None:
        poll = select.poll()
        poll.register(self._wake, select.POLLIN)
        listened = self._channel.fileno() if self._channel is not None else -1
        poll.register(listened, select.POLLIN)
        while self._reap():
            if self._ending.due(now()):
                self._ask("deadline")
            if (self._why or self._leader == 0) and not self._told:
                self._end()
            if self._signals and self._leader:
                self._signal_command()
            at = now()
            if self._ending.kills(at) and at >= self._round:
                self._kill()
                self._round, self._pause = at + self._pause, min(2 * self._pause, SLOWEST)
            later = [at + LOOK, self._round if self._ending.kills(at) else self._ending.next()]
            ready = poll.poll(max(0, min(one for one in later if one is not None) - at) / 1e6)
            for fd, _ in ready:
                if fd == self._wake:
                    os.read(fd, 4096)
                else:
                    self._receive()
                    if self._channel is None:
                        poll.unregister(listened)

    def _reap(self) -> bool:
        """Looks at all who ended or were stopped. False if nobody is left."""
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG | os.WUNTRACED)
            except ChildProcessError:
                return False  # nor have any descendants: they would have become children
            if pid == 0:
                return True
            if pid != self._leader:
                continue
            if os.WIFSTOPPED(status):
                self._say(f"stopped {os.WSTOPSIG(status)}")
            else:
                self._leader = 0
                self._say(f"exited {os.waitstatus_to_exitcode(status)}")

    def _end(self) -> None:
        """SIGTERM, once, to all that there are."""
        self._told = True
        self._ending.begin(self._since or now())
        if self._why:
            self._say(f"ending {self._why}")
        # To a group at once: a shell that sees its command die must have been told itself.
        group = self._command if self._to_group(signal.SIGTERM) else 0
        rest = [one for one in descendants(os.getpid()) if one.group != group]
        for number in (signal.SIGTERM, signal.SIGCONT):  # a stopped process gets the first only when it goes on
            for one in rest:
                with suppress(PermissionError):
                    one.signal(number)
        self._to_group(signal.SIGCONT)

    def _kill(self) -> None:
        """SIGKILL to all that there are; whoever was forked meanwhile has it the next time."""
        self._group.kill()
        if not self._to_group(signal.SIGKILL) and not self._stuck and is_hidden():
            self._stuck.add(0)
            self._say("stuck 0")
        for one in descendants(os.getpid()):
            try:
                one.signal(signal.SIGKILL)
            except PermissionError:
                if one.pid not in self._stuck:
                    self._stuck.add(one.pid)
                    self._say(f"stuck {one.pid}")

    def _signal_command(self) -> None:
        caught = caught_by(self._leader)
        for number in [number for number in self._signals if caught >> (number - 1) & 1]:
            self._signals.discard(number)
            with suppress(OSError):
                os.kill(self._leader, number)

    def _to_group(self, number: int) -> bool:
        """To the command's group, if that is still its: it is while the command, or another child, is in it."""
        with suppress(ChildProcessError, ProcessLookupError, PermissionError):
            if not self._leader:
                os.waitid(os.P_PGID, self._command, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            os.killpg(self._command, number)
            return True
        return False

    def _ask(self, why: str, since: int = 0) -> None:
        """All of it is to end; the first reason counts."""
        if not self._why:
            self._why, self._since = why, since or now()

    def _on_signal(self, *_: object) -> None:
        self._ask("signal")

    # The channel

    def _say(self, words: str) -> None:
        if self._channel is not None:
            with suppress(OSError):
                self._channel.send(f"{words}\n".encode())

    def _receive(self) -> None:
        """Takes what came. There is no channel any more when the client has gone."""
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
                self._ask("client")
            *lines, self._received = (self._received + text).split(b"\n")
            for line in lines:
                self._obey(*line.decode().split())

    def _obey(self, word: str, number: str = "") -> None:
        if word == "until":
            self._ending.renew(int(number))
        elif word == "end":
            self._ask("client", int(number))
        elif word == "kill":
            self._ask("client")
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
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free
    (channel, *kept), tty, grace = map(int, sys.argv[1].split(",")), int(sys.argv[2]), int(sys.argv[3])
    command = sys.argv[4:]
    for fd in (channel, *kept):
        os.set_inheritable(fd, False)
    connection = socket.socket(fileno=channel)
    connection.setblocking(False)
    guardian = Guardian(connection, grace)
    guardian.run(tty, command)
    if guardian.speaks and not kept:
        os.execv(LEFT[0], LEFT)  # noqa: S606 - an interpreter of our own


if __name__ == "__main__":
    main()
