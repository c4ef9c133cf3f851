"""The folder of a machine's or person's certificate: `ca.pem` (trusted CAs), `cert.pem` and `key.pem`.

Nodes and clients read it with the standard library alone. That has no public parser of certificates, but TLS does the
checks: the certificate does a handshake with itself in memory, as server and client. TLS ignores times there and they
are checked here, so that an expired certificate is reported as expired and can be shown."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from zscout.config.strict import Where, check_name, quoted, read_text

if TYPE_CHECKING:
    import ssl

CA: Final = "ca.pem"
CERT: Final = "cert.pem"
KEY: Final = "key.pem"
CA_KEY: Final = "ca-key.pem"
"""In the folder of a CA, beside its `ca.pem`."""
PLACES_KEY: Final = "places.key"
"""In the folders of managers and of their CA: the key that seals places in the queue."""
PLACES_KEY_BYTES: Final = 32
KEYS_VARIABLE: Final = "ZSCOUT_KEYS"
"""Environment variable with the path of a person's folder."""
MAX_FILE: Final = 65_536
"""Bytes of each file."""
WARN_BEFORE_END: Final = timedelta(days=14)
"""Warnings begin this long before the end of a certificate, or in the last third of a shorter validity."""
NO_CHECK_TIME: Final = 0x200000
"""OpenSSL's X509_V_FLAG_NO_CHECK_TIME, which `ssl` passes on and does not name."""
HANDSHAKE_ROUNDS: Final = 3
"""In each, both sides send once; TLS 1.3 takes two."""
UNKNOWN_ISSUER: Final = frozenset({2, 7, 18, 19, 20, 21})
"""OpenSSL's codes for a certificate that no known CA has signed."""


@dataclass(frozen=True, slots=True)
class Validity:
    """Name and validity of a certificate."""

    name: str
    """The common name."""
    begins: datetime
    ends: datetime

    def ends_in(self, now: datetime) -> float:
        """Seconds until its end, negative after it."""
        return (self.ends - now).total_seconds()

    def soon(self, now: datetime) -> bool:
        """Return True if it is still valid, but its end is near enough for a warning."""
        return timedelta(0) < self.ends - now <= min(WARN_BEFORE_END, (self.ends - self.begins) / 3)


@dataclass(frozen=True, slots=True)
class Certificates(Validity):
    """The content of a certificate's folder. Its end is that of the certificate or of its CA, the earlier."""

    folder: Path
    issuer: str
    """The common name of its CA."""
    trusted: tuple[str, ...]
    """The common names of all CAs in `ca.pem`."""

    @property
    def ca(self) -> Path:
        return self.folder / CA

    @property
    def cert(self) -> Path:
        return self.folder / CERT

    @property
    def key(self) -> Path:
        return self.folder / KEY

    def check(self, now: datetime, name: str | None = None) -> None:
        """Raises BadInput unless it is valid now and, if given, for this `name`."""
        where = Where(str(self.cert))
        if name is not None and self.name != name:
            raise where.bad(
                f"is the certificate of {quoted(self.name)}, but this host is {quoted(name)}",
                f"put the certificate of {quoted(name)} there, or correct the host's name",
            )
        if now < self.begins:
            raise where.bad(f"is not valid before {shown(self.begins)}", "set this host's clock, or wait")
        if now >= self.ends:
            raise where.bad(f"expired on {shown(self.ends)}", "renew it (zscout cert renew), or set this host's clock")

    def expires_soon(self, now: datetime) -> str:
        """The warning while its end is near, otherwise ""."""
        if not self.soon(now):
            return ""
        return f"{self.cert}: expires on {shown(self.ends)}; renew it (zscout cert renew)"


def read_certificates(folder: Path) -> Certificates:
    """An expired certificate is no error. Raises BadInput if a file is missing, broken or open to others, if key and
    certificate do not match, if no CA in `ca.pem` issued it, or if its name is invalid."""
    import ssl

    instead = f"or name your own folder by ${KEYS_VARIABLE}"
    try:
        if not any((folder / name).exists() for name in (CA, CERT, KEY)):
            raise Where(str(folder)).bad("has no certificate", f"copy there what `zscout cert issue` made, {instead}")
    except PermissionError:
        raise Where(str(folder)).bad("may not be entered by this user", f"change its mode, {instead}") from None
    cas = read_cas(folder / CA)
    cert, key = Where(str(folder / CERT)), Where(str(folder / KEY))
    check_mode(folder / CERT, 0o002, "644")
    check_mode(folder / KEY, 0o027, "640")
    if "ENCRYPTED" in read_text(folder / KEY, max_bytes=MAX_FILE):
        raise key.bad("has a passphrase, which zscout can't enter", f"write it without one: {_MAKE}")
    _store(folder / CERT)
    sides = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        for side in sides:
            side.load_cert_chain(folder / CERT, folder / KEY)
    except ssl.SSLError as error:
        if "MISMATCH" in (error.reason or ""):
            raise key.bad(f"is not the key of {CERT}", "copy both from one folder of `zscout cert issue`") from None
        raise key.bad("has no readable private key", _MAKE) from None
    except OSError as error:
        raise key.bad(f"can't be read: {error.strerror}", "check its permissions") from None
    try:
        parsed = _shake_hands(*sides, read_text(folder / CA, max_bytes=MAX_FILE))
    except ssl.SSLCertVerificationError as error:
        if error.verify_code in UNKNOWN_ISSUER:
            known = ", ".join(ca.name for ca in cas)
            raise cert.bad(f"was not issued by a CA in {CA} ({known})", "copy both from one folder") from None
        raise cert.bad(f"can't be used for zscout: {error.verify_message}", _MAKE) from None
    except ssl.SSLError as error:
        raise cert.bad(f"can't be used: {error.reason or error}", _MAKE) from None
    own, issuer = validity(parsed, cert), common_name(parsed["issuer"])
    check_name(own.name, cert)
    last = max((ca.ends for ca in cas if ca.name == issuer), default=own.ends)
    return Certificates(own.name, own.begins, min(own.ends, last), folder, issuer, tuple(ca.name for ca in cas))


def read_places_key(folder: Path) -> bytes | None:
    """The key that seals places in the queue; None without its file. Raises BadInput."""
    path = folder / PLACES_KEY
    if not path.exists():
        return None
    check_mode(path, 0o027, "640")
    with suppress(ValueError):
        if len(key := bytes.fromhex(read_text(path, max_bytes=MAX_FILE))) == PLACES_KEY_BYTES:
            return key
    raise Where(str(path)).bad(f"is not {PLACES_KEY_BYTES} hex bytes", f"copy {PLACES_KEY} from the CA's folder")


def read_cas(path: Path) -> list[Validity]:
    """Raises BadInput, also for one that is not a CA's: Zenoh would trust certificates signed with its key."""
    check_mode(path, 0o002, "644")
    store = _store(path)
    count = store.cert_store_stats()
    where = Where(str(path))
    if count["x509"] != count["x509_ca"]:
        raise where.bad("has a certificate that is not a CA's", f"copy {CA} from the folder of the CA")
    return [validity(ca, where) for ca in store.get_ca_certs()]


def check_mode(path: Path, forbidden: int, remedy: str) -> None:
    """Raises BadInput if a file's mode has one of the `forbidden` bits; `remedy` is the mode for chmod."""
    try:
        mode = path.stat().st_mode & 0o777
    except OSError:
        read_text(path, max_bytes=MAX_FILE)  # raises BadInput with the reason
        raise
    if mode & forbidden:
        done = "read" if mode & forbidden & 0o044 else "written" if mode & forbidden & 0o022 else "used"
        raise Where(str(path)).bad(f"may be {done} by others ({mode:03o})", f"chmod {remedy} {shlex.quote(str(path))}")


def shown(at: datetime) -> str:
    return f"{at:%Y-%m-%d %H:%M} UTC"


_MAKE: Final = "make it with `zscout cert issue`"


def _store(path: Path) -> ssl.SSLContext:
    """A context that trusts the certificates in the file. Raises BadInput."""
    import ssl

    text = read_text(path, max_bytes=MAX_FILE)
    store = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        store.load_verify_locations(cadata=text)
    except (ssl.SSLError, ValueError):
        raise Where(str(path)).bad("has no readable PEM certificate", _MAKE) from None
    return store


def _shake_hands(client: ssl.SSLContext, server: ssl.SSLContext, trusted: str) -> dict[str, Any]:
    """Connect both sides in memory, each checking the other; return the parsed certificate. Raises SSLError."""
    import ssl

    client.check_hostname = False
    for side in (client, server):
        side.verify_mode = ssl.CERT_REQUIRED
        side.load_verify_locations(cadata=trusted)
        side.verify_flags |= ssl.VerifyFlags(NO_CHECK_TIME)
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (client.wrap_bio(back, there), server.wrap_bio(there, back, server_side=True))
    for _ in range(HANDSHAKE_ROUNDS):
        for end in ends:
            with suppress(ssl.SSLWantReadError):
                end.do_handshake()
    return ends[1].getpeercert() or {}


def validity(parsed: Mapping[str, Any], where: Where) -> Validity:
    """Raises BadInput."""
    from ssl import cert_time_to_seconds

    try:
        begins, ends = (
            datetime.fromtimestamp(cert_time_to_seconds(parsed[key]), UTC) for key in ("notBefore", "notAfter")
        )
    except (KeyError, ValueError, OverflowError):
        raise where.bad("has unreadable times", _MAKE) from None
    return Validity(common_name(parsed["subject"]), begins, ends)


def common_name(name: tuple[tuple[tuple[str, str], ...], ...]) -> str:
    """The common name in a parsed subject; several are joined, which gives an invalid name."""
    return ", ".join(value for part in name for key, value in part if key == "commonName")
