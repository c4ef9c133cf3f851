"""zscout: a program gets all the devices that it requests, or none, over a Zenoh mesh.

    import zscout
    with zscout.connect() as lab, lab.hold("survey", {"robot/scout33": {}}) as held:
        ...

With asyncio, use `zscout.Client`, `zscout.hold` and `zscout.holds`. Nodes start and move a `zscout.Component`.
Each name is imported at its first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from zscout.streams import open_standard_streams
from zscout.types import VERSION

__version__ = VERSION

# In each of zscout's programs, before it opens any file.
open_standard_streams()

if TYPE_CHECKING:
    from zscout.behaviors.client.arc import Held, Revoked, hold, holds
    from zscout.behaviors.client.blocking import BlockingHeld, Lab, connect
    from zscout.behaviors.client.bookings import BookingsClient
    from zscout.behaviors.client.client import Client, CommandRefused, NoRcm, RequestRefused
    from zscout.behaviors.client.hold_notices import HoldNotice
    from zscout.behaviors.client.lab_status import LabStatus
    from zscout.behaviors.client.request import OpenArc
    from zscout.behaviors.components.component import Component, ComponentContext, Stage
    from zscout.config.fleet import Fleet, load_fleet
    from zscout.config.strict import BadInput
    from zscout.mesh import MeshError
    from zscout.mesh.frames import Frame

_NAMES = {
    "zscout.behaviors.client.arc": "Held Revoked hold holds",
    "zscout.behaviors.client.blocking": "BlockingHeld Lab connect",
    "zscout.behaviors.client.bookings": "BookingsClient",
    "zscout.behaviors.client.client": "Client CommandRefused NoRcm RequestRefused",
    "zscout.behaviors.client.hold_notices": "HoldNotice",
    "zscout.behaviors.client.lab_status": "LabStatus",
    "zscout.behaviors.client.request": "OpenArc",
    "zscout.behaviors.components.component": "Component ComponentContext Stage",
    "zscout.config.fleet": "Fleet load_fleet",
    "zscout.config.strict": "BadInput",
    "zscout.mesh": "MeshError",
    "zscout.mesh.frames": "Frame",
}
_HOME = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = [
    "BadInput", "BlockingHeld", "BookingsClient", "Client", "CommandRefused", "Component", "ComponentContext",
    "Fleet", "Frame", "Held", "HoldNotice", "Lab", "LabStatus", "MeshError", "NoRcm", "OpenArc", "RequestRefused",
    "Revoked", "Stage", "__version__", "connect", "hold", "holds", "load_fleet",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
