"""What `zscout doctor` makes of what it saw."""

from __future__ import annotations

import re
from collections.abc import Collection
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from msgspec.structs import replace

from zscout.cli.fleet.findings import Evidence, Finding, findings
from zscout.cli.fleet.fleet_view import Host
from zscout.config.access import AccessPolicy, Roles
from zscout.config.certificates import Certificates, Validity
from zscout.config.devices import ExclusiveRc
from zscout.config.fleet import Fleet, MeshConfig, default_fleet
from zscout.config.node import default_node
from zscout.config.strict import BadInput, Where
from zscout.keyexpr import Role, Token
from zscout.mesh.probing import Called, Heard
from zscout.messages import LoadReport, RcmState, RcState, RcView, Unwell, version_words
from zscout.types import VERSION, Term

NOW = datetime(2026, 5, 1, 12, tzinfo=UTC)
DAY = timedelta(days=1)
YEAR = timedelta(days=365)
HERE = Heard("1", ("tcp/10.0.0.1:7447",), here=True)
ROLES = AccessPolicy(Roles(manager=("anvil", "bellows"), node={"anvil": ("robot/*",)}, client=("ada",)))
PLAIN = default_fleet()
CLOSED = replace(PLAIN, security=Path("keys"), access=ROLES)


def certificates(name: str = "ada", *, lasts: timedelta = YEAR, begun: timedelta = DAY) -> Certificates:
    return Certificates(name, NOW - begun, NOW - begun + lasts, Path("keys"), "CA one", ("CA one",))


def shown(name: str, *, begins: timedelta = -DAY, ends: timedelta = YEAR) -> Validity:
    return Validity(name, NOW + begins, NOW + ends)


def host(name: str, *roles: str, rcs: Collection[str] = (), **load: object) -> dict[str, Host]:
    tokens = {Token(name, role, "node", "1") for role in roles} | {Token(name, Role.RC, rc, "1") for rc in rcs}
    report = LoadReport(name, 1, 4, (0.0,) * 3, 0.0, 10**9, 10**10, **load)  # type: ignore[arg-type]
    return {name: Host(tokens, report if Role.LOAD in roles else None)}


def leading(name: str = "anvil", *rcs: str, **load: object) -> dict[str, Host]:
    return host(name, Role.NODE, Role.CANDIDATE, Role.RCM, Role.LOAD, rcs=rcs, **({"version": VERSION} | load))


def led(*views: RcView, by: str = "anvil") -> RcmState:
    return RcmState(Term(3, by), 1, by, rcs=list(views), version=VERSION)


def seen(fleet: Fleet = PLAIN, **more: object) -> Evidence:
    """All is well, but for what is said otherwise."""
    known = {"interfaces": {"eth0": ""}, "heard": [HERE], "links": 1, "hosts": leading(), "state": led()}
    return Evidence(NOW, "ada", "lab.toml", fleet, clock_kept=True, **(known | more))  # type: ignore[arg-type]


def mends(one: Evidence) -> list[tuple[str, str]]:
    return [(found.about, str(found)) for found in findings(one) if found.state == "mend"]


def the_mend(one: Evidence) -> Finding:
    (found,) = [found for found in findings(one) if found.state == "mend"]
    assert found.remedy
    return found


def test_a_fleet_that_is_well_has_nothing_to_mend() -> None:
    told = [(one.about, one.state) for one in findings(seen())]
    assert told == [
        ("files", "ok"), ("multicast", "ok"), ("links", "ok"), ("leader", "ok"), ("versions", "ok"), ("clock", "ok"),
        ("open", "note"),
    ]  # fmt: skip
    closed = findings(seen(CLOSED, certificates=certificates()))
    assert [one.about for one in closed if one.state != "ok"] == []
    assert closed[0].says == "fleet zscout (lab.toml), checked as ada"
    assert closed[1].says == "keys/cert.pem: ada, by CA one, until 2027-04-30 12:00 UTC"


def test_a_bad_file_is_told_with_its_remedy_and_is_all_that_is_looked_at() -> None:
    error = Where("fleet.toml", ("mesh", "lease")).bad("is 90", "write at most 30")
    told = findings(Evidence(NOW, bad=[("files", error)], clock_kept=False))
    assert told[0] == Finding("files", "mend", "fleet.toml: mesh.lease: is 90", "write at most 30")
    assert [(one.about, one.state) for one in told[1:]] == [("clock", "note")]


def test_a_certificate_that_ends_soon_is_told_of_every_host_and_of_ones_own_once() -> None:
    hosts = leading(certificate_ends_in=86_400.0, renew=True) | host(
        "bellows", Role.NODE, Role.LOAD, certificate_ends_in=-60.0, renew=True, version=VERSION
    )
    ends = [
        "the certificate of anvil expires in 1 d; renew it (zscout cert renew)",
        "the certificate of bellows expired 1 min ago; renew it (zscout cert renew)",
    ]
    for own in (certificates("anvil", lasts=40 * DAY, begun=39 * DAY), certificates()):
        assert [words for _, words in mends(seen(CLOSED, certificates=own, seals=True, hosts=hosts))] == ends
    healthy = leading(certificate_ends_in=200 * 86_400.0)
    assert not mends(seen(CLOSED, certificates=certificates(), hosts=healthy))


def test_a_manager_without_the_key_of_places_is_told() -> None:
    assert the_mend(seen(CLOSED, certificates=certificates("anvil"))).says.startswith("keys has no places.key: ")
    assert not mends(seen(CLOSED, certificates=certificates("anvil"), seals=True))


def test_who_has_no_role_is_told_so() -> None:
    found = the_mend(seen(CLOSED, certificates=certificates("eve")))
    assert (found.about, found.says) == ("certificate", "keys/cert.pem: eve has no role in fleet zscout")


@pytest.mark.parametrize(
    ("mesh", "more", "says"),
    [
        (MeshConfig(multicast=False), {}, "it is off, and `connect` is empty: hosts can't find each other"),
        (MeshConfig(), {"interfaces": {"eth0": "Network is unreachable"}}, "(eth0: Network is unreachable)"),
        (MeshConfig(), {"interfaces": {}}, "(no interface is up for it)"),
        (MeshConfig(), {"interfaces": {}}, "; until then this host works alone, and joins the others by itself"),
        (MeshConfig(), {"heard": []}, "no process is found at 224.0.0.224:7446 on eth0"),
    ],
)
def test_without_multicast_nobody_is_found(mesh: MeshConfig, more: dict[str, object], says: str) -> None:
    alone = seen(replace(PLAIN, mesh=mesh), **more, links=0, hosts={}, state=None)
    (found,) = [one for one in findings(alone) if one.about == "multicast"]
    assert (found.state, says in str(found)) == ("mend", True)
    # Links by `connect` do without.
    linked = seen(replace(PLAIN, mesh=replace(mesh, connect=("tcp/anvil:7447",))), **more)
    assert [one.state for one in findings(linked) if one.about == "multicast"] == ["note"]


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (Called("tcp/anvil:7447", "", "Connection refused"), "tcp/anvil:7447: Connection refused"),
        (Called("tls/anvil:7447", "plain"), "tls/anvil:7447: answers without TLS"),
        (Called("tcp/anvil:7447", "tls"), "tcp/anvil:7447: takes TLS only"),
    ],
)
def test_what_stands_under_connect_is_called(answer: Called, says: str) -> None:
    fleet = replace(PLAIN, mesh=MeshConfig(connect=(answer.address,)))
    assert [one.says for one in findings(seen(fleet, answers=[answer])) if one.about == "connect"] == [says]
    # Of a process that is only heard its addresses may well be of another network.
    assert not [one for one in findings(seen(answers=[answer])) if one.about == "connect"]


def test_the_own_host_is_not_told_to_be_elsewhere() -> None:
    refused = [
        Called("tcp/anvil.lab:7447", "", "Connection refused"),
        Called("tcp/10.0.0.7:7447", "", "Connection refused", here=True),
        Called("tcp/bellows:7447", "", "no answer"),
    ]
    fleet = replace(PLAIN, mesh=MeshConfig(connect=tuple(one.address for one in refused)))

    def told(hosts: dict[str, Host]) -> list[str]:
        alone = seen(fleet, answers=refused, hosts=hosts)
        alone.host = "anvil"
        return [str(one) for one in findings(alone) if one.about == "connect"]

    own, other = told({})
    assert own == "this host's node does not run (tcp/anvil.lab:7447: Connection refused); start zscout-node here"
    assert other.startswith("tcp/bellows:7447: no answer; ")
    # One that runs may well listen at another of its addresses.
    assert told(leading()) == [other]


def test_a_plain_host_among_secured_ones_is_told_whose_they_are() -> None:
    closed = Called("tls/10.0.0.2:7447", "tls", "", shown("bellows"), "CA one")
    shut_out = seen(answers=[closed], links=0, hosts={}, state=None)
    about, words = mends(shut_out)[0]
    assert about == "security"
    assert words.startswith("bellows takes TLS only, and this host's files have no [security]; use the files of ")
    # Where the own fleet is plain, and there, it is another one; unless its name is one of the own hosts.
    other = seen(answers=[closed])
    assert not mends(other)
    assert "another fleet here is secured: bellows" in [one.says for one in findings(other)]
    half = seen(replace(PLAIN, candidates=("anvil", "bellows")), answers=[closed])
    assert ("security", "bellows takes TLS only") in [(about, words.partition(",")[0]) for about, words in mends(half)]


def test_plain_hosts_of_a_secured_fleet_are_named() -> None:
    mixed = seen(CLOSED, certificates=certificates(), plain={"zscout": {"bellows", "anvil"}, "lab": {"x"}})
    found = the_mend(mixed)
    assert (found.about, found.says) == ("security", "anvil, bellows run fleet zscout without certificates")


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (
            Called("tls/b:1", "tls", "", shown("bellows"), "CA two"),
            "bellows (tls/b:1) shows a certificate of CA two, and ca.pem trusts CA one",
        ),
        (
            Called("tls/b:1", "tls", "", shown("bellows", ends=-DAY), "CA one", trusted=True),
            "the certificate of bellows (tls/b:1) expired on 2026-04-30 12:00 UTC",
        ),
        (
            Called("tls/b:1", "tls", "", shown("bellows", begins=DAY), "CA one", trusted=True),
            "the certificate of bellows (tls/b:1) is valid from 2026-05-02 12:00 UTC on",
        ),
        (
            Called("tls/b:1", "tls", "", shown("bellows"), "CA one", trusted=True, objection="unknown ca"),
            "bellows (tls/b:1) refuses this certificate: unknown ca",
        ),
    ],
)
def test_certificates_that_do_not_fit_are_told_apart(answer: Called, says: str) -> None:
    found = the_mend(seen(CLOSED, certificates=certificates(), answers=[answer, answer]))
    assert (found.about, found.says) == ("security", says)


def test_another_secured_fleet_on_the_network_is_well() -> None:
    other = Called("tls/x:1", "tls", "", shown("stranger"), "CA two")
    fits = Called("tls/b:1", "tls", "", shown("bellows"), "CA one", trusted=True)
    assert not mends(seen(CLOSED, certificates=certificates(), answers=[other, fits]))


def test_an_own_certificate_that_is_bad_is_not_told_again_by_those_who_refuse_it() -> None:
    bad = [("certificate", BadInput("keys/cert.pem: expired on x; renew it"))]
    refuses = Called("tls/b:1", "tls", "", shown("bellows"), "CA one", trusted=True, objection="certificate expired")
    shut_out = seen(CLOSED, bad=bad, certificates=certificates(), answers=[refuses], links=None, hosts={}, state=None)
    assert mends(shut_out) == [("certificate", "keys/cert.pem: expired on x; renew it")]


def test_where_keys_cannot_be_read_it_is_told_once() -> None:
    bad = [("certificate", BadInput("keys: may not be entered by this user; change its mode"))]
    foreign = [Called(f"tls/{name}:1", "tls", "", shown(name), "CA one") for name in ("anvil", "bellows", "x")]
    told = seen(CLOSED, bad=bad, answers=foreign, links=None, hosts={}, state=None)
    assert mends(told) == [("certificate", "keys: may not be entered by this user; change its mode")]
    assert not [one for one in findings(told) if one.about == "security"]


def test_a_relay_and_the_site_that_belong_together_are_told() -> None:
    north = MeshConfig(site="north")

    def told(mesh: MeshConfig, fleet: Fleet = PLAIN, **more: object) -> list[tuple[str, str]]:
        asked = seen(replace(fleet, mesh=mesh), **({"certificates": certificates()} | more))
        return [(one.state, str(one)) for one in findings(asked) if one.about == "site"]

    ((state, words),) = told(north)
    assert (state, words.partition(";")[0]) == ("mend", "no link to a relay: this host sees its own site only (north)")
    assert told(north, relays=1) == [("ok", "site north, linked to 1 relay")]
    assert not told(north, links=0)
    assert not told(north, links=None)
    assert not told(MeshConfig())
    assert not told(MeshConfig(relay=("north", "south")))

    alone = "no `site` is set, so no link to the relay"
    relay = Heard("2", ("tcp/10.0.0.9:7447",), here=False, relay=True)
    ((state, words),) = told(MeshConfig(), heard=[HERE, relay])
    assert state == "note"  # of which fleet it is can't be told
    assert words.startswith(f"{alone} (tcp/10.0.0.9:7447): if it is this fleet's, this host sees its own site only; ")
    ((state, _),) = told(MeshConfig(connect=relay.addresses), heard=[relay])
    assert state == "mend"
    gate = replace(CLOSED, access=replace(ROLES, roles=replace(ROLES.roles, relay=("gate",))))
    ((state, words),) = told(MeshConfig(), gate)
    assert (state, words.partition(";")[0]) == ("mend", f"{alone} (gate): this host sees its own site only")


def test_links_without_anybody_of_the_fleet_are_explained() -> None:
    alone: dict[str, object] = {"hosts": {}, "state": None}

    def said(fleet: Fleet, **more: object) -> str:
        (found,) = [one for one in findings(seen(fleet, **more, **alone)) if one.about == "links"]
        assert found.state == "mend"
        return str(found)

    assert said(PLAIN, links=0).startswith("no link to another process; ")
    assert said(PLAIN, links=2).startswith("2 links, but no participant of fleet zscout is seen through them; ")
    assert "no participant of fleet zscout is found; others are: lab (anvil)" in said(PLAIN, plain={"lab": {"anvil"}})
    shut_out = seen(CLOSED, links=1, certificates=certificates(), **alone)
    told = findings(shut_out)
    assert mends(shut_out)[0][1].startswith(
        "1 link, but no participant of fleet zscout is visible to ada; name it under [roles] "
    )
    assert [one.about for one in told if one.state == "mend"] == ["certificate"]
    refused = Called("tls/b:1", "tls", "", shown("bellows"), "CA one", trusted=True, objection="unknown ca")
    assert said(CLOSED, links=1, answers=[refused]).startswith("no link to another process; ")
    assert said(PLAIN, unjoined="the mesh can't be joined: x") == "the mesh can't be joined: x"


@pytest.mark.parametrize(
    ("candidates", "hosts", "says"),
    [
        ((), {}, "no leader: no host that may lead is seen"),
        (("anvil", "forge"), host("bellows", Role.NODE), "no leader: no candidate is seen (anvil, forge)"),
        (("forge",), host("anvil", Role.NODE, Role.CANDIDATE), "no leader: no candidate is seen (forge)"),
        ((), host("anvil", Role.NODE, Role.CANDIDATE), "no leader, though anvil could lead"),
        ((), host("anvil", Role.NODE, Role.CANDIDATE, Role.RCM), "anvil leads and does not answer"),
    ],
)
def test_why_nobody_leads(candidates: tuple[str, ...], hosts: dict[str, Host], says: str) -> None:
    told = findings(seen(replace(PLAIN, candidates=candidates), hosts=hosts, state=None))
    assert [one.says for one in told if one.about == "leader"] == [says]


def test_a_candidate_that_is_not_there_is_named() -> None:
    found = the_mend(seen(replace(PLAIN, candidates=("anvil", "bellows", "cart"))))
    assert (found.about, found.says) == ("leader", "bellows, cart may lead and are not there")


def view(rc: str, *, present: bool = True, **more: object) -> RcView:
    return RcView(rc, present, False, **({"host": "anvil"} | more))  # type: ignore[arg-type]


def test_devices_that_are_not_there_are_told_by_host() -> None:
    fleet = replace(PLAIN, devices={"anvil": ("robot/a", "robot/b"), "forge": ("robot/c",)})
    gone = view("robot/d", present=False, reason="the node of bellows is gone", gone=60.0, host="bellows")
    told = mends(seen(fleet, hosts=leading("anvil", "robot/a"), state=led(view("robot/a"), gone)))
    assert [words.partition(";")[0].partition(" since")[0] for _, words in told] == [
        "not there: robot/b of anvil",
        "not there: robot/d of bellows (the node of bellows is gone",
        "not there: robot/c of forge (that host is not seen either)",
    ]


def test_what_no_file_names_may_be_forgotten() -> None:
    gone = led(view("robot/d", present=False, reason="the node of dock is gone", gone=60.0, host="dock"))
    assert (
        the_mend(seen(state=gone)).remedy
        == "start zscout-node at dock, or ignore this if it was removed: it is listed for a day"
    )
    named = replace(PLAIN, devices={"dock": ("robot/d",)})
    assert the_mend(seen(named, state=gone)).remedy == "start zscout-node at dock, or remove it from [devices]"
    there = leading() | host("dock", Role.NODE, version=VERSION)
    assert the_mend(seen(hosts=there, state=gone)).remedy.endswith(
        " or ignore this if it was removed: it is listed for a day"
    )


def test_what_a_node_should_offer_is_expected_of_it() -> None:
    spec = ExclusiveRc(name="robot/a")
    node = replace(default_node(), host="anvil", rcs=(spec,))
    assert the_mend(seen(node=node)).says == "not there: robot/a of anvil"
    assert not mends(seen(node=node, hosts=leading("anvil", "robot/a"), state=led(view("robot/a"))))


def test_a_device_that_is_lost_or_double_is_told() -> None:
    state = RcState("robot/a", "anvil", "1", False, health="no such file")
    lost = seen(
        hosts=leading("anvil", "robot/a"), state=led(view("robot/a", present=False)), devices={"robot/a": state}
    )
    assert the_mend(lost).says == "robot/a at anvil is lost: no such file"
    sick = replace(state, health="ok", unwell=Unwell("it reboots", since=0.0, left=30.0))
    unwell = seen(hosts=leading("anvil", "robot/a"), state=led(view("robot/a")), devices={"robot/a": sick})
    assert not mends(unwell)
    assert any(re.match(r"robot/a is unwell since .*: it reboots; lost in 30 s", one.says) for one in findings(unwell))
    both = leading("anvil", "robot/a") | host("bellows", Role.NODE, rcs=["robot/a"])
    double = seen(hosts=both, state=led(view("robot/a", duplicates=["bellows"])))
    assert not mends(double)  # one may be a substitute
    assert "robot/a is offered by anvil, bellows, using the instance at anvil" in [one.says for one in findings(double)]
    half = seen(hosts=leading("anvil", "robot/a"), state=led(view("robot/a", unseen={"bellows": 9.0})))
    assert the_mend(half).says == "robot/a: its other host bellows is not seen"
    leaderless = findings(seen(hosts=both, state=None))
    assert "robot/a is offered by anvil, bellows" in [one.says for one in leaderless]


def test_a_mixture_of_versions_is_noted_and_nothing_to_mend() -> None:
    mixed = seen(hosts=leading() | host("bellows", Role.NODE, Role.LOAD))
    assert not mends(mixed)
    assert [(one.state, one.says) for one in findings(mixed) if one.about == "versions"] == [
        ("note", f"they differ: {version_words('')} on bellows; version {VERSION} on anvil; this zscout is {VERSION}")
    ]


@pytest.mark.parametrize(("kept", "state"), [(True, ["ok"]), (False, ["note"]), (None, [])])
def test_the_clock_is_told_where_that_is_known(kept: bool | None, state: list[str]) -> None:
    one = seen()
    one.clock_kept = kept
    assert [found.state for found in findings(one) if found.about == "clock"] == state


def test_clocks_that_differ_from_fleet_time_are_named_with_their_direction() -> None:
    one = seen()
    one.clocks = {"pi": -259_200.0, "anvil": 3.0}
    told = [str(found) for found in findings(one) if found.about == "clock" and found.state == "note"]
    assert told == [
        "the clock of anvil is 3.0 s ahead of the fleet's; set it (timedatectl)",
        "the clock of pi is 3 d behind the fleet's; set it (timedatectl)",
    ]


def test_advisory_roles_are_told_on_a_plain_mesh_only() -> None:
    def opens(fleet: Fleet) -> list[str]:
        told = findings(seen(fleet, certificates=certificates()))
        return [one.says.partition(" anyone")[0] for one in told if one.about == "open"]

    assert opens(PLAIN) == ["a plain mesh:"]
    assert opens(replace(PLAIN, access=ROLES)) == ["a plain mesh: roles are advisory and"]
    assert opens(CLOSED) == []


def test_many_names_are_cut_short() -> None:
    names = tuple(f"h{number}" for number in range(9))
    found = the_mend(seen(replace(PLAIN, candidates=("anvil", *names))))
    assert found.says == "h0, h1, h2, h3, h4, h5 and 3 more may lead and are not there"
