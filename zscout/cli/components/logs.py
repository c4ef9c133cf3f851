"""`zscout component logs`: print the output of a component, and follow it."""

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
    state_words,
    unknown_here,
)
from zscout.cli.fleet.fleet_view import see_hosts
from zscout.mesh.supervision import done_within
from zscout.messages import Output, Placement, ReadOutput

READ_TIMEOUT_S: Final = 2.0
READ_INTERVAL_S: Final = 0.25
MAX_UNKNOWN_LISTINGS: Final = 3
"""Listings in a row without the component after which it counts as ended."""


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
    """Reads the output of one component on each host in turn, or on `host` alone."""

    def __init__(self, client: Client, placer: PlacerClient, name: str, host: str | None) -> None:
        self._client, self._placer, self._name = client, placer, name
        self._only = host is not None
        self._host = host
        self._incarnation = 0
        self._at = 0
        """Bytes read of this incarnation."""

    @property
    def _record(self) -> Placement | None:
        return self._placer.placements.get(self._name)

    async def first(self, *, follow: bool) -> Output:
        """The output so far; with `follow`, wait until the component was started. Raises Failed, NobodyThere."""
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
            # No answer: the host is gone, busy, or has dropped the output. The placer knows which.
            silent = found is None
            if (found is None or found.over) and (self._only or not await self._successor(silent=silent)):
                break
            if found is None or not (found.over or found.text):
                await done_within(READ_INTERVAL_S, self._placer.changed.wait())
                self._placer.changed.clear()
            found = await self._read()
            if found is not None:
                self.write(found.text)
        record = self._record
        ended = state_words(record) if record is not None and not self._only else "has ended"
        self._report(f"{self._name} {ended}")

    async def _read(self) -> Output | None:
        """Return the new output; None if the host does not answer or does not know the component."""
        if self._host is None:
            return None
        key = self._client.mesh.keys.component(self._host, self._client.mesh.me)
        reply = await self._client.mesh.ask_one(key, ReadOutput(self._name, self._at), Output, timeout=READ_TIMEOUT_S)
        output = reply.message if reply is not None else None
        if output is None or output.incarnation < self._incarnation:
            return None
        if output.incarnation > self._incarnation:
            earlier, self._incarnation = self._incarnation, output.incarnation
            if earlier:
                self._report(f"{self._name} continues on {self._host}")
            if self._at:
                self._at = 0
                return await self._read()
        if output.start > self._at and self._at:
            self._report(f"{output.start - self._at} bytes lost: written faster than they could be read")
        self._at = output.end
        return output

    async def _read_anywhere(self) -> Output | None:
        """Like `_read`, from the host with the latest incarnation."""
        if self._only:
            return None
        mesh = self._client.mesh
        question = ReadOutput(self._name)
        replies = await common.ask_nodes(mesh, question, Output, READ_TIMEOUT_S)
        found = [(reply.message.incarnation, mesh.keys.host_of(reply.key)) for reply in replies if reply.message]
        self._host = max(found)[1] if found else self._host
        return await self._read() if found else None

    async def _successor(self, *, silent: bool) -> bool:
        """Wait for a newer incarnation or, if its host was `silent`, for the same to be listed again. Return False if
        it has ended for good. Raises NobodyThere."""
        missed = 0
        await self._placer.refresh()
        while True:
            record = self._record
            missed = missed + 1 if record is None else 0
            if missed >= MAX_UNKNOWN_LISTINGS:
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
        if self._only and self._host is not None:
            for line in await absent(self._client.mesh, [self._host]):
                return common.Failed(f"--host: {line}")
            return common.Failed(
                f"{self._host} has no output of {self._name}; leave --host out to read from the component's last host"
            )
        if self._record is not None:
            return common.Failed(f"no host has output of {self._name}: it {state_words(self._record)}")
        return await unknown_here(self._placer, self._name)

    def write(self, text: str) -> None:
        """Write to stdout; at a terminal with control characters replaced by blanks."""
        if terminal.at_terminal():
            text = "".join(char if char.isprintable() or char in "\n\t" else " " for char in text)
        sys.stdout.write(text)
        sys.stdout.flush()

    def _report(self, text: str) -> None:
        terminal.print_line(terminal.clean(f"-- {text}"), sys.stderr)


def last(text: str, lines: int | None) -> str:
    """None: all."""
    if lines is None:
        return text
    return "".join(text.splitlines(keepends=True)[-lines:]) if lines else ""
