"""The node file: what one host does in its fleet."""

from __future__ import annotations

import socket
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from msgspec import Meta, Struct, structs

from zscout.config.access import AccessPolicy
from zscout.config.devices import RcConfig, read_rc
from zscout.config.fleet import (
    Endpoints,
    Fleet,
    SecurityTable,
    Sites,
    check_links,
    check_security,
    check_sites,
    default_fleet,
    ip_of,
    keys_folder,
    load_fleet,
)
from zscout.config.notify import NotifyConfig, NotifyTable, read_notify
from zscout.config.packages import check_installed
from zscout.config.strict import (
    Where,
    check_folder_name,
    check_name,
    check_names,
    check_unique,
    key,
    quoted,
    read_toml,
    seconds,
)
from zscout.keyexpr import MACHINES, valid_name
from zscout.messages import MAX_LABELS
from zscout.types import SECOND, Ns

MAX_RCS: Final = 1_000
"""RCs in one node file."""
MAX_KINDS: Final = 256
"""Kinds of components that a node may be limited to, and that it lists."""
MAX_STARTED: Final = 256
"""Components of one node that run at one time; a load report holds no more."""
FRAMES: Final = 2.0
"""Pictures a second that a recorder shows of each camera, by default."""

STATE: Final = 'state = "/var/lib/zscout"'
PAST: Final = 24 * 3_600 * SECOND
"""Of the time before a recording, asked of the journals, by default."""
MAX_PAST: Final = 31 * 86_400
"""Seconds."""
RECORDED: Final = 5_000
"""Megabytes of recordings that are kept, by default."""

LoadKind = bool | Literal["tree"]


class RecorderConfig(Struct, frozen=True):
    """The recorder: the files it writes and where its live view is served."""

    path: Path
    """The folder of recordings; relative ones in a file are relative to that file."""
    bind: str
    """IP address; loopback unless the file allowed others."""
    port: int
    frames: float = FRAMES
    """Frames a second shown of each camera; 0: none."""
    limit: int = RECORDED
    """Megabytes (10^6 bytes) of this fleet's recordings that are kept."""
    past: Ns = PAST
    """Of the time before a recording, asked of the journals; 0: none."""


class MetricsConfig(Struct, frozen=True):
    """Where the node's figures are served."""

    bind: str
    """IP address; loopback unless the file allowed others."""
    port: int


class CalendarConfig(Struct, frozen=True):
    """Where the fleet's bookings are served as calendars."""

    bind: str
    """IP address; loopback unless the file allowed others."""
    port: int


class ComponentsConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [components]: what a node starts for others."""

    allow: Annotated[bool, key("Whether it starts components at all.")] = True
    kinds: Annotated[
        Annotated[tuple[str, ...], Meta(max_length=MAX_KINDS)] | None,
        key("Only these kinds (entry points); without it all that are installed.", example=["counter"]),
    ] = None
    max: Annotated[int, key("Components that run at one time.", 1, MAX_STARTED)] = 64


class JournalConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [journal]: what a candidate keeps of the holds that are over, in the folder `state`."""

    off: Annotated[bool, key("Whether it keeps none.")] = False
    max_age: Annotated[Ns, seconds("3600", "315360000", "Holds that ended longer ago are forgotten.")] = (
        90 * 86_400 * SECOND
    )
    max_size: Annotated[int, key("Of the file; what ended longest ago goes first.", 1, 10_000, unit="MB")] = 64


class Node(Struct, frozen=True):
    """What one host does in its fleet."""

    host: str
    fleet: Fleet
    """With this host's own `listen`, `connect` and `interface` in its `mesh`."""
    candidate: bool
    load: LoadKind
    rcs: tuple[RcConfig, ...]
    recorder: RecorderConfig | None
    """None: this node does not record."""
    labels: tuple[str, ...] = ()
    components: ComponentsConfig = ComponentsConfig()
    metrics: MetricsConfig | None = None
    """None: it serves no figures."""
    calendar: CalendarConfig | None = None
    """None: it serves no calendars."""
    notify: NotifyConfig | None = None
    """None: it tells nobody."""
    journal: JournalConfig = JournalConfig()
    state: Path | None = None
    """The folder of what must outlive the node (`state_folder.py`); None: where such folders usually are."""


# The file as it is written


class NodeTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [node]."""

    host: Annotated[str | None, key("Name of the host; without it its hostname.", example="anvil")] = None
    fleet: Annotated[str | None, key("The fleet file, relative to this one.", example="lab.toml")] = None
    candidate: Annotated[bool, key("Whether this host may lead, if `candidates` let it.")] = True
    load: Annotated[
        LoadKind, key('Whether it reports its load; "tree": only that of this node and what it started.')
    ] = True
    labels: Annotated[tuple[str, ...], key("For components that need them.", most=MAX_LABELS, example=["gpu"])] = ()
    state: Annotated[
        str | None, key("The folder of what must outlive the node, relative to this file.", example="/var/lib/zscout")
    ] = None


class RecorderTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [recorder]. Without it the node does not record."""

    path: Annotated[str, key("The folder of recordings, relative to this file.")] = "runs"
    bind: Annotated[str, key("IP address of the live view.")] = "127.0.0.1"
    port: Annotated[int, key("TCP port of the live view.", 1, 65_535)] = 9876
    allow_remote: Annotated[bool, key("Whether `bind` may let other hosts in.")] = False
    frames: Annotated[float, key("Shown of each camera; 0: none.", 0, 30, unit="frames/s")] = FRAMES
    limit: Annotated[
        int, key("Kept of this fleet's recordings in `path`; the oldest go first.", 300, 1_000_000, unit="MB")
    ] = RECORDED
    past: Annotated[Ns, seconds("0", str(MAX_PAST), "Of before a recording, shown from journals; 0: none.")] = PAST


class MetricsTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [metrics]. With it the node serves its figures to Prometheus, over plain HTTP."""

    bind: Annotated[str, key("IP address.")] = "127.0.0.1"
    port: Annotated[int, key("TCP port.", 1, 65_535)] = 9464
    allow_remote: Annotated[bool, key("Whether `bind` may let other hosts in.")] = False


class CalendarTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [calendar]. With it the node serves the fleet's bookings as iCalendar, over plain HTTP."""

    bind: Annotated[str, key("IP address.")] = "127.0.0.1"
    port: Annotated[int, key("TCP port.", 1, 65_535)] = 9465
    allow_remote: Annotated[bool, key("Whether `bind` may let other hosts in.")] = False


class NodeMeshTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [mesh] of a node file: what this host has instead of the fleet file's."""

    listen: Annotated[Endpoints | None, key("Endpoints of this host.", example=["tcp/0.0.0.0:7447"])] = None
    connect: Annotated[Endpoints | None, key("Endpoints of other hosts.", example=["tcp/anvil:7447"])] = None
    interface: Annotated[str | None, key("Network interface for multicast.", example="eth0")] = None
    site: Annotated[str | None, key("The site of this host.", example="north")] = None
    relay: Annotated[
        Sites | None, key("Makes this node the relay between these sites.", example=["north", "south"])
    ] = None


class NodeFile(Struct, frozen=True, forbid_unknown_fields=True):
    """A node file."""

    node: NodeTable = NodeTable()
    mesh: NodeMeshTable = NodeMeshTable()
    rc: Annotated[tuple[dict[str, Any], ...], Meta(max_length=MAX_RCS)] = ()
    """Each is read by itself: which keys it may have is its driver's."""
    recorder: RecorderTable | None = None
    security: SecurityTable | None = None
    components: ComponentsConfig = ComponentsConfig()
    metrics: MetricsTable | None = None
    calendar: CalendarTable | None = None
    notify: NotifyTable | None = None
    journal: JournalConfig = JournalConfig()


def load_node(path: Path) -> Node:
    """Reads a node file, and the fleet file that it names (relative to itself). Raises BadInput."""
    file = read_toml(path, NodeFile)
    named = file.node.fleet
    fleet = load_fleet(path.parent / named, f"node.fleet in {path}") if named is not None else default_fleet()
    return _node(file, fleet, path.parent, Where(str(path)))


def default_node() -> Node:
    """The node of those who wrote no file: named by the host, without RCs, in the default fleet."""
    return _node(NodeFile(), default_fleet(), Path(), Where("defaults"))


def _node(file: NodeFile, fleet: Fleet, folder: Path, top: Where) -> Node:
    host = file.node.host if file.node.host is not None else valid_name(socket.gethostname())
    check_folder_name(host, top / "node" / "host")
    own = {name: value for name, value in structs.asdict(file.mesh).items() if value is not None}
    if file.mesh.relay and file.mesh.site is None:
        own["site"] = None  # that of the fleet file is the site of those who do not relay
    mesh = structs.replace(fleet.mesh, **own, shared=() if fleet.mesh.multicast else fleet.mesh.known_by)
    check_links(mesh.listen, mesh.connect, mesh.interface, top / "mesh")
    check_sites(mesh, top / "mesh")
    if mesh.relay and file.recorder is not None:
        raise (top / "recorder").bad("a relay can't record", "record on the node of a site")
    security = fleet.security if file.security is None else keys_folder(file.security, folder, top)
    fleet = structs.replace(fleet, mesh=mesh, security=security)
    check_security(fleet, top)
    check_names(file.node.labels, top / "node" / "labels")
    for number, kind in enumerate(file.components.kinds or ()):
        check_name(kind, (top / "components" / "kinds").item(number))
    rcs = tuple(read_rc(table, (top / "rc").item(number, table.get("name"))) for number, table in enumerate(file.rc))
    check_unique((rc.name for rc in rcs), top / "rc", "name")
    leads = file.node.candidate
    if security is not None:
        _check_roles(host, (rc.name for rc in rcs), fleet.access, top)
        leads = leads and "manager" in fleet.access.ranks_of(host)
    if file.notify is not None and not leads:
        raise (top / "notify").bad("only the leader sends notices, and this host never leads", "move it to a candidate")
    return Node(
        host=host,
        fleet=fleet,
        candidate=leads,
        load=file.node.load,
        rcs=rcs,
        recorder=None if file.recorder is None else _recorder(file.recorder, folder, top / "recorder"),
        labels=file.node.labels,
        components=file.components,
        metrics=None if file.metrics is None else _metrics(file.metrics, top / "metrics"),
        calendar=None if file.calendar is None else _calendar(file.calendar, top / "calendar"),
        notify=None if file.notify is None else read_notify(file.notify, folder, top / "notify"),
        journal=file.journal,
        state=None if file.node.state is None else _folder(file.node.state, folder, top / "node" / "state", STATE),
    )


def _check_roles(host: str, rcs: Iterable[str], access: AccessPolicy, top: Where) -> None:
    """Raises BadInput."""
    if not access.ranks_of(host) & MACHINES:
        remedy = "name it under [roles] of the fleet file, as manager or under node"
        raise (top / "node" / "host").bad(f"{quoted(host)} is not a machine of this fleet", remedy)
    for number, rc in enumerate(rcs):
        if not access.may_serve(host, rc):
            remedy = f"name it at {host} under [roles.node] of the fleet file"
            raise (top / "rc").item(number, rc).bad(f"{host} may not serve {rc}", remedy)


def _folder(text: str, folder: Path, at: Where, example: str) -> Path:
    """The folder of this name, relative to that of the file. Raises BadInput."""
    if not text or "\0" in text:
        raise at.bad(f"{quoted(text)} is not a folder", f"name one, as in {example}")
    return folder / text


def _recorder(table: RecorderTable, folder: Path, at: Where) -> RecorderConfig:
    path = _folder(table.path, folder, at / "path", 'path = "runs"')
    address = _served_at(table.bind, "the recording", at, allow_remote=table.allow_remote)
    return RecorderConfig(path, address, table.port, table.frames, table.limit, table.past)


def _metrics(table: MetricsTable, at: Where) -> MetricsConfig:
    check_installed("prometheus_client", at)
    return MetricsConfig(_served_at(table.bind, "the figures", at, allow_remote=table.allow_remote), table.port)


def _calendar(table: CalendarTable, at: Where) -> CalendarConfig:
    address = _served_at(table.bind, "the bookings", at, allow_remote=table.allow_remote)
    return CalendarConfig(address, table.port)


def _served_at(bind: str, what: str, at: Where, *, allow_remote: bool) -> str:
    """The IP address. Raises BadInput."""
    address = ip_of("127.0.0.1" if bind == "localhost" else bind)
    if address is None:
        raise (at / "bind").bad(f"{quoted(bind)} is not an IP address", 'write one, as in "127.0.0.1"')
    if not address.is_loopback and not allow_remote:
        raise (at / "bind").bad(
            f"{quoted(bind)} shows {what} to other hosts",
            'write "127.0.0.1", or add allow_remote = true if that is meant',
        )
    return str(address)
