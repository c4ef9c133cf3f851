"""The fleet file: what all hosts of one fleet have in common."""

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
"""Environment variable with the folder of this user's certificate, instead of the file's."""
KEYS: Final = 'folder = "/etc/zscout/keys"'
MAX_CANDIDATES: Final = 1_000
MAX_ENDPOINTS: Final = 256
MAX_SITES: Final = 64
MIN_RUNTIME: Final[Ns] = 60 * SECOND
"""Default, in ns."""
DAY: Final[Ns] = 86_400 * SECOND
MAX_HOSTS: Final = 1_000
MAX_DEVICES: Final = 1_000
"""That a fleet file expects of one host."""

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
    connect: Annotated[Endpoints, key("Endpoints of hosts to be connected to always.", example=["tcp/anvil:7447"])] = ()
    multicast: Annotated[bool, key("Whether hosts find each other by UDP multicast.")] = True
    multicast_address: Annotated[str, key("`ip:port`.")] = "224.0.0.224:7446"
    interface: Annotated[str, key("Network interfaces for multicast.", example="eth0")] = "auto"
    lease: Annotated[float, key("A host that was silent for this long is gone.", 0.2, 30, unit="s")] = 1.0
    site: Annotated[
        str | None, key("The site of this host, where a relay joins several to one fleet.", example="north")
    ] = None


class MeshConfig(MeshTable, frozen=True):
    """How one process joins the mesh."""

    relay: Sites = ()
    """It joins these sites: a node's only, not that of a program on the same host."""
    shared: tuple[str, ...] = ()
    """Without multicast: the endpoints in the fleet file, where this host or process has others."""

    @property
    def known_by(self) -> tuple[str, ...]:
        """What all processes of a host know this mesh by; empty if there is nothing."""
        return (
            (self.multicast_address,) if self.multicast else self.shared or tuple(sorted({*self.listen, *self.connect}))
        )


class SecurityTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [security]: only who has a certificate of the fleet's is let in. `ca.pem`, `cert.pem` and `key.pem` lie
    in its folder; the certificate's name is the host's, or the person's. [roles] says what each may do."""

    folder: Annotated[
        str, key("The folder of the certificate, relative to this file; `~` is the home.", example="/etc/zscout/keys")
    ]


class RcmLimits(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [limits]: what the RCM accepts at most."""

    max_queued: Annotated[int, key("ARCs that wait at one time.", 1, 1_000_000)] = 10_000
    max_needs: Annotated[int, key("RCs in one ARC.", 1, 1_000)] = 64
    max_requests_per_client: Annotated[int, key("ARCs of one client, waiting or running.", 1, 100_000)] = 256
    max_requests_per_host: Annotated[
        int, key("ARCs of all clients of one host or person, waiting or running.", 1, 1_000_000)
    ] = 2_500
    max_payload: Annotated[int, key("Of one request.", 1_024, 16_777_216, unit="bytes")] = 65_536
    max_running_per_host: Annotated[
        int, key("Running ARCs of all clients of one host, but for an operator's; 0: any number.", 0, 100_000)
    ] = 0
    max_runtime: Annotated[
        Ns, seconds("0", "31622400", "After this long every hold ends as completed, whoever's it is; 0: never.")
    ] = 0
    max_booking: Annotated[
        Ns, seconds("0", "31622400", "The longest booking, whose hold lasts until its end; 0: as `max_runtime`.")
    ] = 0
    max_bookings_per_host: Annotated[int, key("Bookings of one host or person, that are not over.", 0, 1_000)] = 100

    def bound(self, policy: SchedulingPolicy) -> SchedulingPolicy:
        return dataclasses.replace(
            policy,
            max_running_per_host=self.max_running_per_host or None,
            max_runtime=self.max_runtime or None,
            max_booking=self.max_booking or self.max_runtime or None,
        )


class Timing(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [timing]: the clockwork of the RCM and of RCs, in ns. `hold_lease` is longer than the mesh lease plus
    `rebuild`, and than two heartbeats."""

    heartbeat: Annotated[Ns, seconds("0.05", "10", "From one publication of the RCM to the next at the latest.")] = (
        SECOND // 2
    )
    hold_lease: Annotated[
        Ns, seconds("0.5", "300", "A hold ends at RC and client when no RCM was heard for this long.")
    ] = 3 * SECOND
    vote_timeout: Annotated[Ns, seconds("0.01", "10", "A vote is overdue after this long.")] = SECOND // 4
    rebuild: Annotated[Ns, seconds("0.01", "10", "A new RCM waits this long for what stands.")] = SECOND // 5


class PlacementPolicy(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [placement]: how hard a fleet tries to place, and whether it moves what pays. Durations in ns."""

    start_timeout: Annotated[Ns, seconds("0.05", "600", "A start without an answer for this long has failed.")] = (
        15 * SECOND
    )
    restarts: Annotated[int, key("Starts in a row that fail soon until it is given up.", 0, 1_000)] = 5
    back_off: Annotated[Ns, seconds("0.05", "3600", "Before the first restart after a failure; doubled each time.")] = (
        SECOND // 2
    )
    longest_back_off: Annotated[Ns, seconds("0.05", "86400", "Up to this.")] = 30 * SECOND
    settled: Annotated[Ns, seconds("0.05", "86400", "After running this long its failures are counted anew.")] = (
        30 * SECOND
    )
    rebalance: Annotated[bool, key("Whether running components are moved when that pays.")] = False
    gain: Annotated[float, key("How much better it must run elsewhere, as a share of now, to be moved.", 0.05, 100)] = (
        0.3
    )
    steady: Annotated[Ns, seconds("0.05", "3600", "For how long that must be so.")] = 10 * SECOND
    rest: Annotated[Ns, seconds("0.05", "86400", "A component that was placed or moved stays for this long.")] = (
        60 * SECOND
    )


DEFAULT_PLACEMENT: Final = PlacementPolicy()


class Fleet(Struct, frozen=True):
    """One mesh with one RCM at a time; the same on every host, but for the node's own part of `mesh`."""

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
    """For how long a hold is protected where its program says nothing."""
    devices: Mapping[str, tuple[str, ...]] = {}
    """The RCs that are expected, by their host."""
    security: Path | None = None
    """The folder of this host's or this user's certificate; None: a plain mesh, on which `access` is advice."""
    access: AccessPolicy = AccessPolicy()
    file: Path | None = None
    """Of a secured fleet: where this was read. Programs look there for changed rights."""

    @property
    def operator_priority(self) -> int:
        """ARCs of this priority and above are an operator's."""
        return self.scheduling.operator_priority

    @property
    def silence(self) -> Ns:
        """A leader that published nothing for so long hangs, or is gone: longer than a few heartbeats and a lease."""
        return max(4 * self.timing.heartbeat, round(self.mesh.lease * SECOND))

    def may_lead(self, host: str) -> bool:
        return not self.candidates or host in self.candidates


# The file as it is written


class FleetTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [fleet]."""

    name: Annotated[str, key("Hosts of one name find each other.", example="lab")] = "zscout"
    candidates: Annotated[
        tuple[str, ...],
        key("Hosts that may lead, best first; none: every one.", most=MAX_CANDIDATES, example=["anvil"]),
    ] = ()
    strategy: Annotated[StrategyName, key("By which the RCM schedules.")] = "adaptive"
    operator_priority: Annotated[
        int, key("ARCs of this priority and above are an operator's: nothing keeps them.", 0, 1_000_000_000)
    ] = DEFAULT.operator_priority
    preempt: Annotated[Preempt, key("When one ARC may take the hold of another of lower priority.")] = DEFAULT.preempt
    preempt_budget: Annotated[
        float,
        key(
            "`adaptive`: who lost this part of its minimum runtime to others is protected from all but operators.",
            0,
            1e6,
        ),
    ] = DEFAULT.preempt_budget
    patience: Annotated[
        Ns | None,
        seconds(
            "0",
            "31622400",
            "`adaptive`: after this long an ARC that waits is due; 0: never; unset: 28 mean minimum runtimes.",
        ),
    ] = None
    promise: Annotated[
        Promise, key("Whom an ARC that is due goes before: equal and lower priority, or all but operators.")
    ] = DEFAULT.promise
    min_runtime: Annotated[
        Ns, seconds("0.001", "31622400", "For how long a hold is protected where its program says nothing.")
    ] = MIN_RUNTIME


class FairSharesTable(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [fair_shares]: of one priority that group goes first which lately had least of what others waited for.
    Off where it is not there."""

    half_life: Annotated[Ns, seconds("60", "31622400", "After this long half of what a group had counts.")] = DAY
    weights: Annotated[
        Mapping[str, Annotated[float, Meta(ge=0.001, le=1_000)]],
        key(
            "By group, or name that is in none: the parts that they are to have, 1 where nothing is said.",
            most=MAX_NAMES,
            example={"arms": 2},
        ),
    ] = {}
    patience: Annotated[
        Ns, seconds("0", "31622400", "That of groups that had more than another that waits; `fleet.patience` or more.")
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
        key("Names that are one to [access] and [quotas].", most=MAX_NAMES, example={"arms": ["bob"]}),
    ] = {}
    access: Annotated[
        Mapping[str, Names],
        key("RCs that only these names and groups may hold.", most=MAX_NAMES, example={"robot/arm*": ["arms"]}),
    ] = {}
    quotas: Annotated[
        Mapping[str, Quota], key("By name or group.", most=MAX_NAMES, example={"arms": {"rcs": 4, "arcs": 8}})
    ] = {}
    ceilings: Annotated[
        Mapping[Rank, Ceiling],
        key("By role: client (programs on machines, too), operator.", example={"client": {"priority": 5}}),
    ] = {}
    devices: Annotated[
        Mapping[str, Annotated[tuple[str, ...], Meta(max_length=MAX_DEVICES)]],
        key("The RCs that are expected there, by host.", most=MAX_HOSTS, example={"anvil": ["robot/scout33"]}),
    ] = {}


def load_fleet(path: Path, named_by: str = "") -> Fleet:
    """Reads a fleet file; an error says what named it. Raises BadInput."""
    try:
        fleet = _fleet(read_toml(path, FleetFile), Where(str(path)), path.parent)
        return fleet if fleet.security is None else structs.replace(fleet, file=path.absolute())
    except BadInput as error:
        raise (BadInput(f"{error} (named by {named_by})") if named_by else error) from None


def default_fleet() -> Fleet:
    """The fleet of those who wrote no file."""
    return _fleet(FleetFile(), Where("defaults"))


def fleet_from_env() -> Fleet:
    """The fleet whose file `ZSCOUT_FLEET` names; if that is unset or empty, the default. Raises BadInput."""
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
            f'is "{table.promise}", but only "adaptive" with some patience promises anything',
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
    )
    check_security(fleet, top)
    return fleet


def _fair_shares(file: FleetFile, access: AccessPolicy, at: Where) -> FairShares | None:
    """What the table says, without groups: `Authority` has these. Raises BadInput."""
    table = file.fair_shares
    if table is None:
        return None
    if file.fleet.strategy != "adaptive":
        what = f'is there, but only "adaptive" has an order of groups, not "{file.fleet.strategy}"'
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
    """The folder of the certificate that this process is to show. Raises BadInput."""
    text, at = os.environ.get(KEYS_VARIABLE) or table.folder, top / "security" / "folder"
    if not text or "\0" in text:
        raise at.bad(f"{quoted(text)} is not a folder", f"name one, as in {KEYS}")
    try:
        return beside / Path(text).expanduser()
    except RuntimeError:
        raise at.bad(f"{quoted(text)} names no user's home", f"name a folder, as in {KEYS}") from None


def check_security(fleet: Fleet, top: Where) -> None:
    """Refuses certificates without roles, and what the roles do not allow. Raises BadInput."""
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
                raise (top / "devices" / host).bad(f"{host} may not serve {rc}", f"name it under [roles.node], {host}")


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
        # A takeover begins when the old RCM's lease is over; no hold may end while the new one asks what stands.
        (round(lease * SECOND) + timing.rebuild, "mesh.lease + timing.rebuild"),
        # One lost heartbeat ends nothing.
        (2 * timing.heartbeat, "2 * timing.heartbeat"),
    ):
        if timing.hold_lease <= bound:
            remedy = f"write more than {meaning}, which is {bound / SECOND:g} s"
            raise (at / "hold_lease").bad(f"is {timing.hold_lease / SECOND:g} s", remedy)


# Endpoints and addresses, checked before Zenoh sees them


def check_links(listen: tuple[str, ...], connect: tuple[str, ...], interface: str, at: Where) -> None:
    """Refuses endpoints and interfaces that Zenoh would not understand. Raises BadInput."""
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
        raise (at / "interface").bad(f"{quoted(interface)} is not an interface", 'write "auto", or as in "eth0"')


def check_sites(mesh: MeshConfig, at: Where) -> None:
    """Refuses a relay of fewer than two sites, or of one of its own. Raises BadInput."""
    if mesh.site is not None:
        check_name(mesh.site, at / "site")
    check_names(mesh.relay, at / "relay")
    if len(mesh.relay) == 1:
        raise (at / "relay").bad(f"joins {mesh.relay[0]} to no other site", 'name the sites, as in ["north", "south"]')
    if mesh.relay and mesh.site is not None:
        raise (at / "site").bad("a relay belongs to no single site", "remove site, or relay")


def check_multicast(address: str, where: Where) -> None:
    """Refuses what is not a multicast `ip:port`. Raises BadInput."""
    host, _, port = address.rpartition(":")
    ip = ip_of(host.removeprefix("[").removesuffix("]"))
    if ip is None or not ip.is_multicast or not re.fullmatch("[0-9]{1,5}", port) or not 0 < int(port) < 65_536:
        raise where.bad(f"{quoted(address)} is not a multicast address", 'write ip:port, as in "224.0.0.224:7446"')


def _is_host(host: str) -> bool:
    if host.startswith("["):
        return isinstance(ip_of(host[1:-1]), ipaddress.IPv6Address)
    # Digits and dots alone are meant as an IPv4 address.
    return ip_of(host) is not None if re.fullmatch("[0-9.]+", host) else True


def beside(mesh: MeshConfig) -> MeshConfig:
    """How a second process joins where a node does: on ports of its own, linked to the node's, and without relaying."""
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
    """The IP address that a text is, or None."""
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None
