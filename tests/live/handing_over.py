"""For tests of hand-overs: what a client has, and how all of it goes to another one."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from tests.hang import HANG
from tests.live.bench import until
from zscout.behaviors.client import handover
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.keyexpr import Sender
from zscout.messages import RcmState
from zscout.types import Grant

NEEDS: dict[str, dict[str, dict[str, int]]] = {
    "drive": {"robot/x": {}},
    "talk": {"radio/f": {"rate": 2}},
    "later": {"robot/x": {}},
}
"""By name of the ARC: two that run, and one that waits for the first."""


def me(client: Client) -> Sender:
    return client.mesh.me


async def settle_down(old: Client, new: Client, names: Sequence[str]) -> dict[str, OpenArc]:
    """Moves all of `old` to `new`, which asks for it by `names`."""
    old.internals.pause()
    new.internals.expect(old.internals.open_requests())
    await old.internals.hand_over_all(me(new))
    return await claimed(new, names)


async def claimed(client: Client, names: Sequence[str]) -> dict[str, OpenArc]:
    arcs = {name: await client.request(name, NEEDS[name], min_runtime=600) for name in names}
    # A vote may come later than the answer.
    await until(lambda: all(arc.state == "running" for name, arc in arcs.items() if name != "later"))
    return arcs


def patiently(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nobody dies, all comes: it is waited for until then, however long a process does not run."""
    for name in ("HAND_OVER", "EXPECT_TIMEOUT", "TOKEN_GRACE", "CLAIM_TIMEOUT"):
        monkeypatch.setattr(handover, name, HANG)


def holding(state: RcmState) -> dict[str, tuple[str, Grant]]:
    return {view.arc: (view.client, view.grant) for view in state.holds}
