"""The mesh for asyncio: typed queries, queryables, publications and liveliness."""

from __future__ import annotations

from zscout.mesh.exchange import Answered as Answered
from zscout.mesh.exchange import Declaration as Declaration
from zscout.mesh.exchange import IncomingQuery as IncomingQuery
from zscout.mesh.exchange import MeshError as MeshError
from zscout.mesh.exchange import Refused as Refused
from zscout.mesh.exchange import Reply as Reply
from zscout.mesh.exchange import Tally as Tally
from zscout.mesh.frames import FrameWatch as FrameWatch
from zscout.mesh.session import Lane as Lane
from zscout.mesh.session import Mesh as Mesh
from zscout.mesh.supervision import Supervisor as Supervisor
from zscout.mesh.supervision import clock as clock
from zscout.mesh.zenoh_mesh import ZenohMesh as ZenohMesh
