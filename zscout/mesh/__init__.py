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

from zscout.mesh.declared import Declaration as Declaration
from zscout.mesh.declared import Publisher as Publisher
from zscout.mesh.exchange import IncomingQuery as IncomingQuery
from zscout.mesh.exchange import Refused as Refused
from zscout.mesh.exchange import Reply as Reply
from zscout.mesh.frames import FrameWatch as FrameWatch
from zscout.mesh.protocol import Mesh as Mesh
from zscout.mesh.protocol import MeshError as MeshError
from zscout.mesh.settings import zenoh_config as zenoh_config
from zscout.mesh.supervision import Supervisor as Supervisor
from zscout.mesh.zenoh_mesh import ZenohMesh as ZenohMesh
