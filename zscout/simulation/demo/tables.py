"""Tables 1 and 2 of the paper, and the same tables as observed. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib import resources
from itertools import groupby, islice, zip_longest
from typing import Final, NamedTuple, TypeAlias

from zscout.messages import LoadReport
from zscout.simulation.workload import Workload, parse_workload
from zscout.types import SECOND, Ns

FREE: Final = "-"
Table: TypeAlias = dict[str, list[str]]
"""By RC, the holder in each second: the ARC's name without "arc", or FREE."""


class Paper(NamedTuple):
    """The workload of the paper's example, and its outcome."""

    workload: Workload
    table: Table


class Difference(NamedTuple):
    rc: str
    second: int
    paper: str
    published: str
    bodies: str


def paper() -> Paper:
    data = resources.files("zscout.simulation") / "paper"
    workload = parse_workload((data / "table1.toml").read_text(encoding="utf-8"), "table1.toml")
    lines = (data / "table2.csv").read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines if line and not line.startswith("#")]
    # The paper writes Scout33 for robot/scout33.
    names = {rc.name.rpartition("/")[2]: rc.name for rc in workload.rcs}
    return Paper(workload, {names[row[0].lower()]: row[1:] for row in rows if row[0] != "time"})


@dataclass(slots=True)
class ArcBody:
    """A run of an ARC's body (times in ns); `end` is None while it runs."""

    arc: str
    rcs: tuple[str, ...]
    begin: Ns
    end: Ns | None = None


@dataclass(slots=True)
class Observed:
    """The RCM's publications and the runs of the ARCs' bodies, on the same host's clock."""

    zero: Ns | None = None  # time of the first request
    changes: dict[str, list[tuple[Ns, tuple[str, ...]]]] = field(default_factory=dict)  # by RC: since when, holders
    bodies: list[ArcBody] = field(default_factory=list)
    loads: dict[str, LoadReport] = field(default_factory=dict)  # newest report of each host

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
        return all(not changes[-1][1] for changes in self.changes.values())

    def same_order(self, expected: Table) -> bool:
        """Return True if the RCM's states of all RCs, and the bodies on each RC, came in the table's order."""
        instants = sorted({at for changes in self.changes.values() for at, _ in changes})
        published = zip(*([self._held(rc, at) for at in instants] for rc in expected), strict=True)
        return _order(published) == _order(zip(*expected.values(), strict=True)) and all(
            [_cell([body.arc]) for body in sorted(self.bodies, key=lambda body: body.begin) if rc in body.rcs]
            == [cell for cell, _ in groupby(row) if cell != FREE]
            for rc, row in expected.items()
        )

    def by_rcm(self, rcs: Sequence[str], seconds: int, now: Ns) -> Table:
        """The holders in the middle of each second until `now`, as the RCM published them."""
        return {rc: [self._held(rc, at) for at in self._middles(seconds, now)] for rc in rcs}

    def by_bodies(self, rcs: Sequence[str], seconds: int, now: Ns) -> Table:
        """The holders in the middle of each second until `now`, by the bodies that ran."""

        def cell(rc: str, at: Ns) -> str:
            at_work = (body for body in self.bodies if body.begin <= at and (body.end is None or at < body.end))
            return _cell([body.arc for body in at_work if rc in body.rcs])

        return {rc: [cell(rc, at) for at in self._middles(seconds, now)] for rc in rcs}

    def _held(self, rc: str, at: Ns) -> str:
        return _cell(next((arcs for since, arcs in reversed(self.changes.get(rc, [])) if since <= at), ()))

    def _middles(self, seconds: int, now: Ns) -> list[Ns]:
        """The middle of each second that has begun, or `now` if that is earlier."""
        if self.zero is None:
            return []
        begun = (self.zero + second * SECOND for second in range(seconds))
        return [min(begin + SECOND // 2, now) for begin in begun if begin <= now]


def differences(expected: Table, published: Table, bodies: Table) -> list[Difference]:
    """The cells in which either table differs from the paper's; a missing cell is "?"."""
    return [
        Difference(rc, second, cell, *pair)
        for rc, cells in expected.items()
        for second, (cell, *pair) in enumerate(
            islice(zip_longest(cells, published.get(rc, []), bodies.get(rc, []), fillvalue="?"), len(cells))
        )
        if pair != [cell, cell]
    ]


def _cell(arcs: Sequence[str]) -> str:
    return "+".join(arc.removeprefix("arc") for arc in arcs) or FREE


def _order(states: Iterable[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """The successive states of all RCs from the first hold to the last."""
    order = [state for state, _ in groupby(states)]
    while order and set(order[-1]) == {FREE}:
        order.pop()
    return order[1:] if order and set(order[0]) == {FREE} else order
