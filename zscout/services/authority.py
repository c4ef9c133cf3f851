"""What a sender's role allows beyond what its keys tell: checked by whoever answers it. Pure.

Access control holds the `<host>` in a sender's keys to its certificate, so that name is all that is looked up. On a
plain mesh nothing proves a name, and nothing is refused here."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Final

from msgspec import structs

from zscout.config.fleet import Fleet
from zscout.config.scheduling_policy import RcQuota, SchedulingPolicy
from zscout.keyexpr import NODES, USERS, Rank, Sender, as_pattern, is_pattern
from zscout.mesh import Refused
from zscout.messages import Amounts, Ask, Foresee, Who, decimal_seconds, duration
from zscout.scheduling.model import ArcStatus
from zscout.types import ClientId, RcName

OPERATORS: Final[frozenset[Rank]] = frozenset({"operator"})


class Authority:
    """The rights of all names, as the fleet file has them at present."""

    def __init__(self, fleet: Fleet) -> None:
        self._policy, self._enforced = fleet.access, fleet.security is not None
        self._operator_priority = fleet.operator_priority

    def reload(self, fleet: Fleet) -> None:
        """Takes the rights of a fleet file that was read anew."""
        self._policy = fleet.access

    def bound(self, policy: SchedulingPolicy) -> SchedulingPolicy:
        """The policy, with what the scheduler has to see to: groups, quotas of RCs, and what no pattern is bound to.
        Who is in several groups counts in the first."""
        if policy.fair_shares is not None:
            # Backwards, so that the first group of a name stands last.
            listed = reversed([*self._policy.groups.items()])
            groups = {name: group for group, members in listed for name in members}
            policy = replace(policy, fair_shares=replace(policy.fair_shares, groups=groups))
        if not self._enforced:
            return policy
        names = list(self._policy.ranks)
        quotas = {
            name: tuple(
                RcQuota(owner, frozenset(members), quota.rcs)
                for owner, members, quota in self._policy.quotas_of(name)
                if quota.rcs is not None
            )
            for name in names
        }
        return replace(
            policy,
            rc_quotas={name: found for name, found in quotas.items() if found},
            barred={name: found for name in names if (found := self._barred(name))},
        )

    def check_ask(self, sender: Sender, ask: Ask | Foresee, open_by: Callable[[Collection[str]], int]) -> None:
        """Raises Refused for what `sender` may not ask for. `open_by`: how many ARCs some names have open."""
        if not self._enforced:
            return
        name = sender.host
        self._check_rank(name, "request devices", USERS)
        ceiling, most = self._policy.ceiling(name), None
        if "operator" not in self._policy.ranks_of(name):
            most = self._operator_priority - 1
        if ceiling.priority is not None:
            most = ceiling.priority if most is None else min(most, ceiling.priority)
        if most is not None and ask.priority > most:
            raise self._refused(name, f"request priority {ask.priority}; at most {most}")
        if ceiling.runtime:
            if ask.keep:
                raise self._refused(name, "keep a hold")
            if duration(ask.min_runtime, "min_runtime") > ceiling.runtime:
                what = f"request {ask.min_runtime} s; at most {ceiling.runtime / 1e9:g}"
                raise self._refused(name, what)
        for need in ask.needs:
            if not is_pattern(need) and not self.may_hold(name, need):
                raise self._not_its(name, need)
        for owner, members, quota in self._policy.quotas_of(name):
            if quota.rcs is not None and len(ask.needs) > quota.rcs:
                raise Refused(
                    "not_allowed",
                    f"{owner} may hold {quota.rcs} devices at one time, and this request needs more; name fewer",
                )
            if quota.arcs is not None and open_by(members) >= quota.arcs:
                raise Refused("not_allowed", f"{owner} has {quota.arcs} open requests, its quota; cancel one")

    def known_as(self, sender: Sender, who: Who | None) -> Who | None:
        """Who asks, as people are told it: whoever it says to be, its user is the one that its certificate names."""
        return structs.replace(who, user=sender.host) if who is not None and self._enforced else who

    def check_hand_over(
        self,
        sender: Sender,
        to: Sender,
        arcs: Collection[ArcStatus],
        open_by: Callable[[Collection[str]], int],
        held_by: Callable[[Collection[str]], int],
    ) -> None:
        """Raises Refused where the new client may not have what it is given. `open_by`, `held_by`: how many ARCs some
        names have open, and how many RCs they hold."""
        if not self._enforced:
            return
        self._check_rank(to.host, "take over a request", USERS)
        for arc in arcs:
            request = arc.request
            wanted: dict[str, Amounts] = {need: {} for need in (request.needs if arc.hold is None else arc.needs)}
            seconds = decimal_seconds(request.min_runtime)
            self.check_ask(to, Ask("", "", wanted, request.priority, seconds, request.keep), lambda _: 0)
        running = sum(len(arc.needs) for arc in arcs if arc.hold is not None)
        for owner, members, quota in self._policy.quotas_of(to.host):
            if sender.host in members:
                continue  # it has no more than before
            if quota.arcs is not None and open_by(members) + len(arcs) > quota.arcs:
                words = f"{owner} may have {quota.arcs} open requests, and would have more; cancel some first"
                raise Refused("not_allowed", words)
            if running and quota.rcs is not None and held_by(members) + running > quota.rcs:
                words = f"{owner} may hold {quota.rcs} devices at one time, and would hold more; release some first"
                raise Refused("not_allowed", words)

    def check_operator(self, sender: Sender, what: str) -> None:
        """Raises Refused for all but operators. `what` stands behind `may not`."""
        if self._enforced:
            self._check_rank(sender.host, what, OPERATORS)

    def check_user(self, sender: Sender, what: str) -> None:
        """Raises Refused for who may only look."""
        if self._enforced:
            self._check_rank(sender.host, what, USERS)

    def check_machine(self, sender: Sender, what: str) -> None:
        """Raises Refused for all but the placer, and components that move."""
        if self._enforced:
            self._check_rank(sender.host, what, NODES)

    def may_hold(self, name: str, rc: RcName) -> bool:
        holders = self._policy.holders(rc) if self._enforced else None
        return holders is None or name in holders

    def _barred(self, name: str) -> tuple[str, ...]:
        """The patterns of RCs that may not be had by this name."""
        allowed = {name, *self._policy.groups_of(name)}
        barred = (pattern for pattern, names in self._policy.access.items() if not allowed & {*names})
        return tuple(map(as_pattern, barred))

    def is_removed(self, client: ClientId) -> bool:
        """Whether this client's name has no role any more that lets it hold anything."""
        ranks = self._policy.ranks_of(client.partition("/")[0])
        return self._enforced and not ranks & USERS

    def _check_rank(self, name: str, what: str, needed: Collection[Rank]) -> None:
        if why := self._policy.refusal(name, what, needed):
            raise Refused("not_allowed", why)

    def _not_its(self, name: str, rc: RcName) -> Refused:
        return Refused("not_allowed", self._policy.told(name, f"hold {rc}", self._policy.holders(rc) or ()))

    def _refused(self, name: str, what: str) -> Refused:
        """Of what operators may."""
        could = [one for one, ranks in self._policy.ranks.items() if "operator" in ranks]
        return Refused("not_allowed", self._policy.told(name, what, could))
