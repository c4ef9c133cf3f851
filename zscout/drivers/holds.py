"""Who holds an RC, as the RC itself knows it: *the resource is its own arbiter*. Pure; time is passed in.

The rules, all of them:

- What an RCM publishes is ordered by (term, seq). Older than the newest received or promised: ignored. So
  is a term absurdly far above it: it would silence every RCM to come.
- A publication that touches this RC lists all its holders from then on. If it names another instance of the RC, this
  one holds nothing.
- A gap, or a new term, means that something was missed: the RC reads `rcm/state` and presents its hold. A
  snapshot may add a hold that was missed; it ends nothing.
- A command is obeyed only under exactly a grant that is held now, from the client that holds it.
- A hold ends here by itself when its time is over, or when nothing of an RCM was received for the hold lease.
- A promise given to a term is kept: no lower one is obeyed again.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any

from msgspec import structs

from zscout.messages import EndedHold, Grants, Holder, Problem, RcmState, absurd
from zscout.types import NO_TERM, SECOND, Grant, HostName, Ns, Place, Term

REMEMBERED = 64
"""Grants that ended lately, kept to say why a command under one of them is refused."""
MAX_HOLDERS = 1_024


@dataclass(slots=True)
class HoldEntry:
    """A holder, and when its minimum runtime is over on this host's clock."""

    holder: Holder
    end: Ns


@dataclass(slots=True)
class HoldChange:
    """What an input changed: holders that were added or removed, and what the RC is to do about it."""

    began: list[Holder] = field(default_factory=list)
    removed: list[Holder] = field(default_factory=list)
    expired_locally: list[EndedHold] = field(default_factory=list)
    """Of the removed, those whose hold ended here by itself: by time, by lease, or as the device failed."""
    stayed: bool = False
    """Others hold the RC before and after."""
    reread: bool = False
    """Something was missed: read `rcm/state`."""
    named: str | None = None
    """The instance of this RC that the RCM means."""
    named_host: HostName | None = None
    """Its host, where that was said."""
    announce: bool = False
    """The RCM does not know what this RC holds, or is behind its term: publish its state."""

    def __bool__(self) -> bool:
        return bool(self.began or self.removed)

    @property
    def removed_not_handed_over(self) -> list[Holder]:
        """Of the removed, those that do not go on in another client: there the same ARC has the same id and place.
        (What was taken back from a client that is gone has its place only.)"""
        after = {_arc(holder): holder.client for holder in self.began}
        return [holder for holder in self.removed if after.get(_arc(holder), holder.client) == holder.client]

    @property
    def interrupts(self) -> bool:
        """Whether the device serves nobody between what was before and what is after."""
        return not self.stayed and self.removed_not_handed_over == self.removed


def _arc(holder: Holder) -> tuple[str, Place]:
    """What an ARC keeps, whichever client has it."""
    return holder.id, holder.place


class HoldTable:
    def __init__(self, rc: str, *, hold_lease: Ns, instance: str = "") -> None:
        self.rc, self.instance = rc, instance
        self.hold_lease = hold_lease
        self.term: Term = NO_TERM
        """The newest term received or promised."""
        self.seq = 0
        self.last_contact: Ns = 0
        """When an RCM that is obeyed last published, as received here."""
        self.held: dict[Grant, HoldEntry] = {}
        self._ended: OrderedDict[Grant, str] = OrderedDict()
        self._awaited: set[Grant] = set()
        """Grants that a snapshot names while another hold is in force: their publication is still to come."""

    # Publications and snapshots

    def apply_grants(self, grants: Grants, now: Ns, *, sharable: bool = True) -> HoldChange:
        """Takes a publication. Of several holders of an exclusive RC only the newest grant is obeyed."""
        missed = grants.term != self.term or grants.prev > self.seq
        change = HoldChange()
        if not self._accept(grants, change, now):
            return change
        change.reread = missed
        holders = grants.rcs.get(self.rc)
        if holders is None:
            return change
        # An RCM that names none means whoever hears it.
        change.named = grants.instances.get(self.rc, self.instance)
        if change.named != self.instance:
            self._end_all("another instance of this RC serves", change)
            return change
        if len(holders) > 1 and not sharable:
            holders = [max(holders, key=lambda holder: holder.grant)]
            change.announce = True
        reasons = {revoked.grant: f"{revoked.outcome}: {revoked.reason}" for revoked in grants.revoked}
        wanted = {holder.grant: holder for holder in holders[:MAX_HOLDERS]}
        self._awaited.clear()
        for grant in [grant for grant in self.held if grant not in wanted]:
            self._remove(grant, reasons.get(grant, "the RCM gave it to another"), change)
        for grant, holder in wanted.items():
            if grant in self._ended:
                change.announce = True
            elif grant not in self.held:
                self._begin(holder, change, now)
        return change

    def apply_snapshot(
        self, state: RcmState, now: Ns, carries: Callable[[Collection[Holder]], bool] = lambda _: False
    ) -> HoldChange:
        """Takes a snapshot: what was missed is added, what the snapshot does not know is announced.

        It ends nothing but older holds of what it names, so what is still held here may be over: beside that only such
        a holder begins with whom the device `carries` them all, and an exclusive one carries no second."""
        change = HoldChange()
        if not self._accept(state, change, now):
            return change
        change.named, change.named_host = state.instances.get(self.rc, (None, None))
        if change.named not in (None, self.instance):
            self._end_all("another instance of this RC serves", change)
            return change
        known = {view.grant for view in state.holds if self.rc in view.needs}
        change.announce = any(grant not in known for grant in self.held)
        self._awaited.clear()
        for view in state.holds:
            if self.rc not in view.needs or view.grant in self.held or view.grant in self._ended:
                continue
            own: dict[str, Any] = {"rcs": sorted(view.needs), "params": view.needs[self.rc]}
            shared = {name: getattr(view, name) for name in Holder.__struct_fields__ if name not in own}
            holder = Holder(**shared, **own)
            # An ARC has one hold: its older one is over.
            older = [grant for grant, held in self.held.items() if _arc(held.holder) == _arc(holder)]
            others = [held.holder for grant, held in self.held.items() if grant not in older]
            if self.held and not carries([*others, holder]):
                change.announce = True
                self._awaited.add(view.grant)
                continue
            for grant in older:
                self._remove(grant, "it was granted anew", change)
            self._begin(holder, change, now)
        return change

    def _accept(self, update: Grants | RcmState, change: HoldChange, now: Ns) -> bool:
        """Whether this is obeyed: it is not older than what is known, and its term no absurd jump."""
        if (update.term, update.seq) < (self.term, self.seq):
            change.announce = update.term < self.term
            return False
        if not self.believes(update.term, now):
            return False
        self.term, self.seq, self.last_contact = update.term, update.seq, now
        return True

    def believes(self, term: Term, now: Ns) -> bool:
        """Whether `term` is no absurd jump."""
        return not absurd(term, self.term, heard=self._heard(now))

    def _heard(self, now: Ns) -> bool:
        return now - self.last_contact < self.hold_lease

    def catch_up(self, term: Term) -> None:
        """Others have promised `term`."""
        if term > self.term:
            self.term, self.seq = term, 0

    def promise(self, term: Term, now: Ns, *, above: bool = False) -> bool:
        """Obeys no lower term again. False: a higher one is known, or the jump is absurd, unless the fleet must go
        `above` one that an RC obeys already."""
        if term < self.term or absurd(term, self.term, heard=self._heard(now) and not above):
            return False
        if term != self.term:
            self.term, self.seq = term, 0
        return True

    # Time

    def expire(self, now: Ns, *, lease: bool = True) -> HoldChange:
        """Ends what is over. Holds that may be kept end only with the lease."""
        change = HoldChange()
        lease_over = lease and self.held and now - self.last_contact >= self.hold_lease
        for grant, held in list(self.held.items()):
            if lease_over:
                self._remove(grant, "lease: no RCM was heard for too long", change, expired="lease")
            elif now >= held.end and not held.holder.keep:
                self._remove(grant, "its time is over", change, expired="time")
        return change

    def next_expiry(self) -> Ns | None:
        """When `expire` should be called next."""
        if not self.held:
            return None
        ends = [held.end for held in self.held.values() if not held.holder.keep]
        return min([self.last_contact + self.hold_lease, *ends])

    def fail(self, why: str) -> HoldChange:
        change = HoldChange()
        self._end_all(why, change, expired="failed")
        return change

    # Commands

    def check(self, grant: Grant, client: str, now: Ns) -> Problem | None:
        """Why a command of `client` under `grant` is not obeyed at this moment; None: it is. Codes are part
        of the protocol."""
        held = self.held.get(grant)
        newer = (grant.term, grant.seq) > (self.term, self.seq) and not absurd(grant.term, self.term)
        if held is not None and held.holder.client != client:
            code, why = "wrong_client", f"{self.rc} is held by {held.holder.client}, not by {client}"
        elif held is not None and now >= held.end and not held.holder.keep:
            code, why = "ended", f"the hold of {self.rc} is over: its time is up"
        elif held is not None:
            return None
        elif grant in self._ended:
            code, why = "ended", f"the hold of {self.rc} is over: {self._ended[grant]}"
        elif newer or grant in self._awaited:
            code, why = "not_yet", f"{self.rc} has not heard of this grant"
        elif not self.held:
            code, why = "free", f"{self.rc} is held by nobody; ask the RCM for it"
        else:
            holders = ", ".join(sorted(held.holder.arc for held in self.held.values()))
            code, why = "not_holder", f"{self.rc} is held by {holders}"
        return Problem(code, why, self.term)

    def holders(self, now: Ns) -> list[Holder]:
        """The holders, with the time that each has left now."""
        return [structs.replace(held.holder, remaining=(held.end - now) / SECOND) for held in self.held.values()]

    # Changes

    def _begin(self, holder: Holder, change: HoldChange, now: Ns) -> None:
        self.held[holder.grant] = HoldEntry(holder, now + round(holder.remaining * SECOND))
        change.began.append(holder)
        change.stayed = len(self.held) > len(change.began)

    def _end_all(self, why: str, change: HoldChange, expired: str | None = None) -> None:
        for grant in list(self.held):
            self._remove(grant, why, change, expired)

    def _remove(self, grant: Grant, why: str, change: HoldChange, expired: str | None = None) -> None:
        holder = self.held.pop(grant).holder
        change.removed.append(holder)
        change.stayed = len(self.held) > len(change.began)
        if expired is not None:
            change.expired_locally.append(EndedHold(id=holder.id, grant=grant, why=expired))
        self._ended[grant] = why
        if len(self._ended) > REMEMBERED:
            self._ended.popitem(last=False)
