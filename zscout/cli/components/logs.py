"""`zscout component logs`: what a component wrote, and what it writes."""

from __future__ import annotations

import sys
from typing import Final

import click

from zscout import terminal
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.placer_client import PlacerClient, PlacerSilent
from zscout.cli import common
from zscout.cli.components.placing import (
    OVER,
    absent,
    component_argument,
    host_option,
    placer_of,
    standing,
    unknown_here,
)
from zscout.cli.fleet.fleet_view import see_hosts
from zscout.mesh.supervision import done_within
from zscout.messages import Output, Placement, ReadOutput

READ_TIMEOUT: Final = 2.0
READ_EVERY: Final = 0.25
"""Seconds between two looks for more."""
UNKNOWN: Final = 3
"""Looks in a row at which the placer does not know a component that has ended, until that is believed."""


@click.command()
@component_argument
@click.option("-f", "--follow", is_flag=True, help="Print new output until the component ends, on any host.")
@click.option("--lines", type=click.IntRange(0, 100_000), help="Print only the last so many lines.")
@host_option("--host", "Output on this host. Default: where it ran last.")
@common.runs
async def logs(name: str, follow: bool, lines: int | None, host: str | None) -> None:
    """Print the output of a component: of its running or its last incarnation.

    Its host keeps the last 64 KiB of each incarnation, until zscout-node ends there. --follow prints new output as
    well, on whichever host the component continues; moves and its end are reported on stderr. At a terminal control
    characters are left out.

    \b
    Examples:
      zscout component logs counter
      zscout component logs counter --follow --lines 10
      zscout component logs counter --host anvil > before-it-moved.txt
    """
    async with common.connected("logs", need_rcm=False) as client:
        with placer_of(client, {name}) as placer:
            reader = Reader(client, placer, name, host)
            output = await reader.first(follow=follow)
            reader.write(last(output.text, lines))
            if follow:
                await reader.follow(output)
            elif terminal.at_terminal() and output.text and not output.text.endswith("\n"):
                reader.write("\n")


class Reader:
    """Reads one component's output, from one host after another. `host`: only there."""

    def __init__(self, client: Client, placer: PlacerClient, name: str, host: str | None) -> None:
        self._client, self._placer, self._name = client, placer, name
        self._only = host is not None
        self._host = host
        self._incarnation = 0
        self._at = 0
        """Bytes that were read of this incarnation."""

    @property
    def _record(self) -> Placement | None:
        return self._placer.placements.get(self._name)

    async def first(self, *, follow: bool) -> Output:
        """What it has written, as soon as it was started. Raises Failed, NobodyThere."""
        try:
            await common.see_rcm(self._client)
            await self._placer.refresh()
        except (common.NobodyThere, PlacerSilent):
            # The nodes answer without an RCM as well.
            await see_hosts(self._client)
        while True:
            if self._record is not None and self._host is None:
                self._host = self._record.host
            if (output := await self._read()) is not None:
                return output
            await see_hosts(self._client)
            if (output := await self._read_anywhere()) is not None:
                return output
            if self._record is None or self._record.state in OVER or self._only or not follow:
                raise await self._nothing()
            await self._placer.wait_changed()

    async def follow(self, output: Output) -> None:
        found: Output | None = output
        while True:
            # Without an answer its host is gone or busy, or has forgotten it; the placer knows which.
            silent = found is None
            if (found is None or found.over) and (self._only or not await self._successor(silent=silent)):
                break
            if found is None or not (found.over or found.text):
                await done_within(READ_EVERY, self._placer.changed.wait())
                self._placer.changed.clear()
            found = await self._read()
            if found is not None:
                self.write(found.text)
        record = self._record
        ended = standing(record) if record is not None and not self._only else "has ended"
        self._tell(f"{self._name} {ended}")

    async def _read(self) -> Output | None:
        """What is new at its host; None where that does not answer, or knows nothing of it."""
        if self._host is None:
            return None
        key = self._client.mesh.keys.component(self._host, self._client.mesh.me)
        reply = await self._client.mesh.ask_one(key, ReadOutput(self._name, self._at), Output, timeout=READ_TIMEOUT)
        output = reply.message if reply is not None else None
        if output is None or output.incarnation < self._incarnation:
            return None
        if output.incarnation > self._incarnation:
            begun, self._incarnation = self._incarnation, output.incarnation
            if begun:
                self._tell(f"{self._name} continues on {self._host}")
            if self._at:
                self._at = 0
                return await self._read()
        if output.start > self._at and self._at:
            self._tell(f"{output.start - self._at} bytes came too fast, and are lost")
        self._at = output.end
        return output

    async def _read_anywhere(self) -> Output | None:
        """The same from the host that knows its latest incarnation, whichever that is."""
        if self._only:
            return None
        mesh = self._client.mesh
        asked = ReadOutput(self._name)
        replies = await common.ask_nodes(mesh, asked, Output, READ_TIMEOUT)
        found = [(one.message.incarnation, mesh.keys.host_of(one.key)) for one in replies if one.message]
        self._host = max(found)[1] if found else self._host
        return await self._read() if found else None

    async def _successor(self, *, silent: bool) -> bool:
        """Waits until it goes on somewhere, if only where it was and its host is merely `silent`; False: it
        has ended for good. Raises NobodyThere."""
        missed = 0
        await self._placer.refresh()
        while True:
            record = self._record
            missed = missed + 1 if record is None else 0
            if missed >= UNKNOWN:
                return False
            if record is not None and record.incarnation >= self._incarnation:
                newer = record.incarnation > self._incarnation
                if record.state in OVER and not newer:
                    return False
                if (newer or silent) and record.host is not None and record.state in (*OVER, "running"):
                    self._host = record.host
                    return True
            await self._placer.wait_changed()

    async def _nothing(self) -> common.Failed:
        """What to raise where there is no output."""
        if self._only and self._host is not None:
            for line in await absent(self._client.mesh, [self._host]):
                return common.Failed(f"--host: {line}")
            return common.Failed(f"{self._host} has no output of {self._name}; leave --host out to read its last host")
        if self._record is not None:
            return common.Failed(f"no host has output of {self._name}: it {standing(self._record)}")
        return await unknown_here(self._placer, self._name)

    def write(self, text: str) -> None:
        """To stdout, as it is; at a terminal without what could draw on it."""
        if terminal.at_terminal():
            text = "".join(char if char.isprintable() or char in "\n\t" else " " for char in text)
        sys.stdout.write(text)
        sys.stdout.flush()

    def _tell(self, text: str) -> None:
        terminal.print_line(terminal.clean(f"-- {text}"), sys.stderr)


def last(text: str, lines: int | None) -> str:
    """The last lines of a text; all of them for None."""
    if lines is None:
        return text
    return "".join(text.splitlines(keepends=True)[-lines:]) if lines else ""
