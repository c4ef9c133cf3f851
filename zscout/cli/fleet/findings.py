"""What `zscout doctor` makes of what it saw: why there is no link, no leader, no device. Pure."""

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
    """One line: what is `about`, whether it is `ok`, a `note`, or something to `mend`, and then how."""

    about: str
    state: Literal["ok", "note", "mend"]
    says: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.says}; {self.remedy}" if self.remedy else self.says


@dataclass(slots=True)
class Evidence:
    """All that was found out. What could not be looked at is None, or empty."""

    at: datetime
    host: str = ""
    """In whose name it was looked: this host's or person's."""
    file: str = ""
    """That says how; empty: there is none."""
    fleet: Fleet | None = None
    node: Node | None = None
    bad: list[tuple[str, BadInput]] = field(default_factory=list)
    """About what, and what is wrong with it."""
    certificates: Certificates | None = None
    seals: bool = False
    """Whether the key by which managers seal places is there."""
    interfaces: Mapping[str, str] = field(default_factory=dict)
    """Those that multicast would use, with why it can't."""
    heard: Sequence[Heard] = ()
    answers: Sequence[Called] = ()
    """Of the addresses under `connect`, and of those that were heard."""
    plain: Mapping[str, Collection[str]] = field(default_factory=dict)
    """Hosts with nodes on the network without TLS, by fleet."""
    unjoined: str | None = None
    """Why the mesh could not be joined."""
    links: int | None = None
    """None: it was not joined."""
    relays: int = 0
    """Of the links, those to one."""
    hosts: Mapping[str, Host] = field(default_factory=dict)
    state: RcmState | None = None
    devices: Mapping[str, RcState] = field(default_factory=dict)
    clock_kept: bool | None = None
    """Whether something keeps this host's clock."""
    clocks: Mapping[str, float] = field(default_factory=dict)
    """By how many seconds hosts' clocks are ahead of fleet time, where they differ by more than 2."""


def findings(seen: Evidence) -> list[Finding]:
    found = [_bad(about, error) for about, error in seen.bad]
    if seen.fleet is None:
        return [*found, *_clock(seen)]
    network = (_security, _multicast, _called, _links, _site)
    parts = (_files, _certificate, *network, _leader, _devices, _hosts, _clock, _open)
    return [*found, *(one for part in parts for one in part(seen))]


def _bad(about: str, error: BadInput) -> Finding:
    says, _, remedy = str(error).partition("; ")
    return Finding(about, "mend", says, remedy)


def _the_fleet(seen: Evidence) -> Fleet:
    assert seen.fleet is not None  # noqa: S101 - looked at by `findings`
    return seen.fleet


def _files(seen: Evidence) -> Iterator[Finding]:
    by = seen.file or "no file is named: the default"
    yield Finding("files", "ok", f"fleet {_the_fleet(seen).name} ({by}), looked at as {seen.host}")


def _certificate(seen: Evidence) -> Iterator[Finding]:
    fleet, own = _the_fleet(seen), seen.certificates
    if own is None or any(about == "certificate" for about, _ in seen.bad):
        return
    ranks = fleet.access.ranks_of(own.name)
    if not ranks:
        says = f"{own.cert}: {own.name} has no role in fleet {fleet.name}"
        yield Finding("certificate", "mend", says, "name it under [roles] of the fleet file, on all hosts")
    elif _shut_out(seen):
        says = f"{many(seen.links or 0, 'link')}, and nobody of fleet {fleet.name} is seen by {own.name}"
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
    """Whether its certificate is taken, and its name may not see anybody."""
    refused = any(one.objection for one in seen.answers)  # a link that is refused lives for a moment
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
            yield Finding("multicast", "mend", "it is off, and `connect` names nobody: no host finds another", remedy)
        else:
            yield Finding("multicast", "note", "it is off: only the hosts under `connect` are found")
        return
    works = [name for name, problem in seen.interfaces.items() if not problem]
    where = f"{mesh.multicast_address} on {_listed(works)}"
    if not works:
        why = (
            "; ".join(f"{name}: {problem}" for name, problem in seen.interfaces.items()) or "no interface is up for it"
        )
        remedy = "mend `interface` under [mesh] or the network, or name hosts under connect"
        remedy += "; until then this host works alone, and joins the others by itself" * (not seen.interfaces)
        yield Finding("multicast", "note" if linked else "mend", f"it is not possible here ({why})", remedy)
    elif not seen.heard:
        remedy = (
            "start zscout-node; if one runs: same multicast_address and network? A firewall lets UDP "
            f"{mesh.multicast_address.rpartition(':')[2]} through? Else name hosts under connect"
        )
        yield Finding("multicast", "note" if linked else "mend", f"nobody is heard at {where}", remedy)
    else:
        here = sum(one.here for one in seen.heard)
        heard = f"{len(seen.heard)} {'process' if len(seen.heard) == 1 else 'processes'}"
        yield Finding(
            "multicast", "ok", f"{heard} heard at {where}, {here} of them here, {len(seen.heard) - here} elsewhere"
        )


def _called(seen: Evidence) -> Iterator[Finding]:
    """The addresses that files name, and who is not heard as it says."""
    fleet = _the_fleet(seen)
    named = [one for one in seen.answers if one.address in fleet.mesh.connect]
    # Of a host that is seen to run one of its own addresses is no matter: it may well listen at another.
    own = [one for one in named if not one.speaks and (one.here or _host_in(one.address) == seen.host)]
    if own and not (seen.host in seen.hosts and seen.hosts[seen.host].has(Role.NODE)):
        says = f"this host's node does not run ({own[0].address}: {own[0].problem})"
        yield Finding("connect", "mend", says, "start zscout-node here")
    for one in named:
        if one in own:
            continue
        if not one.speaks:
            remedy = "is the host up, does zscout-node run and listen there, does a firewall let it through?"
            yield Finding("connect", "mend", f"{one.address}: {one.problem}", remedy)
        elif one.speaks == "plain" and one.address.startswith("tls/"):
            remedy = "give that host the fleet file with [security], and restart its node"
            yield Finding("connect", "mend", f"{one.address}: answers without TLS", remedy)
        elif one.speaks == "tls" and one.address.startswith("tcp/"):
            remedy = f"write tls/ there, and [security] ({SECURE})"
            yield Finding("connect", "mend", f"{one.address}: takes TLS only", remedy)


def _host_in(address: str) -> str:
    """The name in it, without its domain."""
    return address.partition("/")[2].rpartition(":")[0].partition(".")[0]


def _security(seen: Evidence) -> Iterator[Finding]:
    fleet = _the_fleet(seen)
    closed = [one for one in seen.answers if one.speaks == "tls"]
    # Two fleets on one network, of which one is secured, are well: it is told whose hosts they are by their names.
    members = {*fleet.access.ranks, *fleet.candidates, *fleet.devices}
    if fleet.security is None:
        ours = sorted({one.certificate.name for one in closed if one.certificate and one.certificate.name in members})
        names = ours or sorted({one.certificate.name if one.certificate else one.address for one in closed})
        if closed and (ours or not (seen.hosts or seen.plain.get(fleet.name))):
            says = f"{_listed(names)} {_take(names)} TLS only, and this host's files have no [security]"
            yield Finding("security", "mend", says, f"use the files of the secured fleet ({SECURE})")
        elif closed:
            yield Finding("security", "note", f"another fleet here is secured: {_listed(names)}")
        return
    if mixed := sorted(seen.plain.get(fleet.name, ())):
        says = f"{_listed(mixed)} {'runs' if len(mixed) == 1 else 'run'} fleet {fleet.name} without certificates"
        yield Finding("security", "mend", says, "give them the fleet file with [security], and restart their nodes")
    if (own := seen.certificates) is None:  # why is told already, and whom they trust is not known
        return
    for (name, issuer), addresses in _by_name(one for one in closed if not one.trusted):
        says = f"{name} ({addresses[0]}) shows a certificate of {issuer}, and {CA} trusts {', '.join(own.trusted)}"
        if name in members:
            yield Finding("security", "mend", says, f"issue both by one CA, or put both CAs into {CA} ({SECURE})")
        else:
            yield Finding("security", "note", f"another fleet here is secured: {name} ({addresses[0]}), by {issuer}")
    for one in {one.certificate.name: one for one in closed if one.trusted and one.certificate is not None}.values():
        yield from _member(one.address, one.certificate, one.objection, seen)  # type: ignore[arg-type]


def _member(address: str, certificate: Validity, objection: str, seen: Evidence) -> Iterator[Finding]:
    """A host whose certificate is of a CA of ours."""
    name = f"{certificate.name} ({address})"
    if seen.at >= certificate.ends:
        says = f"the certificate of {name} expired on {shown(certificate.ends)}"
        yield Finding("security", "mend", says, "renew it (zscout cert renew), and restart its node if that is alone")
    elif seen.at < certificate.begins:
        says = f"the certificate of {name} is valid from {shown(certificate.begins)} on"
        yield Finding("security", "mend", says, "set the clocks of this host and of the CA's (timedatectl)")
    elif objection and not any(about == "certificate" for about, _ in seen.bad):
        says = f"{name} refuses this certificate: {objection}"
        yield Finding("security", "mend", says, f"is its {CA} that of this CA, is its clock right?")


def _by_name(answers: Iterable[Called]) -> list[tuple[tuple[str, str], list[str]]]:
    found = defaultdict[tuple[str, str], list[str]](list)
    for one in answers:
        name = one.certificate.name if one.certificate is not None else "somebody"
        found[name, one.issuer or "an unknown CA"].append(one.address)
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
        remedy = "mend the fleet's name in the file, or start zscout-node with it"
        yield Finding("links", "mend", f"nobody is seen of fleet {fleet.name}, and of others: {known}", remedy)
    elif seen.links and fleet.security is None:
        says = f"{many(seen.links, 'link')}, and nobody of fleet {fleet.name} is seen through them"
        yield Finding("links", "mend", says, "is the fleet's name the same there?")
    else:
        yield Finding("links", "mend", "no link to anybody", "mend what stands above, or start zscout-node")
    if here and others:
        yield Finding("links", "note", f"other fleets on this network: {known}")


def _site(seen: Evidence) -> Iterator[Finding]:
    """A relay links only to those whose `site` it names, and refuses the others without a word."""
    fleet = _the_fleet(seen)
    if fleet.mesh.relay:
        return
    if (site := fleet.mesh.site) is not None:
        if seen.relays:
            yield Finding("site", "ok", f"site {site}, linked to {many(seen.relays, 'relay')}")
        elif seen.links and not _shut_out(seen):
            remedy = "does zscout-relay run, is it under connect, does its `relay` name this site?"
            yield Finding("site", "mend", f"no relay is linked: this host sees its own site only ({site})", remedy)
        return
    heard = {address: one for one in seen.heard if one.relay for address in one.addresses}
    called = [one.address for one in seen.answers if one.address in heard and one.trusted]
    ours = [*fleet.access.roles.relay, *called, *(one for one in fleet.mesh.connect if one in heard)]
    if names := ours or [one.addresses[0] for one in heard.values() if one.addresses][:1]:
        whose = "" if ours else " if it is this fleet's,"
        says = f"no `site` is set, so no link to the relay ({names[0]}):{whose} this host sees its own site only"
        yield Finding("site", "mend" if ours else "note", says, "set `site` under [mesh] as the relay's file names it")


def _leader(seen: Evidence) -> Iterator[Finding]:
    fleet = _the_fleet(seen)
    if seen.links is None or _shut_out(seen):
        return
    leads = sorted(name for name, host in seen.hosts.items() if host.has(Role.RCM))
    # One that the file does not name leads nobody.
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
        yield Finding("leader", "mend", f"nobody leads, though {_listed(could)} could", remedy)
    elif fleet.candidates:
        says = f"nobody leads: of the candidates {_listed(fleet.candidates)} none is seen"
        yield Finding("leader", "mend", says, "start zscout-node on one of them, with this fleet's file")
        return
    else:
        says = "nobody leads: no host is seen that may"
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
            yield Finding("devices", "mend", f"{rc} at {device.host} is lost: {device.health}", "mend the device")
        elif words := unwell(device):
            yield Finding("devices", "note", f"{rc} is {words}", "wait, or mend the device")
        elif view is not None and not view.present:
            remedy = "is its node linked to the leader's? See the log of both"
            yield Finding("devices", "mend", f"{rc}: {absence(view) or 'its leader does not see it'}", remedy)
        else:
            well += 1
        stand_by = {*view.duplicates, view.host} if view is not None and view.duplicates else set[str]()
        if len(at := sorted(offered[rc] | stand_by)) > 1:
            meant = f", and {view.host} is meant" if view is not None and view.host else ""
            remedy = "unless the others are substitutes, remove it from their node files"
            yield Finding("devices", "note", f"{rc} is offered by {_listed(at)}{meant}", remedy)
        for other in view.unseen if view is not None else ():
            remedy = "is it up, is the network cut in two? If it has the device no more, it is forgotten after a day"
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
        yield Finding("devices", "ok", f"{many(well, 'device')} there and well")


def _hosts(seen: Evidence) -> Iterator[Finding]:
    reports = {name: host.load for name, host in sorted(seen.hosts.items()) if host.load is not None}
    own = seen.certificates.name if seen.certificates is not None and seen.certificates.soon(seen.at) else ""
    for name, report in reports.items():
        if report.renew and name != own:
            yield _ends_soon(name, report.certificate_ends_in or 0.0)
    told = versions(seen.hosts, seen.devices, seen.state)
    if (words := mixture(told)) is not None:
        yield Finding("versions", "note", words, "upgrade what is old, and use new settings then")
    elif told:
        yield Finding("versions", "ok", f"all run {VERSION}, as this command does")


def _clock(seen: Evidence) -> Iterator[Finding]:
    if seen.clock_kept:
        yield Finding("clock", "ok", "this host's clock is kept")
    elif seen.clock_kept is False:
        says = f"nothing keeps this host's clock, which says {shown(seen.at)}"
        needs = "dates of bookings, the journal and certificates go by it"
        yield Finding("clock", "note", says, f"{needs}; start a time service (timedatectl)")
    for host, ahead in sorted(seen.clocks.items()):
        yield Finding("clock", "note", clock_words(host, ahead), "set it (timedatectl)")


def _open(seen: Evidence) -> Iterator[Finding]:
    fleet = _the_fleet(seen)
    if fleet.security is None:
        roles = "roles are advisory and " if fleet.access.ranks else ""
        says = f"a plain mesh: {roles}whoever reaches it can drive every device and end every hold"
        yield Finding("open", "note", says, f"{SECURE} closes it")


def _take(names: Sequence[str]) -> str:
    return "takes" if len(names) == 1 else "take"


def _listed(names: Sequence[str]) -> str:
    rest = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + (f" and {rest} more" if rest > 0 else "")
