"""What people configure: the fleet file, shared by all hosts, and the node file of one host.

Both files and all keys but an RC's name and driver are optional. What is wrong in them ends in one `BadInput`
line that names file, key and remedy. Durations are whole ns (`Ns`), but seconds as float where Zenoh is told
them (`Mesh`).
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Final, Literal

from msgspec import Meta, Struct, structs

from zscout.balancing.rules import DEFAULT_RULES, Rules
from zscout.endpoints import check_links, check_multicast, ip_of
from zscout.keyexpr import valid_name
from zscout.messages import MAX_LABELS
from zscout.scheduling.model import SECOND, Ns
from zscout.scheduling.policy import OPERATOR_PRIORITY, PATIENCE, Policy, Preempt, Promise
from zscout.scheduling.strategies import StrategyName
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

FLEET_VARIABLE: Final = "ZSCOUT_FLEET"
"""Environment variable with the path of the fleet file, for the CLI."""
DEFAULT_FLEET_NAME: Final = "zscout"
MAX_RCS: Final = 1_000
"""RCs in one node file."""
MAX_CANDIDATES: Final = 1_000
MAX_ENDPOINTS: Final = 256
MAX_PARAMETERS: Final = 64
"""Capacities of one RC."""

MAX_KINDS: Final = 256
MAX_STARTED: Final = 256
"""Components of one node that run at one time; a load report holds no more."""

Driver = Literal["exclusive", "capacity"]
LoadKind = bool | Literal["tree"]
_Endpoints = Annotated[tuple[str, ...], Meta(max_length=MAX_ENDPOINTS)]


class Mesh(Struct, frozen=True, forbid_unknown_fields=True):
    """How this host joins the mesh: what Zenoh is told."""

    listen: _Endpoints = ()
    """Endpoints such as `tcp/0.0.0.0:7447`; none: Zenoh chooses a port on all interfaces."""
    connect: _Endpoints = ()
    """Endpoints of other hosts to be connected to at all times."""
    multicast: bool = True
    """Whether hosts find each other by UDP multicast."""
    multicast_address: str = "224.0.0.224:7446"
    interface: str = "auto"
    """The network interface for multicast, several by commas."""
    lease: Annotated[float, Meta(ge=0.2, le=30)] = 1.0
    """Seconds without a sign of life after which the others hold this host for gone."""


class Limits(Struct, frozen=True, forbid_unknown_fields=True):
    """What the RCM accepts at most."""

    max_queued: Annotated[int, Meta(ge=1, le=1_000_000)] = 10_000
    """ARCs that wait at one time."""
    max_needs: Annotated[int, Meta(ge=1, le=1_000)] = 64
    """RCs in one ARC."""
    max_requests_per_client: Annotated[int, Meta(ge=1, le=100_000)] = 256
    """ARCs of one client, waiting or running."""
    max_payload: Annotated[int, Meta(ge=1_024, le=16_777_216)] = 65_536
    """Bytes in one message."""
    max_running_per_host: Annotated[int, Meta(ge=0, le=100_000)] = 0
    """ARCs of all clients of one host that may run at one time; an operator's do not count. 0: any number."""


class Timing(Struct, frozen=True):
    """The clockwork of the RCM and of RCs. `hold_lease` is longer than the mesh lease plus `rebuild`."""

    heartbeat: Ns
    """From one publication of the RCM to the next at the latest, in ns."""
    hold_lease: Ns
    """Time in ns after which a hold ends at the RC and the client if no RCM was heard."""
    vote_timeout: Ns
    """Time in ns after which a vote is overdue."""
    rebuild: Ns
    """How long in ns a new RCM waits for what stands."""


class Components(Struct, frozen=True, forbid_unknown_fields=True):
    """What of other hosts' asking a node starts."""

    allow: bool = True
    """Whether it starts components at all."""
    kinds: Annotated[tuple[str, ...], Meta(max_length=MAX_KINDS)] | None = None
    """Only these entry points; None: all that are installed."""
    max: Annotated[int, Meta(ge=1, le=MAX_STARTED)] = 64
    """That run at one time."""


class Fleet(Struct, frozen=True):
    """One mesh with one RCM at a time; the same on every host, but for the node's own part of `mesh`."""

    name: str
    candidates: tuple[str, ...]
    """Hosts whose nodes may lead, best first; empty: every node, by name."""
    strategy: StrategyName
    policy: Policy
    mesh: Mesh
    limits: Limits
    timing: Timing
    rules: Rules = DEFAULT_RULES
    """Of the component placer."""

    @property
    def operator_priority(self) -> int:
        """ARCs of this priority and above are an operator's."""
        return self.policy.operator_priority


class RcSpec(Struct, frozen=True):
    """An RC that the node runs."""

    name: str
    """`kind/name`."""
    driver: Driver
    capacity: Mapping[str, Fraction]
    """Of a `capacity` driver: the greatest sum of each bandwidth parameter; empty for others."""
    activation: Ns
    """From a grant until the device can be used, in ns (a camera warms up)."""


class Recorder(Struct, frozen=True):
    """The recorder: the files it writes and where its live view is served."""

    path: Path
    """The folder of recordings; relative ones in a file are relative to that file."""
    bind: str
    """IP address; loopback unless the file allowed others."""
    port: int


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


# The files as they are written


class _FleetTable(Struct, frozen=True, forbid_unknown_fields=True):
    name: str = DEFAULT_FLEET_NAME
    candidates: Annotated[tuple[str, ...], Meta(max_length=MAX_CANDIDATES)] = ()
    strategy: StrategyName = "adaptive"
    operator_priority: Annotated[int, Meta(ge=0, le=1_000_000_000)] = OPERATOR_PRIORITY
    preempt: Preempt = "always"
    patience: Decimal = Decimal(PATIENCE) / SECOND
    promise: Promise = "equals"


class _TimingTable(Struct, frozen=True, forbid_unknown_fields=True):
    heartbeat: Decimal = Decimal("0.5")
    hold_lease: Decimal = Decimal(3)
    vote_timeout: Decimal = Decimal("0.25")
    rebuild: Decimal = Decimal("0.2")


class _PlacementTable(Struct, frozen=True, forbid_unknown_fields=True):
    start_timeout: Decimal = Decimal(DEFAULT_RULES.start_timeout) / SECOND
    restarts: Annotated[int, Meta(ge=0, le=1_000)] = DEFAULT_RULES.restarts
    back_off: Decimal = Decimal(DEFAULT_RULES.back_off) / SECOND
    longest_back_off: Decimal = Decimal(DEFAULT_RULES.longest_back_off) / SECOND
    settled: Decimal = Decimal(DEFAULT_RULES.settled) / SECOND
    rebalance: bool = False
    gain: Annotated[float, Meta(ge=0.05, le=100)] = DEFAULT_RULES.gain
    steady: Decimal = Decimal(DEFAULT_RULES.steady) / SECOND
    rest: Decimal = Decimal(DEFAULT_RULES.rest) / SECOND


class _FleetFile(Struct, frozen=True, forbid_unknown_fields=True):
    fleet: _FleetTable = _FleetTable()
    mesh: Mesh = Mesh()
    limits: Limits = Limits()
    timing: _TimingTable = _TimingTable()
    placement: _PlacementTable = _PlacementTable()


class _NodeTable(Struct, frozen=True, forbid_unknown_fields=True):
    host: str | None = None
    fleet: str | None = None
    candidate: bool = True
    load: LoadKind = True
    labels: Annotated[tuple[str, ...], Meta(max_length=MAX_LABELS)] = ()


class _RcTable(Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    driver: Driver
    capacity: Annotated[dict[str, Decimal], Meta(max_length=MAX_PARAMETERS)] | None = None
    activation: Decimal = Decimal(0)


class _RecorderTable(Struct, frozen=True, forbid_unknown_fields=True):
    path: str = "runs"
    bind: str = "127.0.0.1"
    port: Annotated[int, Meta(ge=1, le=65_535)] = 9876
    allow_remote: bool = False


class _NodeMeshTable(Struct, frozen=True, forbid_unknown_fields=True):
    listen: _Endpoints | None = None
    connect: _Endpoints | None = None
    interface: str | None = None


class _NodeFile(Struct, frozen=True, forbid_unknown_fields=True):
    node: _NodeTable = _NodeTable()
    mesh: _NodeMeshTable = _NodeMeshTable()
    rc: Annotated[tuple[_RcTable, ...], Meta(max_length=MAX_RCS)] = ()
    recorder: _RecorderTable | None = None
    components: Components = Components()


def load_fleet(path: Path) -> Fleet:
    """Reads a fleet file. Raises BadInput."""
    return _fleet(read_toml(path, _FleetFile), Where(str(path)))


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


def default_fleet() -> Fleet:
    """The fleet of those who wrote no file."""
    return _fleet(_FleetFile(), Where("defaults"))


def default_node() -> Node:
    """The node of those who wrote no file: named by the host, without RCs, in the default fleet."""
    return _node(_NodeFile(), default_fleet(), Path(), Where("defaults"))


def fleet_from_env() -> Fleet:
    """The fleet whose file `ZSCOUT_FLEET` names; if that is unset or empty, the default. Raises BadInput."""
    path = os.environ.get(FLEET_VARIABLE)
    if not path:
        return default_fleet()
    try:
        return load_fleet(Path(path))
    except BadInput as error:
        raise BadInput(f"{error} (named by ${FLEET_VARIABLE})") from None


def _fleet(file: _FleetFile, top: Where) -> Fleet:
    table, mesh, at = file.fleet, file.mesh, top / "fleet"
    check_name(table.name, at / "name")
    for number, host in enumerate(table.candidates):
        check_name(host, (at / "candidates").item(number))
    check_unique(table.candidates, at / "candidates")
    check_links(mesh.listen, mesh.connect, mesh.interface, top / "mesh")
    check_multicast(mesh.multicast_address, top / "mesh" / "multicast_address")
    return Fleet(
        name=table.name,
        candidates=table.candidates,
        strategy=table.strategy,
        policy=_policy(table, file.limits, at),
        mesh=mesh,
        limits=file.limits,
        timing=_timing(file.timing, mesh.lease, top / "timing"),
        rules=_rules(file.placement, top / "placement"),
    )


def _policy(table: _FleetTable, limits: Limits, at: Where) -> Policy:
    year = Decimal(366 * 24 * 3600)
    patience = seconds_to_ns(table.patience, at / "patience", high=year)
    if table.promise != "equals" and (table.strategy != "adaptive" or not patience):
        raise (at / "promise").bad(
            f'is "{table.promise}", but only "adaptive" with some patience promises anything',
            'write strategy = "adaptive" and a patience above 0, or promise = "equals"',
        )
    return Policy(
        preempt=table.preempt,
        operator_priority=table.operator_priority,
        patience=patience or None,
        promise=table.promise,
        max_running_per_host=limits.max_running_per_host or None,
    )


def _timing(table: _TimingTable, lease: float, at: Where) -> Timing:
    def ns(key: str, low: str, high: str) -> Ns:
        return seconds_to_ns(getattr(table, key), at / key, low=Decimal(low), high=Decimal(high))

    timing = Timing(
        heartbeat=ns("heartbeat", "0.05", "10"),
        hold_lease=ns("hold_lease", "0.5", "300"),
        vote_timeout=ns("vote_timeout", "0.01", "10"),
        rebuild=ns("rebuild", "0.01", "10"),
    )
    # A takeover begins when the old RCM's lease is over; no hold may end while the new one asks what stands.
    takeover = round(lease * SECOND) + timing.rebuild
    _check_above(timing.hold_lease, takeover, "mesh.lease + timing.rebuild", at / "hold_lease")
    # One lost heartbeat ends nothing.
    _check_above(timing.hold_lease, 2 * timing.heartbeat, "2 * timing.heartbeat", at / "hold_lease")
    return timing


def _rules(table: _PlacementTable, at: Where) -> Rules:
    def ns(key: str, high: int) -> Ns:
        return seconds_to_ns(getattr(table, key), at / key, low=Decimal("0.05"), high=Decimal(high))

    return Rules(
        start_timeout=ns("start_timeout", 600),
        restarts=table.restarts,
        back_off=ns("back_off", 3600),
        longest_back_off=ns("longest_back_off", 86_400),
        settled=ns("settled", 86_400),
        rebalance=table.rebalance,
        gain=table.gain,
        steady=ns("steady", 3600),
        rest=ns("rest", 86_400),
    )


def _check_above(value: Ns, bound: Ns, meaning: str, where: Where) -> None:
    if value <= bound:
        limit = f"{bound / SECOND:g}"
        raise where.bad(f"is {value / SECOND:g} s", f"write more than {meaning}, which is {limit} s")


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
    if table.driver == "capacity" and not capacity:
        raise (at / "capacity").bad("is missing or empty", "add one, as in capacity = { command_rate = 10 }")
    if table.driver != "capacity" and table.capacity is not None:
        raise (at / "capacity").bad(
            f'the driver "{table.driver}" has none', 'remove it, or write driver = "capacity"'
        )
    for parameter in capacity:
        check_name(parameter, at / "capacity")
    hour = Decimal(3600)
    return RcSpec(
        name=table.name,
        driver=table.driver,
        capacity=amounts(capacity, at / "capacity"),
        activation=seconds_to_ns(table.activation, at / "activation", high=hour),
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
    return Recorder(path=folder / table.path, bind=str(address), port=table.port)
