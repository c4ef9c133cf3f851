"""Who comes to a mesh and who leaves it, in words."""

from __future__ import annotations

from zscout.keyexpr import Role, Token


def words_of(token: Token, alive: bool) -> tuple[str, str] | None:
    """What happened, and how much people should look at it (INFO or WARN); None for what is of no use."""
    level = "INFO" if alive else "WARN"
    match token.role:
        case Role.NODE:
            return f"node {token.host} {'is there' if alive else 'is gone'}", level
        case Role.RCM:
            return f"{token.host} {'leads' if alive else 'does not lead any more'}", level
        case Role.RC:
            return f"{token.name} {'is offered by' if alive else 'is gone from'} {token.host}", level
        case Role.CLIENT:
            return f"client {token.host}/{token.name} {'joined' if alive else 'left'}", "INFO"
        case _:
            return None
