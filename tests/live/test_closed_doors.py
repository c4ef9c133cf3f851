"""Who gets in where a fleet has certificates, and what each role may send on each key: tried by bare sessions."""

from __future__ import annotations

import asyncio
import functools
import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final, Self

import pytest
import zenoh

from tests.hang import HANG
from tests.live.closed import DAY, ClosedLab, make_authority, raw_session
from tests.mesh.kit import until
from tests.protocol_pages import read_page
from zscout.config.certificate_authority import CertificateAuthority
from zscout.config.certificates import read_certificates
from zscout.keyexpr import ACCESS, Keys, Sender
from zscout.mesh import ZenohMesh, zenoh_mesh
from zscout.mesh.zenoh_mesh import Security, zenoh_config

pytestmark = pytest.mark.live

DOCUMENT: Final = read_page("access")


def tls(folder: Path, *, own: bool = True) -> dict[str, Any]:
    """Zenoh's settings for a session with the certificate of this folder, or only its CA."""
    settings: dict[str, Any] = {"root_ca_certificate": str(folder / "ca.pem"), "verify_name_on_connect": False}
    if own:
        for side in ("listen", "connect"):
            settings |= {
                f"{side}_private_key": str(folder / "key.pem"),
                f"{side}_certificate": str(folder / "cert.pem"),
            }
        settings["enable_mtls"] = True
    return settings


@contextmanager
def bare(lab: ClosedLab, **settings: Any) -> Iterator[zenoh.Session]:
    """A session on the fleet's network with these settings beside those of any session; `tls` for certificates."""
    config = zenoh_config(lab.fleet.mesh)
    if "tls" in settings:
        certificates = settings.pop("tls")
        config.insert_json5("transport/link/tls", json.dumps(certificates))
        config.insert_json5("listen/endpoints", '["tls/127.0.0.1:0"]' if "listen_certificate" in certificates else "[]")
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


class Inside:
    """Two members of a fleet that has certificates, in this process."""

    def __init__(self, lab: ClosedLab) -> None:
        self.lab = lab
        self.meshes: list[ZenohMesh] = []

    async def join(self, name: str) -> ZenohMesh:
        """Joins, and waits for the links to the members that are there."""
        mesh = await ZenohMesh.open(self.lab.fleet_of(name), Sender(name, "node"))
        self.meshes.append(mesh)
        await until(lambda: mesh.links() >= len(self.meshes) - 1, within=HANG)
        return mesh

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        for mesh in self.meshes:
            await mesh.close()


def intruders(lab: ClosedLab) -> dict[str, dict[str, Any]]:
    keys = lab.folder / "keys"
    now = datetime.now(UTC)
    make_authority(lab.folder / "other").issue("ada", lab.folder / "others", DAY, now)
    lab.authority.issue("eve", keys / "expired", timedelta(seconds=1), now - DAY)
    return {
        "plain TCP": {},
        "no certificate": {"tls": tls(keys / "ada", own=False)},
        "another CA's": {"tls": tls(lab.folder / "others") | {"root_ca_certificate": str(keys / "ada" / "ca.pem")}},
        "expired": {"tls": tls(keys / "expired")},
    }


def linked(session: zenoh.Session) -> bool:
    return bool(session.info.links())


def has_seen(session: zenoh.Session) -> list[str]:
    """The tokens that a session sees, and who answers it."""
    tokens = [str(one.ok.key_expr) for one in session.liveliness().get("**", timeout=1.0) if one.ok is not None]
    answers = [str(one.ok.key_expr) for one in session.get("zscout/**", timeout=1.0) if one.ok is not None]
    return tokens + answers


@pytest.mark.parametrize("name", ["plain TCP", "no certificate", "another CA's", "expired"])
async def test_an_intruder_has_no_link_no_token_and_no_key(lab: ClosedLab, name: str) -> None:
    async with Inside(lab) as inside:
        # Whoever joins makes the links: one member joins before the intruder, one after.
        await inside.join("anvil")
        with bare(lab, **intruders(lab)[name]) as intruder:
            mesh = await inside.join("bench")
            assert not await asyncio.to_thread(has_seen, intruder)
            assert not linked(intruder)
            # Either end may tell later than the other.
            await until(lambda: {one.links() for one in inside.meshes} == {1}, within=HANG)
            assert mesh.links() == 1


def without(settings: dict[str, Any], path: str) -> dict[str, Any]:
    """Zenoh's settings of a closed session, but this one, which is as Zenoh has it by itself."""
    table, _, key = path.partition("#")
    settings = dict(settings)
    if key:
        settings[table] = {name: value for name, value in settings[table].items() if name != key}
    else:
        del settings[table]
    return settings


@pytest.mark.parametrize(
    ("setting", "name"),
    [
        ("transport/link/protocols", "plain TCP"),
        ("transport/link/tls#enable_mtls", "no certificate"),
        ("transport/link/tls#enable_mtls", "another CA's"),
        ("transport/link/tls#enable_mtls", "expired"),
    ],
)
async def test_each_setting_keeps_somebody_out(
    lab: ClosedLab, monkeypatch: pytest.MonkeyPatch, setting: str, name: str
) -> None:
    closed = zenoh_mesh._secured
    monkeypatch.setattr(zenoh_mesh, "_secured", lambda security: without(closed(security), setting))
    async with Inside(lab) as inside:
        await inside.join("anvil")
        with bare(lab, **intruders(lab)[name]) as intruder:
            await inside.join("bench")
            await until(lambda: linked(intruder), within=HANG)


# Roles

ACTS: Final = ("asks", "answers", "publishes", "hears", "shows")
RANKS: Final = {"anvil": "manager", "cart": "node", "ada": "operator", "bob": "client", "wall": "viewer"}
CLASSES: Final = {
    "all": set(RANKS.values()),
    "users": set(RANKS.values()) - {"viewer"},
    "nodes": {"node", "manager"},
    "managers": {"manager"},
    "": set(),
}


def rows() -> list[tuple[str, dict[str, set[str]]]]:
    """The table of the protocol: each key, and which ranks may do what."""
    found = []
    for line in DOCUMENT.splitlines():
        if match := re.match(r"\| `([^`]+)` \|(.*)\|$", line):
            cells = [cell.strip() for cell in match[2].split("|")]
            found.append((match[1], {act: CLASSES[cell] for act, cell in zip(ACTS, cells, strict=True)}))
    return found


RCS: Final = {"anvil": "robot/a", "cart": "radio/r"}


def key_of(row: str, act: str, name: str, rc: str) -> str:
    """A key of that row as `name` would use it for `act`, with that RC."""
    key = row.replace("<kind>/<name>", rc).replace("/**", "/x/1").replace("/*", "/1").replace("<client>", "c1")
    asker = row.startswith(("rcm/schedule", "rcm/state/", "rcm/bookings/", "balancer/rank/", "rc/", "placer/component"))
    if key.count("<host>") == 2:
        first, last = ("other", name) if act == "asks" else (name, "other")
        return key.replace("<host>", first, 1).replace("<host>", last, 1)
    own = act == "asks" if asker else act not in ("asks", "hears") and not row.endswith("/notice")
    return key.replace("<host>", name if own else "other")


def tried(name: str, act: str) -> dict[str, bool]:
    """Keys that this member tries, and whether it may: in its own name, in another's, and for another's RCs."""
    rank, found = RANKS[name], dict[str, bool]()
    for row, may in rows():
        own = key_of(row, act, name, RCS.get(name, "robot/a"))
        for key in (key_of(row, act, "eve", RCS.get(name, "robot/a")), key_of(row, act, name, "gripper/g")):
            found[key] = rank in may[act] and (key == own or (act in ("asks", "hears") and "eve" not in key))
        found[own] = rank in may[act]
    return found


def direct(call: Callable[[Any], object]) -> Any:
    """A callback of Zenoh's own thread: what comes to several is heard in the order in which it came."""
    return zenoh.handlers.Callback(call, lambda: None, indirect=False)


class Member:
    """A bare session with somebody's certificate, on the network of a lab; `closed`: with the fleet's own rules."""

    def __init__(self, lab: ClosedLab, name: str, stack: ExitStack, *, closed: bool) -> None:
        folder, self.base = lab.folder / "keys" / name, f"zscout/{lab.fleet.name}/"
        if closed:
            fleet = lab.fleet_of(name)
            security = Security(read_certificates(folder), Keys(fleet.name, closed=True), tuple(fleet.access.members()))
            self.session = stack.enter_context(zenoh.open(zenoh_config(fleet.mesh, security)))
        else:
            self.session = stack.enter_context(bare(lab, tls=tls(folder)))
        self.live = self.session.liveliness()
        self.kept: list[object] = []

    def collects(self, declare: Callable[[Any], object]) -> set[str]:
        """The keys of what comes to a declaration."""
        keys = set[str]()

        def collect(one: Any) -> None:
            keys.add(str(one.key_expr).removeprefix(self.base))
            if isinstance(one, zenoh.Query):
                one.drop()  # type: ignore[no-untyped-call]

        self.kept.append(declare(direct(collect)))
        return keys


def awaited(seen: set[str], key: str) -> None:
    """Waits for what is sent last: all before it has come, or never will."""
    deadline = time.monotonic() + HANG
    while key not in seen:
        assert time.monotonic() < deadline, f"{key} never came"
        time.sleep(0.005)


@pytest.mark.parametrize("name", RANKS)
def test_each_role_may_send_what_the_table_says(tmp_path: Path, name: str) -> None:
    """By somebody with that role's certificate who keeps to no rule, against one who has the fleet's settings."""
    lab = ClosedLab(tmp_path)
    with ExitStack() as stack:
        inside = Member(lab, "bench", stack, closed=True)
        forger = Member(lab, name, stack, closed=False)
        base, end = inside.base, f"alive/{name}/session/end"
        tokens = inside.collects(lambda on: inside.live.declare_subscriber(f"{base}**", on, history=True))

        answers = tried(name, "answers")
        for key in answers:
            reply = functools.partial(lambda key, query: query.reply(key, b"{}"), base + key)
            forger.kept.append(forger.session.declare_queryable(base + key, reply))
        heard = set[str]()
        last = "client/last/c1/notice"
        for key in (*tried(name, "hears"), last):
            if not key.startswith("alive/"):
                forger.kept.append(
                    forger.session.declare_subscriber(
                        base + key, direct(lambda sample: heard.add(str(sample.key_expr).removeprefix(base)))
                    )
                )
        shows = tried(name, "shows")
        for key in (*(key for key in shows if key.startswith("alive/")), f"{end}/1"):
            forger.kept.append(forger.live.declare_token(base + key))
        awaited(tokens, f"{end}/1")
        assert tokens - {f"{end}/1"} == {key for key, may in shows.items() if may}
        got = {
            key
            for key in answers
            if not key.startswith("alive/") and any(one.ok is not None for one in inside.session.get(base + key))
        }
        assert got == {key for key, may in answers.items() if may}

        hears = tried(name, "hears")
        for key in (*hears, last):
            if not key.startswith("alive/"):
                inside.session.put(base + key, b"{}")
        awaited(heard, last)
        assert heard - {last} == {key for key, may in hears.items() if may and not key.startswith("alive/")}

        queries = inside.collects(lambda on: inside.session.declare_queryable(f"{base}**", on))
        puts = inside.collects(lambda on: inside.session.declare_subscriber(f"{base}**", on))
        # What the other side has declared is known here once this comes through.
        forger.kept.append(inside.live.declare_token(f"{base}alive/bench/session/begin/1"))
        while not [one for one in forger.live.get(f"{base}alive/bench/**") if one.ok is not None]:
            pass
        publishes, asks = tried(name, "publishes"), tried(name, "asks")
        for key in publishes:
            forger.session.put(base + key, b"{}")
        for key in asks:
            if not key.startswith("alive/"):
                forger.session.get(base + key, lambda _: None, timeout=HANG)
        asked_last = "recorder/last/c1/recorded"  # which everybody may
        forger.session.get(base + asked_last, lambda _: None, timeout=HANG)
        awaited(queries, asked_last)
        assert puts == {key for key, may in publishes.items() if may}
        assert queries - {asked_last} == {key for key, may in asks.items() if may}


def test_every_key_stands_in_the_table() -> None:
    table = {re.sub(r"<kind>/<name>", "{rc}", re.sub("<host>|<client>", "*", key)) for key, _ in rows()}
    assert table == {re.sub(r"\{(by|at)\}", "*", row.key) for row in ACCESS}


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
