"""Which terms others have promised, for who knows too little to believe one of the last (`messages.LAST_TERMS`)."""

from __future__ import annotations

import asyncio

from zscout.keyexpr import BadName, Role, Token, client_of
from zscout.mesh.session import Mesh
from zscout.messages import ClientRequests, RcAsk, RcmState, RcState, StateAsk
from zscout.types import NO_TERM, Term


async def promised_elsewhere(mesh: Mesh, *, timeout: float) -> Term:
    """The highest term that RCs and clients have promised, or an RCM leads in, of those whose tokens are seen."""
    keys = mesh.keys
    tokens, rcs, clients, leaders = await asyncio.gather(
        mesh.living(keys.alive_any(), timeout=timeout),
        mesh.ask(keys.rc_state_any, RcAsk(), RcState, timeout=timeout),
        mesh.ask(keys.requests_any, RcAsk(), ClientRequests, timeout=timeout),
        mesh.ask(keys.rcm_state, StateAsk(holds_only=True), RcmState, timeout=timeout),
    )
    seen = {_key_of(mesh, token) for token in tokens}
    said = [(reply.key, reply.message.term) for reply in rcs if reply.message is not None]
    said += [(reply.key, reply.message.term) for reply in clients if reply.message is not None]
    terms = [term for key, term in said if key in seen]
    leading = {token.instance for token in tokens if token.role == Role.RCM}
    terms += [
        reply.message.term for reply in leaders if reply.message is not None and reply.message.term.rcm in leading
    ]
    return max(terms, default=NO_TERM)


def _key_of(mesh: Mesh, token: Token) -> str | None:
    """Where who has this token answers for itself."""
    try:
        if token.role == Role.RC:
            return mesh.keys.rc_state(token.name)
        if token.role == Role.CLIENT:
            return mesh.keys.requests(client_of(f"{token.host}/{token.name}"))
    except BadName:
        pass
    return None
