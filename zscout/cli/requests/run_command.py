"""Run a command under a grant: its guardian starts it, and it is ended with all its processes.

At a terminal the command has the foreground, so that it receives Ctrl-C (otherwise Ctrl-C reaches `cli/common.run`,
which cancels the request). Ctrl-Z can't suspend it, since its devices would be idle. In a pipeline it gets the terminal
when it asks for it.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import shutil
import signal
import socket
import subprocess
import sys
import termios
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import msgspec

from zscout.behaviors.guardian import GUARD, NOT_EXECUTABLE, NOT_FOUND, ROUND, SLOWEST, be_subreaper, descendants, now
from zscout.cli.common import Failed, first_of, fleet_file
from zscout.terminal import print_line
from zscout.types import SECOND, Ns

if TYPE_CHECKING:
    from zscout.behaviors.client.arc import Held
    from zscout.behaviors.client.client import Client

TERMINAL_RETRY_S: Final = 0.3
"""Interval between attempts to get a terminal, which reports no changes."""
COMMAND_CODES: Final = (NOT_EXECUTABLE, NOT_FOUND)
"""Exit codes that shells also use for a command that can't be run."""
KILLED: Final = -signal.SIGKILL
PROCESSES_HIDDEN: Final = "/proc shows no processes, but a process of the command still runs: end it by hand"
CANNOT_END: Final = "runs as another user and can't be ended: end it by hand"


def check_command(command: Sequence[str]) -> None:
    """Check that a command can be run, before waiting for devices. Raises Failed with exit code 126 or 127."""
    name = command[0]
    if shutil.which(name) is not None:
        return
    if "/" in name and Path(name).exists():
        raise Failed(f"{name} is not an executable file; name a program, or chmod +x it", NOT_EXECUTABLE)
    raise Failed(f"{name}: there is no such command; check the name and $PATH", NOT_FOUND)


def environment(held: Held, client: Client) -> dict[str, str]:
    return os.environ | hold_variables(held, client)


def hold_variables(held: Held, client: Client) -> dict[str, str]:
    variables = {
        "ZSCOUT_ARC": held.arc.name,
        "ZSCOUT_ARC_ID": held.arc.id,
        "ZSCOUT_RCS": " ".join(held.rcs),
        "ZSCOUT_BOUND": msgspec.json.encode(held.bound).decode(),
        "ZSCOUT_GRANT": msgspec.json.encode(held.grant).decode(),
        "ZSCOUT_CLIENT": str(client.mesh.me),
        "ZSCOUT_REMAINING": f"{max(0.0, held.remaining):.3f}",
        "ZSCOUT_FLEET_NAME": client.fleet.name,
    }
    if (file := fleet_file()) is not None:
        variables["ZSCOUT_FLEET"] = str(file.absolute())
    return variables


class RunningCommand:
    """A command, from its start to the end of its last process. An async context manager: at its exit none is left.
    grace: seconds from SIGTERM to SIGKILL. until: as of `hold_until`. kept: a descriptor that the guardian keeps open
    until all processes have ended."""

    def __init__(
        self,
        command: Sequence[str],
        env: Mapping[str, str],
        grace: float,
        until: Ns | None = None,
        kept: int | None = None,
    ) -> None:
        self._command, self._env, self._grace = list(command), env, grace
        self._kept = () if kept is None else (kept,)
        self._loop = asyncio.get_running_loop()
        self._gone: asyncio.Future[None] = self._loop.create_future()
        self._tty = _Terminal()
        self._timer: asyncio.TimerHandle | None = None
        self._channel, self._theirs = socket.socketpair()
        self._received = b""
        self._noted = self._terminated = self._exited = False
        self._code = KILLED
        self._stuck = asyncio.Event()
        self.pid = 0
        """Id of the command's process and of its process group."""
        self.why_ended = ""
        """The reason that the guardian ended it: `deadline`, `client`, `signal`; empty: it ended by itself."""
        if until is not None:
            self.hold_until(until)

    async def __aenter__(self) -> Self:
        # If the guardian is killed, this process inherits the command's processes.
        be_subreaper()
        self._channel.setblocking(False)
        self._loop.add_reader(self._channel, self._receive)
        self._loop.add_signal_handler(signal.SIGTSTP, self._note_suspension)
        theirs, tty = self._theirs.fileno(), self._tty.fd if self._tty.ours_to_give() else -1
        try:
            self._process: subprocess.Popen[Any] = subprocess.Popen(  # noqa: S603, ASYNC220 - returns at once
                [
                    *GUARD,
                    ",".join(map(str, (theirs, *self._kept))),
                    str(tty),
                    str(round(self._grace * SECOND)),
                    *self._command,
                ],
                env=dict(self._env),
                process_group=0,
                pass_fds=(theirs, *self._kept) if tty < 0 else (theirs, *self._kept, tty),
            )
        except OSError as error:
            self._close()
            raise Failed(f"{self._command[0]} can't be run: {error.strerror}", NOT_EXECUTABLE) from None
        self._theirs.close()
        return self

    async def __aexit__(self, *exc: object) -> None:
        try:
            await self.end()
        finally:
            self._close()

    def hold_until(self, at: Ns) -> None:
        """End the command at this time, by the monotonic clock of the fleet's programs, unless a later one is given."""
        self._send(f"until {at}")

    async def wait(self) -> int:
        """Wait until the command and all its processes are ended. Return its exit code, 128 + n by signal n."""
        await self._wait_until_gone()
        return self._code if self._code >= 0 else 128 - self._code

    @property
    def gone(self) -> bool:
        return self._gone.done()

    def signal(self, number: int) -> None:
        """Send a signal to the command's own process, as soon as it catches that signal."""
        self._send(f"signal {number}")

    def terminate(self, at: Ns) -> None:
        """Send SIGTERM to all its processes; SIGKILL follows a grace after `at`. Further calls do nothing."""
        if not self._terminated:
            self._terminated = True
            self._send(f"end {at}")

    async def end(self) -> None:
        """Return when all its processes have ended: SIGTERM, then SIGKILL after the grace or when this is cancelled.
        Processes of another user that can't be ended are reported and left."""
        self.terminate(now())
        try:
            await first_of(self._wait_until_gone(), self._stuck.wait())
        except asyncio.CancelledError:
            self._send("kill")
            await first_of(self._wait_until_gone(), self._stuck.wait())
            raise

    async def _wait_until_gone(self) -> None:
        await asyncio.shield(self._gone)

    def _close(self) -> None:
        self._loop.remove_reader(self._channel)
        self._loop.remove_signal_handler(signal.SIGTSTP)
        self._channel.close()
        self._theirs.close()
        if self._timer is not None:
            self._timer.cancel()
        if self.pid:
            self._tty.take_back(self.pid, restore=self._code != 0)
        self._tty.close()

    def _send(self, words: str) -> None:
        with contextlib.suppress(OSError):  # the guardian has ended
            self._channel.send(f"{words}\n".encode())

    def _receive(self) -> None:
        try:
            text = self._channel.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            text = b""
        *lines, self._received = (self._received + text).split(b"\n")
        for line in lines:
            self._take(*line.decode().split())
        if not text:
            self._loop.remove_reader(self._channel)
            self._process.wait()
            if not self._gone.done():
                self._sweep(ROUND / SECOND)

    def _take(self, word: str, number: str = "0") -> None:
        match word:
            case "started":
                self.pid = int(number)
            case "stopped":
                self._stopped(int(number))
            case "exited":
                self._code = int(number)
                self._exited = True
            case "ending" if not self._exited:
                self.why_ended = number
            case "stuck":
                process = f"process {number} {CANNOT_END}" if number != "0" else PROCESSES_HIDDEN
                print_line(f"zscout: {self._command[0]}: {process}", sys.stderr)
                self._stuck.set()
            case "gone":
                self._over()

    def _over(self) -> None:
        if not self._gone.done():
            self._gone.set_result(None)

    def _sweep(self, pause: float) -> None:
        left = descendants(os.getpid())
        for process in left:
            with contextlib.suppress(PermissionError):
                process.signal(signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if left:
            self._timer = self._loop.call_later(pause, self._sweep, min(2 * pause, SLOWEST / SECOND))
            return
        print_line(f"zscout: {self._command[0]} was ended: its guardian was killed", sys.stderr)
        self._over()

    def _stopped(self, number: int) -> None:
        if number in (signal.SIGTTIN, signal.SIGTTOU):
            self._want_terminal()
        elif number == signal.SIGTSTP:
            self._note_suspension()
            self._send("continue")

    def _want_terminal(self) -> None:
        """The command was stopped because it needs the terminal: continue it as soon as it can have the terminal."""
        if self._gone.done():
            return
        if self._tty.give(self.pid):
            self._send("continue")
        else:
            self._timer = self._loop.call_later(TERMINAL_RETRY_S, self._want_terminal)

    def _note_suspension(self) -> None:
        if not self._noted:
            self._noted = True
            print_line("zscout: not suspended: its devices would be idle", sys.stderr)


class _Terminal:
    """The controlling terminal, if there is one."""

    def __init__(self) -> None:
        self.fd = -1
        self._modes: list[Any] = []
        try:
            self.fd = os.open("/dev/tty", os.O_RDWR | os.O_CLOEXEC)
            self._modes = termios.tcgetattr(self.fd)
        except (OSError, termios.error):
            self.close()

    def ours_to_give(self) -> bool:
        """Return True if this process has the foreground, outside a pipeline, whose other processes would lose it."""
        return self._foreground() == os.getpgrp() and sys.stdin.isatty() and sys.stdout.isatty()

    def give(self, group: int) -> bool:
        """Give a process group the foreground, if this process has it. Return True if the group has it then."""
        if self._foreground() == os.getpgrp():
            self._set(group)
        return self._foreground() == group

    def take_back(self, group: int, *, restore: bool) -> None:
        """Take the foreground back from a process group; with `restore`, restore the terminal's modes."""
        if self.fd < 0 or self._foreground() != group:
            return
        self._set(os.getpgrp())
        if restore:
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self.fd, termios.TCSADRAIN, self._modes)

    def close(self) -> None:
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1

    def _foreground(self) -> int | None:
        if self.fd < 0:
            return None
        try:
            return os.tcgetpgrp(self.fd)
        except OSError as error:
            if error.errno in (errno.ENOTTY, errno.EIO):  # hung up
                return None
            raise

    def _set(self, group: int) -> None:
        # From the background tcsetpgrp stops the caller unless SIGTTOU is blocked.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTOU})
        try:
            os.tcsetpgrp(self.fd, group)
        except OSError:
            pass
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTTOU})
