"""What fleets in memory share: processes on one network, and questions whose answer must come."""

from __future__ import annotations

from typing import Any, TypeVar

from zscout.keyexpr import Sender
from zscout.mesh import Mesh
from zscout.messages import Problem
from zscout.testing.memory import MemoryMesh, MemoryNetwork

R = TypeVar("R")


class Refusal(Exception):
    def __init__(self, problem: Problem) -> None:
        super().__init__(f"{problem.code}: {problem.message}")
        self.code = problem.code


async def answer(mesh: Mesh, key: str, question: Any, kind: type[R], timeout: float = 5) -> R:
    """Raises Refusal."""
    reply = await mesh.ask_one(key, question, kind, timeout=timeout)
    assert reply is not None, "no answer"
    if reply.message is None:
        assert reply.problem is not None
        raise Refusal(reply.problem)
    return reply.message


class MemoryFleet:
    """Processes on one network, one of which only watches."""

    def __init__(self, *, closed: bool = False) -> None:
        """`closed`: as with certificates."""
        self.network = MemoryNetwork(closed=closed)
        self.watcher = self.mesh("watcher", "all")
        self.failures: list[Exception] = []

    def mesh(self, host: str, client: str = "node") -> MemoryMesh:
        return self.network.open("test", Sender(host, client))

    def cut(self, one: Mesh, *others: Mesh) -> None:
        """Both ways."""
        for other in others:
            self.network.cut(one, other)
            self.network.cut(other, one)
