"""A device for tests of behaviors and components: it records calls, and fails on request."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from zscout.drivers.driver import Driver, Holder, Parameter, ProposedHolder, Refused


class FakeDevice(Driver):
    """A driver that accepts every command.

    Exclusive unless `sharable`; a sharable device votes `refuses` (a reason; empty for yes). `answers` has answers by
    command name; other commands are answered with their `value`."""

    def __init__(
        self,
        *,
        sharable: bool = False,
        parameters: list[Parameter] | None = None,
        answers: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.sharable = sharable
        self.calls: list[str] = []
        """In order: `begin ARC`, `end ARC`, `safe`, and each command as `NAME` or `NAME VALUE`."""
        self.commands: list[dict[str, Any]] = []
        self.fails_on: set[str] = set()
        """Names of calls that raise RuntimeError: `begin`, `end`, or a command's."""
        self.refuses = ""
        self.answers = dict(answers or {})
        self._parameters = parameters

    def parameters(self) -> list[Parameter] | None:
        return self._parameters

    def vote(self, holders: list[ProposedHolder]) -> str:
        return self.refuses

    async def begin(self, holder: Holder) -> None:
        self._record("begin", holder.arc)

    async def end(self, holder: Holder) -> None:
        self._record("end", holder.arc)

    async def safe(self) -> None:
        self.calls.append("safe")

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        name, value = do.get("name"), do.get("value")
        if not isinstance(name, str):
            raise Refused("bad_command", "a command needs a name")
        self.commands.append(dict(do))
        self._record(name, "" if value is None else str(value))
        return self.answers.get(name, value)

    def _record(self, name: str, about: str) -> None:
        self.calls.append(f"{name} {about}".strip())
        if name in self.fails_on:
            raise RuntimeError(f"{name} failed, as the test asked")
