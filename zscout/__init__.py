"""zscout: all the devices a program asked for, or none, over a Zenoh mesh.

    import zscout
    with zscout.connect() as lab, lab.hold("survey", {"robot/scout33": {}}, min_runtime=60) as held:
        ...

For asyncio see `zscout.Client`, `zscout.hold` and `zscout.holds`; for what nodes can start and move,
`zscout.Component`. Everything is imported when it is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from zscout.behaviors.client.arc import Held, Revoked, hold, holds
    from zscout.behaviors.client.blocking import Lab, connect
    from zscout.behaviors.client.client import Client, CommandRefused, RequestRefused
    from zscout.behaviors.components.component import Component, ComponentContext, Stage

_HOME = {
    "Client": "zscout.behaviors.client.client",
    "CommandRefused": "zscout.behaviors.client.client",
    "Component": "zscout.behaviors.components.component",
    "ComponentContext": "zscout.behaviors.components.component",
    "Held": "zscout.behaviors.client.arc",
    "Lab": "zscout.behaviors.client.blocking",
    "RequestRefused": "zscout.behaviors.client.client",
    "Revoked": "zscout.behaviors.client.arc",
    "Stage": "zscout.behaviors.components.component",
    "connect": "zscout.behaviors.client.blocking",
    "hold": "zscout.behaviors.client.arc",
    "holds": "zscout.behaviors.client.arc",
}

__all__ = [
    "Client",
    "CommandRefused",
    "Component",
    "ComponentContext",
    "Held",
    "Lab",
    "RequestRefused",
    "Revoked",
    "Stage",
    "__version__",
    "connect",
    "hold",
    "holds",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOME[name]), name)
