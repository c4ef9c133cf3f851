"""Shared by the subcommands: running, joining the mesh, options.

Zenoh and Rich are imported where they are needed: most of a short command's time is imports."""

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

FIND_RCM_S: Final = 2.0
"""Within this time the token of an RCM is seen."""
AWAIT_TAKEOVER_S: Final = 5.0
"""The same if a candidate is seen: it may be about to take the lead."""
REMEDIES: Final[Mapping[str, str]] = {
    "wait_for_device": "to wait anyway, add --wait-for-device",
    "check_fleet": (
        f"start zscout-node on a host, or check the fleet file (--fleet, ${FLEET_VARIABLE}): `zscout doctor` finds the "
        "cause"
    ),
}
"""What an error proposes at the command line, by its code."""
STATE_TRIES: Final = 3
MAX_NAMED: Final = 8
"""Known names that an error lists."""

P = ParamSpec("P")
T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


class Failed(Exception):
    """A command failed: one line, with the remedy, and the exit code."""

    exit_code = 1

    def __init__(self, line: str, exit_code: int | None = None) -> None:
        super().__init__(line)
        self.exit_code = exit_code or self.exit_code


class NobodyThere(Failed):
    """No RCM is on the mesh."""

    exit_code = 3


class Interrupted(Exception):
    """Ended by a signal, after cleaning up."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number


def run(main: Coroutine[Any, Any, T]) -> T:
    """SIGINT, SIGTERM and SIGHUP cancel it to clean up; a second one cancels that. Raises Interrupted after them."""
    signals: list[int] = []

    async def guarded() -> T:
        loop = asyncio.get_running_loop()
        task = asyncio.ensure_future(main)

        def stop(number: int) -> None:
            signals.append(number)
            task.cancel()

        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # Signals that a shell or nohup made this process ignore stay ignored.
            if signal.getsignal(number) is not signal.SIG_IGN:
                loop.add_signal_handler(number, stop, number)
        return await task

    try:
        return asyncio.run(guarded())
    except asyncio.CancelledError:
        if not signals:
            raise
        raise Interrupted(signals[0]) from None


def runs(main: Callable[P, Coroutine[Any, Any, T]]) -> Callable[P, T]:

    @wraps(main)
    def command(*args: P.args, **kwargs: P.kwargs) -> T:
        return run(main(*args, **kwargs))

    return command


def _given_file() -> Path | None:
    """Also during completion, before any command runs."""
    context = click.get_current_context(silent=True)
    given = context.find_root().params.get("fleet") if context is not None else None
    return given if isinstance(given, Path) else None


def fleet_file() -> Path | None:
    """Return the fleet file: `--fleet`, else $ZSCOUT_FLEET; None: the default fleet."""
    variable = os.environ.get(FLEET_VARIABLE)
    return _given_file() or (Path(variable) if variable else None)


def the_fleet() -> Fleet:
    """Raises BadInput."""
    given = _given_file()
    return load_fleet(given) if given is not None else fleet_from_env()


@asynccontextmanager
async def connected(role: str, fleet: Fleet | None = None, *, need_rcm: bool = True) -> AsyncIterator[Client]:
    """A client named `<role>-<random>` on the mesh of `fleet` (default: `the_fleet()`). Raises MeshError, BadInput, and
    with `need_rcm` NobodyThere if no RCM is seen in time."""
    from zscout.behaviors.client.client import Client

    async with await Client.connect(f"{role}-{new_instance()}", fleet=fleet or the_fleet()) as client:
        client.who = replace(client.who or Who(), command=f"zscout {role}")
        if need_rcm:
            await see_rcm(client)
        yield client


async def see_rcm(client: Client, seconds: float = FIND_RCM_S) -> None:
    """Return once an RCM is seen. Raises NobodyThere after `seconds`, or later if a candidate may be about to lead."""
    from zscout.behaviors.client.client import NoRcm
    from zscout.behaviors.client.remedies import with_remedy

    try:
        await client.see_rcm(seconds, AWAIT_TAKEOVER_S)
    except NoRcm as error:
        raise NobodyThere(with_remedy(error.fault, error.remedy, REMEDIES)) from None


async def state_of(client: Client, arc: str | None = None, *, forecast: bool = False) -> RcmState:
    """With the explanation of `arc`. Raises NobodyThere if no RCM answers."""
    for _ in range(STATE_TRIES):
        state = await client.state(arc, forecast=forecast)
        if state is not None:
            return state
    raise NobodyThere(f"the leader of fleet {client.fleet.name} did not answer; try again, or see its log")


async def ask_nodes(mesh: Mesh, message: Message, kind: type[T], timeout: float) -> list[Reply[T]]:
    """The answers of all nodes. In a secured fleet none may answer on the shared key: each node is asked on its own."""
    keys = mesh.keys
    if not keys.closed:
        return await mesh.ask(keys.component_any(mesh.me), message, kind, timeout=timeout)
    hosts = {token.host for token in await mesh.living(keys.alive_any(Role.NODE), timeout=timeout)}
    asked = (mesh.ask(keys.component(host, mesh.me), message, kind, timeout=timeout) for host in sorted(hosts))
    return [reply for replies in await asyncio.gather(*asked) for reply in replies]


async def until(true: Callable[[], bool], changed: asyncio.Event, seconds: float) -> bool:
    """Wait at most `seconds` until `true()` holds, checked after each `changed`; return its last value."""
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
    """Run until the first ends, then cancel the others. Return for each whether it had ended; raise its exception."""
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


def unknown(what: str, name: str, known: Iterable[str], nothing: str, listed: str, more: int = 0) -> Failed:
    """The error for an unknown `name`, with similar names, else the known names after `listed` and the number of
    `more`, else `nothing`."""
    return Failed(f"unknown {what} {quoted(name)}{hint_at(name, known, nothing, listed, more)}")


def device_named(state: RcmState, name: str) -> str | None:
    """Return the device of this name, or the only device whose name ends in it: `robot/arm1` for `arm1`."""
    alike = [view.rc for view in state.rcs if name in (view.rc, view.rc.partition("/")[2])]
    return name if name in alike else alike[0] if len(alike) == 1 else None


def hint_at(name: str, known: Iterable[str], nothing: str, listed: str, more: int = 0) -> str:
    """Return the end of an error about an unknown `name`: similar or known names. Arguments as of `unknown`."""
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
    """A parameter type from `parse`, which takes the text and the option's name and raises BadInput."""

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
    """A need with its bandwidth parameters: `radio/rf0 (command_rate=5,other=1)`."""
    amounts = ",".join(f"{param}={value.normalize():f}" for param, value in sorted(params.items()))
    return f"{name} ({amounts})" if amounts else name


def check_recording(option: str, path: Path | None) -> None:
    """Check that a recording can be written to `path`. Raises BadInput."""
    if path is None:
        return
    if path.suffix != ".rrd":
        raise BadInput(f"{option} {path}: not the name of a recording; end it in .rrd")
    existed = path.exists()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("ab").close()
    except OSError as error:
        why = "its folder is a file" if isinstance(error, FileExistsError) else error.strerror
        raise BadInput(f"{option} {path}: can't be written ({why}); give another file") from None
    if not existed:
        path.unlink()
