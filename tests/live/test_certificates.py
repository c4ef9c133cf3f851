"""Zenoh's sessions take the certificates that `zscout cert` makes, and no others. Two bare sessions at a time."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.hang import HANG
from zscout.config.certificate_authority import CertificateAuthority
from zscout.config.certificates import read_certificates

pytestmark = pytest.mark.live

DAY = timedelta(days=1)
ENDPOINT = "tls/127.0.0.1:0"


def now() -> datetime:
    return datetime.now(UTC)


def authority(folder: Path) -> CertificateAuthority:
    CertificateAuthority.make(folder, 9 * DAY, now())
    return CertificateAuthority.read(folder, now())


@pytest.fixture
def ca(tmp_path: Path) -> CertificateAuthority:
    return authority(tmp_path / "ca")


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def session(stack: ExitStack, folder: Path, **more: Any) -> zenoh.Session:
    """One with the certificate in this folder, and these settings besides; `__` stands for `/`."""
    found = read_certificates(folder)
    settings = {
        "mode": "peer",
        "adminspace/enabled": True,
        "scouting/multicast/enabled": False,
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": str(found.ca),
            "listen_certificate": str(found.cert),
            "listen_private_key": str(found.key),
            "connect_certificate": str(found.cert),
            "connect_private_key": str(found.key),
            "enable_mtls": True,
            "verify_name_on_connect": False,
            "close_link_on_expiration": False,
        },
        **{key.replace("__", "/"): value for key, value in more.items()},
    }
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return stack.enter_context(zenoh.open(config))


def listening(stack: ExitStack, folder: Path) -> tuple[zenoh.Session, str]:
    """One that listens, and where."""
    one = session(stack, folder, listen__endpoints=[ENDPOINT])
    (reply,) = one.get(f"@/{one.zid()}/peer")
    assert reply.ok is not None
    (locator,) = json.loads(reply.ok.payload.to_string())["locators"]
    return one, locator


def dial(stack: ExitStack, folder: Path, locator: str) -> zenoh.Session:
    """One that tries once to make a link. Raises ZError where that is refused."""
    return session(
        stack,
        folder,
        listen__endpoints=[],
        connect__endpoints=[locator],
        connect__timeout_ms=0,
        connect__exit_on_failure=True,
    )


def await_(true: Callable[[], object]) -> None:
    deadline = time.monotonic() + HANG
    while not true():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def names(one: zenoh.Session) -> set[str]:
    """The common names of those whom it has links with."""
    return {str(link.auth_identifier) for link in one.info.links()}


def test_sessions_of_one_ca_link_and_tell_each_others_names(
    ca: CertificateAuthority, stack: ExitStack, tmp_path: Path
) -> None:
    for name in ("anvil", "ada"):
        ca.issue(name, tmp_path / name, DAY, now())
    anvil, locator = listening(stack, tmp_path / "anvil")
    ada = dial(stack, tmp_path / "ada", locator)
    await_(lambda: (names(anvil), names(ada)) == ({"ada"}, {"anvil"}))


@pytest.mark.parametrize("listens", [True, False])
@pytest.mark.parametrize("what", ["another CA's", "expired"])
def test_one_of_another_ca_and_an_expired_one_get_no_link_either_way(
    what: str, listens: bool, ca: CertificateAuthority, stack: ExitStack, tmp_path: Path
) -> None:
    ca.issue("anvil", tmp_path / "anvil", DAY, now())
    if what == "expired":
        ca.issue("ada", tmp_path / "ada", DAY, now() - 2 * DAY)
    else:
        authority(tmp_path / "other").issue("ada", tmp_path / "ada", DAY, now())
    first, second = ("ada", "anvil") if listens else ("anvil", "ada")
    there, locator = listening(stack, tmp_path / first)
    with pytest.raises(zenoh.ZError):
        dial(stack, tmp_path / second, locator)
    assert not there.info.links()


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
    new = authority(tmp_path / "new-ca")
    with (ca.folder / "ca.pem").open("a") as file:
        file.write((new.folder / "ca.pem").read_text())
    CertificateAuthority.read(ca.folder, now()).issue("anvil", tmp_path / "anvil", DAY, now())
    new.issue("ada", tmp_path / "ada", DAY, now())
    anvil, locator = listening(stack, tmp_path / "anvil")
    with pytest.raises(zenoh.ZError):
        dial(stack, tmp_path / "ada", locator)  # trusts the new one alone
    (tmp_path / "ada" / "ca.pem").write_text((ca.folder / "ca.pem").read_text())
    dial(stack, tmp_path / "ada", locator)
    await_(lambda: names(anvil) == {"ada"})
