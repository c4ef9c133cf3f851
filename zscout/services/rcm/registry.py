"""How every request of one reign stands, and for a while how those that ended did, as notices."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

from msgspec.structs import replace

from zscout.keyexpr import is_pattern
from zscout.mesh import Mesh
from zscout.messages import Notice, State
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcStatus, Dropped, HoldEnded, Outcome
from zscout.services.rcm import convert
from zscout.services.rcm.forecasts import Forecasts
from zscout.types import SECOND, ArcId, Ns, Term

REMEMBER: Ns = 60 * SECOND
"""How long ended requests are known: longer than any query's timeout and a lease together."""
MAX_REMEMBERED = 20_000


class RequestRegistry:
    """The names of requests, how those that ended lately ended, and the numbers of all notices."""

    def __init__(self, mesh: Mesh, core: Core, term: Term) -> None:
        self._mesh, self._core, self._term = mesh, core, term
        self.forecasts = Forecasts(core)
        self._step = 0
        self._names: dict[ArcId, str] = {}
        self._ended: OrderedDict[ArcId, tuple[Ns, Notice]] = OrderedDict()
        self._estimated: set[ArcId] = set()
        """ARCs whose notices say when they will start."""

    def enter(self, arc: ArcId, name: str, *, estimate: bool = False) -> None:
        """From now on `arc` is called `name`; with `estimate` its notices say when it will start."""
        self._names[arc] = name
        if estimate:
            self._estimated.add(arc)

    def name(self, arc: ArcId) -> str:
        return self._names.get(arc, convert.request_id(arc))

    def ended(self, arc: ArcId) -> bool:
        """Whether `arc` ended lately."""
        return arc in self._ended

    def notice(self, arc_id: ArcId) -> Notice:
        """How a request stands now, or how it ended."""
        arc = self._core.arc(arc_id)
        if arc is not None:
            return self._open(arc)
        if arc_id in self._ended:
            return self._ended[arc_id][1]
        return self._notice(arc_id, "ended", reason="no such request is open")

    def handed_over(self, arc: ArcId, name: str) -> Notice:
        """That a request goes on in another client, where no more than that is known."""
        reason = "handed over to another client"
        return replace(self._notice(arc, "ended", reason=reason, outcome=Outcome.HANDED_OVER), arc=name)

    def close(self, effect: HoldEnded | Dropped) -> Notice:
        """How a hold, or the wait for one, ended. A request that is not queued again has ended with it."""
        details: dict[str, Any] = {"reason": str(effect.reason), "outcome": effect.outcome}
        details["why"] = convert.reason_info(effect.reason)
        requeued = isinstance(effect, HoldEnded) and effect.requeued
        if isinstance(effect, HoldEnded):
            details |= {"by": effect.by, "grant": effect.grant, "rcs": list(effect.rcs)}
        if requeued and (arc := self._core.arc(effect.arc)) is not None:
            details["starts_in"] = self._starts_in(arc)
        notice = self._notice(effect.arc, "queued" if requeued else "ended", **details)
        if self._core.arc(effect.arc) is None:
            self._remember(effect.arc, notice)
        return notice

    def _starts_in(self, arc: ArcStatus) -> float | None:
        if arc.hold is not None or arc.id not in self._estimated:
            return None
        now = self._mesh.now()
        start = self.forecasts.start(arc.id, arc.since, now)
        return None if start is None else max(0, start - now) / SECOND

    def _open(self, arc: ArcStatus) -> Notice:
        hold = arc.hold
        # While it waits, what it is bound to is only what it was last looked at with.
        rcs = arc.needs if hold is not None else [need for need in arc.request.needs if not is_pattern(need)]
        return self._notice(
            arc.id,
            "queued" if hold is None else "running",
            priority=arc.request.priority,
            reason=str(arc.reason or ""),
            why=convert.reason_info(arc.reason),
            place=arc.place,
            ahead=arc.ahead,
            grant=hold.grant if hold is not None else None,
            rcs=sorted(rcs),
            bound=dict(arc.bound) if hold is not None else {},
            remaining=(hold.end - self._mesh.now()) / SECOND if hold is not None else None,
            starts_in=self._starts_in(arc),
        )

    def _notice(self, arc: ArcId, state: State, **details: Any) -> Notice:
        self._step += 1
        return Notice(
            id=convert.request_id(arc),
            arc=self.name(arc),
            client=convert.client_id(arc),
            state=state,
            term=self._term,
            step=self._step,
            **details,
        )

    def _remember(self, arc: ArcId, notice: Notice) -> None:
        now = self._mesh.now()
        self._names.pop(arc, None)
        self._estimated.discard(arc)
        self._ended[arc] = (now + REMEMBER, notice)
        self._ended.move_to_end(arc)
        while self._ended and (
            len(self._ended) > MAX_REMEMBERED or next(iter(self._ended.values()))[0] < now
        ):
            self._ended.popitem(last=False)
