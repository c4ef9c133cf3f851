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
    from zscout.behaviors.arc import Held, Revoked, hold, holds
    from zscout.behaviors.blocking import Lab, connect
    from zscout.behaviors.client import Client, CommandRefused, RequestRefused
    from zscout.components.component import Component, Stage

_HOME = {
    "Client": "zscout.behaviors.client",
    "CommandRefused": "zscout.behaviors.client",
    "Component": "zscout.components.component",
    "Held": "zscout.behaviors.arc",
    "Lab": "zscout.behaviors.blocking",
    "RequestRefused": "zscout.behaviors.client",
    "Revoked": "zscout.behaviors.arc",
    "Stage": "zscout.components.component",
    "connect": "zscout.behaviors.blocking",
    "hold": "zscout.behaviors.arc",
    "holds": "zscout.behaviors.arc",
}

__all__ = [
    "Client",
    "CommandRefused",
    "Component",
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
