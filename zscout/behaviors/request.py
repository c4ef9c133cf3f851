"""One request as its client sees it: what was asked, and how it stands by the newest word. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Any, NamedTuple, Self

from zscout.keyexpr import BadName, check_name, check_need, check_rc, is_pattern, matcher
from zscout.messages import Amounts, Ask, Notice, OpenRequest
from zscout.scheduling.model import NO_TERM, SECOND, Grant, Ns, Place, Term

Needs = Mapping[str, Mapping[str, Any]]


class Ending(NamedTuple):
    """How a hold ended: the protocol's word, the reason in words, and the ARC that it was taken for."""

    outcome: str
    reason: str
    by: str | None = None


@dataclass(slots=True)
class OpenArc:
    """A request from its first asking to its end.

    `state` is `asking` until the first word, then `queued`, `running`, `ended` or `refused`. One that another
    client is to hand over is `expected` until the first word; one that was handed over is `moved`.
    """

    id: str
    name: str
    needs: dict[str, Amounts]
    priority: int
    min_runtime: Decimal
    keep: bool = False
    state: str = "asking"
    reason: str = ""
    outcome: str | None = None
    by: str | None = None
    place: Place | None = None
    ahead: int | None = None
    grant: Grant | None = None
    rcs: list[str] = field(default_factory=list)
    """What it holds, or held last."""
    bound: dict[str, str] = field(default_factory=dict)
    """By each of its patterns: the RC among them that meets it."""
    end: Ns = 0
    """When the minimum runtime of the present hold is over, on this host's clock."""
    since: Ns = 0
    """When `state` began."""
    waits_since: Ns | None = None
    """When it was last queued: its present wait began then, whichever RCM leads."""
    ending: Ending | None = None
    """How the last hold ended; `outcome` and `reason` are of the newest word, whatever it is about."""
    last: tuple[Term, int] = field(default=(NO_TERM, 0))

    @classmethod
    def expected(cls, request: OpenRequest, now: Ns) -> Self:
        """What another client will hand over, as it told of it. Raises BadName."""
        for need in request.needs:
            check_need(need)
        return cls(
            id=check_name(request.id, "id"),
            name=check_name(request.arc, "arc"),
            needs=request.needs,
            priority=request.priority,
            min_runtime=request.min_runtime,
            keep=request.keep,
            state="expected",
            reason="another client is to hand it over",
            place=request.place,
            since=now,
            waits_since=now - round(request.waited * SECOND),
        )

    @property
    def open(self) -> bool:
        return self.state in ("asking", "queued", "running")

    def take(self, notice: Notice, now: Ns) -> bool:
        """Takes a newer word about this request. False if it is an old one, a replaced RCM's, or tells of a
        hold that is not what was asked for."""
        if (notice.term, notice.step) <= self.last or not self.open:
            return False
        bound = self._binding(notice)
        if bound is None:
            return False
        self.last = (notice.term, notice.step)
        if notice.state != self.state or notice.grant != self.grant:
            self.since = now
        if notice.state != "running":
            self._close(Ending(notice.outcome or "lost", notice.reason, notice.by), now)
        elif notice.grant != self.grant:
            self._close(Ending("lost", "it was granted anew"), now)
        self.state = notice.state
        self.reason = notice.reason
        self.outcome, self.by = notice.outcome, notice.by
        self.ahead = notice.ahead
        if notice.place is not None:
            self.place = notice.place
        if notice.state == "running":
            self.grant = notice.grant
            self.bound, self.rcs = bound, sorted(bound.get(need, need) for need in self.needs)
            self.end = now + round((notice.remaining or 0.0) * SECOND)
        return True

    def _binding(self, notice: Notice) -> dict[str, str] | None:
        """The RC that meets each pattern, each another one; None: this is no binding of what was asked."""
        bound = {need: notice.bound.get(need, "") for need in self.needs if is_pattern(need)}
        if notice.state != "running" or not bound:
            return {}
        rcs = {bound.get(need, need) for need in self.needs}
        fits = all(_is_rc(rc) and matcher(need)(rc) for need, rc in bound.items())
        return bound if fits and len(rcs) == len(self.needs) else None

    def _close(self, ending: Ending, now: Ns) -> None:
        if self.grant is not None:
            self.grant, self.ending, self.waits_since = None, ending, now
        elif self.waits_since is None:
            self.waits_since = now

    def lose(self, reason: str, now: Ns) -> None:
        """The hold is over by the client's own judgement; the request is asked again."""
        self._close(Ending("lost", reason), now)
        self.state, self.reason, self.outcome, self.since = "asking", reason, "lost", now

    def finish(self, outcome: str, reason: str, now: Ns) -> None:
        """The request is over by the client's own judgement."""
        self._close(Ending(outcome, reason), now)
        self.state, self.outcome, self.reason, self.since = "ended", outcome, reason, now

    def come(self, notice: Notice, now: Ns) -> bool:
        """Takes the first word about an expected one. False if it is none: an old one, or not credible."""
        self.state = "asking"
        if notice.state != "ended" and self.take(notice, now):
            return True
        self.state = "expected"
        return False

    def move(self, now: Ns) -> None:
        """It goes on in another client."""
        self._close(Ending("handed_over", "handed over"), now)
        self.state, self.since = "moved", now

    def take_back(self, new_id: str, reason: str, now: Ns) -> None:
        """The client to which it was handed over is gone: it is asked for anew, at its old place."""
        if self.ending is not None and self.ending.outcome == "handed_over":
            self.ending = Ending("lost", reason)
        self.id, self.last = new_id, (NO_TERM, 0)
        self.state, self.reason, self.outcome, self.since = "asking", reason, None, now

    def _waited(self, now: Ns) -> float:
        since = self.waits_since
        return 0.0 if since is None or self.grant is not None else max(0, now - since) / SECOND

    def ask(self, now: Ns) -> Ask:
        return Ask(
            id=self.id,
            arc=self.name,
            needs=self.needs,
            priority=self.priority,
            min_runtime=self.min_runtime,
            keep=self.keep,
            place=self.place,
            waited=self._waited(now),
        )

    def told(self, now: Ns) -> OpenRequest:
        """As an RCM that takes the lead is told of it."""
        return OpenRequest(
            id=self.id,
            arc=self.name,
            needs=self.needs,
            priority=self.priority,
            min_runtime=self.min_runtime,
            keep=self.keep,
            place=self.place,
            waited=self._waited(now),
            grant=self.grant,
        )


def _is_rc(name: str) -> bool:
    try:
        check_rc(name)
    except BadName:
        return False
    return True


def amounts(needs: Needs) -> dict[str, Amounts]:
    """Needs as people write them (ints, floats, Decimals), as they are sent. 0.1 means one tenth."""
    return {
        rc: {
            name: value if isinstance(value, Decimal) else Decimal(str(value))
            for name, value in params.items()
        }
        for rc, params in needs.items()
    }
