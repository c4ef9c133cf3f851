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
- Its time begins when the device has begun for it, and where other devices of it have not (`waits` in a publication),
  when the leader publishes that they have.
- A promise given to a term is kept: no lower one is obeyed again.
- The program of a direct hold touches the device past this RC. When such a hold, once confirmed here, ends in any way
  but its own client's release or a hand-over, the RC settles: nothing is obeyed under grants that began after that end,
  until the old client says that its program has left, or it must have been killed.
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
"""Stands for the hold of whoever had this RC before it started."""
REMEMBERED = 64
"""Grants that ended lately, kept to say why a command under one of them is refused."""
MAX_HOLDERS = 1_024


@dataclass(slots=True)
class HoldEntry:
    """A holder, and when its minimum runtime is over on this host's clock."""

    holder: Holder
    """As published last."""
    end: Ns
    since: int = 0
    """Counts beginnings and ends: a hold is held back by what settles since before it."""
    gone_by: Ns | None = None
    """Of a direct one that was confirmed: by then its program is gone, if it is not confirmed again."""
    begun: bool = True
    """The device has begun for it."""
    protected_from: Ns | None = None
    """From then on only operators preempt it."""

    @property
    def is_timed(self) -> bool:
        """Return True if its time runs: all its devices have begun."""
        return self.begun and self.holder.waits is None

    def is_over(self, now: Ns) -> bool:
        return self.is_timed and now >= self.end and not self.holder.keep

    def take(self, holder: Holder, now: Ns) -> None:
        """What was published of it, at its beginning or as its devices have begun."""
        self.holder, self.end = holder, now + round(holder.remaining * SECOND)
        if holder.protected_from is not None:
            self.protected_from = self.end - round(holder.protected_from * SECOND)

    def state(self, now: Ns, waits: Ns | None) -> Holder:
        """As it is now. `waits`: for how long this device has not begun, at most."""
        if self.is_timed:
            return structs.replace(self.holder, remaining=(self.end - now) / SECOND)
        # All of its time is left. What protects it does not wait.
        left, protected = self.holder.remaining, None
        if self.protected_from is not None:
            protected = left - (self.protected_from - now) / SECOND
        until = None if waits is None else waits / SECOND
        return structs.replace(self.holder, protected_from=protected, waits=until)


class Settling(NamedTuple):
    """A direct hold that has ended, and whose program may still touch the device."""

    client: str
    since: int
    gone_by: Ns


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
    settled: bool = False
    """A program that the RC settled for is gone: its device is made safe once more, and whom that held back begins."""
    entries: list[HoldEntry] = field(default_factory=list)
    """Of the removed."""

    def __bool__(self) -> bool:
        return bool(self.began or self.removed)

    @property
    def going_on(self) -> dict[Grant, Holder]:
        """Of the removed, those that go on, each by the grant of the one that it goes on in."""
        found: dict[Grant, Holder] = {}
        for holder in self.removed:
            into = (one.grant for one in self.began if one.grant not in found and goes_on(holder, one))
            if (grant := next(into, None)) is not None:
                found[grant] = holder
        return found

    @property
    def over(self) -> list[Holder]:
        """Of the removed, those that go on in none that began."""
        going_on = {holder.grant for holder in self.going_on.values()}
        return [holder for holder in self.removed if holder.grant not in going_on]

    @property
    def interrupts(self) -> bool:
        """Whether the device serves nobody between what was before and what is after."""
        return not self.stayed and self.over == self.removed


def goes_on(before: Holder, after: Holder) -> bool:
    """Whether one hold goes on in another, with no safe state in between: it was handed over (the same ARC has the same
    id and place at another client; what was taken back from a client that is gone has its place only), or its client
    has said so of another ARC of its own, which has all RCs of the first: a camera that goes on transmits on the
    channel that it had. The program of a direct one is not known to be the same."""
    if _arc(before) == _arc(after):
        return before.client != after.client
    said = before.client == after.client and before.arc == after.continues
    return said and not (before.direct or after.direct) and set(before.rcs) <= set(after.rcs)


def _arc(holder: Holder) -> tuple[str, Place]:
    """What an ARC keeps, whichever client has it."""
    return holder.id, holder.place


def _named(holder: Holder) -> str:
    return named(holder.who, holder.client, holder.arc)


class HoldTable:
    def __init__(self, rc: str, *, hold_lease: Ns, settle: Ns = 0, instance: str = "", begins: bool = False) -> None:
        """`begins`: the caller reports when the device has `begun` for a holder."""
        self.rc, self.instance, self._begins = rc, instance, begins
        self.hold_lease, self.settle = hold_lease, settle
        self.term: Term = NO_TERM
        """The newest term received or promised."""
        self.seq = 0
        self.last_contact: Ns = 0
        """When an RCM that is obeyed last published, as received here."""
        self.held: dict[Grant, HoldEntry] = {}
        self.settling: dict[Grant, Settling] = {}
        self._events = 0
        """Beginnings and ends of holds, so far."""
        self._ended: OrderedDict[Grant, str] = OrderedDict()
        self._awaited: set[Grant] = set()
        """Grants that a snapshot names while another hold is in force: their publication is still to come."""

    # Publications and snapshots

    def follow(self, grants: Grants, now: Ns) -> bool:
        """Takes the next publication of the RCM that is obeyed, if it is about other RCs, as most are. False: it has to
        be applied."""
        if grants.term != self.term or not grants.prev <= self.seq <= grants.seq or self.rc in grants.rcs:
            return False
        self.seq, self.last_contact = grants.seq, now
        return True

    def apply_grants(self, grants: Grants, now: Ns, *, sharable: bool = True, stood_still: bool = False) -> HoldChange:
        """Takes a publication. Of several holders of an exclusive RC only the newest grant is obeyed. `stood_still`:
        this process did until just now, and so has heard nothing."""
        missed = grants.term != self.term or grants.prev > self.seq
        change = HoldChange()
        if not self._accept(grants, change, now):
            if grants.term == self.term and not stood_still and not self._heard(now):
                # For a hold lease nothing newer came: what made this old was no RCM's. What stands is read.
                self.seq, change.reread = grants.seq, True
            return change
        change.reread = missed
        holders = grants.rcs.get(self.rc)
        if holders is None:
            return change
        # An RCM that names none means whoever hears it.
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
        """Takes a snapshot: what was missed is added, what the snapshot does not know is announced.

        It ends nothing but older holds of what it names, so what is still held here may be over: beside that only such
        a holder begins with whom the device `carries` them all, and an exclusive one carries no second."""
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
            # An ARC has one hold: its older one is over.
            older = [grant for grant, held in self.held.items() if _arc(held.holder) == _arc(holder)]
            others = [held.holder for grant, held in self.held.items() if grant not in older]
            if self.held and not carries([*others, holder]):
                change.announce = True
                self._awaited.add(view.grant)
                continue
            for grant in older:
                self._remove(grant, "it was granted anew", change, now, to=[holder])
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
                self._remove(grant, "lease: no leader published for too long", change, now, expired="lease")
            elif held.is_over(now):
                self._remove(grant, "its time is over", change, now, expired="time")
        for grant in [grant for grant, settling in self.settling.items() if now >= settling.gone_by]:
            self._leave(grant, change)
        return change

    def next_expiry(self) -> Ns | None:
        """When `expire` should be called next."""
        ends = [held.end for held in self.held.values() if held.is_timed and not held.holder.keep]
        if self.held:
            ends.append(self.last_contact + self.hold_lease)
        return min([*ends, *(settling.gone_by for settling in self.settling.values())], default=None)

    def fail(self, why: str, now: Ns) -> HoldChange:
        change = HoldChange()
        self._end_all(why, change, now, expired="failed")
        return change

    # Settling

    def confirmed(self, grant: Grant, now: Ns) -> None:
        """A client has confirmed a hold in force: if it is direct, its program may run from now on."""
        held = self.held[grant]
        if held.holder.direct:
            held.gone_by = now + self.hold_lease + self.settle

    def leaving(self, grant: Grant, client: str, now: Ns) -> HoldChange | Problem:
        """The client has heard of the end of its hold, and its program is gone a `settle` from now."""
        return self._bound(grant, client, now, now + self.settle)

    def left(self, grant: Grant, client: str, now: Ns) -> HoldChange | Problem:
        """The client's program is gone."""
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
        """Somebody may have held this RC directly before it started."""
        self.settling[BEFORE] = Settling("", 0, now + self.hold_lease + self.settle)

    def settles(self, grant: Grant) -> Ns | None:
        """Until when, at the latest, a hold in force is held back; None: it is not."""
        since = self.held[grant].since
        return max((one.gone_by for one in self.settling.values() if one.since < since), default=None)

    def may_be_direct(self, now: Ns) -> bool:
        """Whether somebody's program may touch the device past this RC."""
        return bool(self.settling) or any(
            held.gone_by is not None and held.gone_by > now for held in self.held.values()
        )

    def _leave(self, grant: Grant, change: HoldChange) -> None:
        if self.settling.pop(grant, None) is not None:
            change.settled = True
        elif grant in self.held:
            self.held[grant].gone_by = None

    # Commands

    def check(self, grant: Grant, client: str, now: Ns) -> Problem | None:
        """Why a command of `client` under `grant` is not obeyed at this moment; None: it is. Codes are part
        of the protocol."""
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
            code, why = "not_yet", f"{self.rc} has not heard of this grant"
        elif not self.held:
            code, why = "free", f"{self.rc} is held by nobody; request it"
        else:
            holders = ", ".join(sorted(_named(held.holder) for held in self.held.values()))
            code, why = "not_holder", f"{self.rc} is held by {holders}"
        return Problem(code, why, self.term)

    def holders(self, now: Ns, waits: Mapping[Grant, Ns] = MappingProxyType({})) -> list[Holder]:
        """The holders, with the time that each has left now. `waits`: for how long the device has not begun for one,
        at most."""
        return [held.state(now, waits.get(grant)) for grant, held in self.held.items()]

    # Beginning

    def begun(self, grant: Grant, now: Ns, *, late: bool = False) -> None:
        """The device has begun for a hold in force. `late`: not at its grant, so that its time begins now."""
        entry = self.held[grant]
        if not entry.begun:
            entry.begun = True
            if late and entry.holder.waits is None:
                entry.end = now + round(entry.holder.remaining * SECOND)

    def _retime(self, holder: Holder, now: Ns) -> None:
        """The leader publishes a hold in force again: its devices have begun, or not yet."""
        entry = self.held[holder.grant]
        if (entry.holder.waits is None) is not (holder.waits is None):
            entry.take(holder, now)

    # Changes

    def _begin(self, holder: Holder, change: HoldChange, now: Ns) -> None:
        self._events += 1
        entry = HoldEntry(holder, now, self._events, begun=not self._begins)
        entry.take(holder, now)
        for before in change.entries:
            if goes_on(before.holder, holder):
                # It goes on: it is held back by no more than it was, and its program may be the one of before.
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
        """`to`: who holds the RC afterwards."""
        entry = self.held.pop(grant)
        holder = entry.holder
        change.removed.append(holder)
        change.entries.append(entry)
        self._events += 1
        if entry.gone_by is not None and entry.gone_by > now and not any(goes_on(holder, other) for other in to):
            self.settling[grant] = Settling(holder.client, self._events, entry.gone_by)
        change.stayed = len(self.held) > len(change.began)
        if expired is not None:
            change.expired_locally.append(EndedHold(id=holder.id, grant=grant, why=expired))
        self._ended[grant] = why
        if len(self._ended) > REMEMBERED:
            self._ended.popitem(last=False)
