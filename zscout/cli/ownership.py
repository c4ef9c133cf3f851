"""Owners of bookings, requests and components, and the question before another user's is touched."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Iterable
from typing import Final, NamedTuple

import click

from zscout.behaviors.client.client import Client
from zscout.cli.common import Failed
from zscout.messages import Who
from zscout.terminal import clean

yes_option = click.option("-y", "--yes", is_flag=True, help="Don't ask.")
MAX_ANSWER: Final = 4_096
MAX_NAMED: Final = 8


class User(NamedTuple):
    """The user of this program, with its host or certificate. `proved`: certificates prove names."""

    name: str
    host: str
    proved: bool = False

    @classmethod
    def of(cls, client: Client) -> User:
        closed = client.fleet.security is not None
        return cls(client.who.user if client.who is not None else "", client.mesh.me.host, closed)

    def owns(self, owner: str, who: Who | None) -> bool:
        """Same user on any host; with certificates or an unknown user, same `owner`: a host or certificate's name."""
        user = who.user if who is not None else ""
        return owner == self.host if self.proved or not user else user == self.name


def whose(owner: str, who: Who | None) -> str:
    """`alice@ws1`; `owner`, the host or certificate, if the user is unknown."""
    return clean(f"{who.user}@{who.host or owner}" if who is not None and who.user else owner)


async def ask_for_others(client: Client, others: Iterable[str], verb: str, *, yes: bool) -> None:
    """Ask before doing `verb` to `others`, the words for what other users own; not without the right, as the fleet
    refuses that. Raises Failed for a no."""
    named = [*others]
    allowed = client.fleet.security is None or "operator" in client.fleet.access.ranks_of(client.mesh.me.host)
    if yes or not named or not allowed:
        return
    listed = ", ".join(named[:MAX_NAMED]) + (f" and {len(named) - MAX_NAMED} more" if len(named) > MAX_NAMED else "")
    what = f"{listed} {'is' if len(named) == 1 else 'are'} not yours"
    it = "it" if len(named) == 1 else f"all {len(named)}"
    await confirm(f"{what}; {verb} {it}?", f"{what}; to {verb} {it} all the same, add --yes", "nothing was done")


async def confirm(question: str, unasked: str, no: str, *, code: int | None = None) -> None:
    """Ask on stderr. Raises Failed: `no` for any answer but y; `unasked`, with this exit code, without a terminal."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise Failed(unasked, code)
    sys.stderr.write(f"{clean(question)} [y/N] ")
    sys.stderr.flush()
    if (await _answer()).strip().lower() not in ("y", "yes"):
        raise Failed(no)


async def _answer() -> str:
    """Read a line from the terminal. Unlike with input(), Ctrl-C reaches the event loop."""
    loop = asyncio.get_running_loop()
    readable = asyncio.Event()
    loop.add_reader(0, readable.set)
    try:
        await readable.wait()
        return os.read(0, MAX_ANSWER).decode(errors="replace")
    finally:
        loop.remove_reader(0)
