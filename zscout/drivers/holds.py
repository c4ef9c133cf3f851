"""The holders of an RC, as the RC itself knows them: *the resource is its own arbiter*. Pure; time is passed in.

The rules, all of them:

- Publications of an RCM are ordered by (term, seq). The RC ignores one that is older than the newest received or
  promised. It also ignores an absurdly high term, which would silence every later RCM.
- A publication about this RC lists all its new holders. If it names another instance of the RC, this instance holds
  nothing.
- A gap or a new term means that the RC missed something: it reads `rcm/state` and presents its holds. The snapshot can
  add a missed hold, but ends none.
- A command is obeyed only under a grant that is in force now, and only from the client that holds it.
- The RC ends a hold by itself when its time is over, or when no RCM published for the hold lease.
- The time of a hold begins when the device has begun for it. While other devices of the hold have not begun (`waits` in
  a publication), it begins when the leader publishes that they have.
- A promise to a term is kept: no lower term is obeyed again.
- The program of a direct hold uses the device past this RC. If such a hold was confirmed here and ends other than by
  its client's release or a hand-over, the RC settles: it obeys no command under grants that began after this end, until
  the old client reports that its program has left, or the program must have been killed.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Final, NamedTuple

from msgspec import structs

from zscout.messages import EndedHold, Grants, Holder, Problem, RcmState, absurd, carried
from zscout.scheduling.reason import ended, named
from zscout.types import NO_TERM, SECOND, Grant, HostName, Ns, Place, Term

BEFORE: Final = Grant(NO_TERM, 0)
"""Represents the unknown hold before this RC started."""
REMEMBERED = 64
"""Ended grants that are kept, to explain why a command under such a grant is refused."""
MAX_HOLDERS = 1_024


@dataclass(slots=True)
class HoldEntry:
    """A holder, and when its minimum runtime is over on this host's clock."""

    holder: Holder
    """As last published."""
    end: Ns
    since: int = 0
    """Number of the event by which it began. Settling that began before it holds it back."""
    gone_by: Ns | None = None
    """For a confirmed direct hold: when its program is gone, unless it is confirmed again."""
    begun: bool = True
    """True if the device has begun for it."""
    protected_from: Ns | None = None
    """From then on only operators preempt it."""

    @property
    def is_timed(self) -> bool:
        """Return True if its time passes: all its devices have begun."""
        return self.begun and self.holder.waits is None

    def is_over(self, now: Ns) -> bool:
        return self.is_timed and now >= self.end and not self.holder.keep

    def take(self, holder: Holder, now: Ns) -> None:
        self.holder, self.end = holder, now + round(holder.remaining * SECOND)
        if holder.protected_from is not None:
            self.protected_from = self.end - round(holder.protected_from * SECOND)

    def state(self, now: Ns, waits: Ns | None) -> Holder:
        """`waits`: the longest time until this device begins."""
        if self.is_timed:
            return structs.replace(self.holder, remaining=(self.end - now) / SECOND)
        # All of its time is left; its protection does not wait.
        left, protected = self.holder.remaining, None
        if self.protected_from is not None:
            protected = left - (self.protected_from - now) / SECOND
        until = None if waits is None else waits / SECOND
        return structs.replace(self.holder, protected_from=protected, waits=until)


class Settling(NamedTuple):
    """An ended direct hold with a program that may still use the device."""

    client: str
    since: int
    gone_by: Ns


@dataclass(slots=True)
class HoldChange:
    """The effect of an input: holders that were added or removed, and actions for the RC."""

    began: list[Holder] = field(default_factory=list)
    removed: list[Holder] = field(default_factory=list)
    expired_locally: list[EndedHold] = field(default_factory=list)
    """Removed holds that ended here by themselves: by time, by lease, or because the device failed."""
    stayed: bool = False
    """True if other holders keep the RC before and after."""
    reread: bool = False
    """Something was missed: read `rcm/state`."""
    named: str | None = None
    """The instance of this RC that the RCM means."""
    named_host: HostName | None = None
    """The host of this instance, if known."""
    announce: bool = False
    """Publish the RC's state: the RCM does not know its holds, or has a lower term."""
    settled: bool = False
    """A program is gone that the RC settled for: make the device safe again, then let the held back holds begin."""
    entries: list[HoldEntry] = field(default_factory=list)
    """The entries of the removed holders."""

    def __bool__(self) -> bool:
        return bool(self.began or self.removed)

    @property
    def continued(self) -> dict[Grant, Holder]:
        """Removed holders that continue, by the grant of the hold in which they continue."""
        found: dict[Grant, Holder] = {}
        for holder in self.removed:
            into = (new.grant for new in self.began if new.grant not in found and continues_as(holder, new))
            if (grant := next(into, None)) is not None:
                found[grant] = holder
        return found

    @property
    def over(self) -> list[Holder]:
        """Removed holders that do not continue in a new hold."""
        continued = {holder.grant for holder in self.continued.values()}
        return [holder for holder in self.removed if holder.grant not in continued]

    @property
    def interrupts(self) -> bool:
        return not self.stayed and self.over == self.removed


def continues_as(before: Holder, after: Holder) -> bool:
    """Return True if the hold `before` continues as `after`, with no safe state in between.

    Either it was handed over: the same ARC has the same id and place at another client. (An ARC taken back from a
    vanished client keeps only its place, and does not continue.) Or the same client declared that `after` continues its
    ARC, with all RCs of `before`: a camera then keeps its channel. A direct hold does not continue by declaration,
    because its program may be another."""
    if _arc(before) == _arc(after):
        return before.client != after.client
    declared = before.client == after.client and before.arc == after.continues
    return declared and not (before.direct or after.direct) and set(before.rcs) <= set(after.rcs)


def _arc(holder: Holder) -> tuple[str, Place]:
    return holder.id, holder.place


def _named(holder: Holder) -> str:
    return named(holder.who, holder.client, holder.arc)


class HoldTable:
    def __init__(self, rc: str, *, hold_lease: Ns, settle: Ns = 0, instance: str = "", begins: bool = False) -> None:
        """`begins`: the caller calls `begun` when the device has begun for a holder."""
        self.rc, self.instance, self._begins = rc, instance, begins
        self.hold_lease, self.settle = hold_lease, settle
        self.term: Term = NO_TERM
        """The newest term received or promised."""
        self.seq = 0
        self.last_contact: Ns = 0
        """When the last publication of an obeyed RCM was received."""
        self.held: dict[Grant, HoldEntry] = {}
        self.settling: dict[Grant, Settling] = {}
        self._events = 0
        """Number of beginnings and ends of holds so far."""
        self._ended: OrderedDict[Grant, str] = OrderedDict()
        self._awaited: set[Grant] = set()
        """Grants that a snapshot named while another hold was in force: their publication has not arrived."""

    def follow(self, grants: Grants, now: Ns) -> bool:
        """Take the next publication if it concerns only other RCs, as most do. Return False if it must be applied."""
        if grants.term != self.term or not grants.prev <= self.seq <= grants.seq or self.rc in grants.rcs:
            return False
        self.seq, self.last_contact = grants.seq, now
        return True

    def apply_grants(self, grants: Grants, now: Ns, *, sharable: bool = True, stalled: bool = False) -> HoldChange:
        """Take a publication. Of several holders of an exclusive RC only the newest is obeyed. `stalled`: this process
        has just stalled, and received nothing meanwhile."""
        missed = grants.term != self.term or grants.prev > self.seq
        change = HoldChange()
        if not self._accept(grants, change, now):
            if grants.term == self.term and not stalled and not self._in_contact(now):
                # Nothing newer came for a hold lease, so the known seq was not from an RCM: read the current state.
                self.seq, change.reread = grants.seq, True
            return change
        change.reread = missed
        holders = grants.rcs.get(self.rc)
        if holders is None:
            return change
        # An RCM that names no instance means every receiver.
        change.named = grants.instances.get(self.rc, self.instance)
        if change.named != self.instance:
            self._end_all("another instance of this device serves", change, now)
            return change
        if len(holders) > 1 and not sharable:
            holders = [max(holders, key=lambda holder: holder.grant)]
            change.announce = True
        reasons = {revoked.grant: ended(revoked.outcome, revoked.reason, revoked.why) for revoked in grants.revoked}
        for revoked in grants.revoked:
            if revoked.own:
                self._leave(revoked.grant, change)
        wanted = {holder.grant: holder for holder in holders[:MAX_HOLDERS]}
        self._awaited.clear()
        for grant in [grant for grant in self.held if grant not in wanted]:
            self._remove(grant, reasons.get(grant, "the leader gave it to another"), change, now, to=wanted.values())
        for grant, holder in wanted.items():
            if grant in self._ended:
                change.announce = True
            elif grant not in self.held:
                self._begin(holder, change, now)
            else:
                self._retime(holder, now)
        return change

    def apply_snapshot(
        self, state: RcmState, now: Ns, carries: Callable[[Collection[Holder]], bool] = lambda _: False
    ) -> HoldChange:
        """Take a snapshot: add missed holds, and announce holds that it lacks. It ends only older holds of the ARCs
        that it names, so holds in force here may be over. Beside them a new hold begins only if the device `carries`
        all of them; an exclusive device never does."""
        change = HoldChange()
        if not self._accept(state, change, now):
            return change
        change.named, change.named_host = state.instances.get(self.rc, (None, None))
        if change.named not in (None, self.instance):
            self._end_all("another instance of this device serves", change, now)
            return change
        known = {view.grant for view in state.holds if self.rc in view.needs}
        change.announce = any(grant not in known for grant in self.held)
        self._awaited.clear()
        for view in state.holds:
            if self.rc not in view.needs or view.grant in self._ended:
                continue
            holder = carried(view, Holder, rcs=sorted(view.needs), params=view.needs[self.rc])
            if view.grant in self.held:
                self._retime(holder, now)
                continue
            # An ARC has one hold: its older hold is over.
            older = [grant for grant, held in self.held.items() if _arc(held.holder) == _arc(holder)]
            others = [held.holder for grant, held in self.held.items() if grant not in older]
            if self.held and not carries([*others, holder]):
                change.announce = True
                self._awaited.add(view.grant)
                continue
            for grant in older:
                self._remove(grant, "it was granted again", change, now, to=[holder])
            self._begin(holder, change, now)
        return change

    def _accept(self, update: Grants | RcmState, change: HoldChange, now: Ns) -> bool:
        """Return True if the update is obeyed: not older than the known state, and its term plausible."""
        if (update.term, update.seq) < (self.term, self.seq):
            change.announce = update.term < self.term
            return False
        if not self.believes(update.term, now):
            return False
        self.term, self.seq, self.last_contact = update.term, update.seq, now
        return True

    def believes(self, term: Term, now: Ns) -> bool:
        """Return True if `term` is plausible: not an absurd jump."""
        return not absurd(term, self.term, heard=self._in_contact(now))

    def _in_contact(self, now: Ns) -> bool:
        return now - self.last_contact < self.hold_lease

    def catch_up(self, term: Term) -> None:
        if term > self.term:
            self.term, self.seq = term, 0

    def promise(self, term: Term, now: Ns, *, above: bool = False) -> bool:
        """Promise to obey no lower term again. Return False if a higher term is known, or if the jump is absurd;
        `above` permits large jumps, to get above a term that an RC already obeys."""
        if term < self.term or absurd(term, self.term, heard=self._in_contact(now) and not above):
            return False
        if term != self.term:
            self.term, self.seq = term, 0
        return True

    def expire(self, now: Ns, *, lease: bool = True) -> HoldChange:
        """End the holds that are over. Holds that may be kept end only with the lease."""
        change = HoldChange()
        lease_over = lease and self.held and now - self.last_contact >= self.hold_lease
        for grant, held in list(self.held.items()):
            if lease_over:
                self._remove(grant, "lease: no leader published for too long", change, now, expired="lease")
            elif held.is_over(now):
                self._remove(grant, "its time is over", change, now, expired="time")
        for grant in [grant for grant, settling in self.settling.items() if now >= settling.gone_by]:
            self._leave(grant, change)
        return change

    def next_expiry(self) -> Ns | None:
        ends = [held.end for held in self.held.values() if held.is_timed and not held.holder.keep]
        if self.held:
            ends.append(self.last_contact + self.hold_lease)
        return min([*ends, *(settling.gone_by for settling in self.settling.values())], default=None)

    def fail(self, why: str, now: Ns) -> HoldChange:
        change = HoldChange()
        self._end_all(why, change, now, expired="failed")
        return change

    def confirmed(self, grant: Grant, now: Ns) -> None:
        """A client confirmed a hold in force: the program of a direct hold may run from now on."""
        held = self.held[grant]
        if held.holder.direct:
            held.gone_by = now + self.hold_lease + self.settle

    def leaving(self, grant: Grant, client: str, now: Ns) -> HoldChange | Problem:
        """The client knows that its hold has ended; its program is gone within `settle`."""
        return self._bound(grant, client, now, now + self.settle)

    def left(self, grant: Grant, client: str, now: Ns) -> HoldChange | Problem:
        return self._bound(grant, client, now, now)

    def _bound(self, grant: Grant, client: str, now: Ns, gone_by: Ns) -> HoldChange | Problem:
        change, held, settling = HoldChange(), self.held.get(grant), self.settling.get(grant)
        if held is not None and held.holder.client == client:
            if held.gone_by is not None:
                held.gone_by = min(held.gone_by, gone_by)
        elif settling is not None and settling.client == client:
            self.settling[grant] = settling._replace(gone_by=min(settling.gone_by, gone_by))
            if gone_by <= now:
                self._leave(grant, change)
        else:
            return self.check(grant, client, now) or change
        return change

    def settle_at_start(self, now: Ns) -> None:
        """Settle because a direct hold may have been in force before this RC started."""
        self.settling[BEFORE] = Settling("", 0, now + self.hold_lease + self.settle)

    def settles(self, grant: Grant) -> Ns | None:
        """The latest time until which a hold in force is held back, or None."""
        since = self.held[grant].since
        return max((other.gone_by for other in self.settling.values() if other.since < since), default=None)

    def may_be_direct(self, now: Ns) -> bool:
        """Return True if a program may use the device past this RC."""
        return bool(self.settling) or any(
            held.gone_by is not None and held.gone_by > now for held in self.held.values()
        )

    def _leave(self, grant: Grant, change: HoldChange) -> None:
        if self.settling.pop(grant, None) is not None:
            change.settled = True
        elif grant in self.held:
            self.held[grant].gone_by = None

    def check(self, grant: Grant, client: str, now: Ns) -> Problem | None:
        """Why a command of `client` under `grant` is refused now, with a code of the protocol; None: obeyed."""
        held = self.held.get(grant)
        newer = (grant.term, grant.seq) > (self.term, self.seq) and not absurd(grant.term, self.term)
        if held is not None and held.holder.client != client:
            code, why = "wrong_client", f"{self.rc} is held by {_named(held.holder)}, not by {client}"
        elif held is not None and held.is_over(now):
            code, why = "ended", f"the hold of {self.rc} is over: its time is up"
        elif held is not None:
            return None
        elif grant in self._ended:
            code, why = "ended", f"the hold of {self.rc} is over: {self._ended[grant]}"
        elif newer or grant in self._awaited:
            code, why = "not_yet", f"{self.rc} does not know this grant yet; try again"
        elif not self.held:
            code, why = "free", f"{self.rc} is free; request it first"
        else:
            holders = ", ".join(sorted(_named(held.holder) for held in self.held.values()))
            code, why = "not_holder", f"{self.rc} is held by {holders}"
        return Problem(code, why, self.term)

    def holders(self, now: Ns, waits: Mapping[Grant, Ns] = MappingProxyType({})) -> list[Holder]:
        """`waits`: by grant, the longest time until the device begins."""
        return [held.state(now, waits.get(grant)) for grant, held in self.held.items()]

    def begun(self, grant: Grant, now: Ns, *, late: bool = False) -> None:
        """The device has begun for a hold in force. `late`: some time after the grant, so its time begins now."""
        entry = self.held[grant]
        if not entry.begun:
            entry.begun = True
            if late and entry.holder.waits is None:
                entry.end = now + round(entry.holder.remaining * SECOND)

    def _retime(self, holder: Holder, now: Ns) -> None:
        """Take new times for a hold in force if its `waits` appeared or ended."""
        entry = self.held[holder.grant]
        if (entry.holder.waits is None) is not (holder.waits is None):
            entry.take(holder, now)

    def _begin(self, holder: Holder, change: HoldChange, now: Ns) -> None:
        self._events += 1
        entry = HoldEntry(holder, now, self._events, begun=not self._begins)
        entry.take(holder, now)
        for before in change.entries:
            if continues_as(before.holder, holder):
                # Nothing more holds it back than before, and its program may be the same.
                entry.since, entry.gone_by, entry.begun = before.since, before.gone_by, before.begun
        self.held[holder.grant] = entry
        change.began.append(holder)
        change.stayed = len(self.held) > len(change.began)

    def _end_all(self, why: str, change: HoldChange, now: Ns, expired: str | None = None) -> None:
        for grant in list(self.held):
            self._remove(grant, why, change, now, expired=expired)

    def _remove(
        self,
        grant: Grant,
        why: str,
        change: HoldChange,
        now: Ns,
        *,
        expired: str | None = None,
        to: Collection[Holder] = (),
    ) -> None:
        """`to`: the holders afterwards."""
        entry = self.held.pop(grant)
        holder = entry.holder
        change.removed.append(holder)
        change.entries.append(entry)
        self._events += 1
        if entry.gone_by is not None and entry.gone_by > now and not any(continues_as(holder, other) for other in to):
            self.settling[grant] = Settling(holder.client, self._events, entry.gone_by)
        change.stayed = len(self.held) > len(change.began)
        if expired is not None:
            change.expired_locally.append(EndedHold(id=holder.id, grant=grant, why=expired))
        self._ended[grant] = why
        if len(self._ended) > REMEMBERED:
            self._ended.popitem(last=False)
