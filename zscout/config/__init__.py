"""What people configure: the fleet file, shared by all hosts, and the node file of one host.

Both files and all keys but an RC's name and driver are optional. What is wrong in them ends in one `BadInput`
line that names file, key and remedy. Durations are whole ns (`Ns`), but seconds as float where Zenoh is told
them (`Mesh`).
"""

from zscout.config.devices import Device, Driver, Framegrabber, Radio, Robot, Video
from zscout.config.fleet import (
    DEFAULT_FLEET_NAME,
    FLEET_VARIABLE,
    Fleet,
    Limits,
    Mesh,
    Timing,
    default_fleet,
    fleet_from_env,
    load_fleet,
)
from zscout.config.node import (
    MAX_KINDS,
    Components,
    Node,
    RcSpec,
    Recorder,
    default_node,
    load_node,
)

__all__ = [
    "DEFAULT_FLEET_NAME",
    "FLEET_VARIABLE",
    "MAX_KINDS",
    "Components",
    "Device",
    "Driver",
    "Fleet",
    "Framegrabber",
    "Limits",
    "Mesh",
    "Node",
    "Radio",
    "RcSpec",
    "Recorder",
    "Robot",
    "Timing",
    "Video",
    "default_fleet",
    "default_node",
    "fleet_from_env",
    "load_fleet",
    "load_node",
]
