"""Whether the RCs of a grant know of it. They are asked at once, beside the body: one question for all RCs of a process
(`host/<host>/confirm`), and one to each RC that does not answer that, or has to be asked again.

What is not confirmed within a second ends the body; its ARC is asked for again, at its place. What touches its devices
past their RCs is entered when all have confirmed it, and confirmed again and again (`direct.py`)."""

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

UNREACHED = 10.0
"""Seconds for which an RC may be granted that this client neither sees nor reaches."""
SILENT: Final = "was granted and does not answer"
DEAF: Final = "was granted and takes no command"
CONFIRM_TIMEOUT = 1.0
"""Seconds within which all RCs of a grant must have confirmed it."""
SETTLING: Final = "settling"
"""What an RC answers while the program of its last holder may still touch its device, or that is made ready."""
LOOK_AGAIN: Final = 0.1
"""Seconds between two questions whether it has settled."""
NOT_DONE = frozenset({"not_yet", "stale", "busy", SETTLING})
"""Refusals of a command that may be sent again once its RC has confirmed the grant: it was not carried out."""
CONFIRM_AGAIN = NOT_DONE - {SETTLING} | {"unknown"}
"""Refusals that do not end a hold: an RC may hear of a grant later than its holder, or just after a stall."""
NOT_HELD = frozenset({"ended", "free", "not_holder"})
"""What an RC answers to a command under a hold that is over."""
NOT_CONFIRMED = CONFIRM_AGAIN | NOT_HELD | {"wrong_client"}
"""Refusals after which an ARC is queued again; others concern whoever asked for it."""
HELD_BACK = 30.0
"""Seconds for which an RCM does not grant again what was not confirmed, at most."""


@dataclass(slots=True)
class Confirmation:
    """Of one grant, while it is in force."""

    grant: Grant
    task: asyncio.Task[None] | None = None
    all: bool = False
    """Whether all of its RCs have confirmed it."""
    refused: CommandRefused | None = None
    """Why not, where that is for the caller to decide."""

    @property
    def pending(self) -> bool:
        return self.task is not None and not self.task.done()

    async def over(self) -> None:
        if self.task is not None:
            await asyncio.wait({self.task})


class Confirmations:
    """Of one client's grants."""

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
        self._of: dict[str, Confirmation] = {}
        """By id of an ARC."""
        self._direct: dict[Grant, DirectHold] = {}
        """Holds of direct requests, until their programs are gone."""
        store.watchers.append(self._look_at)

    def begin(self, arc: OpenArc, grant: Grant) -> Confirmation:
        """Has the RCs of a grant confirm it, unless they do or have."""
        known = self._of.get(arc.id)
        if known is None or known.grant != grant or not (known.pending or known.all):
            known = self._of[arc.id] = Confirmation(grant)
            known.task = self._supervisor.spawn(self._see_confirmed(arc, known))
        return known

    def pending(self, grant: Grant) -> Confirmation | None:
        """That of a grant that not all of its RCs have confirmed yet."""
        return next((one for one in self._of.values() if one.grant == grant and one.pending), None)

    def _look_at(self, arc: OpenArc) -> None:
        """There is news of `arc`: its holds before the present one are over."""
        known = self._of.get(arc.id)
        if known is not None and known.grant != arc.grant and not known.pending:
            del self._of[arc.id]
        for direct in self._direct_of(arc):
            if direct.grant != arc.grant:
                direct.end()

    async def _see_confirmed(self, arc: OpenArc, one: Confirmation) -> None:
        grant = one.grant
        if grant == arc._left:
            # Its RCs have been told that its program leaves, whatever a new RCM has found.
            over = Problem("ended", "its program was asked to end")
            refusals = [CommandRefused(rc, over) for rc in arc.rcs]
        else:
            refusals = await self._confirm(arc, grant)
        if arc.grant == grant and not refusals:
            one.all = True
            if grant in self._direct:
                self._direct[grant].keep_confirming(self._on_unsure)
            if arc._settling == grant:
                if arc.ready is None:
                    # What the leader published of its start may have been missed: until when is it?
                    await self._rcm.ask(arc)
                arc._settling = None
                self._store.notify(arc)
            return
        if (direct := self._direct.get(grant)) is not None:
            # Some may have confirmed what was not entered.
            direct.end(released=True)
        if arc.grant == grant:
            self._give_back(arc, one, refusals)

    def _give_back(self, arc: OpenArc, one: Confirmation, refusals: list[CommandRefused]) -> None:
        if other := [refused for refused in refusals if refused.code not in NOT_CONFIRMED | {SETTLING}]:
            one.refused = other[0]
            log.warning("%s is not confirmed: %s", arc.name, other[0])
            return
        rcs = [refused.rc for refused in refusals if refused.code != SETTLING]
        if rcs:
            log.warning("the grant of %s is given back: %s", arc.name, refusals[0])
            arc._not_confirmed(rcs, str(refusals[0]), self._mesh.now())
            self._supervisor.spawn(self._ask_when_reachable(arc, rcs))
        else:
            arc._not_served(one.grant, self._mesh.now())
        self._store.notify(arc)
        self._ask_again(arc)

    # The questions

    async def _confirm(self, arc: OpenArc, grant: Grant) -> list[CommandRefused]:
        """Asks all RCs of a grant, side by side. Returns those that do not say that they know of it within a second in
        which this client did not stand still itself, or that settle until its time is over."""
        direct = self._open_direct(arc, grant) if arc.direct else None
        asked = arc.rcs
        while True:
            by_host: dict[HostName | None, list[RcName]] = {}
            for rc in asked:
                by_host.setdefault(arc.hosts.get(rc), []).append(rc)
            groups = [self._confirm_at(arc, grant, host, rcs, direct) for host, rcs in by_host.items()]
            refusals = dict(one for group in await asyncio.gather(*groups) for one in group)
            for rc, refused in refusals.items():
                await self.look_at_silence(rc, SILENT, silent=refused is not None and refused.code == "unknown")
            # What one has confirmed is old by now if another had to settle.
            asked = [] if direct is None else direct.unanswered(self._mesh.now() - self._fleet.timing.hold_lease // 2)
            refused_by = [refusals[rc] for rc in arc.rcs if refusals.get(rc) is not None]
            if refused_by or arc.grant != grant or not asked:
                return [refused for refused in refused_by if refused is not None]

    async def _confirm_at(
        self, arc: OpenArc, grant: Grant, host: HostName | None, rcs: list[RcName], direct: DirectHold | None
    ) -> Iterable[tuple[RcName, CommandRefused | None]]:
        """Asks the RCs of one host."""
        sent = self._mesh.now()
        deadline = sent + round(CONFIRM_TIMEOUT * SECOND)
        words = await self._ask_host(grant, host, rcs) if host is not None else {}
        asked = (self._confirm_one(arc, grant, rc, direct, deadline, (sent, words.get(rc))) for rc in rcs)
        return zip(rcs, await asyncio.gather(*asked), strict=True)

    async def _ask_host(self, grant: Grant, host: HostName, rcs: list[RcName]) -> Mapping[RcName, Done | Problem]:
        """What its RCs answer; of foreign ones it says nothing."""
        words: dict[RcName, Done | Problem] = {}

        def on_reply(reply: Reply[Confirmed]) -> bool:
            if reply.message is not None:
                words.update(reply.message.refused)
                words.update(reply.message.done)
            return words.keys() >= set(rcs)

        try:
            key = self._mesh.keys.confirm(host, self._mesh.me)
        except BadName:
            return words
        question = Confirm(grant, rcs)
        await self._mesh.ask(key, question, Confirmed, timeout=CONFIRM_TIMEOUT, enough=on_reply)
        return words

    async def _confirm_one(
        self,
        arc: OpenArc,
        grant: Grant,
        rc: RcName,
        direct: DirectHold | None,
        deadline: Ns,
        said: tuple[Ns, Done | Problem | None],
    ) -> CommandRefused | None:
        """`said`: what it has answered to a question that was sent then, if anything."""
        pause, (sent, word) = BACKOFF[0], said
        while True:
            if word is None:
                sent = self._mesh.now()
                word = await self._ask_one(rc, grant, max((deadline - sent) / SECOND, BACKOFF[0]))
            if isinstance(word, Done):
                if direct is not None:
                    direct.confirmed(rc, sent, word)
                return None
            refused, word = CommandRefused(rc, word), None
            if arc.grant != grant or refused.code not in CONFIRM_AGAIN | {SETTLING}:
                return refused
            if refused.code == SETTLING:
                # Neither a refusal nor silence.
                if arc._settling != grant:
                    arc._settling, arc.reason = grant, refused.message
                    self._store.notify(arc)
                if arc._is_over(self._mesh.now()):
                    return refused
                deadline, pause = self._mesh.now() + round(CONFIRM_TIMEOUT * SECOND), BACKOFF[0]
                await asyncio.sleep(min(LOOK_AGAIN, refused.left if refused.left is not None else LOOK_AGAIN))
                continue
            if self._rcm.stood_still:
                deadline = self._mesh.now() + round(CONFIRM_TIMEOUT * SECOND)
            elif sent >= deadline:
                return refused
            # The last time when all is over: a link to the RC may take that long.
            await asyncio.sleep(max(0.0, min(pause, (deadline - self._mesh.now()) / SECOND)))
            pause *= 2

    async def _ask_one(self, rc: RcName, grant: Grant, timeout: float) -> Done | Problem:
        try:
            return await self._command(rc, grant, {"name": "confirm"}, timeout=timeout)
        except CommandRefused as refused:
            return refused.problem

    async def look_at_silence(self, rc: RcName, what: str, *, silent: bool) -> None:
        """An RC that the RCM sees, and so should this client."""
        seen = silent and await self._mesh.living(self._mesh.keys.alive_rc(rc), timeout=CONFIRM_TIMEOUT)
        # There may be no link to one that is not seen: but for so long?
        patience = PATIENCE if seen else UNREACHED
        self._mesh.suspicions.suspect(f"{rc} {what}", so=silent, patience=patience)

    async def _ask_when_reachable(self, arc: OpenArc, rcs: list[RcName]) -> None:
        """Where tokens of RCs that did not confirm go, or have gone, and come back, links are back: `arc` is held back
        for nothing."""
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
            if await done_within(HELD_BACK, back.wait()):
                while arc.state == "asking" and arc.id in self._store.arcs:
                    await self._store.changed(arc)
                if arc.state == "queued" and self._store.resumed.is_set():
                    await self._rcm.ask(arc, reachable=True)

    # Direct holds

    def direct(self, grant: Grant) -> DirectHold | None:
        return self._direct.get(grant)

    def program_is_gone(self, arc: OpenArc) -> None:
        for direct in self._direct_of(arc):
            direct.end(released=True)

    @property
    def telling(self) -> list[asyncio.Task[None]]:
        """What is being told to RCs of direct holds."""
        return [task for direct in self._direct.values() for task in direct.telling]

    def _open_direct(self, arc: OpenArc, grant: Grant) -> DirectHold:
        if grant not in self._direct:
            lease, spawn = self._fleet.timing.hold_lease, self._supervisor.spawn
            self._direct[grant] = DirectHold(arc, grant, self._command, self._mesh.now, spawn, hold_lease=lease)
        return self._direct[grant]

    def _direct_of(self, arc: OpenArc) -> list[DirectHold]:
        self._direct = {grant: one for grant, one in self._direct.items() if not one.gone or one.telling}
        return [direct for direct in self._direct.values() if direct.arc is arc]

    def _on_unsure(self, direct: DirectHold) -> None:
        """An RC has not confirmed it for a hold lease: it is over, whatever RCMs say."""
        arc, rcs = direct.arc, direct.unanswered(self._mesh.now() - self._fleet.timing.hold_lease)
        direct.end()
        if arc.grant == direct.grant:
            arc._not_confirmed(rcs, f"{', '.join(rcs)} did not confirm it for the hold lease", self._mesh.now())
            self._store.notify(arc)
            self._supervisor.spawn(self._ask_when_reachable(arc, rcs))
            self._ask_again(arc)
