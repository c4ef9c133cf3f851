"""The fleet file: what all hosts of one fleet have in common."""

from __future__ import annotations

import os
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Final

from msgspec import Meta, Struct

from zscout.endpoints import check_links, check_multicast
from zscout.placing.rules import DEFAULT_RULES, Rules
from zscout.scheduling.model import SECOND, Ns
from zscout.scheduling.policy import OPERATOR_PRIORITY, PATIENCE, Policy, Preempt, Promise, StrategyName
from zscout.strict import BadInput, Where, check_name, check_unique, read_toml, seconds_to_ns

FLEET_VARIABLE: Final = "ZSCOUT_FLEET"
"""Environment variable with the path of the fleet file, for the CLI."""
DEFAULT_FLEET_NAME: Final = "zscout"
MAX_CANDIDATES: Final = 1_000
MAX_ENDPOINTS: Final = 256

Endpoints = Annotated[tuple[str, ...], Meta(max_length=MAX_ENDPOINTS)]


class Mesh(Struct, frozen=True, forbid_unknown_fields=True):
    """How this host joins the mesh: what Zenoh is told."""

    listen: Endpoints = ()
    """Endpoints such as `tcp/0.0.0.0:7447`; none: Zenoh chooses a port on all interfaces."""
    connect: Endpoints = ()
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


# The file as it is written


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


def load_fleet(path: Path) -> Fleet:
    """Reads a fleet file. Raises BadInput."""
    return _fleet(read_toml(path, _FleetFile), Where(str(path)))


def default_fleet() -> Fleet:
    """The fleet of those who wrote no file."""
    return _fleet(_FleetFile(), Where("defaults"))


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
