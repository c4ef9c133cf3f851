"""The holder process behind a token: it waits for the devices, holds them, and serves commands that use the hold.

`zscout acquire` starts it, in a session of its own, and ends before it. Each `zscout run` learns the time until which
the hold is certain; the guardian of the command ends the command by then, even if this process dies. The devices are
released only when no command is left. If a command can't be ended, or this process dies, the devices settle."""

from __future__ import annotations

import asyncio
import os
import socket
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from zscout.behaviors.client.arc import Held
from zscout.behaviors.client.client import Client, CommandRefused
from zscout.behaviors.client.direct import DEFAULT_SETTLE, DirectHold
from zscout.behaviors.client.hold_notices import HoldNotice
from zscout.behaviors.client.request import OpenArc
from zscout.cli import common
from zscout.cli.common import Failed
from zscout.cli.requests import token_files
from zscout.cli.requests.options import HoldOptions
from zscout.cli.requests.request import (
    TAKEN_AWAY,
    TIME_OVER,
    Report,
    ending_of,
    held_text,
    report_notices,
    reporting_unwell,
    tolerate,
    wait_for_grant,
)
from zscout.cli.requests.run_command import hold_variables
from zscout.cli.requests.token_files import FromHolder, ToHolder, TokenChannel, TokenFile, TokenGranted
from zscout.config.strict import BadInput
from zscout.keyexpr import new_instance
from zscout.terminal import clock, span
from zscout.types import SECOND, Ns

MAX_RUNS: Final = 64
"""Commands at one time under one token."""
CHECK_FILE_INTERVAL_S: Final = 1.0
"""Interval between checks that the token's file still exists."""
KILL_TIMEOUT_S: Final = 2.0
"""Within this time after the grace guardians have killed their commands."""


class TokenEnding(NamedTuple):
    """The end of a hold: the reason in words, and the exit code of commands that ran, or are run later."""

    why: str
    code: int = TAKEN_AWAY


RELEASED: Final = TokenEnding("released")
INTERRUPTED: Final = TokenEnding("its holder process was ended")


class _Run:
    """A `zscout run` and its command."""

    def __init__(self, channel: TokenChannel) -> None:
        self.channel = channel
        self.tree_gone, self.client_gone = asyncio.Event(), asyncio.Event()


class TokenHolder:
    """A hold of at most `seconds`, and the commands that use it."""

    def __init__(self, client: Client, held: Held, seconds: float) -> None:
        self._client, self._held, self._arc = client, held, held.arc
        self._direct: DirectHold | None = client.internals.direct_hold(held.grant)
        self._limit: Ns = held.now() + round(seconds * SECOND)
        self._runs: set[_Run] = set()
        self._noticed: dict[str, str] = {}
        """Notices in force, in words by code."""
        self._releasing: list[TokenChannel] = []
        self._ending: asyncio.Future[TokenEnding] = asyncio.get_running_loop().create_future()
        self._changed = asyncio.Event()
        self._server: socket.socket | None = None
        self._talks: set[asyncio.Task[None]] = set()
        if self._direct is not None:
            self._direct.watch(self._follow)

    def serve(self, path: Path) -> None:
        """Serve the commands that use the token of this file, until `close`. Raises Failed."""
        try:
            self._server = token_files.listen(path)
        except OSError as error:
            raise Failed(f"the token's socket can't be opened: {error}") from None
        asyncio.get_running_loop().add_reader(self._server, self._accept, self._server)

    async def until_over(self, path: Path, followed: int | None) -> TokenEnding:
        """Wait until the hold of this file's token is over. followed: pidfd of a process whose end ends the hold."""
        loop = asyncio.get_running_loop()
        if followed is not None:
            loop.add_reader(followed, self._end, TokenEnding("the process that it follows has ended"))
        try:
            async with common.beside(self._watch_hold()):
                while not self._ending.done():
                    left = self._look(path)
                    await asyncio.wait((self._ending,), timeout=max(0.0, min(left, CHECK_FILE_INTERVAL_S)))
                return self._ending.result()
        finally:
            if followed is not None:
                loop.remove_reader(followed)

    def notice(self, notice: HoldNotice, text: str) -> None:
        """Pass a notice to the commands that run, and keep it for later commands."""
        self._noticed.pop(notice.code, None)
        if not notice.withdrawn:
            self._noticed[notice.code] = text
        for run in self._runs:
            run.channel.send(FromHolder("notice", why=text, withdrawn=notice.withdrawn))

    async def give_back(self, ending: TokenEnding) -> bool:
        """End the commands, then release the devices. Return False if a command can't be ended: the devices settle."""
        if not self._ending.done():
            self._ending.set_result(ending)
        at = self._held.now() if self._direct is None else min(self._held.now(), self._direct.ended_at or sys.maxsize)
        for run in self._runs:
            run.channel.send(FromHolder("end", at=at, why=ending.why, code=ending.code))
        await self._wait_for_commands()
        if stuck := any(not run.tree_gone.is_set() for run in self._runs):
            await self._client.internals.leave()
        else:
            if self._direct is not None and self._direct.over:
                self._direct.returned()
            if self._arc.open:
                await self._client.end(self._arc)
        return not stuck

    @property
    def released(self) -> bool:
        return bool(self._releasing)

    def close(self, *, gave_back: bool) -> None:
        """Answer the processes that released the token, and stop serving it: the file has the reason for the end."""
        if self._server is not None:
            asyncio.get_running_loop().remove_reader(self._server)
            self._server.close()
        for channel in self._releasing:
            channel.send(FromHolder("done") if gave_back else FromHolder("refused", why="a command can't be ended"))

    def _end(self, ending: TokenEnding) -> None:
        if not self._ending.done():
            self._ending.set_result(ending)

    async def _watch_hold(self) -> None:
        await self._held.over()
        ending = ending_of(self._arc)
        if ending.outcome == "completed":
            self._end(TokenEnding(ending.reason or "its time is over", TIME_OVER))
        else:
            self._end(TokenEnding(ending.reason or ending.outcome))

    def _look(self, path: Path) -> float:
        """End the hold if its time is over or its file was removed. Return the seconds left."""
        left = (self._limit - self._held.now()) / SECOND
        if left <= 0:
            self._end(TokenEnding("its time is over", TIME_OVER))
        if not path.exists():
            self._end(TokenEnding("the file of its token was removed"))
        return left

    def _accept(self, server: Any) -> None:
        if (channel := token_files.accept(server)) is not None:
            talk = asyncio.ensure_future(self._talk(channel))
            self._talks.add(talk)
            talk.add_done_callback(self._talks.discard)

    async def _talk(self, channel: TokenChannel) -> None:
        received = await channel.receive(ToHolder)
        match received:
            case ToHolder(op="run"), [tree]:
                await self._serve_run(channel, tree)
                channel.close()
            case ToHolder(op="renew", seconds=seconds), _:
                self._limit = self._held.now() + round(seconds * SECOND)
                channel.send(FromHolder("done", remaining=max(0.0, self._held.remaining)))
                channel.close()
            case ToHolder(op="release"), _:
                self._releasing.append(channel)
                self._end(RELEASED)
            case _:
                for fd in received[1] if received is not None else ():
                    os.close(fd)
                channel.close()

    async def _serve_run(self, channel: TokenChannel, tree: int) -> None:
        run = _Run(channel)
        try:
            if self._ending.done():
                ending = self._ending.result()
                channel.send(FromHolder("end", why=ending.why, code=ending.code))
                return
            if len(self._runs) >= MAX_RUNS:
                channel.send(FromHolder("refused", why=f"{MAX_RUNS} commands run under it; wait until one has ended"))
                return
            self._runs.add(run)
            grace = (self._direct.grace if self._direct is not None else DEFAULT_SETTLE) / SECOND
            channel.send(FromHolder("hold", hold_variables(self._held, self._client), float(grace), self._sure_until))
            for text in self._noticed.values():
                channel.send(FromHolder("notice", why=text))
            await asyncio.gather(self._note_client(run), self._note_tree(run, tree))
        finally:
            self._runs.discard(run)
            os.close(tree)
            self._changed.set()

    async def _note_client(self, run: _Run) -> None:
        await run.channel.receive(ToHolder)  # `gone`, or the process has ended
        run.client_gone.set()
        self._changed.set()

    async def _note_tree(self, run: _Run, tree: int) -> None:
        await token_files.readable(tree)
        run.tree_gone.set()
        self._changed.set()

    @property
    def _sure_until(self) -> Ns:
        return self._held.now() if self._direct is None else self._direct.sure_until

    def _follow(self, direct: DirectHold) -> None:
        for run in self._runs:
            if direct.ended_at is not None:
                ending = ending_of(self._arc)
                code = TIME_OVER if ending.outcome == "completed" else TAKEN_AWAY
                run.channel.send(FromHolder("end", at=direct.ended_at, why=ending.reason, code=code))
            else:
                run.channel.send(FromHolder("until", at=direct.sure_until))

    async def _wait_for_commands(self) -> None:
        """Wait until all commands have ended. A frozen `zscout run` is not waited for once its guardian has ended."""
        now, grace = self._held.now(), DEFAULT_SETTLE
        if self._direct is not None:
            grace = self._direct.gone_by - now if self._direct.over else self._direct.grace
        with suppress(TimeoutError):
            async with asyncio.timeout(max(0, grace) / SECOND + KILL_TIMEOUT_S):
                while any(not (run.tree_gone.is_set() and run.client_gone.is_set()) for run in self._runs):
                    self._changed.clear()
                    await self._changed.wait()


async def hold(client: Client, wanted: HoldOptions, seconds: float, follow: int | None, starter: TokenChannel) -> int:
    """Wait for the devices, hand the token to the starter, and hold. Raises Failed, RequestRefused, BadInput."""
    followed = _descriptor_of(follow)
    client.who = wanted.asked_by(client.who)
    with Report(wanted.name, client, as_json=wanted.as_json, stream=sys.stderr, events=wanted.events) as report:
        client.internals.watch(report.news)
        held = await _granted(client, wanted, report, starter)
        arc = held.arc
        if wanted.tolerate is not None:
            await tolerate(wanted.tolerate, report, held)
        details: dict[str, Any] = {"id": arc.id, "rcs": held.rcs, "bound": held.bound, "grant": held.grant}
        details |= {"remaining": round(held.remaining, 3)}
        text = (
            f"{arc.name} holds {held_text(held)}: yours for {span(seconds)} (until {clock(seconds)}), then given back"
        )
        report.event("granted", text, **details)
        holder = TokenHolder(client, held, seconds)
        ending, path = INTERRUPTED, None
        try:
            token = f"{arc.name}-{new_instance()}"
            path, content = _new_file(token, client, held)
            # Whoever gets the token may use it at once.
            holder.serve(path)
            starter.send(TokenGranted(token, text, {"arc": arc.name, "client": str(client.mesh.me)} | details))
            if await starter.receive(ToHolder) is None:
                ending = TokenEnding("the token was not printed")
            else:
                starter.close()
                _detach(wanted)
                noticing = report_notices(report, held, client, holder.notice)
                with reporting_unwell(report, held, client):
                    async with common.beside(noticing):
                        ending = await holder.until_over(path, followed)
        except asyncio.CancelledError:
            if (task := asyncio.current_task()) is not None:
                task.uncancel()
        finally:
            try:
                gave_back = await holder.give_back(ending)
            except BaseException:
                await client.internals.leave()
                raise
            if path is not None:
                _record_end(path, content, ending, forget=holder.released)
            report.event("ended", f"{arc.name} gave back {held_text(held)}", reason=ending.why, code=ending.code)
            holder.close(gave_back=gave_back)
    return 0


async def _granted(client: Client, wanted: HoldOptions, report: Report, starter: TokenChannel) -> Held:
    """Wait for the hold, or until the starter has ended. Raises Failed, BadInput, RequestRefused."""
    waiting = asyncio.ensure_future(wait_for_grant(client, wanted, report, None))

    async def give_up_without_starter() -> None:
        await starter.receive(ToHolder)
        waiting.cancel()

    try:
        async with common.beside(give_up_without_starter()):
            arc: OpenArc = await waiting
    except CommandRefused as refused:
        raise Failed(f"{wanted.name}: {refused}; try again") from None
    except asyncio.CancelledError:
        gone = waiting.done()
        waiting.cancel()
        await asyncio.gather(waiting, return_exceptions=True)
        if gone:
            raise Failed(f"{wanted.name} was cancelled: zscout acquire was ended") from None
        raise
    if arc.grant is None:
        ending = ending_of(arc)
        await client.end(arc)
        raise Failed(f"{arc.name} lost its grant: {ending.reason or ending.outcome}", TAKEN_AWAY)
    return Held(client, arc, arc.grant)


def _descriptor_of(follow: int | None) -> int | None:
    """Raises BadInput."""
    if follow is None:
        return None
    try:
        return os.pidfd_open(follow)
    except OSError as error:
        raise BadInput(f"--follow {follow}: {error.strerror}; give the id of a process that runs") from None


def _new_file(token: str, client: Client, held: Held) -> tuple[Path, TokenFile]:
    """Raises Failed."""
    content = TokenFile(held.arc.name, held.arc.id, str(client.mesh.me), client.fleet.name, held.rcs, os.getpid())
    try:
        path = token_files.new_folder() / f"{token}.json"
        token_files.write(path, content)
    except OSError as error:
        raise Failed(f"the token's file can't be written: {error}") from None
    return path, content


def _record_end(path: Path, content: TokenFile, ending: TokenEnding, *, forget: bool) -> None:
    """Write the end of the hold to the token's file, or remove the file if the token was released."""
    with suppress(OSError):
        if forget or not path.exists():
            token_files.remove(path)
        else:
            token_files.write(path, msgspec.structs.replace(content, ended=ending.why, code=ending.code))
            token_files.remove_socket(path)


def _detach(wanted: HoldOptions) -> None:
    """Close the standard streams: readers of the starter's output must not wait for the end of this process."""
    null = os.open(os.devnull, os.O_RDWR)
    for fd in range(3):
        os.dup2(null, fd)
    os.close(null)
    if wanted.events is not None:
        wanted.events.close_given()
