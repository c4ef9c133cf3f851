"""`zscout acquire`, `run` and `renew`: a hold that outlasts commands, named by a token."""

from __future__ import annotations

import asyncio
import os
import socket
import subprocess
import sys
from contextlib import suppress
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any, Final

import click
import msgspec

from zscout.behaviors.guardian import now
from zscout.cli import common
from zscout.cli.common import Failed, Parsed, json_option
from zscout.cli.requests import token_files
from zscout.cli.requests.options import (
    DEFAULT_NAMES,
    CommandAfterDashes,
    HoldCommand,
    HoldOptions,
    gather,
    grace_option,
    grace_within,
    hold_options,
    infra_exit_option,
    is_descriptor,
    notify_signal_option,
    parse_duration,
    priority_option,
    tolerate_option,
)
from zscout.cli.requests.request import TAKEN_AWAY
from zscout.cli.requests.run_command import RunningCommand, check_command
from zscout.cli.requests.token_files import FromHolder, ToHolder, TokenChannel, TokenFile, TokenGranted
from zscout.config.strict import BadInput, quoted
from zscout.terminal import clean, clock, print_json, print_line, span

ANSWER_TIMEOUT_S: Final = 10.0
"""The longest wait for an answer of the holder process."""
RELEASE_TIMEOUT_S: Final = 60.0
"""The longest wait until the holder process has ended the commands and released the devices."""
ABORT_TIMEOUT_S: Final = 10.0
"""For the end of a holder process that is no longer needed."""
for_option: Final = click.option(
    "--for",
    "span_",
    required=True,
    type=Parsed("duration", parse_duration),
    help="Hold for at most this long: 30m, 2h.",
)


def _tokens(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[str]:
    return [token for token in token_files.tokens() if token.startswith(incomplete)]


token_argument: Final = click.argument("token", metavar="TOKEN", shell_complete=_tokens)


class AcquireCommand(HoldCommand):
    """The command keeps its arguments: it starts itself again with them, as the holder process."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if "--" in args:
            raise click.UsageError("acquire runs no command; write zscout run TOKEN -- COMMAND after it", ctx)
        ctx.meta["args"] = tuple(args)
        return super().parse_args(ctx, args)


@click.command(cls=AcquireCommand)
@click.option(
    "--starter", type=int, hidden=True, help="Descriptor of the socket to the process that started the holder process."
)
@click.option(
    "--follow",
    metavar="PID",
    type=click.IntRange(1),
    help="Release the devices when this process ends, as the shell of a job: $$. Default in a GitLab job: its shell.",
)
@priority_option
@tolerate_option
@for_option
@partial(hold_options, runs_command=False)
@common.runs
async def acquire(
    needs: Any, span_: Decimal, follow: int | None, starter: int | None, name: str | None, **rest: Any
) -> int:
    """Wait for devices and hold them for the commands that follow; print a token and return.

    A background process on this host holds the devices until `zscout release TOKEN`, or until the time of --for is
    over. `zscout run TOKEN -- COMMAND` runs commands under the hold, in later steps of a job or in another terminal of
    the same user; `zscout renew TOKEN --for 1h` extends it. The hold is protected from requests of equal priority for
    the time of --for.

    The devices are also released when the background process ends, by any signal, and with --follow when that
    process ends. Only the token is printed on stdout; DEVICE and the exit codes are those of `zscout request`.

    \b
    Examples:
      TOKEN=$(zscout acquire dut/board --for 2h)
      zscout acquire 'gpu/*' --for 30m --timeout 10m --follow 4711
      zscout acquire dut/board --for 2h --json | jq -r .token
    """
    follow = follow if follow is not None else _job_process()
    if starter is None:
        return await _start(follow, rest["json_file"], as_json=rest["as_json"])
    channel = TokenChannel(socket.socket(fileno=starter))
    os.set_inheritable(starter, False)
    from zscout.cli.requests import token_holder

    terms: dict[str, Any] = {"min_runtime": span_, "grace": None, "again": False, "direct": True, "release_after": None}
    wanted: HoldOptions = gather(needs, name, DEFAULT_NAMES[2], keep=True, **terms, **rest)
    async with common.connected("acquire") as client:
        return await token_holder.hold(client, wanted, float(span_), follow, channel)


def _job_process() -> int | None:
    """A GitLab job's shell, which leads the job's process group. Other CI services run each step in a shell of its own,
    and find leftover processes by their environment."""
    group = os.getpgrp()
    return group if os.environ.get("GITLAB_CI") and group not in (0, os.getpid()) else None


async def _start(follow: int | None, json_file: str | None, *, as_json: bool) -> int:
    """Start the holder process, and print the token that it sends. Return its exit code if it sends none."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    context = click.get_current_context()
    fleet = common.fleet_file()
    command = [sys.executable, "-P", "-m", "zscout.cli.main", *(["--fleet", str(fleet)] if fleet is not None else [])]
    command += ["acquire", *context.meta["args"], "--starter", str(theirs.fileno())]
    command += ["--follow", str(follow)] if follow is not None else []
    given = [int(json_file)] if json_file is not None and is_descriptor(json_file) else []
    process = subprocess.Popen(  # noqa: S603, ASYNC220 - returns at once
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        pass_fds=(theirs.fileno(), *(fd for fd in given if fd > 2)),
    )
    theirs.close()
    channel = TokenChannel(ours)
    try:
        received = await channel.receive(TokenGranted)
        if received is not None:
            granted, _ = received
            if as_json:
                print_json({"token": granted.token} | granted.details)
            else:
                print_line(granted.token)
            channel.send(ToHolder("printed"))
            return 0
    except BaseException:
        channel.close()  # the holder process then gives up
        with suppress(subprocess.TimeoutExpired):
            process.wait(ABORT_TIMEOUT_S)
        raise
    code = await asyncio.to_thread(process.wait)
    if code < 0:
        raise Failed(f"the holder process was ended by signal {-code}; nothing is held")
    return code


class UsedToken:
    """The token of a command, connected to its holder process. Raises BadInput, or Failed if its hold has ended."""

    def __init__(self, token: str) -> None:
        path = token_files.find(token)
        if path is None:
            hint = f"; {token} is a device: zscout request {token} -- COMMAND" if "/" in token else ""
            raise BadInput(f"unknown token {quoted(token)}{hint or _known()}")
        self.path: Path = path
        try:
            self.file: TokenFile = token_files.read(path)
        except (OSError, msgspec.DecodeError) as error:
            raise Failed(f"{path} can't be read: {error}; remove it, and acquire the devices again") from None
        if self.file.ended:
            raise Failed(f"{self.file.arc} has ended: {self.file.ended}; acquire the devices again", self.file.code)
        channel = token_files.connect(path)
        if channel is None:
            raise Failed(f"{self.file.arc} has ended: {DIED}; acquire the devices again", TAKEN_AWAY)
        self.channel: TokenChannel = channel

    async def receive(self) -> FromHolder | None:
        """Return the next message of the holder process; None: it has ended."""
        received = await self.channel.receive(FromHolder)
        return received[0] if received is not None else None

    async def answer(self) -> FromHolder:
        """Return the next message within ANSWER_TIMEOUT_S. Raises Failed for a refusal, the end or no message."""
        try:
            async with asyncio.timeout(ANSWER_TIMEOUT_S):
                word = await self.receive()
        except TimeoutError:
            raise Failed(f"the holder process {self.file.pid} of {self.file.arc} does not answer; try again") from None
        if word is None:
            raise Failed(f"{self.file.arc} has ended: {DIED}; acquire the devices again", TAKEN_AWAY)
        if word.op == "refused":
            raise Failed(f"{self.file.arc}: {word.why}")
        if word.op == "end":
            raise Failed(f"{self.file.arc} has ended: {word.why}; acquire the devices again", word.code)
        return word


DIED: Final = "its holder process has ended, and the devices are released"


def _known() -> str:
    known = token_files.tokens()
    listed = f"; known here: {', '.join(known[:8])}" if known else ", and you have no token on this host"
    return f"{listed}; a token works for the same user on the same host"


@click.command(cls=CommandAfterDashes)
@token_argument
@infra_exit_option
@grace_option
@notify_signal_option
@common.runs
async def run(token: str, grace: Decimal | None, infra_exit: int | None, notify_signal: int | None) -> int:
    """Run a command under the hold of a token that `zscout acquire` printed.

    The command gets the same environment variables as with `zscout request -- COMMAND`, and is ended in the same way:
    when its hold ends, the command and its processes get SIGTERM, and SIGKILL after the grace; also if zscout or the
    holder process dies or hangs. When the command ends by itself, the devices stay held. Several commands may run
    under one token at a time.

    \b
    Exit code: the command's own (128 + n: ended by signal n), or
      75   the devices were taken away, or released by another command
      124  the time of --for was over
      126  the command can't be executed       127  there is no such command
      1    the holder process does not answer  2    there is no such token
    With --infra-exit N it is N instead of 1, 2, 75 and 124: all other codes are the command's own.

    \b
    Examples:
      zscout run $TOKEN -- ./flash.sh
      zscout run $TOKEN --infra-exit 99 -- pytest tests/on_board
    """
    command: tuple[str, ...] = click.get_current_context().meta["command"]
    if not command:
        raise click.UsageError("-- COMMAND is missing", click.get_current_context())
    check_command(command)
    held = UsedToken(token)
    read, write = os.pipe()
    held.channel.send(ToHolder("run"), [read])
    os.close(read)
    try:
        begun = await held.answer()
        longest, text = grace_within(grace, begun.grace)
        if text:
            print_line(text, sys.stderr)
        return await _run(held, command, begun, longest, write, infra_exit, notify_signal)
    finally:
        held.channel.close()


async def _run(
    held: UsedToken,
    command: tuple[str, ...],
    begun: FromHolder,
    grace: float,
    kept: int,
    infra_exit: int | None,
    notify_signal: int | None,
) -> int:
    """Run a command under the hold. Closes `kept`."""
    ended: FromHolder | None = None
    running = RunningCommand(command, os.environ | begun.env, grace, begun.at, kept)

    async def follow() -> None:
        nonlocal ended
        while (word := await held.receive()) is None or word.op != "end":
            if word is None:
                word = FromHolder("end", at=now(), why=DIED, code=TAKEN_AWAY)
                break
            if word.op == "until":
                running.hold_until(word.at)
            elif word.op == "notice":
                print_line(clean(f"zscout: {word.why}"), sys.stderr)
                if notify_signal is not None and not word.withdrawn:
                    running.signal(notify_signal)
        ended = word
        running.terminate(word.at)

    try:
        async with running:
            os.close(kept)
            _, over = await common.first_of(follow(), running.wait())
            if over and running.why_ended not in ("client", "deadline"):
                return await running.wait()
            why = ended.why if ended is not None else "its hold could not be confirmed in time"
            print_line(clean(f"zscout: {command[0]} is stopped: {held.file.arc} has ended: {why}"), sys.stderr)
    finally:
        if running.gone:
            held.channel.send(ToHolder("gone"))
    return infra_exit or (ended.code if ended is not None else TAKEN_AWAY)


@click.command(cls=HoldCommand)
@token_argument
@for_option
@infra_exit_option
@json_option("Print one JSON object.")
@common.runs
async def renew(token: str, span_: Decimal, as_json: bool, infra_exit: int | None) -> None:
    """Hold the devices of a token for at most the time of --for from now.

    Only the time of `zscout acquire --for` is protected. After it you keep the devices until a request of equal or
    higher priority waits for one of them: if you need them longer, acquire them for longer.

    \b
    Examples:
      zscout renew $TOKEN --for 1h
    """
    held = UsedToken(token)
    held.channel.send(ToHolder("renew", float(span_)))
    try:
        done = await held.answer()
    finally:
        held.channel.close()
    seconds, protected = float(span_), min(done.remaining, float(span_))
    if as_json:
        found = {"token": token, "arc": held.file.arc, "for": seconds, "protected": round(protected, 3)}
        print_json(found)
        return
    then = "" if protected >= seconds else f", protected for {span(protected)}, then unless another request waits"
    print_line(clean(f"{held.file.arc} is yours for {span(seconds)} (until {clock(seconds)}){then}"))


async def release_token(token: str) -> TokenFile | None:
    """End the hold, and remove the file if the hold has ended already. None: `token` is no token. Raises Failed."""
    path = token_files.find(token)
    if path is None:
        return None
    try:
        file = token_files.read(path)
    except (OSError, msgspec.DecodeError) as error:
        raise Failed(f"{path} can't be read: {error}") from None
    channel = None if file.ended else token_files.connect(path)
    if channel is None:
        token_files.remove(path)
        return file if file.ended else msgspec.structs.replace(file, ended=DIED)
    channel.send(ToHolder("release"))
    try:
        async with asyncio.timeout(RELEASE_TIMEOUT_S):
            received = await channel.receive(FromHolder)
    except TimeoutError:
        raise Failed(
            f"the holder process {file.pid} of {file.arc} does not answer; to end it: kill {file.pid}"
        ) from None
    finally:
        channel.close()
    if received is None:
        token_files.remove(path)
    elif received[0].op == "refused":
        raise Failed(f"{file.arc}: {received[0].why}; the devices wait until they have settled")
    return file
