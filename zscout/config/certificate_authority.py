"""A fleet's CA, a folder with `ca.pem` and `ca-key.pem`: it issues and renews certificates.

Its certificates serve both ends of a link, on the curve P-256, which every TLS library supports. Only the machine of
the CA needs the package `cryptography` (extra `secure`)."""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Final, Self

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import CertificatePublicKeyTypes
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from zscout.config.certificates import (
    CA,
    CA_KEY,
    CERT,
    KEY,
    MAX_FILE,
    PLACES_KEY,
    PLACES_KEY_BYTES,
    Validity,
    check_mode,
    read_places_key,
    shown,
)
from zscout.config.state_folder import write_durably
from zscout.config.strict import Where, check_name, read_text

PUBLIC, PRIVATE = 0o644, 0o600
BACKDATED: Final = timedelta(hours=1)
"""A new certificate is valid from this long ago, for hosts with slow clocks."""


@dataclass(frozen=True, slots=True)
class CertificateAuthority:
    """A CA with its private key. Methods that write raise OSError if a file can't be written."""

    folder: Path
    _certificate: x509.Certificate
    _key: ec.EllipticCurvePrivateKey
    _trusted: bytes
    """Content of `ca.pem`, which may hold further CAs; it is copied beside each issued certificate."""

    @classmethod
    def make(cls, folder: Path, lasts: timedelta, now: datetime) -> Validity:
        """Make a CA in this folder, replacing an earlier CA."""
        key = _new_key()
        # Each CA has a different name, so that an error can say which CA it means.
        number = x509.SubjectKeyIdentifier.from_public_key(key.public_key()).digest[:4].hex()
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"zscout CA {number}")])
        ends = _whole(now + lasts)
        certificate = (
            _builder(name, name, key.public_key(), key.public_key(), now, ends)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_usage(signs=True), critical=True)
            .sign(key, SHA256())
        )
        write_durably(folder / CA_KEY, _private(key), PRIVATE)
        write_durably(folder / CA, certificate.public_bytes(Encoding.PEM), PUBLIC)
        write_durably(folder / PLACES_KEY, f"{secrets.token_hex(PLACES_KEY_BYTES)}\n".encode(), PRIVATE)
        return Validity(f"zscout CA {number}", now, ends)

    @classmethod
    def read(cls, folder: Path, now: datetime) -> Self:
        """The CA in this folder. Raises BadInput if it is incomplete, expired, or its key is readable by others."""
        where, key_where = Where(str(folder / CA)), Where(str(folder / CA_KEY))
        if not (folder / CA_KEY).exists():
            raise key_where.bad("there is no such file", "make a CA with `zscout cert ca`, or name its folder by --ca")
        check_mode(folder / CA_KEY, 0o077, "600")
        trusted = read_text(folder / CA, max_bytes=MAX_FILE).encode()
        try:
            key = load_pem_private_key(read_text(folder / CA_KEY, max_bytes=MAX_FILE).encode(), None)
        except (ValueError, TypeError, UnsupportedAlgorithm):
            raise key_where.bad("has no readable private key", _COPY) from None
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise key_where.bad("is not an elliptic-curve key", "make a CA with `zscout cert ca`")
        public = _public(key.public_key())
        own = next((ca for ca in _parsed(trusted, where) if _public(ca.public_key()) == public), None)
        if own is None:
            raise key_where.bad(f"does not match any certificate in {CA}", _COPY)
        if now >= own.not_valid_after_utc:
            raise where.bad(f"this CA expired on {shown(own.not_valid_after_utc)}", "make a new one: zscout cert ca")
        return cls(folder, own, key, trusted)

    def issue(self, name: str, folder: Path, lasts: timedelta, now: datetime, *, manager: bool = False) -> datetime:
        """Write this name's folder, replacing its files; a manager's also gets the key that seals places. Returns the
        end of the certificate, at the latest this CA's. Raises BadInput."""
        check_name(name, Where("NAME"))
        if manager:
            if (places := read_places_key(self.folder)) is None:
                raise Where(str(self.folder / PLACES_KEY)).bad(
                    "there is no such file",
                    "copy it from the folder of the CA that issued the first manager's certificate",
                )
            write_durably(folder / PLACES_KEY, f"{places.hex()}\n".encode(), PRIVATE)
        return self._write(folder, name, lasts, now, _new_key())

    def renew(self, folder: Path, lasts: timedelta, now: datetime, *, new_key: bool = False) -> datetime:
        """Renew the certificate in this folder, expired or not. It keeps its key, which need not be there, unless
        `new_key`. Returns the new end. Raises BadInput if no CA in this CA's `ca.pem` issued it."""
        where = Where(str(folder / CERT))
        old = _parsed(read_text(folder / CERT, max_bytes=MAX_FILE).encode(), where)[0]
        if not any(_has_issued(ca, old) for ca in _parsed(self._trusted, Where(str(self.folder / CA)))):
            raise where.bad(f"was not issued by a CA in {self.folder / CA}", "name its CA by --ca, or issue it again")
        name = ", ".join(str(part.value) for part in old.subject.get_attributes_for_oid(NameOID.COMMON_NAME))
        check_name(name, where)
        if new_key:
            return self._write(folder, name, lasts, now, _new_key())
        public = old.public_key()
        if not isinstance(public, ec.EllipticCurvePublicKey):
            raise where.bad("its key is not an elliptic-curve key", "renew it with --new-key")
        return self._write(folder, name, lasts, now, public)

    def _write(
        self,
        folder: Path,
        name: str,
        lasts: timedelta,
        now: datetime,
        key: ec.EllipticCurvePrivateKey | ec.EllipticCurvePublicKey,
    ) -> datetime:
        """Write each file atomically in turn. Readers retry, since they may see a new key with the old certificate."""
        public = key if isinstance(key, ec.EllipticCurvePublicKey) else key.public_key()
        ends = min(_whole(now + lasts), self._certificate.not_valid_after_utc)
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        certificate = (
            _builder(subject, self._certificate.subject, public, self._key.public_key(), now, ends)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(both), critical=False)
            # For programs other than zscout that connect to a host by its name.
            .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
            .sign(self._key, SHA256())
        )
        write_durably(folder / CA, self._trusted, PUBLIC)
        if isinstance(key, ec.EllipticCurvePrivateKey):
            write_durably(folder / KEY, _private(key), PRIVATE)
        write_durably(folder / CERT, certificate.public_bytes(Encoding.PEM), PUBLIC)
        return ends


_COPY: Final = f"copy {CA} and {CA_KEY} from one folder"


def _parsed(text: bytes, where: Where) -> list[x509.Certificate]:
    try:
        return x509.load_pem_x509_certificates(text)
    except ValueError:
        raise where.bad("has no readable PEM certificate", "copy it again") from None


def _has_issued(ca: x509.Certificate, certificate: x509.Certificate) -> bool:
    try:
        certificate.verify_directly_issued_by(ca)
    except (ValueError, TypeError, InvalidSignature, UnsupportedAlgorithm):
        return False
    return True


def _new_key() -> ec.EllipticCurvePrivateKey:
    return ec.generate_private_key(ec.SECP256R1())


def _private(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _public(key: CertificatePublicKeyTypes) -> bytes:
    return key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)


def _whole(at: datetime) -> datetime:
    """The next whole second: certificates have no fractions."""
    return at if at.microsecond == 0 else at.replace(microsecond=0) + timedelta(seconds=1)


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    issuer_key: ec.EllipticCurvePublicKey,
    now: datetime,
    ends: datetime,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - BACKDATED)
        .not_valid_after(ends)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key), critical=False)
    )


def _usage(*, signs: bool) -> x509.KeyUsage:
    """`signs`: the key signs certificates; otherwise handshakes."""
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
