"""The node file: what one host does in its fleet."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Final, Literal

from msgspec import Meta, Struct, structs

from zscout.config.devices import Device, DeviceTable, Driver, check_keys, device
from zscout.config.fleet import Endpoints, Fleet, default_fleet, load_fleet
from zscout.endpoints import check_links, ip_of
from zscout.keyexpr import valid_name
from zscout.messages import MAX_LABELS
from zscout.scheduling.model import Ns
from zscout.strict import (
    BadInput,
    Where,
    amounts,
    check_name,
    check_rc_name,
    check_unique,
    quoted,
    read_toml,
    seconds_to_ns,
)

MAX_RCS: Final = 1_000
"""RCs in one node file."""
MAX_PARAMETERS: Final = 64
"""Capacities of one RC."""
MAX_KINDS: Final = 256
"""Kinds of components that a node may be limited to, and that it tells of."""
MAX_STARTED: Final = 256
"""Components of one node that run at one time; a load report holds no more."""
FRAMES: Final = 2.0
"""Pictures a second that a recorder shows of each camera, unless told otherwise."""

LoadKind = bool | Literal["tree"]


class RcSpec(Struct, frozen=True):
    """An RC that the node runs."""

    name: str
    """`kind/name`."""
    driver: Driver
    capacity: Mapping[str, Fraction]
    """Of a `capacity` driver: the greatest sum of each bandwidth parameter; empty for others."""
    activation: Ns
    """From a grant until the device can be used, in ns (a camera warms up)."""
    device: Device | None = None
    """What the drivers of devices are told; None for `exclusive` and `capacity`."""


class Recorder(Struct, frozen=True):
    """The recorder: the files it writes and where its live view is served."""

    path: Path
    """The folder of recordings; relative ones in a file are relative to that file."""
    bind: str
    """IP address; loopback unless the file allowed others."""
    port: int
    frames: float = FRAMES
    """Pictures a second shown of each camera; 0: none."""


class Components(Struct, frozen=True, forbid_unknown_fields=True):
    """What of other hosts' asking a node starts."""

    allow: bool = True
    """Whether it starts components at all."""
    kinds: Annotated[tuple[str, ...], Meta(max_length=MAX_KINDS)] | None = None
    """Only these entry points; None: all that are installed."""
    max: Annotated[int, Meta(ge=1, le=MAX_STARTED)] = 64
    """That run at one time."""


class Node(Struct, frozen=True):
    """What one host does in its fleet."""

    host: str
    fleet: Fleet
    """With this host's own `listen`, `connect` and `interface` in its `mesh`."""
    candidate: bool
    """Whether this host may lead, if the fleet's `candidates` let it."""
    load: LoadKind
    """Whether the host reports its load; "tree": only that of this node and what it started, as if the host
    had no other programs (several nodes on one machine)."""
    rcs: tuple[RcSpec, ...]
    recorder: Recorder | None
    """None: this node does not record."""
    labels: tuple[str, ...] = ()
    """What the host is or has, for components that need it."""
    components: Components = Components()


# The file as it is written


class _NodeTable(Struct, frozen=True, forbid_unknown_fields=True):
    host: str | None = None
    fleet: str | None = None
    candidate: bool = True
    load: LoadKind = True
    labels: Annotated[tuple[str, ...], Meta(max_length=MAX_LABELS)] = ()


class _RcTable(DeviceTable, frozen=True, forbid_unknown_fields=True, kw_only=True):
    name: str
    driver: Driver
    capacity: Annotated[dict[str, Decimal], Meta(max_length=MAX_PARAMETERS)] | None = None
    activation: Decimal | None = None


class _RecorderTable(Struct, frozen=True, forbid_unknown_fields=True):
    path: str = "runs"
    bind: str = "127.0.0.1"
    port: Annotated[int, Meta(ge=1, le=65_535)] = 9876
    allow_remote: bool = False
    frames: Annotated[float, Meta(ge=0, le=30)] = FRAMES


class _NodeMeshTable(Struct, frozen=True, forbid_unknown_fields=True):
    listen: Endpoints | None = None
    connect: Endpoints | None = None
    interface: str | None = None


class _NodeFile(Struct, frozen=True, forbid_unknown_fields=True):
    node: _NodeTable = _NodeTable()
    mesh: _NodeMeshTable = _NodeMeshTable()
    rc: Annotated[tuple[_RcTable, ...], Meta(max_length=MAX_RCS)] = ()
    recorder: _RecorderTable | None = None
    components: Components = Components()


def load_node(path: Path) -> Node:
    """Reads a node file, and the fleet file that it names (relative to itself). Raises BadInput."""
    file = read_toml(path, _NodeFile)
    fleet = default_fleet()
    if file.node.fleet is not None:
        try:
            fleet = load_fleet(path.parent / file.node.fleet)
        except BadInput as error:
            raise BadInput(f"{error} (named by node.fleet in {path})") from None
    return _node(file, fleet, path.parent, Where(str(path)))


def default_node() -> Node:
    """The node of those who wrote no file: named by the host, without RCs, in the default fleet."""
    return _node(_NodeFile(), default_fleet(), Path(), Where("defaults"))


def _node(file: _NodeFile, fleet: Fleet, folder: Path, top: Where) -> Node:
    host = file.node.host if file.node.host is not None else valid_name(socket.gethostname())
    check_name(host, top / "node" / "host")
    own = {key: value for key, value in structs.asdict(file.mesh).items() if value is not None}
    mesh = structs.replace(fleet.mesh, **own)
    check_links(mesh.listen, mesh.connect, mesh.interface, top / "mesh")
    for number, label in enumerate(file.node.labels):
        check_name(label, (top / "node" / "labels").item(number))
    check_unique(file.node.labels, top / "node" / "labels")
    for number, kind in enumerate(file.components.kinds or ()):
        check_name(kind, (top / "components" / "kinds").item(number))
    check_unique((rc.name for rc in file.rc), top / "rc", "name")
    return Node(
        host=host,
        fleet=structs.replace(fleet, mesh=mesh),
        candidate=file.node.candidate,
        load=file.node.load,
        rcs=tuple(_rc(rc, (top / "rc").item(number, rc.name)) for number, rc in enumerate(file.rc)),
        recorder=None if file.recorder is None else _recorder(file.recorder, folder, top / "recorder"),
        labels=file.node.labels,
        components=file.components,
    )


def _rc(table: _RcTable, at: Where) -> RcSpec:
    check_rc_name(table.name, at / "name")
    capacity = table.capacity or {}
    check_keys(structs.asdict(table), table.driver, at)
    if table.driver == "capacity" and not capacity:
        raise (at / "capacity").bad("is missing or empty", "add one, as in capacity = { command_rate = 10 }")
    for parameter in capacity:
        check_name(parameter, at / "capacity")
    hour = Decimal(3600)
    return RcSpec(
        name=table.name,
        driver=table.driver,
        capacity=amounts(capacity, at / "capacity"),
        activation=seconds_to_ns(table.activation or Decimal(0), at / "activation", high=hour),
        device=device(table, table.name, table.driver, at),
    )


def _recorder(table: _RecorderTable, folder: Path, at: Where) -> Recorder:
    if not table.path or "\0" in table.path:
        raise (at / "path").bad(f"{quoted(table.path)} is no folder", 'name one, as in path = "runs"')
    address = ip_of("127.0.0.1" if table.bind == "localhost" else table.bind)
    if address is None:
        raise (at / "bind").bad(f"{quoted(table.bind)} is not an IP address", 'write one, as in "127.0.0.1"')
    if not address.is_loopback and not table.allow_remote:
        raise (at / "bind").bad(
            f"{quoted(table.bind)} shows the recording to other hosts",
            'write "127.0.0.1", or add allow_remote = true if that is meant',
        )
    return Recorder(folder / table.path, str(address), table.port, table.frames)
