"""`zscout doctor` beside real nodes: each cause is told, above what comes of it, by who is shut out as well."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh
from msgspec.structs import replace

from tests.cli.tools import COMMAND, zscout_soon
from tests.hang import HANG
from tests.live.closed import DAY, ClosedLab, make_authority
from tests.live.lab import Lab, awaited
from tests.live.test_closed_doors import bare, tls
from tests.ports import free_port
from zscout.config.certificates import KEYS_VARIABLE, read_cas
from zscout.keyexpr import Role
from zscout.mesh.zenoh_mesh import zenoh_config

pytestmark = pytest.mark.live


class Told(NamedTuple):
    code: int
    host: str
    findings: list[dict[str, str]]

    def of(self, about: str) -> list[tuple[str, str]]:
        return [(one["state"], one["says"]) for one in self.findings if one["about"] == about]

    def mends(self) -> list[str]:
        return [one["says"] for one in self.findings if one["state"] == "mend"]


async def doctor(lab: Lab, *words: object, **env: object) -> Told:
    done = await zscout_soon("doctor", "--json", *words, env=lab.env | {name: str(one) for name, one in env.items()})
    assert (done.returncode, done.stderr) in ((0, ""), (1, "")), done
    told = json.loads(done.stdout)
    found = Told(done.returncode, told["host"], told["findings"])
    assert bool(found.code) == bool(found.mends())
    assert all(one["remedy"] for one in found.findings if one["state"] == "mend")
    return found


async def told_that(lab: Lab, so: Callable[[Told], bool], *words: object, **env: object) -> Told:
    """Asks until it is so: on a busy machine who is called may not answer in time."""
    return await awaited(lambda: doctor(lab, *words, **env), so)


async def told_of(lab: Lab, about: str, pattern: str, *words: object, **env: object) -> Told:
    """Asks until something like this is said."""
    return await told_that(
        lab, lambda told: any(re.fullmatch(pattern, says) for _, says in told.of(about)), *words, **env
    )


async def mends(lab: Lab, wanted: list[str], *words: object, **env: object) -> Told:
    """Asks until this is to be mended, and nothing else."""
    return await told_that(lab, lambda told: told.mends() == wanted, *words, **env)


async def shown(lab: ClosedLab, name: str, *hosts: str) -> None:
    """Waits until these nodes are seen by this person, who leaves then."""
    client = await lab.person(name)
    await lab.living(client, Role.LOAD, lambda found: set(found) >= set(hosts))
    lab.clients.remove(client)
    await client.close()


def plain_file(lab: Lab) -> Path:
    """The fleet file, as on a host that does not know of certificates."""
    file = lab.folder / "plain.toml"
    file.write_text(re.sub(r"\[security\]\nfolder = .*\n", "", lab.fleet_file.read_text()))
    return file


@pytest.mark.slow
async def test_a_fleet_that_is_well_is_told_to_be(lab: Lab) -> None:
    lab.node("anvil", "robot/a")
    await lab.begun()
    told = await mends(lab, [])
    assert told.code == 0
    assert told.of("leader") == [("ok", "anvil leads, term 1")]
    assert told.of("devices") == [("ok", "1 device present and working")]
    assert [state for state, _ in told.of("open")] == ["note"]


@pytest.mark.slow
async def test_a_device_on_two_hosts_is_told_of(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("anvil",), extra='[devices]\nanvil = ["robot/a"]') as lab:
        lab.node("anvil", "robot/a")
        client = await lab.begun()
        lab.node("bellows", "robot/a")
        await lab.state(client, lambda state: [view.duplicates for view in state.rcs] == [["bellows"]])
        both = "robot/a is offered by anvil, bellows, using the instance at anvil"
        told = await told_of(lab, "devices", both)
        assert told.of("devices")[0] == ("note", both)


@pytest.mark.slow
async def test_why_nobody_leads_is_told_and_what_a_node_should_offer_is_missed(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("forge",)) as lab:
        lab.node("anvil", "robot/a")
        client = await lab.client()
        await lab.living(client, Role.RC, lambda found: found == ["anvil"])
        nobody = "no leader: no candidate is seen (forge)"
        await mends(lab, [nobody])
        file = lab.folder / "cart.toml"
        file.write_text('[node]\nhost = "cart"\nfleet = "fleet.toml"\n[[rc]]\nname = "robot/c"\ndriver = "exclusive"')
        told = await mends(lab, [nobody, "not there: robot/c of cart (that host is not seen either)"], file)
        assert told.host == "cart"
        file.write_text(file.read_text().replace("exclusive", "none-such"))
        missing, nobody, *_ = (await doctor(lab, file)).mends()
        assert missing == f'{file}: rc[0].driver (robot/c): no driver "none-such" is installed here'
        assert nobody.startswith("no leader")  # it joins all the same


@pytest.mark.slow
async def test_beside_a_node_that_listens_where_the_file_says_commands_listen_elsewhere(lab: Lab) -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    text = lab.fleet_file.read_text()
    lab.fleet_file.write_text(
        text.replace("[mesh]\n", f'[mesh]\nlisten = ["{address}"]\nconnect = ["{address}"]\nmulticast = false\n')
    )
    says = f"this host's node does not run ({address}: Connection refused)"
    assert (await doctor(lab)).of("connect") == [("mend", says)]
    lab.node("anvil", "robot/a")
    await lab.logged("anvil", "is on the mesh")
    told = await told_of(lab, "leader", "anvil leads, term 1", lab.folder / "anvil.toml")
    assert told.code == 0
    assert told.of("multicast") == [("note", "it is off: only the hosts under `connect` are found")]
    done = await lab.zscout("status")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
async def test_a_relay_that_is_not_linked_is_told(lab: Lab) -> None:
    plain = lab.fleet_file.read_text()
    lab.fleet_file.write_text(plain.replace("[mesh]\n", '[mesh]\nsite = "north"\n'))
    lab.node("anvil", "robot/a")
    await lab.logged("anvil", "is on the mesh")
    alone = r"no link to a relay: this host sees its own site only \(north\)"
    assert (await told_of(lab, "site", alone)).code == 1
    with zenoh.open(zenoh_config(replace(lab.fleet.mesh, relay=("north", "south")))):
        assert (await told_of(lab, "site", "site north, linked to 1 relay")).code == 0
        file = lab.folder / "nowhere.toml"
        file.write_text(plain)
        lost = r"no `site` is set, so no link to the relay \(tcp/.*\): if it is this fleet's, .*"
        assert (await told_of(lab, "site", lost, ZSCOUT_FLEET=file)).code == 0


@pytest.mark.slow
async def test_whose_role_is_taken_away_is_told_first(tmp_path: Path, lab: ClosedLab) -> None:
    before = lab.folder / "before.toml"
    before.write_text(lab.fleet_file.read_text())
    lab.fleet_file.write_text(before.read_text().replace('"ada"', ""))
    lab.node("anvil")
    await shown(lab, "bob", "anvil")
    keys = tmp_path / "keys" / "ada"
    unseen = f"1 link, but no participant of fleet {lab.fleet.name} is visible to ada"
    told = await told_of(lab, "certificate", unseen, ZSCOUT_KEYS=keys, ZSCOUT_FLEET=before)
    assert told.mends() == [unseen]
    told = await doctor(lab, ZSCOUT_KEYS=keys)
    assert told.mends() == [f"{keys}/cert.pem: ada has no role in fleet {lab.fleet.name}"]


@pytest.mark.slow
async def test_another_name_of_the_fleet_is_told(lab: Lab) -> None:
    lab.node("anvil", "robot/a")
    await lab.ready(await lab.client(), "robot/a")
    other = lab.folder / "other.toml"
    other.write_text(lab.fleet_file.read_text().replace(lab.fleet.name, "typo"))
    others = rf"no participant of fleet typo is found; others are: {lab.fleet.name} \(anvil\)"
    assert (await told_of(lab, "links", others, ZSCOUT_FLEET=other)).code == 1


@pytest.mark.slow
async def test_a_plain_host_and_a_secured_fleet_are_told_of_each_other(tmp_path: Path, lab: ClosedLab) -> None:
    lab.node("anvil", "robot/a")
    await shown(lab, "ada", "anvil")
    well = await mends(lab, [], ZSCOUT_KEYS=tmp_path / "keys" / "ada")
    assert (well.code, well.host) == (0, "ada")
    plain = plain_file(lab)
    told = await told_of(lab, "security", "anvil takes TLS only, .* have no .security.", ZSCOUT_FLEET=plain)
    assert told.of("links")[0][0] == "mend"

    cart = lab.folder / "cart.toml"
    cart.write_text(f'[node]\nhost = "cart"\nfleet = "{plain.name}"')
    lab.spawn([sys.executable, "-m", "zscout.node", str(cart)], log="cart.log")
    await lab.logged("cart", "is on the mesh")
    mixed = f"cart runs fleet {lab.fleet.name} without certificates"
    told = await told_of(lab, "security", mixed, ZSCOUT_KEYS=tmp_path / "keys" / "ada")
    assert told.mends() == [mixed]
    # Each is well by itself.
    assert told.of("leader")[0][0] == "ok"


@pytest.mark.slow
async def test_certificates_of_another_ca_are_told_by_both_sides_and_expired_ones(
    tmp_path: Path, lab: ClosedLab
) -> None:
    keys, now = tmp_path / "keys", datetime.now(UTC)
    lab.node("anvil")
    await shown(lab, "ada", "anvil")
    (ours,) = (one.name for one in read_cas(keys / "ca" / "ca.pem"))
    make_authority(tmp_path / "other").issue("bob", tmp_path / "bob", DAY, now)
    foreign = rf"anvil \(tls/.*\) shows a certificate of {ours}, and ca.pem trusts zscout CA \w+"
    await told_of(lab, "security", foreign, ZSCOUT_KEYS=tmp_path / "bob")
    # Who trusts both still is refused.
    with (tmp_path / "bob" / "ca.pem").open("a") as file:
        file.write((keys / "ada" / "ca.pem").read_text())
    refused = r"anvil \(tls/.*\) refuses this certificate: unknown ca"
    told = await told_of(lab, "security", refused, ZSCOUT_KEYS=tmp_path / "bob")
    assert told.of("links") == [("mend", "no link to another process")]

    lab.authority.issue("eve", keys / "late", timedelta(seconds=1), now - DAY)
    told = await doctor(lab, ZSCOUT_KEYS=keys / "late")
    assert len(told.mends()) == 1
    assert told.of("certificate")[0][1].startswith(f"{keys}/late/cert.pem: expired on ")
    assert not told.of("links")

    lab.authority.issue("bench", keys / "early", DAY, now - 2 * DAY)
    with bare(lab, tls=tls(keys / "early")):
        ended = r"the certificate of bench \(tls/.*\) expired on .*"
        told = await told_of(lab, "security", ended, ZSCOUT_KEYS=keys / "ada")
    assert len(told.mends()) == 1


@pytest.mark.slow
async def test_a_name_that_is_not_the_certificates_is_told_before_joining(tmp_path: Path, lab: ClosedLab) -> None:
    file = lab.folder / "bench.toml"
    file.write_text('[node]\nhost = "bench"\nfleet = "fleet.toml"\n[security]\nfolder = "keys/anvil"')
    told = await doctor(lab, file)
    keys = tmp_path / "keys" / "anvil"
    assert told.of("certificate") == [
        ("mend", f'{keys}/cert.pem: is the certificate of "anvil", but this host is "bench"')
    ]
    assert not told.of("links")
    lab.node("cart")
    await lab.logged("cart", "is on the mesh")
    (keys / "key.pem").chmod(0o644)
    await mends(lab, [f"{keys}/key.pem: may be read by others (644)"], file)
    (keys / "ca.pem").chmod(0o666)
    await mends(lab, [f"{keys}/ca.pem: may be written by others (666)"], file)


@pytest.mark.slow
async def test_status_and_doctor_warn_of_every_certificate_that_ends_soon(tmp_path: Path, lab: ClosedLab) -> None:
    for name in ("anvil", "ada"):  # of ten hours one is left
        lab.authority.issue(name, tmp_path / "keys" / name, DAY * 10 / 24, datetime.now(UTC) - DAY * 9 / 24)
    lab.node("anvil")
    lab.node("cart")
    await shown(lab, "bob", "anvil", "cart")
    env = lab.env | {KEYS_VARIABLE: str(tmp_path / "keys" / "ada")}
    done = await lab.zscout("status", env=env)
    _, warnings = done.stdout.split("\nWarnings\n")
    said = [line.split("  ") for line in warnings.split("\n\n")[0].splitlines()[1:]]
    assert [(about, words.partition(" expires in ")[0]) for about, words in said] == [
        ("certificate", "the certificate of anvil"),
        ("certificate", "the certificate of ada"),
    ]
    state = json.loads((await lab.zscout("status", "--json", env=env)).stdout)
    assert [one["name"] for one in state["ending"]] == ["anvil", "ada"]
    assert all(3000 < one["ends_in"] <= 3600 for one in state["ending"])
    assert state["advisory"] is False
    ending = ["the certificate of ada", "the certificate of anvil"]
    await told_that(
        lab,
        lambda told: [says.partition(" expires in ")[0] for says in told.mends()] == ending,
        **{KEYS_VARIABLE: env[KEYS_VARIABLE]},
    )
    await lab.logged("anvil", "renew it (zscout cert renew)")


@pytest.mark.slow
async def test_status_says_that_roles_are_advisory_where_nothing_proves_a_name(tmp_path: Path) -> None:
    async with Lab(tmp_path, extra='[roles]\nmanager = ["anvil"]\nclient = ["bob"]') as lab:
        lab.node("anvil")
        await lab.ready(await lab.client())
        done = await lab.zscout("status")
        assert "roles  they are only advisory; set [security] to prove names" in done.stdout
        assert json.loads((await lab.zscout("status", "--json")).stdout)["advisory"] is True


@pytest.fixture
def nowhere() -> tuple[str, ...]:
    """Runs a command on a host without a network."""
    words = ("unshare", "--net")
    if shutil.which(words[0]) is None or subprocess.run([*words, "true"], capture_output=True, check=False).returncode:
        pytest.skip("a network namespace of one's own needs root and util-linux")
    return words


@pytest.mark.slow
def test_without_a_network_multicast_is_told_to_be_impossible(tmp_path: Path, nowhere: tuple[str, ...]) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text('[mesh]\nconnect = ["tcp/10.83.0.1:7447"]')
    env = os.environ | {"ZSCOUT_FLEET": str(file)}
    done = subprocess.run(
        [*nowhere, *COMMAND, "doctor"], env=env, capture_output=True, text=True, timeout=HANG, check=False
    )
    assert (done.returncode, done.stderr) == (1, "")
    lines = done.stdout.splitlines()
    assert "it is not possible here (no interface is up for it); " in lines[2]
    assert "tcp/10.83.0.1:7447: Network is unreachable; " in lines[3]
    assert [line.split()[1] for line in lines[4:6]] == ["links", "leader"]


@contextmanager
def doctoring(lab: Lab) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([*COMMAND, "doctor"], env=lab.env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
async def test_interrupted_it_leaves_nothing(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("forge",)) as lab:
        lab.node("anvil")
        client = await lab.client()
        seen = asyncio.Event()
        client.mesh.watch(
            client.mesh.keys.alive_any(Role.CLIENT), lambda token, _: seen.set() if "doctor" in token.name else None
        )
        with doctoring(lab) as process:
            async with asyncio.timeout(HANG):
                await seen.wait()
            process.send_signal(signal.SIGINT)
            out, _ = await asyncio.to_thread(process.communicate, timeout=HANG)
            assert (process.returncode, out) == (130, b"")
        await lab.living(client, Role.CLIENT, lambda found: len(found) == 1)
