"""zscout itself, by the same interface: once as a program is granted, once as its RCs have confirmed."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

from benchmarks.peers.peer import LEASE, RCS, Peer, Session, Waiting, package
from tests.live.lab import Lab
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.config.fleet import load_fleet

HOLD = 60.0


class ZscoutSession(Session):
    def __init__(self, client: Client, *, confirmed: bool) -> None:
        self._client, self._confirmed = client, confirmed

    async def acquire(self, rcs: Sequence[str], waiting: Waiting | None) -> OpenArc:
        arc = await self._client.request("bench", {rc: {} for rc in rcs}, min_runtime=HOLD)
        if waiting is not None and arc.state == "queued":
            waiting()
        while arc.state != "running":
            assert arc.open, f"the ARC ended: {arc.reason}"
            await self._client.changed(arc)
        if self._confirmed:
            await self._client.granted(arc, confirmed=True)
        return arc

    async def release(self, hold: OpenArc) -> None:
        await self._client.end(hold)

    async def close(self) -> None:
        await self._client.close()


class Zscout(Peer):
    """One node leads, two have five RCs each, as in `python -m benchmarks`."""

    def __init__(self, name: str, *, confirmed: bool) -> None:
        self.name, self._confirmed = name, confirmed
        self.lacks = ""

    def version(self) -> str:
        return package("zscout")

    @asynccontextmanager
    async def serve(self, folder: Path) -> AsyncIterator[str]:
        async with Lab(folder, lease=LEASE, candidates=["lead"]) as lab:
            lab.node("lead")
            lab.node("left", *RCS[0::2])
            lab.node("right", *RCS[1::2])
            first = await lab.client("first")
            await lab.ready(first, *RCS)
            await first.close()
            lab.clients.clear()
            yield str(lab.fleet_file)

    async def connect(self, address: str, name: str) -> Session:
        client = await Client.connect(name, fleet=load_fleet(Path(address)), host="bench")
        return ZscoutSession(client, confirmed=self._confirmed)


PEERS: dict[str, Peer] = {
    "zscout": Zscout("zscout", confirmed=False),
    "confirmed": Zscout("zscout, confirmed at all RCs", confirmed=True),
}
