"""The fleet file: the settings that all hosts of a fleet share."""

from __future__ import annotations

import dataclasses
import ipaddress
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Final

from msgspec import Meta, Struct, structs

from zscout.config.access import MAX_NAMES, AccessPolicy, Ceiling, Names, Quota, Roles, check_access
from zscout.config.scheduling_policy import (
    DEFAULT,
    FAIR_PATIENCE,
    PATIENCE,
    FairShares,
    Preempt,
    Promise,
    SchedulingPolicy,
    StrategyName,
)
from zscout.config.strict import (
    BadInput,
    Where,
    check_folder_name,
    check_name,
    check_names,
    check_rc_name,
    check_unique,
    key,
    quoted,
    read_toml,
    seconds,
)
from zscout.keyexpr import Rank
from zscout.types import SECOND, Ns

FLEET_VARIABLE: Final = "ZSCOUT_FLEET"
"""Environment variable with the path of the fleet file, for the CLI."""
KEYS_VARIABLE: Final = "ZSCOUT_KEYS"
"""Environment variable with the folder of this user's certificate; overrides the file."""
KEYS: Final = 'folder = "/etc/zscout/keys"'
MAX_CANDIDATES: Final = 1_000
MAX_ENDPOINTS: Final = 256
MAX_SITES: Final = 64
MIN_RUNTIME: Final[Ns] = 60 * SECOND
COMMAND_MIN_RUNTIME: Final[Ns] = 3600 * SECOND
"""Default, in ns."""
DAY: Final[Ns] = 86_400 * SECOND
MAX_HOSTS: Final = 1_000
MAX_DEVICES: Final = 1_000
"""Devices of one host in a fleet file."""

_ENDPOINT: Final = re.compile(
    r"(?P<protocol>[a-z]+)/(?P<host>\[[0-9A-Fa-f:.%]+\]|[A-Za-z0-9_.-]+):(?P<port>[0-9]{1,5})"
    r"(?P<more>[?#][A-Za-z0-9_.,:;=/#-]+)?"
)
_PROTOCOLS: Final = ("tcp", "tls", "udp", "quic", "ws")
_EVERYWHERE: Final = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}  # noqa: S104 - read, not bound
_INTERFACE: Final = re.compile(r"[A-Za-z0-9_.:,@-]{1,64}")

Sites = Annotated[tuple[str, ...], Meta(max_length=MAX_SITES)]
Endpoints = Annotated[tuple[str, ...], Meta(max_length=MAX_ENDPOINTS)]


class MeshTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [mesh]: how a host, and each program on it, joins the mesh."""

    listen: Annotated[Endpoints, key("Endpoints of this host; none: a free port.", example=["tcp/0.0.0.0:7447"])] = ()
    connect: Annotated[Endpoints, key("Endpoints of hosts to stay connected to.", example=["tcp/anvil:7447"])] = ()
    multicast: Annotated[bool, key("Whether hosts find each other by UDP multicast.")] = True
    multicast_address: Annotated[str, key("`ip:port`.")] = "224.0.0.224:7446"
    interface: Annotated[str, key("Network interfaces for multicast.", example="eth0")] = "auto"
    lease: Annotated[float, key("A host counts as gone after this long a silence.", 0.2, 30, unit="s")] = 1.0
    site: Annotated[
        str | None, key("The site of this host, if a relay joins several sites to one fleet.", example="north")
    ] = None


class MeshConfig(MeshTable, frozen=True):
    """How one process joins the mesh."""

    relay: Sites = ()
    """The sites that this process joins; only nodes relay, not other programs of their hosts."""
    shared: tuple[str, ...] = ()
    """Without multicast: the endpoints of the fleet file, if this host or process has different ones."""

    @property
    def known_by(self) -> tuple[str, ...]:
        """Addresses by which a host's processes know this mesh: multicast, else the fleet file's endpoints."""
        return (
            (self.multicast_address,) if self.multicast else self.shared or tuple(sorted({*self.listen, *self.connect}))
        )


class SecurityTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [security]: the mesh admits only holders of the fleet's certificates. The folder has `ca.pem`,
    `cert.pem` and `key.pem`, in that host's or person's name, whose rights are in [roles]."""

    folder: Annotated[
        str, key("The folder of the certificate, relative to this file; `~` is the home.", example="/etc/zscout/keys")
    ]


class RcmLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [limits]: upper bounds that the RCM enforces."""

    max_queued: Annotated[int, key("ARCs that wait at one time.", 1, 1_000_000)] = 10_000
    max_needs: Annotated[int, key("RCs in one ARC.", 1, 1_000)] = 64
    max_requests_per_client: Annotated[int, key("ARCs of one client, waiting or running.", 1, 100_000)] = 256
    max_requests_per_host: Annotated[
        int, key("ARCs of all clients of one host or person, waiting or running.", 1, 1_000_000)
    ] = 2_500
    max_payload: Annotated[int, key("Size of one request.", 1_024, 16_777_216, unit="bytes")] = 65_536
    max_running_per_host: Annotated[
        int, key("Running ARCs of all clients of one host, except operators; 0: any number.", 0, 100_000)
    ] = 0
    max_runtime: Annotated[
        Ns, seconds("0", "31622400", "After this long every hold ends as completed, also an operator's; 0: never.")
    ] = 0
    max_booking: Annotated[
        Ns, seconds("0", "31622400", "The longest booking, whose hold lasts until its end; 0: as `max_runtime`.")
    ] = 0
    max_bookings_per_host: Annotated[int, key("Current and future bookings of one host or person.", 0, 1_000)] = 100

    def bound(self, policy: SchedulingPolicy) -> SchedulingPolicy:
        return dataclasses.replace(
            policy,
            max_running_per_host=self.max_running_per_host or None,
            max_runtime=self.max_runtime or None,
            max_booking=self.max_booking or self.max_runtime or None,
        )


class Timing(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [timing], in ns. `hold_lease` exceeds two heartbeats, and the mesh lease plus `rebuild`."""

    heartbeat: Annotated[Ns, seconds("0.05", "10", "The longest time between two publications of the RCM.")] = (
        SECOND // 2
    )
    hold_lease: Annotated[
        Ns, seconds("0.5", "300", "A hold ends at RC and client after this long without a publication of an RCM.")
    ] = 3 * SECOND
    vote_timeout: Annotated[Ns, seconds("0.01", "10", "A vote is overdue after this long.")] = SECOND // 4
    rebuild: Annotated[Ns, seconds("0.01", "10", "A new RCM waits this long for reports of present holds.")] = (
        SECOND // 5
    )


class PlacementPolicy(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [placement]: starts, restarts and moves of components. Durations in ns."""

    start_timeout: Annotated[Ns, seconds("0.05", "600", "A start without an answer for this long has failed.")] = (
        15 * SECOND
    )
    restarts: Annotated[int, key("Restarts in a row after early failures before it is given up.", 0, 1_000)] = 5
    back_off: Annotated[Ns, seconds("0.05", "3600", "Pause before the first restart; doubled each time.")] = SECOND // 2
    longest_back_off: Annotated[Ns, seconds("0.05", "86400", "The longest pause before a restart.")] = 30 * SECOND
    settled: Annotated[Ns, seconds("0.05", "86400", "After running this long, earlier failures no longer count.")] = (
        30 * SECOND
    )
    rebalance: Annotated[bool, key("Move running components when that pays.")] = False
    gain: Annotated[float, key("Gain in speed that a move must promise, as a share of the present.", 0.05, 100)] = 0.3
    steady: Annotated[Ns, seconds("0.05", "3600", "Time for which a move must promise that gain.")] = 10 * SECOND
    rest: Annotated[Ns, seconds("0.05", "86400", "A component stays this long after it was placed or moved.")] = (
        60 * SECOND
    )


DEFAULT_PLACEMENT: Final = PlacementPolicy()


class Fleet(Struct, frozen=True):
    """One mesh with one RCM at a time; equal on every host, except for the node's own part of `mesh`."""

    name: str
    candidates: tuple[str, ...]
    """Hosts whose nodes may lead, best first; empty: every node, by name."""
    strategy: StrategyName
    scheduling: SchedulingPolicy
    mesh: MeshConfig
    limits: RcmLimits
    timing: Timing
    placement: PlacementPolicy = DEFAULT_PLACEMENT
    min_runtime: Ns = MIN_RUNTIME
    """Minimum runtime of requests that give none."""
    command_min_runtime: Ns = COMMAND_MIN_RUNTIME
    """How long a hold is protected for a command whose request gives no minimum runtime."""
    devices: Mapping[str, tuple[str, ...]] = {}
    """The expected RCs by host."""
    security: Path | None = None
    """The folder of this host's or this user's certificate; None: a plain mesh, on which `access` is advice."""
    access: AccessPolicy = AccessPolicy()
    file: Path | None = None
    """Path of a secured fleet's file. Programs reread it for changed rights."""

    @property
    def operator_priority(self) -> int:
        return self.scheduling.operator_priority

    @property
    def silence(self) -> Ns:
        """A leader without publications for this long, in ns, hangs or is gone: 4 heartbeats, at least a mesh lease."""
        return max(4 * self.timing.heartbeat, round(self.mesh.lease * SECOND))

    def may_lead(self, host: str) -> bool:
        return not self.candidates or host in self.candidates


class FleetTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [fleet]."""

    name: Annotated[str, key("Hosts of one name find each other.", example="lab")] = "zscout"
    candidates: Annotated[
        tuple[str, ...],
        key("Hosts that may lead, best first; none: all hosts.", most=MAX_CANDIDATES, example=["anvil"]),
    ] = ()
    strategy: Annotated[StrategyName, key("The RCM's scheduling strategy.")] = "adaptive"
    operator_priority: Annotated[
        int, key("ARCs of this priority and above are an operator's: no other rule delays them.", 0, 1_000_000_000)
    ] = DEFAULT.operator_priority
    preempt: Annotated[Preempt, key("When an ARC may preempt a hold of lower priority.")] = DEFAULT.preempt
    preempt_budget: Annotated[
        float,
        key("`adaptive`: only operators preempt an ARC that lost this share of its minimum runtime to others.", 0, 1e6),
    ] = DEFAULT.preempt_budget
    patience: Annotated[
        Ns | None,
        seconds(
            "0",
            "31622400",
            "`adaptive`: a waiting ARC is due after this long; 0: never; unset: 28 mean minimum runtimes.",
        ),
    ] = None
    promise: Annotated[
        Promise, key("ARCs that may not pass a due ARC: of equal and lower priority, or all but operators.")
    ] = DEFAULT.promise
    min_runtime: Annotated[Ns, seconds("0.001", "31622400", "Minimum runtime of requests that give none.")] = (
        MIN_RUNTIME
    )
    command_min_runtime: Annotated[
        Ns,
        seconds(
            "0",
            "31622400",
            "Protect the hold of a command without --min-runtime this long, cut to the next booking, maintenance or "
            "reservation of its devices; no less than `min_runtime`.",
        ),
    ] = COMMAND_MIN_RUNTIME


class FairSharesTable(Struct, frozen=True, forbid_unknown_fields=True):
    """Within one priority, groups with less recent contended usage go first; without the table groups do not matter."""

    half_life: Annotated[Ns, seconds("60", "31622400", "After this long usage counts half.")] = DAY
    weights: Annotated[
        Mapping[str, Annotated[float, Meta(ge=0.001, le=1_000)]],
        key(
            "Share by group, or by name without a group, relative to the others; 1 if not given.",
            most=MAX_NAMES,
            example={"arms": 2},
        ),
    ] = {}
    patience: Annotated[
        Ns,
        seconds("0", "31622400", "Patience of groups that used more than a waiting group; `fleet.patience` or more."),
    ] = FAIR_PATIENCE


class FleetFile(Struct, frozen=True, forbid_unknown_fields=True):
    """A fleet file."""

    fleet: FleetTable = FleetTable()
    mesh: MeshTable = MeshTable()
    limits: RcmLimits = RcmLimits()
    timing: Timing = Timing()
    placement: PlacementPolicy = DEFAULT_PLACEMENT
    fair_shares: FairSharesTable | None = None
    security: SecurityTable | None = None
    roles: Roles = Roles()
    groups: Annotated[
        Mapping[str, Names],
        key("Names that [access] and [quotas] treat alike.", most=MAX_NAMES, example={"arms": ["bob"]}),
    ] = {}
    access: Annotated[
        Mapping[str, Names],
        key("RCs that only these names and groups may hold.", most=MAX_NAMES, example={"robot/arm*": ["arms"]}),
    ] = {}
    quotas: Annotated[
        Mapping[str, Quota], key("Quotas by name or group.", most=MAX_NAMES, example={"arms": {"rcs": 4, "arcs": 8}})
    ] = {}
    ceilings: Annotated[
        Mapping[Rank, Ceiling],
        key("Limits by role: client (also programs on machines), operator.", example={"client": {"priority": 5}}),
    ] = {}
    devices: Annotated[
        Mapping[str, Annotated[tuple[str, ...], Meta(max_length=MAX_DEVICES)]],
        key("Expected RCs by host.", most=MAX_HOSTS, example={"anvil": ["robot/scout33"]}),
    ] = {}


def load_fleet(path: Path, named_by: str = "") -> Fleet:
    """Read a fleet file. `named_by`, such as an option, is added to errors. Raises BadInput."""
    try:
        fleet = _fleet(read_toml(path, FleetFile), Where(str(path)), path.parent)
        return fleet if fleet.security is None else structs.replace(fleet, file=path.absolute())
    except BadInput as error:
        raise (BadInput(f"{error} (named by {named_by})") if named_by else error) from None


def default_fleet() -> Fleet:
    return _fleet(FleetFile(), Where("defaults"))


def fleet_from_env() -> Fleet:
    """The fleet in the file `$ZSCOUT_FLEET`; the default if it is unset or empty. Raises BadInput."""
    path = os.environ.get(FLEET_VARIABLE)
    return load_fleet(Path(path), f"${FLEET_VARIABLE}") if path else default_fleet()


def _fleet(file: FleetFile, top: Where, folder: Path = Path()) -> Fleet:
    table, mesh, at = file.fleet, MeshConfig(**structs.asdict(file.mesh)), top / "fleet"
    check_folder_name(table.name, at / "name")
    check_names(table.candidates, at / "candidates")
    check_links(mesh.listen, mesh.connect, mesh.interface, top / "mesh")
    check_multicast(mesh.multicast_address, top / "mesh" / "multicast_address")
    check_sites(mesh, top / "mesh")
    _check_timing(file.timing, mesh.lease, top / "timing")
    _check_devices(file.devices, top / "devices")
    access = AccessPolicy(file.roles, file.groups, file.access, file.quotas, file.ceilings)
    check_access(access, top)
    if table.promise != "equals" and (table.strategy != "adaptive" or table.patience == 0):
        raise (at / "promise").bad(
            f'is "{table.promise}", but needs the strategy "adaptive" with some patience',
            'write strategy = "adaptive" and a patience above 0, or promise = "equals"',
        )
    unbound = SchedulingPolicy(
        preempt=table.preempt,
        operator_priority=table.operator_priority,
        preempt_budget=table.preempt_budget,
        patience="runtimes" if table.patience is None else table.patience or None,
        promise=table.promise,
        fair_shares=_fair_shares(file, access, top / "fair_shares"),
    )
    policy = file.limits.bound(unbound)
    fleet = Fleet(
        name=table.name,
        candidates=table.candidates,
        strategy=table.strategy,
        scheduling=policy,
        mesh=mesh,
        limits=file.limits,
        timing=file.timing,
        placement=file.placement,
        devices=file.devices,
        security=None if file.security is None else keys_folder(file.security, folder, top),
        access=access,
        min_runtime=min(table.min_runtime, policy.max_runtime or table.min_runtime),
        command_min_runtime=table.command_min_runtime,
    )
    check_security(fleet, top)
    return fleet


def _fair_shares(file: FleetFile, access: AccessPolicy, at: Where) -> FairShares | None:
    """The table as a policy, without groups, which `Authority` adds. Raises BadInput."""
    table = file.fair_shares
    if table is None:
        return None
    if file.fleet.strategy != "adaptive":
        what = f'needs the strategy "adaptive", not "{file.fleet.strategy}"'
        raise at.bad(what, 'write strategy = "adaptive" under [fleet], or remove the table')
    for name in table.weights:
        here = at / "weights" / name
        check_name(name, here)
        if groups := access.groups_of(name):
            raise here.bad(f"{quoted(name)} belongs to the group {groups[0]}", "give the group a weight")
        if access.ranks and name not in access.groups and name not in access.ranks:
            raise here.bad(f"{quoted(name)} is not a group and has no role", "add it under [groups], or correct it")
    least = PATIENCE if file.fleet.patience is None else file.fleet.patience
    if table.patience < least:
        what = f"is {table.patience / SECOND:g} s, less than fleet.patience ({least / SECOND:g} s)"
        raise (at / "patience").bad(what, "write as much, or more")
    return FairShares(table.half_life, table.weights, patience=table.patience)


def keys_folder(table: SecurityTable, beside: Path, top: Where) -> Path:
    """The folder of this process's certificate. Raises BadInput."""
    text, at = os.environ.get(KEYS_VARIABLE) or table.folder, top / "security" / "folder"
    if not text or "\0" in text:
        raise at.bad(f"{quoted(text)} is not a folder", f"name one, as in {KEYS}")
    try:
        return beside / Path(text).expanduser()
    except RuntimeError:
        raise at.bad(f"{quoted(text)} names no user's home", f"name a folder, as in {KEYS}") from None


def check_security(fleet: Fleet, top: Where) -> None:
    """Raises BadInput unless managers, TLS endpoints, and candidates and devices that the roles allow are there."""
    if fleet.security is None:
        return
    access = fleet.access
    if not access.roles.manager:
        raise (top / "roles").bad("[security] needs a host that may lead", 'write manager = ["anvil"] under [roles]')
    for name in ("listen", "connect"):
        for number, endpoint in enumerate(getattr(fleet.mesh, name)):
            if not endpoint.startswith("tls/"):
                remedy = "write tls/host:port, or remove [security]"
                raise (top / "mesh" / name).item(number).bad(f"{quoted(endpoint)} is not TLS", remedy)
    for number, host in enumerate(fleet.candidates):
        if "manager" not in access.ranks_of(host):
            raise (
                (top / "fleet" / "candidates")
                .item(number)
                .bad(f"{host} is not a manager", "name it as one under [roles]")
            )
    for host, rcs in fleet.devices.items():
        for rc in rcs:
            if not access.may_serve(host, rc):
                raise (top / "devices" / host).bad(f"{host} may not serve {rc}", f"add it to {host} under [roles.node]")


def _check_devices(devices: Mapping[str, tuple[str, ...]], at: Where) -> None:
    homes: dict[str, str] = {}
    for host, rcs in devices.items():
        check_name(host, at / host)
        for number, rc in enumerate(rcs):
            here = (at / host).item(number)
            check_rc_name(rc, here)
            if rc in homes:
                raise here.bad(f"{quoted(rc)} is already at {homes[rc]}", "name one home for it")
            homes[rc] = host


def _check_timing(timing: Timing, lease: float, at: Where) -> None:
    for bound, meaning in (
        # A takeover begins when the old RCM's lease is over; no hold may end while the new RCM collects the holds.
        (round(lease * SECOND) + timing.rebuild, "mesh.lease + timing.rebuild"),
        # A single lost heartbeat must not end holds.
        (2 * timing.heartbeat, "2 * timing.heartbeat"),
    ):
        if timing.hold_lease <= bound:
            remedy = f"write more than {meaning}, which is {bound / SECOND:g} s"
            raise (at / "hold_lease").bad(f"is {timing.hold_lease / SECOND:g} s", remedy)


def check_links(listen: tuple[str, ...], connect: tuple[str, ...], interface: str, at: Where) -> None:
    """Raises BadInput for endpoints and interfaces that Zenoh would not accept."""
    remedy = f'write protocol/host:port, as in "tcp/127.0.0.1:7447"; protocols: {", ".join(_PROTOCOLS)}'
    for name, endpoints, lowest_port in (("listen", listen, 0), ("connect", connect, 1)):
        for number, endpoint in enumerate(endpoints):
            where, found = (at / name).item(number), _ENDPOINT.fullmatch(endpoint)
            if not found or found["protocol"] not in _PROTOCOLS or not _is_host(found["host"]):
                raise where.bad(f"{quoted(endpoint)} is not an endpoint", remedy)
            if not lowest_port <= int(found["port"]) <= 65_535:
                raise where.bad(f"{quoted(endpoint)} has no valid port", f"write one from {lowest_port} to 65535")
        check_unique(endpoints, at / name)
    if not _INTERFACE.fullmatch(interface):
        raise (at / "interface").bad(
            f"{quoted(interface)} is not an interface", 'write "auto", or the name of one, as in "eth0"'
        )


def check_sites(mesh: MeshConfig, at: Where) -> None:
    """Raises BadInput for a relay of fewer than two sites, or with a site of its own."""
    if mesh.site is not None:
        check_name(mesh.site, at / "site")
    check_names(mesh.relay, at / "relay")
    if len(mesh.relay) == 1:
        raise (at / "relay").bad(f"joins {mesh.relay[0]} to no other site", 'name the sites, as in ["north", "south"]')
    if mesh.relay and mesh.site is not None:
        raise (at / "site").bad("a relay belongs to no single site", "remove site, or relay")


def check_multicast(address: str, where: Where) -> None:
    """Raises BadInput unless `address` is a multicast `ip:port`."""
    host, _, port = address.rpartition(":")
    ip = ip_of(host.removeprefix("[").removesuffix("]"))
    if ip is None or not ip.is_multicast or not re.fullmatch("[0-9]{1,5}", port) or not 0 < int(port) < 65_536:
        raise where.bad(f"{quoted(address)} is not a multicast address", 'write ip:port, as in "224.0.0.224:7446"')


def _is_host(host: str) -> bool:
    if host.startswith("["):
        return isinstance(ip_of(host[1:-1]), ipaddress.IPv6Address)
    # A text of digits and dots is an IPv4 address.
    return ip_of(host) is not None if re.fullmatch("[0-9.]+", host) else True


def beside(mesh: MeshConfig) -> MeshConfig:
    """The settings of a second process beside a node: free ports, a connection to the node's, and no relaying."""
    listen, connect = [], list(mesh.connect)
    for found in filter(None, map(_ENDPOINT.fullmatch, mesh.listen)):
        protocol, host, port, more = found["protocol"], found["host"], found["port"], found["more"] or ""
        listen.append(f"{protocol}/{host}:0{more}")
        if int(port):
            connect.append(f"{protocol}/{_EVERYWHERE.get(host, host)}:{port}{more}")
    own = structs.replace(mesh, listen=tuple(listen), connect=tuple(dict.fromkeys(connect)), relay=())
    site = mesh.relay[0] if mesh.relay else mesh.site
    return structs.replace(own, site=site, shared=() if mesh.multicast else mesh.known_by)


def ip_of(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """None: it is not one."""
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None
