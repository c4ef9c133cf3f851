"""`zscout status`: devices and their holders, requests that run or wait, hosts and the leader."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Mapping, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from typing import Any, Final

import click
from msgspec import structs

from zscout import terminal
from zscout.cli import booked, common, completion
from zscout.cli.device_words import ending, remarks, unwell
from zscout.cli.fleet.fleet_view import Devices, FleetView, Host
from zscout.cli.fleet.selection import Selection
from zscout.cli.fleet.watching import Overview, show
from zscout.cli.requests.waiting import comment, reason_text, request_words, whose
from zscout.config.access import AccessPolicy
from zscout.keyexpr import Role
from zscout.messages import BookingsTold, HoldView, Notice, RcmState, RcState, RcView, WaitView, version_words
from zscout.scheduling.reason import person, starting
from zscout.terminal import Table, clock, many, span
from zscout.types import SECOND, VERSION, Ns

MAX_NAMED: Final = 8
"""Components named in the row of a host; hosts named for a version."""
NODE_ROLES: Final = (Role.NODE, Role.CANDIDATE, Role.RCM, Role.RC, Role.LOAD, Role.RECORDER)
"""Roles of a node, not of programs on its host."""
MAX_FIGURES_SHOWN: Final = 12


@click.command()
@click.argument("names", nargs=-1, metavar="[NAME...]", shell_complete=completion.shown)
@click.option("--watch", is_flag=True, help="Update continuously; arrows scroll, q or Ctrl-C ends.")
@click.option("--devices", "every", is_flag=True, help="Show the figures of all devices: rates, drops, latency.")
@common.json_option("Print one JSON object; with --watch, one on each line.")
@common.runs
async def status(names: Sequence[str], watch: bool, every: bool, as_json: bool) -> None:
    """Show the fleet: devices and the requests that hold them, the queue with reasons, hosts and their loads.

    NAME is the name of a device, a request (or its id) or a host, or a pattern: 'robot/*'. With names, only these and
    everything linked to them are shown: a device with the requests that hold it or wait for it, a request with its
    devices and their holders, a host with its devices and programs. Exit code 1: a name is unknown.

    HELD BY shows requests by the names that `zscout why`, `cancel` and `release` take, and their persons; `zscout why`
    also shows their commands. For a free device it shows the next booking within 24 h. A narrow terminal leaves out
    less important columns; a pipe gets all of them.

    Warnings come first: certificates that expire within 14 days, roles without [security], hosts whose roles differ or
    whose files have an error, clocks that differ by more than 2 s, different versions. The queue is in rank order,
    and so are groups with fair shares. Candidates of the fleet file are shown even if they are down; other hosts that
    went down only with --watch. A device has a line under Health if something is wrong with it, if it is absent (for a
    day, or always if the fleet file expects it), or if several hosts offer it. --watch refreshes once a second; in a
    pipe it prints a new block if more has changed than loads, times and figures. Exit code 3: no leader.

    \b
    Examples:
      zscout status
      zscout status --json | jq -r '.queue[] | .arc + ": " + .reason'
      zscout status --devices --watch
      zscout status 'framegrabber/*' anvil
    """
    async with AsyncExitStack() as stack:
        client = await stack.enter_async_context(common.connected("status", need_rcm=False))
        fleet_view = stack.enter_context(FleetView(client))
        status_view = StatusView(fleet_view, None, Devices(fleet_view), every, names)
        nobody: common.NobodyThere | None = None
        try:
            status_view.state = await fleet_view.settled()
        except common.NobodyThere as error:  # show hosts and devices without a leader
            nobody = error
        await asyncio.gather(status_view.devices.ask(), status_view.ask_bookings())
        if nobody is None and not watch and (missing := status_view.selection().missing()):
            raise missing
        # Each change of a request is published to its client.
        news = asyncio.Event()
        client.mesh.subscribe(client.mesh.keys.notice_any, Notice, lambda _key, _notice: news.set())
        await show(status_view, news, status_view.refresh, watch=watch, as_json=as_json)
        if nobody is not None and not watch:
            raise nobody


@dataclass(slots=True)
class StatusView:
    """`state`: None if no node leads. `every`: show figures of all devices. `names`: if not empty, show only these."""

    fleet_view: FleetView
    state: RcmState | None
    devices: Devices
    every: bool
    names: Sequence[str] = ()
    booked: BookingsTold | None = None

    def selection(self) -> Selection:
        return Selection(self.names, self.state, self._homes(), self.fleet_view.all_hosts())

    async def refresh(self) -> None:
        self.state = await self.fleet_view.client.state(forecast=True)
        self.fleet_view.forget_gone()
        await asyncio.gather(self.devices.ask(), self.ask_bookings())

    async def ask_bookings(self) -> None:
        self.booked = await booked.look(self.fleet_view.client) if self.state is not None else None

    def overview(self, *, plain: bool | None = None) -> Overview:
        """`plain`: for a pipe, in the columns that scripts read."""
        plain = not terminal.at_terminal() if plain is None else plain
        fleet, links = self.fleet_view.client.fleet.name, many(self.fleet_view.mesh.links(), "link")
        headline = f"Fleet {fleet}: no leader; nothing is granted until a node leads ({links})"
        tables: list[Table] = []
        chosen = self.selection()
        if self.state is not None and chosen.state is not None:
            leader, term = self.state.host, self.state.term.counter
            headline = f"Fleet {fleet}: {leader} leads, term {term} ({links})"
            headline += f"; {many(count, 'booking')} within 24 h" if (count := booked.soon(self.booked)) else ""
            ranks = {f"{wait.client}/{wait.id}": number for number, wait in enumerate(self.state.queue, 1)}
            operator, maintained = self.fleet_view.client.fleet.operator_priority, booked.in_maintenance(self.booked)
            held = running(chosen.state, operator, plain=plain, maintained=maintained)
            tables = [self._rcs(chosen.state), held, waiting(chosen.state, ranks, plain=plain)]
            tables += [] if self.names else [shares_table(self._shares())]
        tables = [self._warnings(), *tables, self._hosts(chosen), self._devices(chosen)]
        if not plain:  # at a terminal the columns are clear without titles
            tables = [replace(table, title="") for table in tables]
        return Overview(headline, tables, alarm=self.state is None)

    def _advisory(self) -> bool:
        """Return True if the fleet file lists rights, but has no [security] to enforce them."""
        fleet = self.fleet_view.client.fleet
        return fleet.security is None and fleet.access != AccessPolicy()

    def _own_rights(self) -> str:
        fleet = self.fleet_view.client.fleet
        return fleet.access.digest if fleet.security is not None else ""

    def _warnings(self) -> Table:
        rows = [
            ("certificate", f"{ending(name, left)}; renew it (zscout cert renew)")
            for name, left in self.fleet_view.ending().items()
        ]
        if self._advisory():
            rows.append(("roles", "they are only advisory; set [security] to prove names"))
        rows += [("roles", words) for words in differing(self._own_rights(), self.fleet_view.rights())]
        rows += [("files", f"{host} uses older settings: {fault}") for host, fault in self.fleet_view.faults().items()]
        rows += [("recorder", f"{host}: {why}") for host, why in self.fleet_view.unrecorded().items()]
        clocks = sorted(self._clocks().items())
        rows += [("clock", f"{booked.clock_words(host, differs)}; set it") for host, differs in clocks]
        if self.booked is not None and self.booked.corrected is not None:
            rows.append(("clock", booked.corrected_words(self.booked.corrected)))
        if (versions := mixture(self._versions())) is not None:
            rows.append(("versions", versions))
        return Table("Warnings", ("ABOUT", "WARNING"), rows, ["yellow"] * len(rows))

    def _clocks(self) -> dict[str, float]:
        return {} if self.booked is None else self.booked.clocks

    def _versions(self) -> dict[str, str]:
        return versions(self.fleet_view.hosts, self.devices.known(), self.state)

    def _homes(self) -> dict[str, str]:
        """By device: the leader's choice, else a host that offers it."""
        offered = {token.name: token.host for token in self.fleet_view.tokens(Role.RC)}
        views = self.state.rcs if self.state is not None else []
        return offered | {view.rc: view.host for view in views if view.host}

    def _rcs(self, state: RcmState) -> Table:
        homes = self._homes()
        lost = {device.rc for device in self.devices.known().values() if device.health != "ok"}
        maintained, coming = booked.in_maintenance(self.booked), booked.coming(self.booked)
        broken = booked.broken(self.booked)
        sick = {rc for rc, device in self.devices.known().items() if unwell(device)}
        rows, styles = [], []
        for view in state.rcs:
            holders = [hold for hold in state.holds if view.rc in hold.needs]
            why = {"broken": broken, "maintenance": maintained, "unwell": sick}
            free = next((word for word, rcs in why.items() if view.rc in rcs), "free")
            there = "held" if holders else free
            words = there if view.present else "lost" if view.rc in lost else "absent"
            kind = "shared" if view.sharable else "exclusive"
            holds = ",\n".join(request_words(hold.arc, hold.who, hold.client, hold.needs[view.rc]) for hold in holders)
            held_by = {"broken": broken, "maintenance": maintained, "free": coming}.get(words, {}).get(view.rc, holds)
            rows.append((view.rc, kind, words, homes.get(view.rc, "-"), held_by))
            styles.append({"absent": "red", "lost": "red", "broken": "red", "free": "green"}.get(words, "yellow"))
        columns, spare = ("DEVICE", "USE", "STATE", "HOST", "HELD BY"), ("USE", "HOST", "HELD BY")
        return Table("Devices", columns, rows, styles, spare, beneath={"HELD BY"})

    def _shares(self) -> list[dict[str, Any]]:
        fair = self.fleet_view.client.fleet.scheduling.fair_shares
        return [] if self.state is None else shares(self.state.charged, {} if fair is None else fair.weights)

    def _hosts(self, chosen: Selection) -> Table:
        rows, styles = [], []
        for name, host in chosen.hosts.items():
            words, style = self._condition(name, host)
            load, cpu, memory = "-", "-", "-"
            if (report := host.load) is not None:
                load = f"{report.load_average[0]:.2f} of {report.cores}"
                cpu = f"{report.cpu:.0f} %"
                memory = f"{report.memory_available / 2**30:.1f} of {report.memory_total / 2**30:.1f} GiB"
            rows.append((name, words, load, cpu, memory, _doing(host)))
            styles.append(style)
        columns, spare = ("HOST", "STATE", "LOAD", "CPU", "MEMORY FREE", "RUNS"), ("MEMORY FREE", "CPU", "LOAD", "RUNS")
        return Table("Hosts", columns, rows, styles, spare, beneath={"RUNS"})

    def _condition(self, name: str, host: Host) -> tuple[str, str]:
        if host.gone is not None:
            gone = (self.fleet_view.mesh.now() - host.gone) / SECOND
            return f"gone since {clock(-gone)} ({span(gone)})", "red"
        if not host.tokens:
            return "not there", "red"
        if not any(map(host.has, NODE_ROLES)):
            # A host of programs alone has none.
            return "no node", "red" if name in self._homes().values() else ""
        if self.fleet_view.stale(host):
            return "no load report", "yellow"
        words, style = ("leads", "bold") if host.has(Role.RCM) else ("alive", "")
        return (f"{words}, cordoned", "yellow") if name in self.fleet_view.placer.cordoned else (words, style)

    def _devices(self, chosen: Selection) -> Table:
        """Return the table of health and figures: of devices with remarks; with `every` of all that report figures."""
        known, broken = self.devices.known(), booked.broken(self.booked)
        noted = {view.rc: list(remarks(view)) for view in (self.state.rcs if self.state is not None else ())}
        rows, styles = [], []
        for rc in filter(chosen.shows, sorted(known.keys() | noted.keys() | broken.keys())):
            device, words = known.get(rc), noted.get(rc, [])
            figures = device.figures if device is not None else {}
            if device is not None and device.health != "ok":
                words = words if words and words[0].startswith(device.health) else [device.health, *words]
            report = f"broken: {broken[rc]}" if rc in broken else ""
            words = [*filter(None, (unwell(device), report)), *words]
            if frozen := figures.get("frozen_seconds"):
                words = [*words, f"frozen: the same picture for {span(frozen)}"]
            if words or (self.every and figures):
                rows.append((rc, "; ".join(words) or "ok", figures_text(figures)))
                styles.append("red" if words else "")
        return Table("Health", ("DEVICE", "HEALTH", "FIGURES"), rows, styles)

    def as_object(self) -> dict[str, Any]:
        """Durations in seconds, memory in bytes. rcm: null if no node leads. advisory: rights are listed and not
        enforced. rights: hosts by the digest of the rights that they enforce. own_rights: the digest of this fleet
        file. faults: reasons that hosts use older settings than their files have. unrecorded: reasons that recorders of
        hosts write nothing. ending: certificates that expire soon. clocks: differences of hosts' clocks from fleet
        time. booked_soon: dates of bookings within 24 h."""
        chosen, versions = self.selection(), self._versions()
        state, homes, now = chosen.state, self._homes(), self.fleet_view.mesh.now()
        holds, views, queue = (state.holds, state.rcs, state.queue) if state is not None else ([], [], [])
        known = self.devices.known()

        def rc_object(view: RcView) -> dict[str, Any]:
            device = known.get(view.rc)
            holders = [hold for hold in holds if view.rc in hold.needs]
            return structs.asdict(view) | {
                "host": homes.get(view.rc),
                "holders": [
                    {"arc": hold.arc, "id": hold.id, "client": hold.client, "who": hold.who} for hold in holders
                ],
                "health": device.health if device is not None else None,
                "unwell": device.unwell if device is not None else None,
                "figures": device.figures if device is not None else {},
                "capacity": device.capacity if device is not None else {},
            }

        return {
            "fleet": self.fleet_view.client.fleet.name,
            "version": VERSION,
            "versions": [{"version": known or None, "hosts": hosts} for known, hosts in by_version(versions).items()],
            "links": self.fleet_view.mesh.links(),
            "advisory": self._advisory(),
            "rights": [{"digest": digest, "hosts": hosts} for digest, hosts in self.fleet_view.rights().items()],
            "own_rights": self._own_rights(),
            "faults": self.fleet_view.faults(),
            "unrecorded": self.fleet_view.unrecorded(),
            "ending": [{"name": name, "ends_in": left} for name, left in self.fleet_view.ending().items()],
            "clocks": self._clocks(),
            "booked_soon": booked.soon(self.booked),
            "rcm": None if state is None else {"host": state.host, "term": state.term, "seq": state.seq},
            "rcs": list(map(rc_object, views)),
            "holds": list(map(structs.asdict, holds)),
            "queue": list(map(structs.asdict, queue)),
            "more": state.more if state is not None else 0,
            "shares": self._shares(),
            "hosts": [self._host_object(name, host, now) for name, host in chosen.hosts.items()],
        }

    def _host_object(self, name: str, host: Host, now: Ns) -> dict[str, Any]:
        return {
            "host": name,
            "leads": host.has(Role.RCM),
            "node": host.has(Role.NODE),
            "candidate": host.has(Role.CANDIDATE),
            "rcs": sorted(token.name for token in host.tokens if token.role == Role.RC),
            "clients": sorted({token.name for token in host.tokens if token.role == Role.CLIENT}),
            "components": host.components,
            "cordoned": name in self.fleet_view.placer.cordoned,
            "alive": bool(host.tokens),
            "gone": None if host.gone is None else (now - host.gone) / SECOND,
            "stale": self.fleet_view.stale(host),
            "load": None if host.load is None else structs.asdict(host.load),
            "age": None if host.load is None else (now - host.reported) / SECOND,
        }


def shares(charged: Mapping[str, float], weights: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return the recent contended usage by group in RC-seconds; the group to be served next comes first."""
    total = sum(charged.values())
    found = [
        {"group": group, "charged": had, "part": had / total if total else 0.0, "weight": weights.get(group, 1.0)}
        for group, had in charged.items()
    ]
    return sorted(found, key=lambda share: (share["charged"] / share["weight"], share["group"]))


def shares_table(found: Sequence[Mapping[str, Any]]) -> Table:
    rows = [
        (share["group"], f"{share['charged']:,.0f}", f"{100 * share['part']:.1f} %", f"{share['weight']:g}")
        for share in found
    ]
    return Table("Shares", ("GROUP", "DEVICE-SECONDS", "PART", "WEIGHT"), rows)


def versions(hosts: Mapping[str, Host], devices: Mapping[str, RcState], state: RcmState | None) -> dict[str, str]:
    """Return the version of each host's node; empty if the node is too old to publish it."""
    loads = {name: host.load for name, host in hosts.items() if host.has(Role.LOAD)}
    found = {name: load.version for name, load in loads.items() if load is not None}
    # An RC without a version may be foreign.
    found |= {device.host: device.version for device in devices.values() if device.version}
    return found | ({} if state is None else {state.host: state.version})


def by_version(versions: Mapping[str, str]) -> dict[str, list[str]]:
    return {
        version: sorted(host for host in versions if versions[host] == version) for version in sorted(versions.values())
    }


def mixture(versions: Mapping[str, str]) -> str | None:
    """Return a warning if versions of nodes and this program differ."""
    if set(versions.values()) <= {VERSION}:
        return None
    parts = [f"{version_words(version)} on {_some(hosts)}" for version, hosts in by_version(versions).items()]
    return f"they differ: {'; '.join(parts)}; this zscout is {VERSION}"


def differing(own: str, rights: Mapping[str, list[str]]) -> list[str]:
    """Return warnings about hosts that enforce other rights than the own fleet file has."""
    copy = "copy the fleet file to all hosts, and reload their nodes (SIGHUP)"
    if own and len(rights) == 1 and own not in rights:
        return [f"all hosts enforce other roles than this fleet file; take theirs, or {copy}"]
    others = {digest: hosts for digest, hosts in rights.items() if digest != own}
    return [f"{_some(hosts)}: enforces other roles than this fleet file; {copy}" for hosts in others.values()]


def _some(hosts: Sequence[str]) -> str:
    more = len(hosts) - MAX_NAMED
    return ", ".join(hosts[:MAX_NAMED]) + (f" and {more} more" if more > 0 else "")


def running(
    state: RcmState, operator_priority: int, *, plain: bool, maintained: Collection[str] = frozenset()
) -> Table:
    """Return the table of holds. maintained: devices in maintenance, whose holds end with their minimum runtimes."""
    rows, styles = [], []
    for hold in sorted(state.holds, key=lambda hold: (-hold.priority, -hold.held)):
        since = f"{clock(-hold.held)} ({span(hold.held)})"
        until = f"{clock(hold.remaining)} ({span(hold.remaining)})"
        if hold.waits is not None:
            until = starting(hold.waits)
        elif hold.keep:
            then = "keeps" if hold.needs.keys().isdisjoint(maintained) else "ends"
            until = f"{until}, {then}" if hold.remaining > 0 else "kept"
        if hold.ends_in is not None:
            until = f"{until}, likely {clock(hold.ends_in)}"
        by, more = _by(hold, plain=plain)
        rows.append((hold.arc, by, str(hold.priority), since, until, "\n".join(sorted(hold.needs)), more))
        styles.append("bold red" if hold.priority >= operator_priority else "")
    head, last = ("REQUEST", "CLIENT") if plain else ("RUNNING REQUEST", "COMMENT")
    columns, spare = (
        (head, "WHO", "PRIORITY", "SINCE", "UNTIL", "DEVICES", last),
        (last, "SINCE", "PRIORITY", "DEVICES", "WHO"),
    )
    return Table("Running", columns, rows, styles, spare, beneath={"DEVICES", "WHO", last})


def waiting(state: RcmState, ranks: Mapping[str, int], *, plain: bool) -> Table:
    """In rank order, with the place in the whole queue."""
    rows = []
    for wait in state.queue:
        number = ranks[f"{wait.client}/{wait.id}"]
        starts = "?" if wait.starts_in is None else f"{clock(wait.starts_in)} (in {span(wait.starts_in)})"
        spans = (f"{clock(-wait.waited)} ({span(wait.waited)})", span(float(wait.min_runtime)), starts)
        by, more = _by(wait, plain=plain)
        why = reason_text(wait.reason, wait.why)
        rows.append((str(number), wait.arc, by, str(wait.priority), *spans, str(wait.preemptions), why, more))
    rest = f", and {state.more} more" if state.more else ""
    head, last = ("REQUEST", "CLIENT") if plain else (f"WAITING REQUEST{rest}", "COMMENT")
    columns = ("#", head, "WHO", "PRIORITY", "SINCE", "RUNTIME", "STARTS", "PREEMPTED", "WHY", last)
    # Rows are in rank order: a narrow terminal can leave out priority and age.
    spare = ("WHY", last, "PREEMPTED", "RUNTIME", "SINCE", "PRIORITY", "WHO")
    return Table(f"Waiting{rest}", columns, rows, spare=spare, beneath={"WHY", "WHO", last})


def _by(view: HoldView | WaitView, *, plain: bool) -> tuple[str, str]:
    """Return WHO and the last column: the comment at a terminal, else the client."""
    if plain:
        return whose(view) + comment(view.who), view.client
    words = view.who.comment if view.who is not None else ""
    return person(view.who, view.client), f'"{words}"' if words else ""


def _doing(host: Host) -> str:
    parts = ["node"] if host.has(Role.NODE) else []
    parts += ["recorder"] if host.has(Role.RECORDER) else []
    rcs, components = sum(token.role == Role.RC for token in host.tokens), host.components
    parts += [many(rcs, "device")] if rcs else []
    # Components are clients too, named `<component>.<incarnation>`, and are listed below.
    named = [token.name.rpartition(".") for token in host.tokens if token.role == Role.CLIENT]
    clients = sum(not (number.isdigit() and component in components) for component, _, number in named)
    parts += [many(clients, "client")] if clients else []
    parts += components[:MAX_NAMED]
    parts += [f"{len(components) - MAX_NAMED} more components"] if len(components) > MAX_NAMED else []
    return ",\n".join(parts)


def figures_text(figures: Mapping[str, float]) -> str:
    """Format the figures that are not 0: `frames_per_second=9.8, opened=1`."""
    parts = []
    for name, value in figures.items():
        if value:
            whole = value == round(value) and abs(value) < 1e15
            parts.append(f"{name}={round(value) if whole else format(value, '.4g')}")
    rest = len(parts) - MAX_FIGURES_SHOWN
    return ", ".join(parts[:MAX_FIGURES_SHOWN]) + (f", {rest} more" if rest > 0 else "")
