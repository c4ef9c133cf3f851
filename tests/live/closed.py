"""A fleet with certificates: its CA, who has which role, and sessions of whoever tries to come in."""

from __future__ import annotations

import asyncio
import json
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import zenoh
from msgspec.structs import replace

from tests.hang import HANG
from tests.live.lab import Lab, PatientClient
from zscout.config.certificate_authority import CertificateAuthority
from zscout.config.fleet import Fleet

ROLES = """
[security]
folder = "keys/anvil"
[roles]
manager = ["anvil", "bench"]
operator = ["ada"]
client = ["bob", "eve"]
viewer = ["wall"]
[roles.node]
anvil = ["robot/*"]
cart = ["radio/*"]
"""
NAMES = ("anvil", "bench", "cart", "ada", "bob", "eve", "wall")
MANAGERS = ("anvil", "bench")
DAY = timedelta(days=1)


def make_authority(folder: Path) -> CertificateAuthority:
    CertificateAuthority.make(folder, DAY, datetime.now(UTC))
    return CertificateAuthority.read(folder, datetime.now(UTC))


def make_keys(folder: Path, *names: str, managers: Sequence[str] = MANAGERS) -> CertificateAuthority:
    """A CA, and a certificate for each name, in folders of their names."""
    authority = make_authority(folder / "ca")
    for name in names:
        authority.issue(name, folder / name, DAY, datetime.now(UTC), manager=name in managers)
    return authority


class ClosedLab(Lab):
    """Nodes and people of one fleet with certificates, and the roles that the test says."""

    own_rights = True

    def __init__(self, folder: Path, *, roles: str = ROLES, lease: float | None = None) -> None:
        super().__init__(folder, extra=roles, lease=lease)
        self.authority = make_keys(folder / "keys", *NAMES)

    def node(self, host: str, *rcs: str, extra: str = "") -> subprocess.Popen[bytes]:
        return super().node(host, *rcs, extra=f'{extra}\n[security]\nfolder = "keys/{host}"')

    async def stop(self) -> None:
        """Ends all clients and nodes in order."""
        for client in self.clients:
            await client.close()
        for node in self.nodes.values():
            node.terminate()
        for node in self.nodes.values():
            await asyncio.to_thread(node.wait, HANG)
        self.clients.clear()
        self.nodes.clear()

    def fleet_of(self, name: str) -> Fleet:
        return replace(self.fleet, security=self.folder / "keys" / name)

    async def person(self, name: str, client: str | None = None) -> PatientClient:
        """A program of this person."""
        made = await PatientClient.connect(client, fleet=self.fleet_of(name))
        self.clients.append(made)
        return made


@contextmanager
def raw_session(settings: dict[str, object]) -> Iterator[zenoh.Session]:
    """A bare Zenoh session with these settings."""
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session
