"""Members of a simulated fleet with certificates that lie about terms, and candidates that die before they lead."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from decimal import Decimal
from typing import Final

from zscout.keyexpr import RANDOM, Role, Token, new_instance
from zscout.mesh import IncomingQuery, Mesh, Refused
from zscout.messages import MAX_COUNTER, Ask, ClientRequests, Notice, OpenRequest, RcAsk, RcState
from zscout.types import Place, Term

LIES: Final = ("client", "rc", "promised")
LIED_EVERY: Final = 0.25
RC: Final = "gripper/liar"
NEEDS: Final[dict[str, dict[str, Decimal]]] = {"robot/a": {}}


async def lie(kind: str, mesh: Mesh, highest: Callable[[], int], jump: int) -> None:
    """Claim terms up to `jump` above the fleet's for as long as this process lives."""

    def term() -> Term:
        return Term(min(highest() + jump, MAX_COUNTER), new_instance())

    await {"client": _as_client, "rc": _as_rc, "promised": _as_candidate}[kind](mesh, term)


async def _as_client(mesh: Mesh, term: Callable[[], Term]) -> None:
    """Refuses each promise, lists a place of a future term, and asks in one."""
    me = str(mesh.me)

    def answer(query: IncomingQuery[RcAsk]) -> None:
        if not query.message.ordinary:
            raise Refused("old_term", "no", term())
        place = Place(term(), 1)
        listed = OpenRequest("lie", "lie", NEEDS, 9, Decimal(60), place=place, seal="0" * 32)
        query.answer(ClientRequests(me, [listed], RANDOM.get().choice((term(), query.message.promise or term()))))

    declared = [
        mesh.serve(mesh.keys.requests(mesh.me), RcAsk, answer),
        mesh.alive(Token(mesh.me.host, Role.CLIENT, mesh.me.client, new_instance())),
    ]
    while declared:
        ask = Ask("lie", "lie", NEEDS, 9, Decimal(60), place=Place(term(), 1), seal="0" * 32, term=term())
        await mesh.ask_one(mesh.keys.schedule(mesh.me), ask, Notice, timeout=LIED_EVERY)
        await asyncio.sleep(LIED_EVERY)


async def _as_rc(mesh: Mesh, term: Callable[[], Term]) -> None:
    """Obeys terms without a leader."""
    instance, host, honest = new_instance(), mesh.me.host, RANDOM.get().random() < 0.5

    def state(promise: Term | None = None) -> RcState:
        return RcState(RC, host, instance, False, promise if honest and promise is not None else term())

    declared = [
        mesh.serve(mesh.keys.rc_state(RC), RcAsk, lambda query: query.answer(state(query.message.promise))),
        mesh.alive(Token(host, Role.RC, RC, instance)),
    ]
    while declared:
        mesh.put(mesh.keys.rc_state(RC), state())
        await asyncio.sleep(LIED_EVERY)


async def _as_candidate(mesh: Mesh, term: Callable[[], Term]) -> None:
    """Asks RCs, clients or both for promises, and then disappears."""
    ask, keys = RcAsk(promise=term(), ordinary=True), mesh.keys
    rcs = mesh.ask(keys.rc_state_any, ask, RcState, timeout=LIED_EVERY)
    clients = mesh.ask(keys.requests_any, ask, ClientRequests, timeout=LIED_EVERY)
    asked = RANDOM.get().choice(((rcs,), (clients,), (rcs, clients)))
    for answers in {rcs, clients} - {*asked}:
        answers.close()
    await asyncio.gather(*asked)
    await asyncio.Event().wait()
