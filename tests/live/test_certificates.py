"""Zenoh's sessions take the certificates that `zscout cert` makes, and no others. Two bare sessions at a time."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.hang import HANG
from tests.live.closed import DAY, make_authority, raw_session
from tests.live.test_closed_doors import tls
from zscout.config.certificate_authority import CertificateAuthority

pytestmark = pytest.mark.live


def now() -> datetime:
    return datetime.now(UTC)


@pytest.fixture
def ca(tmp_path: Path) -> CertificateAuthority:
    return make_authority(tmp_path / "ca")


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def session(stack: ExitStack, folder: Path, **more: Any) -> zenoh.Session:
    """One with the certificate in this folder, and these settings besides; `__` stands for `/`."""
    settings = {
        "mode": "peer",
        "adminspace/enabled": True,
        "scouting/multicast/enabled": False,
        "transport/link/protocols": ["tls"],
        "transport/link/tls": tls(folder) | {"close_link_on_expiration": False},
    }
    return stack.enter_context(raw_session(settings | {key.replace("__", "/"): value for key, value in more.items()}))


def listening(stack: ExitStack, folder: Path) -> tuple[zenoh.Session, str]:
    """One that listens, and where."""
    one = session(stack, folder, listen__endpoints=["tls/127.0.0.1:0"])
    (reply,) = one.get(f"@/{one.zid()}/peer")
    assert reply.ok is not None
    (locator,) = json.loads(reply.ok.payload.to_string())["locators"]
    return one, locator


def dial(stack: ExitStack, folder: Path, locator: str) -> zenoh.Session:
    """One that tries once to make a link. Raises ZError where that is refused."""
    once = {"connect__timeout_ms": 0, "connect__exit_on_failure": True}
    return session(stack, folder, listen__endpoints=[], connect__endpoints=[locator], **once)


def await_(true: Callable[[], object]) -> None:
    deadline = time.monotonic() + HANG
    while not true():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def names(one: zenoh.Session) -> set[str]:
    """The common names of those whom it has links with."""
    return {str(link.auth_identifier) for link in one.info.links()}


def test_what_is_renewed_in_place_is_used_for_the_next_link(
    ca: CertificateAuthority, stack: ExitStack, tmp_path: Path
) -> None:
    ca.issue("anvil", tmp_path / "anvil", DAY, now())
    ca.issue("ada", tmp_path / "ada", DAY, now() - 2 * DAY)
    anvil, locator = listening(stack, tmp_path / "anvil")
    with pytest.raises(zenoh.ZError):
        dial(stack, tmp_path / "ada", locator)
    # It goes on trying.
    retry = {"period_init_ms": 20, "period_max_ms": 50, "period_increase_factor": 1.0}
    session(stack, tmp_path / "ada", listen__endpoints=[], connect__endpoints=[locator], connect__retry=retry)
    assert not anvil.info.links()
    ca.renew(tmp_path / "ada", DAY, now())
    await_(lambda: names(anvil) == {"ada"})


def test_of_two_cas_in_one_file_either_is_trusted(ca: CertificateAuthority, stack: ExitStack, tmp_path: Path) -> None:
    new = make_authority(tmp_path / "new-ca")
    with (ca.folder / "ca.pem").open("a") as file:
        file.write((new.folder / "ca.pem").read_text())
    CertificateAuthority.read(ca.folder, now()).issue("anvil", tmp_path / "anvil", DAY, now())
    new.issue("ada", tmp_path / "ada", DAY, now())
    anvil, locator = listening(stack, tmp_path / "anvil")
    with pytest.raises(zenoh.ZError):
        dial(stack, tmp_path / "ada", locator)  # trusts the new one alone
    (tmp_path / "ada" / "ca.pem").write_text((ca.folder / "ca.pem").read_text())
    ada = dial(stack, tmp_path / "ada", locator)
    await_(lambda: (names(anvil), names(ada)) == ({"ada"}, {"anvil"}))
