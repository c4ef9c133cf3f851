"""What the subcommands share: running, joining the mesh, options.

Zenoh and Rich are imported by the functions that need them: most of a short command's time is imports.
"""

from __future__ import annotations

import asyncio
import difflib
import os
import signal
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Mapping
from contextlib import asynccontextmanager, suppress
from decimal import Decimal
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, ParamSpec, TypeVar

import click
from msgspec.structs import replace

from zscout.config.fleet import FLEET_VARIABLE, Fleet, fleet_from_env, load_fleet
from zscout.config.strict import BadInput, quoted
from zscout.keyexpr import Role, check_name, new_instance
from zscout.messages import Message, RcmState, Who

if TYPE_CHECKING:
    from zscout.behaviors.client.client import Client
    from zscout.mesh import Mesh, Reply

LOOK_FOR_RCM: Final = 2.0
"""Seconds in which a mesh that has an RCM shows it."""
LOOK_FOR_TAKEOVER: Final = 5.0
"""The same where a candidate is seen: it may be about to take the lead."""
STATE_TRIES: Final = 3
MAX_NAMED: Final = 8
"""Names that are listed of those known."""

P = ParamSpec("P")
T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


class Failed(Exception):
    """A command could not do what was asked: one line, with the remedy, and the exit code."""

    exit_code = 1

    def __init__(self, line: str, exit_code: int | None = None) -> None:
        super().__init__(line)
        self.exit_code = exit_code or self.exit_code


class NobodyThere(Failed):
    """No RCM is on the mesh."""

    exit_code = 3


class Interrupted(Exception):
    """Ended by a signal, after everything was cleared up."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number


# Running


def run(main: Coroutine[Any, Any, T]) -> T:
    """Runs a command's coroutine. SIGINT, SIGTERM and SIGHUP cancel it, so that it clears up; a second one
    cancels the clearing up. Raises Interrupted then."""
    got: list[int] = []

    async def guarded() -> T:
        loop = asyncio.get_running_loop()
        task = asyncio.ensure_future(main)

        def stop(number: int) -> None:
            got.append(number)
            task.cancel()

        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # What a shell or nohup made this process ignore stays ignored.
            if signal.getsignal(number) is not signal.SIG_IGN:
                loop.add_signal_handler(number, stop, number)
        return await task

    try:
        return asyncio.run(guarded())
    except asyncio.CancelledError:
        if not got:
            raise
        raise Interrupted(got[0]) from None


def runs(main: Callable[P, Coroutine[Any, Any, T]]) -> Callable[P, T]:

    @wraps(main)
    def command(*args: P.args, **kwargs: P.kwargs) -> T:
        return run(main(*args, **kwargs))

    return command


# Joining the mesh


def _given_file() -> Path | None:
    """What `--fleet` names, at Tab as well, where no command has run yet."""
    context = click.get_current_context(silent=True)
    given = context.find_root().params.get("fleet") if context is not None else None
    return given if isinstance(given, Path) else None


def fleet_file() -> Path | None:
    """The fleet file: `--fleet`, else $ZSCOUT_FLEET; None: the default fleet."""
    named = os.environ.get(FLEET_VARIABLE)
    return _given_file() or (Path(named) if named else None)


def the_fleet() -> Fleet:
    """The fleet that this call of zscout is about. Raises BadInput."""
    given = _given_file()
    return load_fleet(given) if given is not None else fleet_from_env()


@asynccontextmanager
async def connected(role: str, fleet: Fleet | None = None, *, need_rcm: bool = True) -> AsyncIterator[Client]:
    """A client named `<role>-<random>` on the mesh of `fleet` (default: `the_fleet()`), closed at the end. Raises
    MeshError, BadInput, and with `need_rcm` NobodyThere where no RCM is seen in time."""
    from zscout.behaviors.client.client import Client

    async with await Client.connect(f"{role}-{new_instance()}", fleet=fleet or the_fleet()) as client:
        client.who = replace(client.who or Who(), command=f"zscout {role}")
        if need_rcm:
            await see_rcm(client)
        yield client


async def see_rcm(client: Client, seconds: float = LOOK_FOR_RCM) -> None:
    """Returns as soon as an RCM is seen. Raises NobodyThere where none is within `seconds`, or longer where one may be
    about to lead."""
    from zscout.behaviors.client.client import NoRcm

    try:
        await client.see_rcm(seconds, LOOK_FOR_TAKEOVER)
    except NoRcm as nobody:
        raise NobodyThere(str(nobody).replace(f"(${FLEET_VARIABLE})", f"(--fleet, ${FLEET_VARIABLE})")) from None


async def state_of(client: Client, arc: str | None = None, *, forecast: bool = False) -> RcmState:
    """The RCM's state, with the story of `arc`. Raises NobodyThere where no RCM answers."""
    for _ in range(STATE_TRIES):
        state = await client.state(arc, forecast=forecast)
        if state is not None:
            return state
    raise NobodyThere(f"the leader of fleet {client.fleet.name} did not answer; try again, or see its log")


async def ask_nodes(mesh: Mesh, message: Message, kind: type[T], timeout: float) -> list[Reply[T]]:
    """The answers of all nodes to a question about components. On a secured fleet each is asked by itself: nobody may
    answer with the key of a question to all."""
    keys = mesh.keys
    if not keys.closed:
        return await mesh.ask(keys.component_any(mesh.me), message, kind, timeout=timeout)
    hosts = {token.host for token in await mesh.living(keys.alive_any(Role.NODE), timeout=timeout)}
    asked = (mesh.ask(keys.component(host, mesh.me), message, kind, timeout=timeout) for host in sorted(hosts))
    return [reply for replies in await asyncio.gather(*asked) for reply in replies]


async def until(true: Callable[[], bool], changed: asyncio.Event, seconds: float) -> bool:
    """Waits until `true()`, looked at whenever something has `changed`, at most so long; returns which."""
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            while not true():
                changed.clear()
                await changed.wait()
    return true()


@asynccontextmanager
async def beside(work: Coroutine[Any, Any, Any]) -> AsyncIterator[None]:
    task = asyncio.ensure_future(work)
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def first_of(*works: Coroutine[Any, Any, Any]) -> list[bool]:
    """Runs all until one has ended, and cancels the others. Returns which have; raises what one raised."""
    tasks = [asyncio.ensure_future(work) for work in works]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
        return [task in done for task in tasks]
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


# Options and words


def unknown(what: str, name: str, known: Iterable[str], nothing: str, listed: str, more: int = 0) -> Failed:
    """What to raise where nobody knows a `name`: it lists names like it, or those that are known (the word is
    `listed`) and how many `more` there are, or it says that there is `nothing`."""
    return Failed(f"unknown {what} {quoted(name)}{hint_at(name, known, nothing, listed, more)}")


def device_named(state: RcmState, name: str) -> str | None:
    """The device of this name, or the only device that may be meant by it: `robot/arm1` by `arm1`."""
    alike = [view.rc for view in state.rcs if name in (view.rc, view.rc.partition("/")[2])]
    return name if name in alike else alike[0] if len(alike) == 1 else None


def hint_at(name: str, known: Iterable[str], nothing: str, listed: str, more: int = 0) -> str:
    """The end of a line that says that nobody knows `name`: what was meant, perhaps."""
    names = sorted(set(known))
    # `arm1` for `robot/arm1`.
    alike = [known for known in names if known.partition("/")[2] == name][:3]
    if near := alike or difflib.get_close_matches(name, names, n=3):
        return f"; did you mean {' or '.join(near)}?"
    if not names:
        return f", {nothing}"
    rest = len(names) - MAX_NAMED + more
    return f"; {listed}: {', '.join(names[:MAX_NAMED])}" + (f" and {rest} more" if rest > 0 else "")


class Parsed(click.ParamType[T]):
    """What `parse` makes of a text, given the option's name as well. It raises BadInput."""

    def __init__(self, name: str, parse: Callable[[str, str], T]) -> None:
        self.name, self._parse = name, parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> T:
        if not isinstance(value, str):
            return value  # type: ignore[no-any-return]
        return self._parse(value, param.opts[0] if param is not None else self.name)


NAME: Final = Parsed("text", check_name)
"""A name in the key space."""


def json_option(help: str = "Print JSON.") -> Callable[[F], F]:  # noqa: A002 - click's word
    """The `--json` option; the parameter is `as_json`."""
    return click.option("--json", "as_json", is_flag=True, help=help)


def with_amounts(name: str, params: Mapping[str, Decimal]) -> str:
    """With bandwidth parameters as people write them: `radio/rf0 (command_rate=5,other=1)`."""
    amounts = ",".join(f"{one}={value.normalize():f}" for one, value in sorted(params.items()))
    return f"{name} ({amounts})" if amounts else name


def check_recording(option: str, path: Path | None) -> None:
    """That a recording can be written there, before anything is done for it. Raises BadInput."""
    if path is None:
        return
    if path.suffix != ".rrd":
        raise BadInput(f"{option} {path}: not the name of a recording; end it in .rrd")
    there = path.exists()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("ab").close()
    except OSError as error:
        why = "its folder is a file" if isinstance(error, FileExistsError) else error.strerror
        raise BadInput(f"{option} {path}: can't be written ({why}); give another file") from None
    if not there:
        path.unlink()
