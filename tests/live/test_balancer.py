"""The load balancer on a real mesh: ranks whom it hears, and nobody else."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from tests.hang import HANG
from tests.live.lab import Lab, answered, awaited
from zscout.behaviors.client.client import Client
from zscout.keyexpr import Role
from zscout.messages import HostRanking, RankAsk

pytestmark = [pytest.mark.live, pytest.mark.slow]

HOSTS = {"h1", "h2", "h3"}


async def ranked(client: Client, asked: RankAsk, hosts: set[str]) -> HostRanking:
    """The answer, once it names exactly these hosts."""
    mesh = client.mesh
    return await awaited(
        lambda: answered(lambda: mesh.ask_one(mesh.keys.rank, asked, HostRanking, timeout=HANG)),
        lambda ranking: {one.host for one in ranking.hosts} == hosts,
    )


async def test_the_balancer_ranks_whom_it_hears(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=["h1", "h2"]) as lab:
        for host in sorted(HOSTS):
            lab.node(host, f"robot/{host}")
        client = await lab.client()
        await lab.ready(client, *(f"robot/{host}" for host in HOSTS))

        best = await ranked(client, RankAsk(), HOSTS)
        assert best.metric == "composite"
        assert all(one.reason.startswith("would run at ") for one in best.hosts)
        assert [one.score for one in best.hosts] == sorted((one.score for one in best.hosts), reverse=True)
        assert not best.left_out

        some = await ranked(client, RankAsk(hosts=["h2", "h9"], metric="available_memory"), {"h2"})
        assert some.left_out == {"h9": "no report of it"}
        none = await ranked(client, RankAsk(labels=["gpu"]), set())
        assert set(none.left_out.values()) == {"it has no label gpu"}
        reply = await client.mesh.ask_one(client.mesh.keys.rank, RankAsk(at_most=1), HostRanking, timeout=HANG)
        assert reply is not None
        assert reply.message is not None
        assert (len(reply.message.hosts), reply.message.more) == (1, 2)

        # A host that dies is named no more; a new leader's balancer knows the others from their reports.
        await lab.candidates(client, "h2")
        lab.signal("h1", signal.SIGKILL)
        await lab.living(client, Role.RCM, lambda hosts: hosts == ["h2"])
        await ranked(client, RankAsk(), {"h2", "h3"})
