"""A command that runs under a grant: in a process group of its own, ended as a whole.

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
import subprocess
import sys
import termios
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

import msgspec

from zscout.behaviors.launch import LAUNCH
from zscout.cli.common import Failed, fleet_file
from zscout.terminal import print_line

if TYPE_CHECKING:
    from zscout.behaviors.client.arc import Held
    from zscout.behaviors.client.client import Client

NOT_EXECUTABLE, NOT_FOUND = 126, 127
LOOK_AGAIN: Final = 0.3
"""Seconds between two looks at a terminal, or at a group without its leader: neither reports changes."""


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
    return os.environ | variables


class RunningCommand:
    """A command from its start to the end of its last process. Use as an async context manager: whatever
    happens in the body, nothing of it is left afterwards."""

    def __init__(self, command: Sequence[str], env: Mapping[str, str], grace: float) -> None:
        self._command, self._env, self._grace = list(command), env, grace
        self._loop = asyncio.get_running_loop()
        self._ended: asyncio.Future[int] = self._loop.create_future()
        self._tty = _Terminal()
        self._timer: asyncio.TimerHandle | None = None
        self._noted = self._gone = self._foreign = False

    async def __aenter__(self) -> Self:
        # First the handler, then the child: it may end at once.
        self._loop.add_signal_handler(signal.SIGCHLD, self._look)
        self._loop.add_signal_handler(signal.SIGTSTP, self._note_suspension)
        handed = self._tty.fd if self._tty.ours_to_give() else -1
        try:
            self._process: subprocess.Popen[Any] = subprocess.Popen(  # noqa: S603, ASYNC220 - returns at once
                [*LAUNCH, str(os.getpid()), str(handed), *self._command],
                env=dict(self._env),
                process_group=0,
                pass_fds=() if handed < 0 else (handed,),
            )
        except OSError as error:
            self._close()
            raise Failed(f"{self._command[0]} can't be run: {error.strerror}", NOT_EXECUTABLE) from None
        self._look()
        return self

    async def __aexit__(self, *exc: object) -> None:
        try:
            await self.end()
        finally:
            self._close()

    @property
    def pid(self) -> int:
        """Of the command, and of its process group."""
        return self._process.pid

    async def wait(self) -> int:
        """Waits until the command itself has ended. Its exit code, 128 + n where signal n ended it."""
        code = await asyncio.shield(self._ended)
        return code if code >= 0 else 128 - code

    async def end(self) -> None:
        """Ends the whole group: SIGTERM, and SIGKILL after the grace or where this is cancelled."""
        if not self._signal(signal.SIGTERM):
            return
        self._signal(signal.SIGCONT)  # a stopped process gets SIGTERM only when it goes on
        try:
            async with asyncio.timeout(self._grace):
                await asyncio.shield(self._ended)
                while self._signal(0):  # noqa: ASYNC110 - the end of orphans is reported to init, not to us
                    await asyncio.sleep(LOOK_AGAIN / 10)
        except TimeoutError:
            pass
        finally:
            self._signal(signal.SIGKILL)
        if self._foreign and not self._ended.done():
            print_line(
                f"zscout: {self._command[0]} runs as another user now and can't be ended: end it by hand", sys.stderr
            )
            return
        await asyncio.shield(self._ended)

    def _close(self) -> None:
        for number in (signal.SIGCHLD, signal.SIGTSTP):
            self._loop.remove_signal_handler(number)
        if self._timer is not None:
            self._timer.cancel()
        if hasattr(self, "_process"):
            self._tty.take_back(self.pid, restore=self._process.returncode not in (0, None))
        self._tty.close()

    def _signal(self, number: int) -> bool:
        """Signals the whole group. False if there is nobody left in it."""
        if not self._gone:
            try:
                os.killpg(self.pid, number)
            except ProcessLookupError:
                self._gone = True  # from now on the number may be another's
            except PermissionError:
                self._foreign = True
        return not self._gone

    def _look(self) -> None:
        """Something happened to a child: it ended, or was stopped."""
        if not hasattr(self, "_process") or self._ended.done():
            return
        while True:
            try:
                pid, status = os.waitpid(self.pid, os.WNOHANG | os.WUNTRACED)
            except ChildProcessError:
                pid, status = self.pid, 0
            if pid == 0:
                return
            if not os.WIFSTOPPED(status):
                self._process.returncode = os.waitstatus_to_exitcode(status)
                self._ended.set_result(self._process.returncode)
                return
            if os.WSTOPSIG(status) in (signal.SIGTTIN, signal.SIGTTOU):
                self._want_terminal()
            elif os.WSTOPSIG(status) == signal.SIGTSTP:
                self._note_suspension()
                self._signal(signal.SIGCONT)

    def _want_terminal(self) -> None:
        """The command was stopped for want of the terminal: it goes on as soon as it can have it."""
        if self._ended.done():
            return
        if self._tty.give(self.pid):
            self._signal(signal.SIGCONT)
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
