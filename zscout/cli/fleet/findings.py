"""Findings of `zscout doctor` from its evidence: reasons for a missing link, leader or device. Pure."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Final, Literal

from zscout.cli.booked import clock_words
from zscout.cli.device_words import absence, ending, unwell
from zscout.cli.fleet.status import mixture, versions
from zscout.config.certificates import CA, PLACES_KEY, Certificates, Validity, shown
from zscout.config.strict import BadInput
from zscout.keyexpr import Role
from zscout.terminal import many
from zscout.types import VERSION

if TYPE_CHECKING:
    from zscout.cli.fleet.fleet_view import Host
    from zscout.config.fleet import Fleet
    from zscout.config.node import Node
    from zscout.mesh.probing import Called, Heard
    from zscout.messages import RcmState, RcState

MAX_NAMED: Final = 6
"""Names in one line."""
SECURE: Final = "docs/how-to/secure-a-fleet.md"


@dataclass(frozen=True, slots=True)
class Finding:
    """A line of the report. State `mend`: a problem to fix."""

    about: str
    state: Literal["ok", "note", "mend"]
    says: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.says}; {self.remedy}" if self.remedy else self.says


@dataclass(slots=True)
class Evidence:
    """The evidence. Fields that could not be examined are None, or empty."""

    at: datetime
    host: str = ""
    """Name of the host or person that the checks act as."""
    file: str = ""
    """The fleet or node file; empty: none."""
    fleet: Fleet | None = None
    node: Node | None = None
    bad: list[tuple[str, BadInput]] = field(default_factory=list)
    """Errors by subject: (about, error)."""
    certificates: Certificates | None = None
    seals: bool = False
    """True if the key by which managers seal places exists."""
    interfaces: Mapping[str, str] = field(default_factory=dict)
    """Interfaces for multicast, each with its problem or ""."""
    heard: Sequence[Heard] = ()
    answers: Sequence[Called] = ()
    """Results for the addresses under `connect`, and for those of `heard`."""
    plain: Mapping[str, Collection[str]] = field(default_factory=dict)
    """Hosts with nodes on the network without TLS, by fleet."""
    unjoined: str | None = None
    """The reason that the mesh could not be joined."""
    links: int | None = None
    """None: the mesh was not joined."""
    relays: int = 0
    """Number of links to relays."""
    hosts: Mapping[str, Host] = field(default_factory=dict)
    state: RcmState | None = None
    devices: Mapping[str, RcState] = field(default_factory=dict)
    clock_kept: bool | None = None
    """True if a time service synchronizes this host's clock; None: unknown."""
    clocks: Mapping[str, float] = field(default_factory=dict)
    """Seconds by which clocks of hosts are ahead of fleet time; only differences above 2 s."""


def findings(seen: Evidence) -> list[Finding]:
    found = [_bad(about, error) for about, error in seen.bad]
    if seen.fleet is None:
        return [*found, *_clock(seen)]
    network = (_security, _multicast, _called, _links, _site)
    parts = (_files, _certificate, *network, _leader, _devices, _hosts, _clock, _open)
    return [*found, *(finding for part in parts for finding in part(seen))]


def _bad(about: str, error: BadInput) -> Finding:
    says, _, remedy = str(error).partition("; ")
    return Finding(about, "mend", says, remedy)


def _the_fleet(seen: Evidence) -> Fleet:
    assert seen.fleet is not None  # noqa: S101 - looked at by `findings`
    return seen.fleet


def _files(seen: Evidence) -> Iterator[Finding]:
    by = seen.file or "no file is named: the default"
    yield Finding("files", "ok", f"fleet {_the_fleet(seen).name} ({by}), checked as {seen.host}")


def _certificate(seen: Evidence) -> Iterator[Finding]:
    fleet, own = _the_fleet(seen), seen.certificates
    if own is None or any(about == "certificate" for about, _ in seen.bad):
        return
    ranks = fleet.access.ranks_of(own.name)
    if not ranks:
        says = f"{own.cert}: {own.name} has no role in fleet {fleet.name}"
        yield Finding("certificate", "mend", says, "name it under [roles] of the fleet file, on all hosts")
    elif _shut_out(seen):
        says = f"{many(seen.links or 0, 'link')}, but no participant of fleet {fleet.name} is visible to {own.name}"
        remedy = (
            "name it under [roles] in the files of the others (did it lose its role?); is the fleet's name the same?"
        )
        yield Finding("certificate", "mend", says, remedy)
    elif own.soon(seen.at):
        yield _ends_soon(own.name, own.ends_in(seen.at))
    else:
        yield Finding("certificate", "ok", f"{own.cert}: {own.name}, by {own.issuer}, until {shown(own.ends)}")

    if "manager" in ranks and not seen.seals:
        says = f"{own.folder} has no {PLACES_KEY}: the places that {own.name} gives, when it leads, are not sealed"
        yield Finding("certificate", "mend", says, "copy it from the CA's folder")


def _shut_out(seen: Evidence) -> bool:
    """Return True if our certificate is accepted, but its name has no right to see any participant."""
    refused = any(answer.objection for answer in seen.answers)  # a refused link exists for a moment
    secured = seen.fleet is not None and seen.fleet.security is not None
    return secured and bool(seen.links) and not refused and not any(host.tokens for host in seen.hosts.values())


def _ends_soon(name: str, left: float) -> Finding:
    return Finding("certificate", "mend", ending(name, left), "renew it (zscout cert renew)")


def _multicast(seen: Evidence) -> Iterator[Finding]:
    fleet, linked = _the_fleet(seen), bool(seen.links)
    mesh = fleet.mesh
    if not mesh.multicast:
        if not mesh.connect:
            remedy = "name hosts under connect, or remove multicast = false"
            yield Finding("multicast", "mend", "it is off, and `connect` is empty: hosts can't find each other", remedy)
        else:
            yield Finding("multicast", "note", "it is off: only the hosts under `connect` are found")
        return
    works = [name for name, problem in seen.interfaces.items() if not problem]
    where = f"{mesh.multicast_address} on {_listed(works)}"
    if not works:
        why = (
            "; ".join(f"{name}: {problem}" for name, problem in seen.interfaces.items()) or "no interface is up for it"
        )
        remedy = "correct `interface` under [mesh], fix the network, or name hosts under connect"
        remedy += "; until then this host works alone, and joins the others by itself" * (not seen.interfaces)
        yield Finding("multicast", "note" if linked else "mend", f"it is not possible here ({why})", remedy)
    elif not seen.heard:
        remedy = (
            "start zscout-node; if one runs: same multicast_address and network? A firewall lets UDP "
            f"{mesh.multicast_address.rpartition(':')[2]} through? Else name hosts under connect"
        )
        yield Finding("multicast", "note" if linked else "mend", f"no process is found at {where}", remedy)
    else:
        here = sum(process.here for process in seen.heard)
        heard = f"{len(seen.heard)} {'process' if len(seen.heard) == 1 else 'processes'}"
        yield Finding(
            "multicast", "ok", f"{heard} found at {where}, {here} of them here, {len(seen.heard) - here} elsewhere"
        )


def _called(seen: Evidence) -> Iterator[Finding]:
    fleet = _the_fleet(seen)
    named = [answer for answer in seen.answers if answer.address in fleet.mesh.connect]
    # If this host's node runs, an own address without an answer does not matter: the node may listen at another.
    own = [answer for answer in named if not answer.speaks and (answer.here or _host_in(answer.address) == seen.host)]
    if own and not (seen.host in seen.hosts and seen.hosts[seen.host].has(Role.NODE)):
        says = f"this host's node does not run ({own[0].address}: {own[0].problem})"
        yield Finding("connect", "mend", says, "start zscout-node here")
    for answer in named:
        if answer in own:
            continue
        if not answer.speaks:
            remedy = "is the host up, does zscout-node run and listen there, does a firewall let it through?"
            yield Finding("connect", "mend", f"{answer.address}: {answer.problem}", remedy)
        elif answer.speaks == "plain" and answer.address.startswith("tls/"):
            remedy = "give that host the fleet file with [security], and restart its node"
            yield Finding("connect", "mend", f"{answer.address}: answers without TLS", remedy)
        elif answer.speaks == "tls" and answer.address.startswith("tcp/"):
            remedy = f"write tls/ there, and [security] ({SECURE})"
            yield Finding("connect", "mend", f"{answer.address}: takes TLS only", remedy)


def _host_in(address: str) -> str:
    return address.partition("/")[2].rpartition(":")[0].partition(".")[0]


def _security(seen: Evidence) -> Iterator[Finding]:
    fleet = _the_fleet(seen)
    closed = [answer for answer in seen.answers if answer.speaks == "tls"]
    # A secured fleet beside another on one network is no problem: the names tell apart whose hosts they are.
    members = {*fleet.access.ranks, *fleet.candidates, *fleet.devices}
    if fleet.security is None:
        ours = sorted(
            {answer.certificate.name for answer in closed if answer.certificate and answer.certificate.name in members}
        )
        names = ours or sorted({answer.certificate.name if answer.certificate else answer.address for answer in closed})
        if closed and (ours or not (seen.hosts or seen.plain.get(fleet.name))):
            says = f"{_listed(names)} {_take(names)} TLS only, and this host's files have no [security]"
            yield Finding("security", "mend", says, f"use the files of the secured fleet ({SECURE})")
        elif closed:
            yield Finding("security", "note", f"another fleet here is secured: {_listed(names)}")
        return
    if mixed := sorted(seen.plain.get(fleet.name, ())):
        says = f"{_listed(mixed)} {'runs' if len(mixed) == 1 else 'run'} fleet {fleet.name} without certificates"
        yield Finding("security", "mend", says, "give them the fleet file with [security], and restart their nodes")
    if (own := seen.certificates) is None:  # reported already; the trusted CAs are unknown
        return
    for (name, issuer), addresses in _by_name(answer for answer in closed if not answer.trusted):
        says = f"{name} ({addresses[0]}) shows a certificate of {issuer}, and {CA} trusts {', '.join(own.trusted)}"
        if name in members:
            yield Finding("security", "mend", says, f"issue both by one CA, or put both CAs into {CA} ({SECURE})")
        else:
            yield Finding("security", "note", f"another fleet here is secured: {name} ({addresses[0]}), by {issuer}")
    for answer in {
        answer.certificate.name: answer for answer in closed if answer.trusted and answer.certificate is not None
    }.values():
        yield from _member(answer.address, answer.certificate, answer.objection, seen)  # type: ignore[arg-type]


def _member(address: str, certificate: Validity, objection: str, seen: Evidence) -> Iterator[Finding]:
    name = f"{certificate.name} ({address})"
    if seen.at >= certificate.ends:
        says = f"the certificate of {name} expired on {shown(certificate.ends)}"
        yield Finding(
            "security", "mend", says, "renew it (zscout cert renew); if its node is cut off, restart the node"
        )
    elif seen.at < certificate.begins:
        says = f"the certificate of {name} is valid from {shown(certificate.begins)} on"
        yield Finding("security", "mend", says, "set the clocks of this host and of the CA's (timedatectl)")
    elif objection and not any(about == "certificate" for about, _ in seen.bad):
        says = f"{name} refuses this certificate: {objection}"
        yield Finding("security", "mend", says, f"has its {CA} this CA, is its clock right?")


def _by_name(answers: Iterable[Called]) -> list[tuple[tuple[str, str], list[str]]]:
    found = defaultdict[tuple[str, str], list[str]](list)
    for answer in answers:
        name = answer.certificate.name if answer.certificate is not None else "an unnamed host"
        found[name, answer.issuer or "an unknown CA"].append(answer.address)
    return sorted(found.items())


def _links(seen: Evidence) -> Iterator[Finding]:
    fleet = _the_fleet(seen)
    if seen.unjoined is not None:
        yield Finding("links", "mend", seen.unjoined)
        return
    if seen.links is None or _shut_out(seen):
        return
    others = {name: hosts for name, hosts in seen.plain.items() if name != fleet.name}
    known = _listed([f"{name} ({_listed(sorted(hosts))})" for name, hosts in sorted(others.items())])
    here = [name for name, host in seen.hosts.items() if host.tokens]
    if here:
        yield Finding("links", "ok", f"{many(seen.links, 'link')}; seen: {_listed(here)}")
    elif others and fleet.security is None:
        remedy = "correct the fleet's name in the file, or start zscout-node with it"
        yield Finding("links", "mend", f"no participant of fleet {fleet.name} is found; others are: {known}", remedy)
    elif seen.links and fleet.security is None:
        says = f"{many(seen.links, 'link')}, but no participant of fleet {fleet.name} is seen through them"
        yield Finding("links", "mend", says, "is the fleet's name the same there?")
    else:
        yield Finding("links", "mend", "no link to another process", "fix the problems above, or start zscout-node")
    if here and others:
        yield Finding("links", "note", f"other fleets on this network: {known}")


def _site(seen: Evidence) -> Iterator[Finding]:
    """A relay links only to processes whose `site` it names, and refuses others silently."""
    fleet = _the_fleet(seen)
    if fleet.mesh.relay:
        return
    if (site := fleet.mesh.site) is not None:
        if seen.relays:
            yield Finding("site", "ok", f"site {site}, linked to {many(seen.relays, 'relay')}")
        elif seen.links and not _shut_out(seen):
            remedy = "does zscout-relay run, is it under connect, does its `relay` name this site?"
            yield Finding("site", "mend", f"no link to a relay: this host sees its own site only ({site})", remedy)
        return
    heard = {address: relay for relay in seen.heard if relay.relay for address in relay.addresses}
    called = [answer.address for answer in seen.answers if answer.address in heard and answer.trusted]
    ours = [*fleet.access.roles.relay, *called, *(address for address in fleet.mesh.connect if address in heard)]
    if names := ours or [relay.addresses[0] for relay in heard.values() if relay.addresses][:1]:
        whose = "" if ours else " if it is this fleet's,"
        says = f"no `site` is set, so no link to the relay ({names[0]}):{whose} this host sees its own site only"
        yield Finding("site", "mend" if ours else "note", says, "set `site` under [mesh] as the relay's file names it")


def _leader(seen: Evidence) -> Iterator[Finding]:
    fleet = _the_fleet(seen)
    if seen.links is None or _shut_out(seen):
        return
    leads = sorted(name for name, host in seen.hosts.items() if host.has(Role.RCM))
    # A candidate that the file does not name never leads.
    named = {*(fleet.candidates or seen.hosts)}
    could = sorted(name for name, host in seen.hosts.items() if host.has(Role.CANDIDATE) and name in named)
    missing = [name for name in fleet.candidates if name not in could]
    if seen.state is not None:
        yield Finding("leader", "ok", f"{seen.state.host} leads, term {seen.state.term.counter}")
    elif leads:
        remedy = "is it overloaded, is a link one way only? See the log of zscout-node there"
        yield Finding("leader", "mend", f"{_listed(leads)} leads and does not answer", remedy)
    elif could:
        remedy = "see the log of zscout-node there; is each linked to all others?"
        yield Finding("leader", "mend", f"no leader, though {_listed(could)} could lead", remedy)
    elif fleet.candidates:
        says = f"no leader: no candidate is seen ({_listed(fleet.candidates)})"
        yield Finding("leader", "mend", says, "start zscout-node on one of them, with this fleet's file")
        return
    else:
        says = "no leader: no host that may lead is seen"
        yield Finding("leader", "mend", says, "start zscout-node on a host, without candidate = false")
        return
    if missing:
        says = f"{_listed(missing)} may lead and {'is' if len(missing) == 1 else 'are'} not there"
        yield Finding("leader", "mend", says, "start zscout-node there, or remove it from `candidates`")


def _devices(seen: Evidence) -> Iterator[Finding]:
    if seen.links is None or _shut_out(seen):
        return
    offered = defaultdict[str, set[str]](set)
    for name, host in seen.hosts.items():
        for token in host.tokens:
            if token.role == Role.RC:
                offered[token.name].add(name)
    views = {view.rc: view for view in (seen.state.rcs if seen.state is not None else ())}
    homes = {rc: host for host, rcs in _the_fleet(seen).devices.items() for rc in rcs}
    files = dict.fromkeys(homes, "remove it from [devices]")
    if seen.node is not None:
        homes |= {rc.name: seen.node.host for rc in seen.node.rcs}
        files |= dict.fromkeys((rc.name for rc in seen.node.rcs), "remove its [[rc]] table")
    missing = defaultdict[tuple[str, str, str], list[str]](list)
    well = 0
    for rc in sorted({*homes, *offered, *views}):
        view, device = views.get(rc), seen.devices.get(rc)
        if rc not in offered and (view is None or not view.present):
            home = homes.get(rc) or (view.host if view is not None else "")
            else_do = files.get(rc, "ignore this if it was removed: it is listed for a day")
            missing[home, absence(view) if view is not None else "", else_do].append(rc)
        elif device is not None and device.health != "ok":
            yield Finding("devices", "mend", f"{rc} at {device.host} is lost: {device.health}", "repair the device")
        elif words := unwell(device):
            yield Finding("devices", "note", f"{rc} is {words}", "wait, or repair the device")
        elif view is not None and not view.present:
            remedy = "is its node linked to the leader's? See the log of both"
            yield Finding("devices", "mend", f"{rc}: {absence(view) or 'its leader does not see it'}", remedy)
        else:
            well += 1
        stand_by = {*view.duplicates, view.host} if view is not None and view.duplicates else set[str]()
        if len(at := sorted(offered[rc] | stand_by)) > 1:
            meant = f", using the instance at {view.host}" if view is not None and view.host else ""
            remedy = "unless the others are substitutes, remove it from their node files"
            yield Finding("devices", "note", f"{rc} is offered by {_listed(at)}{meant}", remedy)
        for other in view.unseen if view is not None else ():
            remedy = "is it up, is the network cut in two? If it no longer has the device, it is forgotten after a day"
            yield Finding("devices", "mend", f"{rc}: its other host {other} is not seen", remedy)
    for (home, why, else_do), rcs in sorted(missing.items()):
        there = home in seen.hosts and seen.hosts[home].has(Role.NODE)
        why = why or ("" if there else "that host is not seen either")
        remedy = f"start zscout-node at {home or 'the host that has it'}"
        if there:
            remedy = f"see the log of zscout-node at {home}: has its file these [[rc]] tables?"
        says = f"not there: {_listed(rcs)} of {home or 'no known host'}" + (f" ({why})" if why else "")
        yield Finding("devices", "mend", says, f"{remedy}{'' if there else ','} or {else_do}")
    if well and not missing:
        yield Finding("devices", "ok", f"{many(well, 'device')} present and working")


def _hosts(seen: Evidence) -> Iterator[Finding]:
    reports = {name: host.load for name, host in sorted(seen.hosts.items()) if host.load is not None}
    own = seen.certificates.name if seen.certificates is not None and seen.certificates.soon(seen.at) else ""
    for name, report in reports.items():
        if report.renew and name != own:
            yield _ends_soon(name, report.certificate_ends_in or 0.0)
    running = versions(seen.hosts, seen.devices, seen.state)
    if (words := mixture(running)) is not None:
        yield Finding("versions", "note", words, "upgrade the older ones before you use new settings")
    elif running:
        yield Finding("versions", "ok", f"all run {VERSION}, like this command")


def _clock(seen: Evidence) -> Iterator[Finding]:
    if seen.clock_kept:
        yield Finding("clock", "ok", "this host's clock is synchronized")
    elif seen.clock_kept is False:
        says = f"this host's clock is not synchronized; it shows {shown(seen.at)}"
        needs = "bookings, the journal and certificates depend on it"
        yield Finding("clock", "note", says, f"{needs}; start a time service (timedatectl)")
    for host, ahead in sorted(seen.clocks.items()):
        yield Finding("clock", "note", clock_words(host, ahead), "set it (timedatectl)")


def _open(seen: Evidence) -> Iterator[Finding]:
    fleet = _the_fleet(seen)
    if fleet.security is None:
        roles = "roles are advisory and " if fleet.access.ranks else ""
        says = f"a plain mesh: {roles}anyone who reaches it can drive every device and end every hold"
        yield Finding("open", "note", says, f"{SECURE} closes it")


def _take(names: Sequence[str]) -> str:
    return "takes" if len(names) == 1 else "take"


def _listed(names: Sequence[str]) -> str:
    rest = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + (f" and {rest} more" if rest > 0 else "")
