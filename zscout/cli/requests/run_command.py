"""A command that runs under a grant: started by its guardian, ended as a whole.

At a terminal it has the foreground, so that Ctrl-C and job control are its own (else Ctrl-C reaches `cli/common.run`,
which cancels the request); it can't be suspended with Ctrl-Z, as what it holds would stand idle. In a pipeline it gets
the terminal when it asks for it.
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

LOOK_AGAIN: Final = 0.3
"""Seconds between two looks at a terminal, which reports no changes."""
COMMAND_CODES: Final = (NOT_EXECUTABLE, NOT_FOUND)
"""Exit codes by which a shell says as well that it can't run a command."""
KILLED: Final = -signal.SIGKILL
CANT_FIND: Final = "/proc shows no processes, and one that it has started still runs: end it by hand"
CANT_END: Final = "runs as another user and can't be ended: end it by hand"


def check_command(command: Sequence[str]) -> None:
    """Raises Failed where a command can't be run, before anybody waits for devices: 127, or 126."""
    name = command[0]
    if shutil.which(name) is not None:
        return
    if "/" in name and Path(name).exists():
        raise Failed(f"{name} is not an executable file; name a program, or chmod +x it", NOT_EXECUTABLE)
    raise Failed(f"{name}: there is no such command; check the name and $PATH", NOT_FOUND)


def environment(held: Held, client: Client) -> dict[str, str]:
    """This process's environment, and what a command needs to use what it holds."""
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
    """A command from its start to the end of the last process that came of it. Use as an async context manager:
    whatever happens in the body, nothing of it is left afterwards.

    `grace` in seconds, `until` as `hold_until` has it; `kept`: a descriptor that its guardian keeps open until then."""

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
        self._noted = self._told = self._exited = False
        self._code = KILLED
        self._stuck = asyncio.Event()
        self.pid = 0
        """Of the command, and of its process group."""
        self.why_ended = ""
        """Why the guardian ended it: `deadline`, `client`, `signal`; empty: it ended by itself."""
        if until is not None:
            self.hold_until(until)

    async def __aenter__(self) -> Self:
        # All that comes of the command is ours, should the guardian be killed.
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
        """The command is ended then, by the clock of a fleet's programs, unless a later time is given before."""
        self._say(f"until {at}")

    async def wait(self) -> int:
        """Waits until nothing of the command is left: what it left running is ended with it. Its own exit code,
        128 + n where signal n ended it."""
        await self._wait_until_gone()
        return self._code if self._code >= 0 else 128 - self._code

    @property
    def gone(self) -> bool:
        return self._gone.done()

    def signal(self, number: int) -> None:
        """Send a signal to the command itself, once it catches that."""
        self._say(f"signal {number}")

    def terminate(self, at: Ns) -> None:
        """SIGTERM to all of it; SIGKILL follows a grace after `at`. Once, however often it is called."""
        if not self._told:
            self._told = True
            self._say(f"end {at}")

    async def end(self) -> None:
        """Ends all of it, and returns when it has ended: SIGTERM, and SIGKILL after the grace or where this is
        cancelled. What runs as another user and can't be ended is named, and left."""
        self.terminate(now())
        try:
            await first_of(self._wait_until_gone(), self._stuck.wait())
        except asyncio.CancelledError:
            self._say("kill")
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

    # The guardian's words

    def _say(self, words: str) -> None:
        with contextlib.suppress(OSError):  # it has ended
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
                process = f"process {number} {CANT_END}" if number != "0" else CANT_FIND
                print_line(f"zscout: {self._command[0]}: {process}", sys.stderr)
                self._stuck.set()
            case "gone":
                self._over()

    def _over(self) -> None:
        if not self._gone.done():
            self._gone.set_result(None)

    def _sweep(self, pause: float) -> None:
        left = descendants(os.getpid())
        for one in left:
            with contextlib.suppress(PermissionError):
                one.signal(signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if left:
            self._timer = self._loop.call_later(pause, self._sweep, min(2 * pause, SLOWEST / SECOND))
            return
        print_line(f"zscout: {self._command[0]} is ended: its guardian was killed", sys.stderr)
        self._over()

    # The terminal

    def _stopped(self, number: int) -> None:
        if number in (signal.SIGTTIN, signal.SIGTTOU):
            self._want_terminal()
        elif number == signal.SIGTSTP:
            self._note_suspension()
            self._say("continue")

    def _want_terminal(self) -> None:
        """The command was stopped for want of the terminal: it goes on as soon as it can have it."""
        if self._gone.done():
            return
        if self._tty.give(self.pid):
            self._say("continue")
        else:
            self._timer = self._loop.call_later(LOOK_AGAIN, self._want_terminal)

    def _note_suspension(self) -> None:
        if not self._noted:
            self._noted = True
            print_line("zscout: not suspended: what it holds would stand idle", sys.stderr)


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
        """Whether this process has the foreground alone: others of a pipeline would lose it as well."""
        return self._foreground() == os.getpgrp() and sys.stdin.isatty() and sys.stdout.isatty()

    def give(self, group: int) -> bool:
        """Gives a group the foreground, if it is ours. True if the group has it then."""
        if self._foreground() == os.getpgrp():
            self._set(group)
        return self._foreground() == group

    def take_back(self, group: int, *, restore: bool) -> None:
        """Takes the foreground back from a group; with `restore`, the terminal's modes as they were."""
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
        # From the background this would stop us, were the signal not blocked.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTOU})
        try:
            os.tcsetpgrp(self.fd, group)
        except OSError:
            pass
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTTOU})
