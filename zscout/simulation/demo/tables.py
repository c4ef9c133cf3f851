"""Table 1 and Table 2 of the paper, and who was seen to hold what: the tables of `zscout demo`. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib import resources
from itertools import groupby
from typing import Final, NamedTuple, TypeAlias

from zscout.messages import LoadReport
from zscout.simulation.workload import Workload, parse_workload
from zscout.types import SECOND, Ns

FREE: Final = "-"
Table: TypeAlias = dict[str, list[str]]
"""By RC, who holds it in each second: the ARC's name without "arc", FREE for nobody."""


class Paper(NamedTuple):
    """What was asked in the paper's example, and what came of it."""

    workload: Workload
    table: Table


class Difference(NamedTuple):
    """A cell of Table 2 that came out otherwise."""

    rc: str
    second: int
    paper: str
    published: str
    bodies: str


def paper() -> Paper:
    """The paper's tables, as they are shipped with the package."""
    data = resources.files("zscout.simulation") / "paper"
    workload = parse_workload((data / "table1.toml").read_text(encoding="utf-8"), "table1.toml")
    lines = (data / "table2.csv").read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines if line and not line.startswith("#")]
    # The paper writes Scout33 for robot/scout33.
    names = {rc.name.rpartition("/")[2]: rc.name for rc in workload.rcs}
    return Paper(workload, {names[row[0].lower()]: row[1:] for row in rows if row[0] != "time"})


@dataclass(slots=True)
class ArcBody:
    """An ARC's body: what it held, from when to when (ns); `end` None while it goes on."""

    arc: str
    rcs: tuple[str, ...]
    begin: Ns
    end: Ns | None = None


@dataclass(slots=True)
class Observed:
    """What was published by the RCM, and what the ARCs' bodies saw, on one host's clock."""

    zero: Ns | None = None
    """When the first ARC asked."""
    changes: dict[str, list[tuple[Ns, tuple[str, ...]]]] = field(default_factory=dict)
    """By RC: its holders, and from when on."""
    bodies: list[ArcBody] = field(default_factory=list)
    loads: dict[str, LoadReport] = field(default_factory=dict)
    """The newest report of each host."""

    def published(self, rc: str, arcs: Sequence[str], at: Ns) -> None:
        self.changes.setdefault(rc, []).append((at, tuple(arcs)))

    def entered(self, arc: str, rcs: Sequence[str], at: Ns) -> None:
        self.bodies.append(ArcBody(arc, tuple(rcs), at))

    def left(self, arc: str, at: Ns) -> None:
        for body in self.bodies:
            if body.arc == arc and body.end is None:
                body.end = at

    @property
    def free(self) -> bool:
        """Whether nobody holds anything, by the RCM's word."""
        return all(not changes[-1][1] for changes in self.changes.values())

    def same_order(self, expected: Table) -> bool:
        """Whether everything came as in a table, however late: all that the RCM published, one state of all RCs
        after the other, and on each RC the bodies, one after the other."""
        instants = sorted({at for changes in self.changes.values() for at, _ in changes})
        published = zip(*([self._held(rc, at) for at in instants] for rc in expected), strict=True)
        return _order(published) == _order(zip(*expected.values(), strict=True)) and all(
            [_cell([body.arc]) for body in sorted(self.bodies, key=lambda body: body.begin) if rc in body.rcs]
            == [cell for cell, _ in groupby(row) if cell != FREE]
            for rc, row in expected.items()
        )

    def by_rcm(self, rcs: Sequence[str], seconds: int, now: Ns) -> Table:
        """Who held each RC in the middle of each second until `now`, by what the RCM published."""

        return {rc: [self._held(rc, at) for at in self._middles(seconds, now)] for rc in rcs}

    def by_bodies(self, rcs: Sequence[str], seconds: int, now: Ns) -> Table:
        """The same, by the bodies that were entered and left."""

        def cell(rc: str, at: Ns) -> str:
            return _cell(
                [
                    body.arc
                    for body in self.bodies
                    if rc in body.rcs and body.begin <= at and (body.end is None or at < body.end)
                ]
            )

        return {rc: [cell(rc, at) for at in self._middles(seconds, now)] for rc in rcs}

    def _held(self, rc: str, at: Ns) -> str:
        return _cell(next((arcs for since, arcs in reversed(self.changes.get(rc, [])) if since <= at), ()))

    def _middles(self, seconds: int, now: Ns) -> list[Ns]:
        """The middle of each second; of the one that goes on, the present."""
        if self.zero is None:
            return []
        begun = (self.zero + second * SECOND for second in range(seconds))
        return [min(begin + SECOND // 2, now) for begin in begun if begin <= now]


def differences(expected: Table, published: Table, bodies: Table) -> list[Difference]:
    """The cells in which either table is not the paper's; a cell that is missing reads "?"."""
    found = []
    for rc, cells in expected.items():
        for second, cell in enumerate(cells):
            one, two = (
                row[second] if second < len(row) else "?" for row in (published.get(rc, []), bodies.get(rc, []))
            )
            if (one, two) != (cell, cell):
                found.append(Difference(rc, second, cell, one, two))
    return found


def _cell(arcs: Sequence[str]) -> str:
    return "+".join(arc.removeprefix("arc") for arc in arcs) or FREE


def _order(states: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """The states of all RCs one after the other, without those before the first hold and after the last."""
    order = [state for state, _ in groupby(states)]
    while order and set(order[-1]) == {FREE}:
        order.pop()
    return order[1:] if order and set(order[0]) == {FREE} else order
