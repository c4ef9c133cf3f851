"""The part of a fleet that `zscout status NAME...` shows: everything with these names, and everything linked to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

from msgspec import structs

from zscout.cli import common
from zscout.cli.fleet.fleet_view import Host
from zscout.keyexpr import BadName, matcher
from zscout.messages import HoldView, RcmState, WaitView


@dataclass(slots=True)
class Selection:
    """A part of `state` and `hosts`, or all without `names`, which may be patterns; `homes`: devices' hosts."""

    names: Sequence[str]
    state: RcmState | None
    homes: Mapping[str, str]
    hosts: Mapping[str, Host]
    _met: set[str] = field(default_factory=set)
    """Names that were found."""
    _all: dict[str, list[str]] = field(default_factory=dict)
    """Names for a hint."""
    _rcs: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        if not self.names:
            return
        whole = self.state
        holds, queue = (whole.holds, whole.queue) if whole is not None else ([], [])
        there = [view.rc for view in whole.rcs] if whole is not None else list(self.homes)
        hosts = {host for host in self.hosts if self._means(host)}
        rcs = {rc for rc in there if self._means(rc)} | {rc for rc in there if self.homes.get(rc) in hosts}
        arcs: list[HoldView | WaitView] = [*holds, *queue]
        arcs = [view for view in arcs if self._names_arc(view) or view.client.partition("/")[0] in hosts]
        needed = {rc for view in arcs for rc in there if _needs(view, rc)}
        self._rcs = rcs | needed
        shown = {_id(view) for view in arcs}
        shown |= {_id(hold) for hold in holds if any(_needs(hold, rc) for rc in self._rcs)}
        shown |= {_id(wait) for wait in queue if any(_needs(wait, rc) for rc in rcs)}
        hosts |= {self.homes[rc] for rc in rcs if rc in self.homes}
        self.hosts = {name: host for name, host in self.hosts.items() if name in hosts}
        if whole is not None:
            self.state = structs.replace(
                whole,
                rcs=[view for view in whole.rcs if view.rc in self._rcs],
                holds=[hold for hold in holds if _id(hold) in shown],
                queue=[wait for wait in queue if _id(wait) in shown],
            )

    def shows(self, rc: str) -> bool:
        return not self.names or rc in self._rcs

    def missing(self) -> common.Failed | None:
        """Return the error for a name that was not found; None if all were."""
        name = next((name for name in self.names if name not in self._met), None)
        if name is None:
            return None
        return common.unknown("device, request or host", name, self._all, "and there are none", "known")

    def _means(self, *known: str) -> bool:
        """Return True if one of the user's names means the thing `known` by these names. Hints show the first."""
        self._all.setdefault(known[0], [])
        met = {name for name in self.names if any(name == other or fnmatchcase(other, _glob(name)) for other in known)}
        self._met |= met
        return bool(met)

    def _names_arc(self, view: HoldView | WaitView) -> bool:
        return self._means(view.arc, view.id, _id(view))


def _glob(name: str) -> str:
    """Convert a need's pattern (`robot/scout$*`) to a shell's, with `*` as the only special character."""
    return name.replace("$*", "*").replace("[", "[[]").replace("?", "[?]")


def _id(view: HoldView | WaitView) -> str:
    return f"{view.client}/{view.id}"


def _needs(view: HoldView | WaitView, rc: str) -> bool:
    if rc in view.needs:
        return True
    if isinstance(view, HoldView):
        return False
    try:
        return any(matcher(need)(rc) for need in view.needs if "*" in need)
    except BadName:
        return False
