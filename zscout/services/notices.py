"""What clients are told about their requests, and what is remembered of them: words, never decisions."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from typing import Any

from zscout import clock
from zscout.keyexpr import BadName, client_of, is_pattern
from zscout.mesh import Mesh
from zscout.messages import Notice, State
from zscout.scheduling.core import Core
from zscout.scheduling.effects import Dropped, Granted, Outcome, Revoked
from zscout.scheduling.model import SECOND, Arc, ArcId, Ns, Term
from zscout.services import views
from zscout.services.story import Story

log = logging.getLogger(__name__)

REMEMBER = 60 * SECOND
"""How long ended requests are known: longer than any query's timeout and a lease together."""
MAX_REMEMBERED = 20_000
REASONS_EVERY = 0.1
"""Seconds at most until a waiting client hears that its reason to wait has changed: in a busy queue every
grant changes many reasons, and only the last is of use."""
LOG_EVERY = 0.1
MAX_LOGGED = 50
"""Lines in one entry of the log; the story has them all."""


class Notices:
    """Tells one reign's clients how their requests stand."""

    def __init__(self, mesh: Mesh, core: Core, term: Term) -> None:
        self.mesh, self.core, self.term = mesh, core, term
        self.story = Story()
        self._step = 0
        self._names: dict[ArcId, str] = {}
        self._ended: OrderedDict[ArcId, tuple[Ns, Notice]] = OrderedDict()
        self._untold: set[ArcId] = set()
        """ARCs whose reason to wait has not been published yet."""
        self._unlogged: list[str] = []
        self._closed = False

    def close(self) -> None:
        self._closed = True
        self._log()

    # Names and what is remembered

    def call(self, arc: ArcId, name: str) -> None:
        """From now on `arc` is called `name`."""
        self._names[arc] = name

    def name(self, arc: ArcId) -> str:
        return self._names.get(arc, views.request_id(arc))

    def ended(self, arc: ArcId) -> bool:
        """Whether `arc` ended lately."""
        return arc in self._ended

    def granted(self, effect: Granted, *, answered: bool) -> None:
        """`answered`: the client hears it as the answer to its request."""
        arc = self.core.floor.running[effect.arc]
        self.tell(arc.id, arc.name, f"granted {', '.join(effect.rcs)}")
        # Its own answer tells the asker; everybody else reads it from the publication.
        if not answered:
            self._notify(self.of_arc(arc))

    def revoked(self, effect: Revoked, *, answered: bool) -> None:
        """`answered`: the client gave it up itself, and hears so as the answer to that."""
        name = self.name(effect.arc)
        again = "; queued again" if effect.requeued else ""
        self.tell(effect.arc, name, f"{effect.outcome}: {effect.reason}{again}")
        notice = self._notice(
            effect.arc,
            effect.client,
            name,
            "queued" if effect.requeued else "ended",
            reason=effect.reason,
            outcome=effect.outcome,
            by=effect.by,
            grant=effect.grant,
            rcs=list(effect.rcs),
        )
        if not answered:
            self._notify(notice)
        if self.core.floor.arc(effect.arc) is None:
            self._remember(effect.arc, notice)

    def waits(self, arc: ArcId) -> None:
        """The reason to wait has changed: told a little later, with whatever else changes meanwhile."""
        if not self._untold:
            asyncio.get_running_loop().call_later(REASONS_EVERY, self._tell_reasons)
        self._untold.add(arc)

    def stands(self, arc_id: ArcId) -> None:
        """Tells an ARC's client how it stands, now."""
        arc = self.core.floor.arc(arc_id)
        if arc is not None:
            self._untold.discard(arc_id)
            self._notify(self.of_arc(arc))

    def _tell_reasons(self) -> None:
        untold, self._untold = self._untold, set()
        waiting = self.core.floor.queued
        for arc in [waiting[arc] for arc in untold if arc in waiting]:
            self.tell(arc.id, arc.name, f"waits: {arc.reason}")
            if not self._closed:
                self._notify(self.of_arc(arc))

    def dropped(self, effect: Dropped) -> None:
        name = self.name(effect.arc)
        self.tell(effect.arc, name, f"{effect.outcome}: {effect.reason}")
        notice = self._notice(
            effect.arc, effect.client, name, "ended", reason=effect.reason, outcome=effect.outcome
        )
        self._notify(notice)
        self._remember(effect.arc, notice)

    # Words

    def tell(self, arc: ArcId, name: str, text: str) -> None:
        self.story.tell(clock.now(), arc, name, text)
        if not self._unlogged:
            asyncio.get_running_loop().call_later(LOG_EVERY, self._log)
        self._unlogged.append(f"{name} {text}")

    def _log(self) -> None:
        """Writes down what happened lately as one entry: a log that costs as much as a grant is too dear."""
        lines, self._unlogged = self._unlogged, []
        if len(lines) > MAX_LOGGED:
            lines[MAX_LOGGED:] = [f"and {len(lines) - MAX_LOGGED} lines more; ask `zscout why`"]
        if lines:
            log.info("%s", "\n  ".join(lines))

    def of_arc(self, arc: Arc) -> Notice:
        state: State = "queued" if arc.hold is None else "running"
        hold = arc.hold
        # While it waits, what it is bound to is only what it was last looked at with.
        rcs = arc.needs if hold is not None else [need for need in arc.request.needs if not is_pattern(need)]
        return self._notice(
            arc.id,
            arc.request.client,
            arc.name,
            state,
            priority=arc.request.priority,
            reason=self.core.reason(arc),
            place=arc.place,
            ahead=self._ahead(arc) if hold is None else None,
            grant=hold.grant if hold is not None else None,
            rcs=sorted(rcs),
            bound=dict(arc.bound) if hold is not None else {},
            remaining=(hold.end - clock.now()) / SECOND if hold is not None else None,
        )

    def _ahead(self, arc: Arc) -> int:
        return self.core.floor.waits.ahead(arc)

    def _notice(self, arc: ArcId, client: str, name: str, state: State, **details: Any) -> Notice:
        self._step += 1
        return Notice(
            id=views.request_id(arc),
            arc=name,
            client=client,
            state=state,
            term=self.term,
            step=self._step,
            **details,
        )

    def standing(self, arc_id: ArcId, client: str, request_id: str) -> Notice:
        """How a request stands now, as the answer to an operation on it."""
        arc = self.core.floor.arc(arc_id)
        if arc is not None:
            return self.of_arc(arc)
        if arc_id in self._ended:
            return self._ended[arc_id][1]
        return self._notice(arc_id, client, request_id, "ended", reason="no such request is open")

    def handed_over(self, arc: ArcId, client: str, name: str) -> Notice:
        """That a request goes on in another client, where no more than that is known."""
        reason = "handed over to another client"
        return self._notice(arc, client, name, "ended", reason=reason, outcome=Outcome.HANDED_OVER)

    def _notify(self, notice: Notice) -> None:
        try:
            self.mesh.put(self.mesh.keys.notice(client_of(notice.client)), notice)
        except BadName:
            log.exception("a notice could not be addressed")

    def _remember(self, arc: ArcId, notice: Notice) -> None:
        now = clock.now()
        self._names.pop(arc, None)
        self._ended[arc] = (now + REMEMBER, notice)
        self._ended.move_to_end(arc)
        while self._ended and (
            len(self._ended) > MAX_REMEMBERED or next(iter(self._ended.values()))[0] < now
        ):
            self._ended.popitem(last=False)
