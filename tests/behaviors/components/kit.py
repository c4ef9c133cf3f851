"""For tests with components: a lab whose nodes know odd kinds too, and questions to a host."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import psutil

from tests.hang import HANG
from tests.live.lab import Lab
from zscout.mesh import Mesh
from zscout.messages import (
    ComponentList,
    ComponentSpec,
    ComponentView,
    ListComponents,
    Output,
    Problem,
    ReadOutput,
    StartComponent,
    StopComponent,
)

R = TypeVar("R")
ROOT = Path(__file__).parents[3]
ODD = {
    "still": "Still",
    "brief": "Brief",
    "deaf": "Deaf",
    "flood": "Flood",
    "eater": "Eater",
    "parent": "Parent",
    "never": "Never",
    "restless": "Restless",
    "garbler": "Garbler",
    "no-component": "NO_COMPONENT",
}


def register_odd_kinds(folder: Path) -> None:
    """Makes a package of the kinds in `odd.py`, as if it were installed in `folder`."""
    info = folder / "odd-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: odd\nVersion: 1\n")
    lines = "".join(f"{name} = tests.behaviors.components.odd:{value}\n" for name, value in ODD.items())
    missing = "missing = tests.behaviors.components.nowhere:Nothing\n"
    (info / "entry_points.txt").write_text(f"[zscout.components]\n{lines}{missing}")


class ComponentLab(Lab):
    """Nodes that can start the odd kinds."""

    def __init__(
        self, folder: Path, *, start_timeout: float = HANG, candidates: Sequence[str] = (), rules: str = ""
    ) -> None:
        extra = f"[placement]\nstart_timeout = {start_timeout}\n{rules}"
        super().__init__(folder, candidates=candidates, extra=extra)
        register_odd_kinds(folder / "site")
        self.env["PYTHONPATH"] = f"{folder / 'site'}:{ROOT}"


class Hosts:
    """Asks nodes about their components, as the placer does: on the mesh of `Lab.manager`."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh

    async def ask(self, host: str, operation: msgspec.Struct, kind: type[R]) -> R | Problem:
        """The answer of a host, which must come."""
        key = self.mesh.keys.component(host, self.mesh.me)
        async with asyncio.timeout(2 * HANG):
            while True:
                reply = await self.mesh.ask_one(key, operation, kind, timeout=HANG)
                if reply is not None:
                    answer = reply.message or reply.problem
                    assert answer is not None
                    return answer
                await asyncio.sleep(0.05)

    async def get(self, host: str, operation: msgspec.Struct, kind: type[R]) -> R:
        answer = await self.ask(host, operation, kind)
        assert not isinstance(answer, Problem), answer
        return answer

    async def refused(self, host: str, operation: msgspec.Struct) -> str:
        """The code with which a host refuses."""
        answer = await self.ask(host, operation, ComponentView)
        assert isinstance(answer, Problem), answer
        return answer.code

    async def start(
        self,
        host: str,
        component: str,
        kind: str,
        params: dict[str, Any] | None = None,
        *,
        incarnation: int = 1,
        standby: bool = False,
        memory_limit: int = 0,
        cpu_limit: float = 0.0,
    ) -> ComponentView:
        # The placer beside the leading RCM adopts what it sees; it is to leave alone what ends here.
        spec = ComponentSpec(kind, params or {}, restart="never", memory_limit=memory_limit, cpu_limit=cpu_limit)
        return await self.get(host, StartComponent(component, incarnation, spec, standby), ComponentView)

    async def stop(self, host: str, component: str, grace: float = 5.0) -> ComponentView:
        return await self.get(host, StopComponent(component, grace=grace), ComponentView)

    async def ended(self, host: str, component: str) -> ComponentView:
        """A component as it is once it has ended."""
        async with asyncio.timeout(HANG):
            while True:
                listed = await self.get(host, ListComponents(component), ComponentList)
                if listed.components and listed.components[0].phase == "ended":
                    return listed.components[0]
                await asyncio.sleep(0.02)

    async def output(self, host: str, component: str, until: Callable[[str], bool]) -> str:
        """What a component wrote and is kept, as soon as `until` holds of it."""
        text = ""
        try:
            async with asyncio.timeout(HANG):
                while True:
                    text = (await self.get(host, ReadOutput(component), Output)).text
                    if until(text):
                        return text
                    await asyncio.sleep(0.02)
        except TimeoutError:
            raise AssertionError(f"{component} wrote only {text!r}") from None


async def counts(hosts: Hosts, host: str) -> list[int]:
    """What the component "c" has counted on a host, as far as it is kept."""
    text = (await hosts.get(host, ReadOutput("c"), Output)).text
    return [int(line) for line in text.splitlines() if line.isdecimal()]


async def counts_on(hosts: Hosts, host: str) -> None:
    """Waits until it goes on counting there."""
    last = max(await counts(hosts, host), default=0)
    async with asyncio.timeout(HANG):
        while max(await counts(hosts, host), default=0) <= last + 2:  # noqa: ASYNC110 - asked each time
            await asyncio.sleep(0.02)


async def gone(*pids: int) -> None:
    """Waits until these processes are no more."""
    try:
        async with asyncio.timeout(HANG):
            for pid in pids:
                while lives(pid):  # noqa: ASYNC110 - they are no children of ours
                    await asyncio.sleep(0.02)
    except TimeoutError:
        raise AssertionError(f"of {pids} still live {[pid for pid in pids if lives(pid)]}") from None


def lives(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
