"""The node file: the settings of one host."""

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
"""Kinds of components in the list of allowed kinds, and in the list that a node reports."""
MAX_STARTED: Final = 256
"""Running components of one node; a load report holds no more."""
FRAMES: Final = 2.0
"""Default frames per second that a recorder shows of each camera."""

STATE: Final = 'state = "/var/lib/zscout"'
PAST: Final = 24 * 3_600 * SECOND
"""Default time before a recording that it shows from the journals."""
MAX_PAST: Final = 31 * 86_400
"""Seconds."""
RECORDED: Final = 5_000
"""Default megabytes of recordings to keep."""

LoadKind = bool | Literal["tree"]


class RecorderConfig(Struct, frozen=True):
    """The recorder: the files it writes and where its live view is served."""

    path: Path
    """The folder of recordings."""
    bind: str
    """IP address; loopback unless the file allowed others."""
    port: int
    frames: float = FRAMES
    """Frames per second shown of each camera; 0: none."""
    limit: int = RECORDED
    """Megabytes (10^6 bytes) of this fleet's recordings to keep."""
    past: Ns = PAST
    """Time before a recording that it shows from the journals; 0: none."""


class MetricsConfig(Struct, frozen=True):
    """Address of the node's metrics server."""

    bind: str
    """IP address; loopback unless the file allowed others."""
    port: int


class CalendarConfig(Struct, frozen=True):
    """Address of the node's calendar server."""

    bind: str
    """IP address; loopback unless the file allowed others."""
    port: int


class ComponentsConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [components]: limits of the components that a node starts."""

    allow: Annotated[bool, key("Start components.")] = True
    kinds: Annotated[
        Annotated[tuple[str, ...], Meta(max_length=MAX_KINDS)] | None,
        key("Start only these kinds (entry points). Default: all installed kinds.", example=["counter"]),
    ] = None
    max: Annotated[int, key("Greatest number of running components.", 1, MAX_STARTED)] = 64


class JournalConfig(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [journal]: a candidate's record of ended holds, in the folder `state`."""

    off: Annotated[bool, key("Keep no journal.")] = False
    max_age: Annotated[Ns, seconds("3600", "315360000", "Forget holds that ended longer ago.")] = 90 * 86_400 * SECOND
    max_size: Annotated[int, key("Size of the file; the oldest holds are removed first.", 1, 10_000, unit="MB")] = 64


class Node(Struct, frozen=True):
    """The settings of one host in its fleet."""

    host: str
    fleet: Fleet
    """With this host's own `listen`, `connect` and `interface` in its `mesh`."""
    candidate: bool
    load: LoadKind
    rcs: tuple[RcConfig, ...]
    recorder: RecorderConfig | None
    """None: it does not record."""
    labels: tuple[str, ...] = ()
    components: ComponentsConfig = ComponentsConfig()
    metrics: MetricsConfig | None = None
    """None: it serves no metrics."""
    calendar: CalendarConfig | None = None
    """None: it serves no calendars."""
    notify: NotifyConfig | None = None
    """None: it sends no notifications."""
    journal: JournalConfig = JournalConfig()
    state: Path | None = None
    """Folder for files that outlive the node (`state_folder.py`); None: the user's default."""


class NodeTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [node]."""

    host: Annotated[str | None, key("Name of the host. Default: its hostname.", example="anvil")] = None
    fleet: Annotated[str | None, key("The fleet file, relative to this file.", example="lab.toml")] = None
    candidate: Annotated[bool, key("This host may lead, if `candidates` of the fleet file allow it.")] = True
    load: Annotated[
        LoadKind, key('Report the load of this host; "tree": only of this node and the processes it started.')
    ] = True
    labels: Annotated[
        tuple[str, ...], key("Labels that components may require.", most=MAX_LABELS, example=["gpu"])
    ] = ()
    state: Annotated[
        str | None, key("Folder for files that outlive the node, relative to this file.", example="/var/lib/zscout")
    ] = None


class RecorderTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [recorder]. Without it the node does not record."""

    path: Annotated[str, key("The folder of recordings, relative to this file.")] = "runs"
    bind: Annotated[str, key("IP address of the live view.")] = "127.0.0.1"
    port: Annotated[int, key("TCP port of the live view.", 1, 65_535)] = 9876
    allow_remote: Annotated[bool, key("Allow a `bind` that other hosts can reach.")] = False
    frames: Annotated[float, key("Frames shown of each camera; 0: none.", 0, 30, unit="frames/s")] = FRAMES
    limit: Annotated[
        int, key("Size of this fleet's recordings in `path`; the oldest are removed first.", 300, 1_000_000, unit="MB")
    ] = RECORDED
    past: Annotated[Ns, seconds("0", str(MAX_PAST), "Time before a recording, shown from journals; 0: none.")] = PAST


class MetricsTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [metrics]. With it the node serves metrics to Prometheus, over plain HTTP."""

    bind: Annotated[str, key("IP address.")] = "127.0.0.1"
    port: Annotated[int, key("TCP port.", 1, 65_535)] = 9464
    allow_remote: Annotated[bool, key("Allow a `bind` that other hosts can reach.")] = False


class CalendarTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [calendar]. With it the node serves the fleet's bookings as iCalendar, over plain HTTP."""

    bind: Annotated[str, key("IP address.")] = "127.0.0.1"
    port: Annotated[int, key("TCP port.", 1, 65_535)] = 9465
    allow_remote: Annotated[bool, key("Allow a `bind` that other hosts can reach.")] = False


class NodeMeshTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [mesh] of a node file: it overrides the fleet file for this host."""

    listen: Annotated[Endpoints | None, key("Endpoints of this host.", example=["tcp/0.0.0.0:7447"])] = None
    connect: Annotated[Endpoints | None, key("Endpoints of other hosts.", example=["tcp/anvil:7447"])] = None
    interface: Annotated[str | None, key("Network interface for multicast.", example="eth0")] = None
    site: Annotated[str | None, key("The site of this host.", example="north")] = None
    relay: Annotated[Sites | None, key("Make this node the relay between these sites.", example=["north", "south"])] = (
        None
    )


class NodeFile(Struct, frozen=True, forbid_unknown_fields=True):
    """A node file."""

    node: NodeTable = NodeTable()
    mesh: NodeMeshTable = NodeMeshTable()
    rc: Annotated[tuple[dict[str, Any], ...], Meta(max_length=MAX_RCS)] = ()
    """Read one by one, since the allowed keys depend on the driver."""
    recorder: RecorderTable | None = None
    security: SecurityTable | None = None
    components: ComponentsConfig = ComponentsConfig()
    metrics: MetricsTable | None = None
    calendar: CalendarTable | None = None
    notify: NotifyTable | None = None
    journal: JournalConfig = JournalConfig()


def load_node(path: Path) -> Node:
    """Read a node file, and the fleet file that it names (relative to the node file). Raises BadInput."""
    file = read_toml(path, NodeFile)
    named = file.node.fleet
    fleet = load_fleet(path.parent / named, f"node.fleet in {path}") if named is not None else default_fleet()
    return _node(file, fleet, path.parent, Where(str(path)))


def default_node() -> Node:
    """The node without a file: named by the hostname, without RCs, in the default fleet."""
    return _node(NodeFile(), default_fleet(), Path(), Where("defaults"))


def _node(file: NodeFile, fleet: Fleet, folder: Path, top: Where) -> Node:
    host = file.node.host if file.node.host is not None else valid_name(socket.gethostname())
    check_folder_name(host, top / "node" / "host")
    own = {name: value for name, value in structs.asdict(file.mesh).items() if value is not None}
    if file.mesh.relay and file.mesh.site is None:
        own["site"] = None  # the fleet file's site is for hosts that do not relay
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
    """Raises BadInput if the roles do not allow this host or its RCs."""
    if not access.ranks_of(host) & MACHINES:
        remedy = "name it under [roles] of the fleet file, as manager or under node"
        raise (top / "node" / "host").bad(f"{quoted(host)} is neither a manager nor a node of this fleet", remedy)
    for number, rc in enumerate(rcs):
        if not access.may_serve(host, rc):
            remedy = f"name it at {host} under [roles.node] of the fleet file"
            raise (top / "rc").item(number, rc).bad(f"{host} may not serve {rc}", remedy)


def _folder(text: str, folder: Path, at: Where, example: str) -> Path:
    """A folder given relative to the file's `folder`. Raises BadInput."""
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
    """Check the address to serve `what` at. Raises BadInput."""
    address = ip_of("127.0.0.1" if bind == "localhost" else bind)
    if address is None:
        raise (at / "bind").bad(f"{quoted(bind)} is not an IP address", 'write one, as in "127.0.0.1"')
    if not address.is_loopback and not allow_remote:
        raise (at / "bind").bad(
            f"{quoted(bind)} shows {what} to other hosts",
            'write "127.0.0.1", or add allow_remote = true if that is meant',
        )
    return str(address)
