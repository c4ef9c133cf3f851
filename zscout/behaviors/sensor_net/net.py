"""Active robots of a sensor net, and replacements of lost ones. Pure; time is passed in.

`wanted` robots start in the order of their names. A lost one (its camera shows nothing, it is gone from the mesh for
ABSENCE_TIMEOUT, or its behavior can't be had) is replaced by the next free one, for good; if it returns, it is free."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal, TypeAlias

ABSENCE_TIMEOUT: Final = 10.0  # seconds of absence after which a robot counts as lost
RETRY: Final = 60.0  # seconds before a failed robot is retried, if no other is free

WATCHING: Final = frozenset({"watch", "alert", "present"})
"""Status of a robot that watches; `present`: a mover is still there."""
HIDDEN: Final = WATCHING | {"hidden", "blind"}  # status of a robot in its place
PAUSED: Final = frozenset({"wait", "lost", ""})  # status that does not show whether it is hidden

MemberStatus: TypeAlias = Literal["free", "active", "lost"]


@dataclass(frozen=True, slots=True)
class StartRobot:
    robot: str


@dataclass(frozen=True, slots=True)
class StopRobot:
    robot: str
    why: str


Effect: TypeAlias = StartRobot | StopRobot


@dataclass(slots=True)
class Member:
    robot: str
    standing: MemberStatus = "free"
    doing: str = ""
    why: str = ""
    alerts: int = 0
    hidden: bool = False
    there: bool = False
    away_since: float | None = None
    lost_at: float = 0.0


class SensorNet:
    def __init__(self, robots: Sequence[str], wanted: int | None = None) -> None:
        """Raises ValueError for no robots, duplicates, or more wanted than named."""
        if not robots or len(set(robots)) != len(robots):
            raise ValueError("robots is empty or has duplicates; name each robot once")
        self.wanted = len(robots) if wanted is None else wanted
        if not 1 <= self.wanted <= len(robots):
            raise ValueError(f"wanted is {wanted}; write 1 to {len(robots)}, the number of robots")
        self.members = {robot: Member(robot) for robot in robots}

    @property
    def hidden(self) -> int:
        return sum(member.hidden for member in self._active)

    @property
    def watching(self) -> int:
        return sum(member.doing in WATCHING for member in self._active)

    @property
    def alerts(self) -> int:
        return sum(member.alerts for member in self.members.values())

    @property
    def _active(self) -> list[Member]:
        return [member for member in self.members.values() if member.standing == "active"]

    def report(self, now: float, robot: str, doing: str, *, alert: bool = False) -> list[Effect]:
        """Take a status; inactive robots' are old, and ignored."""
        member = self.members.get(robot)
        if member is None or member.standing != "active":
            return []
        member.doing = doing
        member.alerts += alert
        if doing not in PAUSED:
            member.hidden = doing in HIDDEN
        return self._lose(now, member, "its camera shows nothing") if doing == "lost" else []

    def failed(self, now: float, robot: str, why: str) -> list[Effect]:
        member = self.members[robot]
        return self._lose(now, member, why) if member.standing == "active" else []

    def there(self, now: float, robots: Iterable[str]) -> list[Effect]:
        """Exactly these robots are on the mesh now. Call it regularly: it also starts replacements."""
        present = set(robots)
        for member in self.members.values():
            member.there = member.robot in present
            if member.there:
                away_since, member.away_since = member.away_since, None
                was_gone = away_since is not None and member.lost_at - away_since >= ABSENCE_TIMEOUT
                if member.standing == "lost" and was_gone:
                    member.standing, member.why = "free", ""
            elif member.away_since is None:
                member.away_since = now
        # Only once all are updated: a replacement may be gone too.
        effects: list[Effect] = []
        for member in self._active:
            if member.away_since is not None and now - member.away_since >= ABSENCE_TIMEOUT:
                effects += self._lose(now, member, "it is not on the mesh")
        return effects + self._fill(now)

    def _lose(self, now: float, member: Member, why: str) -> list[Effect]:
        member.standing, member.why, member.lost_at = "lost", why, now
        member.hidden, member.doing = False, ""
        return [StopRobot(member.robot, why), *self._fill(now)]

    def _fill(self, now: float) -> list[Effect]:
        effects: list[Effect] = []
        while len(self._active) < self.wanted and (member := self._next(now)) is not None:
            member.standing, member.why, member.doing = "active", "", ""
            effects.append(StartRobot(member.robot))
        return effects

    def _next(self, now: float) -> Member | None:
        """The first free robot on the mesh, else the longest lost."""
        here = [member for member in self.members.values() if member.there]
        free = [member for member in here if member.standing == "free"]
        lost = [member for member in here if member.standing == "lost" and now - member.lost_at >= RETRY]
        return free[0] if free else min(lost, key=lambda member: member.lost_at, default=None)

    def memory(self) -> dict[str, Any]:
        return {"members": [asdict(member) for member in self.members.values()]}

    def recall(self, memory: dict[str, Any]) -> None:
        for known in memory["members"]:
            if known["robot"] in self.members:
                self.members[known["robot"]] = Member(**known)
