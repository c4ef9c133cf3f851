"""A Zenoh session as asyncio sees it: typed queries, queryables, publications, liveliness.

Everything that arrives on Zenoh's threads goes through one bounded inbox into the event loop, in the order
in which it came; handlers are plain functions that run there and must not block. A query that finds its
queue full is answered "busy"; a publication that does is counted as missed, and its subscriber is told.

Declare once per purpose, never per request: Zenoh keeps memory for every key that was ever declared.
"""

from __future__ import annotations

import os

# Zenoh reads this once, when it is loaded. With few receiving threads one cut-off host stalls every link.
os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(rx:(worker_threads:16),net:(worker_threads:4),acc:(worker_threads:4),tx:(worker_threads:4),"
    "app:(worker_threads:2))",
)

from zscout.mesh.declared import Declared, Overheard, Publisher
from zscout.mesh.exchange import Refused, Reply, Request
from zscout.mesh.frames import Frame, FramePublisher, FrameWatch
from zscout.mesh.session import Mesh, MeshError
from zscout.mesh.settings import zenoh_config

__all__ = [
    "Declared",
    "Frame",
    "FramePublisher",
    "FrameWatch",
    "Mesh",
    "MeshError",
    "Overheard",
    "Publisher",
    "Refused",
    "Reply",
    "Request",
    "zenoh_config",
]
