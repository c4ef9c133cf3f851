"""Confirmation of grants by their RCs, queried while the body already runs: one query for all RCs of a process
(`host/<host>/confirm`), then single queries to RCs that it did not cover, or that must be asked again.

A grant that is not confirmed within a second ends the body, and its request is submitted again, at its place. A direct
request is entered only when all RCs have confirmed the grant, and confirmed again periodically (`direct.py`)."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Final

from zscout.behaviors.client.direct import CommandSender, DirectHold
from zscout.behaviors.client.rcm_link import BACKOFF, QUERY_TIMEOUT, RcmLink
from zscout.behaviors.client.request import CommandRefused, OpenArc, RequestStore
from zscout.config.fleet import Fleet
from zscout.keyexpr import BadName, Token
from zscout.mesh import Mesh, Reply
from zscout.mesh.renewal import PATIENCE
from zscout.mesh.supervision import Supervisor, done_within
from zscout.messages import Confirm, Confirmed, Done, Problem
from zscout.types import SECOND, Grant, HostName, Ns, RcName

log = logging.getLogger(__name__)

UNREACHED_PATIENCE = 10.0
"""Seconds for which an RC may be granted that this client neither sees nor reaches, before its session is suspected."""
SILENT: Final = "was granted and does not answer"
DEAF: Final = "was granted and takes no command"
CONFIRM_TIMEOUT = 1.0
"""Seconds within which all RCs of a grant must have confirmed it."""
SETTLING: Final = "settling"
"""Code of an RC whose device is being made ready, or may still be in use by its last holder's program."""
SETTLING_POLL: Final = 0.1
"""Seconds between two queries to an RC that is settling."""
NOT_DONE = frozenset({"not_yet", "stale", "busy", SETTLING})
"""Codes of commands that were not carried out, and may be sent again once their RC has confirmed the grant."""
CONFIRM_AGAIN = NOT_DONE - {SETTLING} | {"unknown"}
"""Codes that do not end a hold: an RC may learn of a grant later than its holder, or just after a stall."""
NOT_HELD = frozenset({"ended", "free", "not_holder"})
"""Codes of commands under a hold that is over."""
NOT_CONFIRMED = CONFIRM_AGAIN | NOT_HELD | {"wrong_client"}
"""Codes after which a request is queued again; other codes are reported to its program."""
HOLD_BACK_LIMIT = 30.0
"""Longest time, in seconds, for which an RCM holds back a request whose grant was not confirmed."""


@dataclass(slots=True)
class Confirmation:
    grant: Grant
    task: asyncio.Task[None] | None = None
    all: bool = False
    """True once all of its RCs have confirmed it."""
    refused: CommandRefused | None = None
    """A refusal on which the caller must decide."""

    @property
    def pending(self) -> bool:
        return self.task is not None and not self.task.done()

    async def over(self) -> None:
        if self.task is not None:
            await asyncio.wait({self.task})


class Confirmations:
    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        store: RequestStore,
        rcm: RcmLink,
        supervisor: Supervisor,
        command: CommandSender,
        ask_again: Callable[[OpenArc], object],
    ) -> None:
        self._mesh, self._fleet, self._store, self._rcm, self._supervisor = mesh, fleet, store, rcm, supervisor
        self._command, self._ask_again = command, ask_again
        self._by_request: dict[str, Confirmation] = {}
        """By id of the request."""
        self._direct: dict[Grant, DirectHold] = {}
        """Holds of direct requests, until their programs are gone."""
        store.watchers.append(self._look_at)

    def begin(self, arc: OpenArc, grant: Grant) -> Confirmation:
        """Ask the RCs of a grant to confirm it, unless they have, or were asked."""
        known = self._by_request.get(arc.id)
        if known is None or known.grant != grant or not (known.pending or known.all):
            known = self._by_request[arc.id] = Confirmation(grant)
            known.task = self._supervisor.spawn(self._see_confirmed(arc, known))
        return known

    def pending(self, grant: Grant) -> Confirmation | None:
        return next((known for known in self._by_request.values() if known.grant == grant and known.pending), None)

    def _look_at(self, arc: OpenArc) -> None:
        """`arc` has changed: end its holds before the present one."""
        known = self._by_request.get(arc.id)
        if known is not None and known.grant != arc.grant and not known.pending:
            del self._by_request[arc.id]
        for direct in self._direct_of(arc):
            if direct.grant != arc.grant:
                direct.end()

    async def _see_confirmed(self, arc: OpenArc, confirmation: Confirmation) -> None:
        grant = confirmation.grant
        if grant == arc._grant_left:
            # This client has announced to the RCs that its program is leaving, though a new RCM continues the hold.
            over = Problem("ended", "its program was asked to end")
            refusals = [CommandRefused(rc, over) for rc in arc.rcs]
        else:
            refusals = await self._confirm(arc, grant)
        if arc.grant == grant and not refusals:
            confirmation.all = True
            if grant in self._direct:
                self._direct[grant].keep_confirming(self._on_unsure)
            if arc._settling == grant:
                if arc.ready is None:
                    # The leader's notice of the start may have been missed: query the end.
                    await self._rcm.ask(arc)
                arc._settling = None
                self._store.notify(arc)
            return
        if (direct := self._direct.get(grant)) is not None:
            # Some RCs may have confirmed the grant, which no body has entered.
            direct.end(released=True)
        if arc.grant == grant:
            self._give_back(arc, confirmation, refusals)

    def _give_back(self, arc: OpenArc, confirmation: Confirmation, refusals: list[CommandRefused]) -> None:
        if other := [refused for refused in refusals if refused.code not in NOT_CONFIRMED | {SETTLING}]:
            confirmation.refused = other[0]
            log.warning("grant of %s refused: %s", arc.name, other[0])
            return
        rcs = [refused.rc for refused in refusals if refused.code != SETTLING]
        if rcs:
            log.warning("giving back the grant of %s: %s", arc.name, refusals[0])
            arc._not_confirmed(rcs, str(refusals[0]), self._mesh.now())
            self._supervisor.spawn(self._ask_when_reachable(arc, rcs))
        else:
            arc._not_served(confirmation.grant, self._mesh.now())
        self._store.notify(arc)
        self._ask_again(arc)

    async def _confirm(self, arc: OpenArc, grant: Grant) -> list[CommandRefused]:
        """Ask all RCs of a grant, concurrently. Return the refusals of RCs that did not confirm it within a second
        without stalls of this client, or settled until its time was over."""
        direct = self._open_direct(arc, grant) if arc.direct else None
        asked = arc.rcs
        while True:
            by_host: dict[HostName | None, list[RcName]] = {}
            for rc in asked:
                by_host.setdefault(arc.hosts.get(rc), []).append(rc)
            groups = [self._confirm_at(arc, grant, host, rcs, direct) for host, rcs in by_host.items()]
            refusals = dict(answer for group in await asyncio.gather(*groups) for answer in group)
            for rc, refused in refusals.items():
                await self.look_at_silence(rc, SILENT, silent=refused is not None and refused.code == "unknown")
            # Confirmations may be too old by now if another RC had to settle.
            asked = [] if direct is None else direct.unanswered(self._mesh.now() - self._fleet.timing.hold_lease // 2)
            refused_by = [refusals[rc] for rc in arc.rcs if refusals.get(rc) is not None]
            if refused_by or arc.grant != grant or not asked:
                return [refused for refused in refused_by if refused is not None]

    async def _confirm_at(
        self, arc: OpenArc, grant: Grant, host: HostName | None, rcs: list[RcName], direct: DirectHold | None
    ) -> Iterable[tuple[RcName, CommandRefused | None]]:
        """Ask the RCs of one host; return each with its refusal, if any."""
        sent = self._mesh.now()
        deadline = sent + round(CONFIRM_TIMEOUT * SECOND)
        answers = await self._query_host(grant, host, rcs) if host is not None else {}
        asked = (self._confirm_one(arc, grant, rc, direct, deadline, (sent, answers.get(rc))) for rc in rcs)
        return zip(rcs, await asyncio.gather(*asked), strict=True)

    async def _query_host(self, grant: Grant, host: HostName, rcs: list[RcName]) -> Mapping[RcName, Done | Problem]:
        """Return the answers of a host's RCs to one query; foreign RCs give none."""
        answers: dict[RcName, Done | Problem] = {}

        def on_reply(reply: Reply[Confirmed]) -> bool:
            if reply.message is not None:
                answers.update(reply.message.refused)
                answers.update(reply.message.done)
            return answers.keys() >= set(rcs)

        try:
            key = self._mesh.keys.confirm(host, self._mesh.me)
        except BadName:
            return answers
        question = Confirm(grant, rcs)
        await self._mesh.ask(key, question, Confirmed, timeout=CONFIRM_TIMEOUT, enough=on_reply)
        return answers

    async def _confirm_one(
        self,
        arc: OpenArc,
        grant: Grant,
        rc: RcName,
        direct: DirectHold | None,
        deadline: Ns,
        first: tuple[Ns, Done | Problem | None],
    ) -> CommandRefused | None:
        """Ask one RC until it confirms or refuses; return its refusal. `first`: time of its host's query, its
        answer."""
        pause, (sent, answer) = BACKOFF[0], first
        while True:
            if answer is None:
                sent = self._mesh.now()
                answer = await self._query_rc(rc, grant, max((deadline - sent) / SECOND, BACKOFF[0]))
            if isinstance(answer, Done):
                if direct is not None:
                    direct.confirmed(rc, sent, answer)
                return None
            refused, answer = CommandRefused(rc, answer), None
            if arc.grant != grant or refused.code not in CONFIRM_AGAIN | {SETTLING}:
                return refused
            if refused.code == SETTLING:
                # Neither a refusal nor silence: wait.
                if arc._settling != grant:
                    arc._settling, arc.reason = grant, refused.message
                    self._store.notify(arc)
                if arc._is_over(self._mesh.now()):
                    return refused
                deadline, pause = self._mesh.now() + round(CONFIRM_TIMEOUT * SECOND), BACKOFF[0]
                await asyncio.sleep(min(SETTLING_POLL, refused.left if refused.left is not None else SETTLING_POLL))
                continue
            if self._rcm.stalled:
                deadline = self._mesh.now() + round(CONFIRM_TIMEOUT * SECOND)
            elif sent >= deadline:
                return refused
            # The last query is sent at the deadline: a link to the RC may take that long.
            await asyncio.sleep(max(0.0, min(pause, (deadline - self._mesh.now()) / SECOND)))
            pause *= 2

    async def _query_rc(self, rc: RcName, grant: Grant, timeout: float) -> Done | Problem:
        try:
            return await self._command(rc, grant, {"name": "confirm"}, timeout=timeout)
        except CommandRefused as refused:
            return refused.problem

    async def look_at_silence(self, rc: RcName, what: str, *, silent: bool) -> None:
        """Suspect the mesh session if an RC that the RCM sees stays silent to this client."""
        seen = silent and await self._mesh.living(self._mesh.keys.alive_rc(rc), timeout=CONFIRM_TIMEOUT)
        # An RC that this client does not see may have no link yet, so be patient.
        patience = PATIENCE if seen else UNREACHED_PATIENCE
        self._mesh.suspicions.suspect(f"{rc} {what}", so=silent, patience=patience)

    async def _ask_when_reachable(self, arc: OpenArc, rcs: list[RcName]) -> None:
        """Let `arc` be granted again once these RCs' tokens have disappeared and returned: links are back."""
        keys, back = self._mesh.keys, asyncio.Event()
        gone = {rc for rc in rcs if not await self._mesh.living(keys.alive_rc(rc), timeout=QUERY_TIMEOUT)}

        def on_token(token: Token, alive: bool) -> None:
            if not alive:
                gone.add(token.name)
            elif token.name in gone:
                gone.remove(token.name)
                if not gone:
                    back.set()

        with ExitStack() as watched:
            for rc in rcs:
                watched.enter_context(closing(self._mesh.watch(keys.alive_rc(rc), on_token)))
            if await done_within(HOLD_BACK_LIMIT, back.wait()):
                while arc.state == "asking" and arc.id in self._store.arcs:
                    await self._store.changed(arc)
                if arc.state == "queued" and self._store.resumed.is_set():
                    await self._rcm.ask(arc, reachable=True)

    def direct(self, grant: Grant) -> DirectHold | None:
        return self._direct.get(grant)

    def program_is_gone(self, arc: OpenArc) -> None:
        for direct in self._direct_of(arc):
            direct.end(released=True)

    @property
    def reporting(self) -> list[asyncio.Task[None]]:
        """Reports under way to RCs of direct holds."""
        return [task for direct in self._direct.values() for task in direct.reporting]

    def _open_direct(self, arc: OpenArc, grant: Grant) -> DirectHold:
        if grant not in self._direct:
            lease, spawn = self._fleet.timing.hold_lease, self._supervisor.spawn
            self._direct[grant] = DirectHold(arc, grant, self._command, self._mesh.now, spawn, hold_lease=lease)
        return self._direct[grant]

    def _direct_of(self, arc: OpenArc) -> list[DirectHold]:
        self._direct = {grant: direct for grant, direct in self._direct.items() if not direct.gone or direct.reporting}
        return [direct for direct in self._direct.values() if direct.arc is arc]

    def _on_unsure(self, direct: DirectHold) -> None:
        """End a direct hold that an RC has not confirmed for a hold lease, whatever the RCM publishes."""
        arc, rcs = direct.arc, direct.unanswered(self._mesh.now() - self._fleet.timing.hold_lease)
        direct.end()
        if arc.grant == direct.grant:
            arc._not_confirmed(rcs, f"{', '.join(rcs)} did not confirm it for the hold lease", self._mesh.now())
            self._store.notify(arc)
            self._supervisor.spawn(self._ask_when_reachable(arc, rcs))
            self._ask_again(arc)
