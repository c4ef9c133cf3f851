"""One fleet over two sites that only a relay joins: as one while it lives, two that go on by themselves while it does
not, and one again, and no hold inside a site feels either."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest

from studies.chaos.net import NoNamespaces, check, ip
from studies.sites import ALL, GATE, SITES, Fault, Sites
from tests.cli.tools import COMMAND
from tests.hang import HANG
from tests.live.lab import PATIENT
from zscout.config.certificate_authority import CertificateAuthority
from zscout.messages import RcmState
from zscout.types import SECOND, Grant

pytestmark = [pytest.mark.live, pytest.mark.slow]
SHOWN = "import ssl; print(ssl.get_server_certificate(('127.0.0.1', 7447), timeout=5))"
"""The certificate that a relay shows who links to it."""
LEASE = 5.0
"""Seconds. A site is on its own when it is over, and no process here is to stand still for so long."""
DOORS = pytest.mark.parametrize("secured", [False, True], ids=["plain", "secured"])


@pytest.fixture(autouse=True)
def _namespaces() -> None:
    try:
        check()
    except NoNamespaces as why:
        pytest.skip(str(why))


async def status(sites: Sites, site: str) -> Any:
    """What `zscout status` says at the desk of a site."""
    command = ["ip", "netns", "exec", sites.net.space(f"{site}desk"), *COMMAND, "status", "--json"]
    env = sites.env(site) | ({} if sites.secured else {"ZSCOUT_HOST": "eye"})
    done = await asyncio.to_thread(subprocess.run, command, env=env, capture_output=True, timeout=HANG, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def held(state: RcmState) -> dict[str, Grant]:
    return {view.arc: view.grant for view in state.holds}


@DOORS
async def test_one_fleet_over_two_sites_is_as_one(tmp_path: Path, secured: bool) -> None:
    gang = "robot/a2", "robot/b1"
    async with Sites(tmp_path, secured=secured, lease=PATIENT) as sites:
        for host, other in (("a1", "b1"), ("b1", "a1")):
            with pytest.raises(subprocess.CalledProcessError, match="route"):
                ip("-n", sites.net.space(host), "route", "get", sites.net.address(other, other[0]))
        here, there = await sites.program("a", "here"), await sites.program("b", "there")
        await sites.whole(here, there)
        for program in (here, there):
            await program.works("gang", *gang)
            seen = [await status(sites, site) for site in ("a", "b")]
            assert len({(one["rcm"]["host"], one["rcm"]["term"][0]) for one in seen}) == 1
            for one in seen:
                assert {rc["rc"] for rc in one["rcs"] if rc["present"]} == ALL
                assert {rc["rc"] for rc in one["rcs"] if rc["holders"]} == set(gang)
            assert not await program.works_on()
            await program.gives_back()
            await sites.sees(here, lambda state: not state.holds)


@DOORS
async def test_the_next_in_the_other_site_follows_a_holder_that_was_killed(tmp_path: Path, secured: bool) -> None:
    async with Sites(tmp_path, secured=secured, lease=PATIENT) as sites:
        for site, other in (("a", "b"), ("b", "a")):
            first, following = (await sites.program(site, f"first-{site}"), await sites.program(other, f"next-{other}"))
            await sites.whole(first, following)
            await first.works("first", "robot/a1", "robot/b2")
            await following.asks("next", "robot/a1", "robot/b2")
            await following.event("queued")
            killed = first.kill()
            # Its token's going counts at once: no lease has passed. A leader that stood still itself leaves who is
            # gone a lease to come back.
            took = await following.enters() - killed
            leaders = [(tmp_path / f"{host}.log").read_text() for host in ("a1", "b1")]
            assert took < PATIENT * SECOND or any("process stalled" in log for log in leaders)
            await following.gives_back()


async def test_what_two_relays_bring_twice_is_carried_out_once(tmp_path: Path) -> None:
    count, do = 20, {"name": "echo", "value": 1}
    sites = Sites(tmp_path, lease=PATIENT, relays=2)
    sites.log_level = "debug"
    async with sites:
        program = await sites.program("a", "across")
        await sites.whole(program)

        async def commands(number: int, **how: bool) -> None:
            for _ in range(number):
                await program.order("command", rc="robot/b1", do=do, ttl=30, **how)
                assert (await program.event("command"))["code"] == "done"

        def carried_out() -> int:
            """Under the present grant: what the second relay brings late belongs to one before."""
            ends = f'"grant":{msgspec.json.encode(program.grant).decode()}}}'
            lines = (tmp_path / "b1.log").read_text().splitlines()
            return sum('"do":"command"' in line and line.endswith(ends) for line in lines)

        async def reaches(number: int) -> None:
            async with asyncio.timeout(HANG):
                while carried_out() < number:  # noqa: ASYNC110
                    await asyncio.sleep(0.05)

        async def both_bring() -> bool:
            """Whether the question if it knows of the grant comes twice: the second relay may be there later."""
            await program.asks("across", "robot/b1")
            await program.enters()
            with suppress(TimeoutError):
                async with asyncio.timeout(5):
                    while carried_out() < 2:  # noqa: ASYNC110
                        await asyncio.sleep(0.05)
            return carried_out() == 2

        async with asyncio.timeout(HANG):
            while not await both_bring():
                await program.gives_back()
        await commands(count, anew=True)
        await reaches(2 + 2 * count)  # so it arrives twice
        await commands(count)
        await commands(1, anew=True)
        await reaches(2 + 2 * count + count + 2)
        assert carried_out() == 2 + 2 * count + count + 2


@DOORS
@pytest.mark.parametrize("fault", get_args(Fault))
async def test_each_site_leads_itself_without_the_relay_and_the_merge_ends_no_hold(
    tmp_path: Path, fault: Fault, secured: bool
) -> None:
    async with Sites(tmp_path, secured=secured, lease=LEASE) as sites:
        inside = [await sites.program(site, f"in-{site}") for site in SITES]
        late = [await sites.program(site, f"late-{site}") for site in SITES]
        across = await sites.program("a", "across")
        await sites.whole(*inside, *late, across)
        for program in inside:
            await program.works(program.name, f"robot/{program.site}1", f"robot/{program.site}2")
        await across.works("across", "robot/a3", "robot/b3")

        sites.lose_relay(fault)
        assert {(await sites.apart(program)).host for program in inside} == {"a1", "b1"}
        await across.event("queued")
        for program in late:
            await program.works(program.name, f"robot/{program.site}3")
        assert [await program.works_on() for program in inside] == [[], []]

        sites.bring_relay_back(fault)
        await sites.whole(*inside, *late, across)
        # Of a hold the RCM may hear later than of its RCs.
        kept = {program.name: program.grant for program in (*inside, *late)}
        await sites.sees(across, lambda state: held(state) == kept)
        assert [await program.works_on() for program in (*inside, *late)] == [[]] * 4

        # What needs both sites is granted when it can be.
        for program in late:
            await program.gives_back()
        await across.enters()
        stand = {one.name: one.grant for one in (*inside, across)}
        await sites.sees(across, lambda state: held(state) == stand)


async def test_a_relay_whose_certificate_is_renewed_ends_no_hold(tmp_path: Path) -> None:
    """It joins anew, and no host is linked to it for a moment."""
    async with Sites(tmp_path, secured=True, lease=LEASE) as sites:
        across = await sites.program("a", "across")
        await sites.whole(across)
        await across.works("across", "robot/a3", "robot/b3")
        now = datetime.now(UTC)
        authority = CertificateAuthority.read(tmp_path / "certificates" / "ca", now)
        authority.renew(tmp_path / "certificates" / GATE, timedelta(hours=1), now)
        look = ["ip", "netns", "exec", sites.net.space(GATE), sys.executable, "-c", SHOWN]
        fresh = (tmp_path / "certificates" / GATE / "cert.pem").read_text()
        async with asyncio.timeout(HANG):
            while True:
                shown = await asyncio.to_thread(subprocess.run, look, capture_output=True, text=True, check=False)
                if shown.stdout.split() == fresh.split():
                    break
        newcomer = await sites.program("b", "newcomer")
        await sites.whole(across, newcomer)
        await sites.sees(newcomer, lambda state: held(state) == {"across": across.grant})
