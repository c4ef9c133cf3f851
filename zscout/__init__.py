"""zscout: all the devices a program asked for, or none, over a Zenoh mesh.

    import zscout
    with zscout.connect() as lab, lab.hold("survey", {"robot/scout33": {}}) as held:
        ...

For asyncio see `zscout.Client`, `zscout.hold` and `zscout.holds`; for what nodes can start and move,
`zscout.Component`. Everything is imported when it is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from zscout.types import VERSION

__version__ = VERSION

if TYPE_CHECKING:
    from zscout.behaviors.client.arc import Held, Revoked, hold, holds
    from zscout.behaviors.client.blocking import BlockingHeld, Lab, connect
    from zscout.behaviors.client.bookings import BookingsClient
    from zscout.behaviors.client.client import Client, CommandRefused, NoRcm, RequestRefused
    from zscout.behaviors.components.component import Component, ComponentContext, Stage
    from zscout.config.fleet import Fleet, load_fleet
    from zscout.config.strict import BadInput
    from zscout.mesh import MeshError

_HOME = {
    "BadInput": "zscout.config.strict",
    "BlockingHeld": "zscout.behaviors.client.blocking",
    "BookingsClient": "zscout.behaviors.client.bookings",
    "Client": "zscout.behaviors.client.client",
    "CommandRefused": "zscout.behaviors.client.client",
    "Component": "zscout.behaviors.components.component",
    "ComponentContext": "zscout.behaviors.components.component",
    "Fleet": "zscout.config.fleet",
    "Held": "zscout.behaviors.client.arc",
    "Lab": "zscout.behaviors.client.blocking",
    "MeshError": "zscout.mesh",
    "NoRcm": "zscout.behaviors.client.client",
    "RequestRefused": "zscout.behaviors.client.client",
    "Revoked": "zscout.behaviors.client.arc",
    "Stage": "zscout.behaviors.components.component",
    "connect": "zscout.behaviors.client.blocking",
    "hold": "zscout.behaviors.client.arc",
    "holds": "zscout.behaviors.client.arc",
    "load_fleet": "zscout.config.fleet",
}

__all__ = [
    "BadInput",
    "BlockingHeld",
    "BookingsClient",
    "Client",
    "CommandRefused",
    "Component",
    "ComponentContext",
    "Fleet",
    "Held",
    "Lab",
    "MeshError",
    "NoRcm",
    "RequestRefused",
    "Revoked",
    "Stage",
    "__version__",
    "connect",
    "hold",
    "holds",
    "load_fleet",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
