"""Answers one query for all RCs of a process: whether they know a grant. Each RC answers as to a `confirm` command."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import msgspec

from zscout.mesh import Declaration, IncomingQuery, Mesh, Refused
from zscout.messages import Command, Confirm, Confirmed, Done, Problem
from zscout.types import Ns, RcName

CommandQuery: TypeAlias = IncomingQuery[Command]


class ConfirmServer:
    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._rcs: dict[RcName, Callable[[CommandQuery], None]] = {}
        mesh.serve(mesh.keys.confirm_any(mesh.me.host), Confirm, self._on_confirm)

    def serve(self, rc: RcName, on_command: Callable[[CommandQuery], None]) -> Declaration:
        """`on_command` handles the query as a command, and may raise Refused."""
        self._rcs[rc] = on_command

        def leave() -> None:
            if self._rcs.get(rc) is on_command:
                del self._rcs[rc]

        return Declaration(leave)

    def _on_confirm(self, query: IncomingQuery[Confirm]) -> None:
        asked, keys = query.message, self._mesh.keys
        sender = keys.sender_of(query.key)
        command = Command({"name": "confirm"}, asked.grant, asked.ttl)
        here = [rc for rc in dict.fromkeys(asked.rcs) if rc in self._rcs]
        answers = _Answers(query, len(here))
        for rc in here:
            part = _Part(answers, rc, keys.command(rc, sender), command, query.arrived)
            try:
                self._rcs[rc](part)
            except Refused as refused:
                part.refuse(refused.problem)


class _Answers:
    def __init__(self, query: IncomingQuery[Confirm], missing: int) -> None:
        self._query, self._missing = query, missing
        self._collected = Confirmed()
        if not missing:
            query.answer(self._collected)

    def add(self, rc: RcName, answer: msgspec.Struct) -> None:
        if isinstance(answer, Problem):
            self._collected.refused[rc] = answer
        elif isinstance(answer, Done):
            self._collected.done[rc] = answer
        self._missing -= 1
        if not self._missing:
            self._query.answer(self._collected)


class _Part(IncomingQuery[Command]):
    __slots__ = ("_answers", "_rc")

    def __init__(self, answers: _Answers, rc: RcName, key: str, command: Command, arrived: Ns) -> None:
        super().__init__(None, key, key, command, arrived)
        self._answers: _Answers | None = answers
        self._rc = rc

    def end(self, answer: msgspec.Struct, encoded: bytes | None = None) -> None:
        answers, self._answers = self._answers, None
        if answers is not None:
            answers.add(self._rc, answer)
