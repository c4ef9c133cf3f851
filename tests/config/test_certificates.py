"""The folder of a certificate: what is read in it, and the line for each way in which it can't be used."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID

from zscout.config.certificate_authority import CertificateAuthority
from zscout.config.certificates import MAX_FILE, read_cas, read_certificates
from zscout.config.strict import BadInput

NOW = datetime(2030, 5, 1, 12, tzinfo=UTC)
DAY = timedelta(days=1)
YEARS = 3650 * DAY


def authority(folder: Path, now: datetime = NOW) -> CertificateAuthority:
    CertificateAuthority.make(folder, YEARS, now)
    return CertificateAuthority.read(folder, now)


@pytest.fixture
def ca(tmp_path: Path) -> CertificateAuthority:
    return authority(tmp_path / "ca")


@pytest.fixture
def anvil(ca: CertificateAuthority, tmp_path: Path) -> Path:
    ca.issue("anvil", tmp_path / "anvil", 90 * DAY, NOW)
    return tmp_path / "anvil"


def test_it_tells_whose_it_is_until_when_and_whom_it_trusts(anvil: Path, ca: CertificateAuthority) -> None:
    found = read_certificates(anvil)
    assert (found.name, found.ends) == ("anvil", NOW + 90 * DAY)
    assert (found.ca, found.cert, found.key) == (anvil / "ca.pem", anvil / "cert.pem", anvil / "key.pem")
    assert found.ends_in(NOW + 89 * DAY) == 86_400
    assert (found.issuer,) == found.trusted == tuple(one.name for one in read_cas(ca.folder / "ca.pem"))


@pytest.mark.live
def test_it_is_read_without_cryptography(anvil: Path) -> None:
    block = "import sys; from pathlib import Path; sys.modules['cryptography'] = None; "
    read = "from zscout.config.certificates import read_certificates; print(read_certificates(Path(sys.argv[1])).name)"
    done = subprocess.run([sys.executable, "-c", block + read, anvil], capture_output=True, text=True, check=True)
    assert done.stdout == "anvil\n"


def test_it_can_be_used_by_whom_it_names_from_a_while_ago_until_its_end(anvil: Path) -> None:
    found = read_certificates(anvil)
    found.check(NOW - timedelta(minutes=59), "anvil")
    found.check(found.ends - timedelta(seconds=1))
    for now, name, words in (
        (NOW - timedelta(minutes=61), "anvil", "is not valid before 2030-05-01 11:00 UTC; set this host's clock"),
        (found.ends, "anvil", "expired on 2030-07-30 12:00 UTC; renew it"),
        (
            NOW,
            "bellows",
            'is the certificate of "anvil", but this host is "bellows"; put the certificate of "bellows" there',
        ),
    ):
        with pytest.raises(BadInput) as error:
            found.check(now, name)
        assert str(error.value).startswith(f"{anvil}/cert.pem: {words}")


def test_its_end_is_told_from_two_weeks_before_of_a_short_life_in_its_last_third(
    ca: CertificateAuthority, anvil: Path, tmp_path: Path
) -> None:
    found = read_certificates(anvil)
    ca.issue("ada", tmp_path / "ada", 9 * DAY - timedelta(hours=1), NOW)
    short = read_certificates(tmp_path / "ada")
    second = timedelta(seconds=1)
    assert [
        one.expires_soon(one.ends - left) for one, left in ((found, 14 * DAY + second), (short, 3 * DAY + second))
    ] == ["", ""]
    assert found.expires_soon(found.ends - 14 * DAY) == (
        f"{anvil}/cert.pem: expires on 2030-07-30 12:00 UTC; renew it (zscout cert renew)"
    )
    assert short.expires_soon(short.ends - 3 * DAY)
    assert found.expires_soon(found.ends) == ""


def test_it_ends_no_later_than_its_ca(ca: CertificateAuthority, tmp_path: Path) -> None:
    ends = ca.issue("anvil", tmp_path / "anvil", 2 * YEARS, NOW)
    assert ends == read_certificates(tmp_path / "anvil").ends == NOW + YEARS


def test_a_ca_that_ends_before_what_it_issued_ends_it(ca: CertificateAuthority, anvil: Path) -> None:
    # As others' CAs may do: the same key and name, with an earlier end.
    key = load_pem_private_key((ca.folder / "ca-key.pem").read_bytes(), None)
    old = x509.load_pem_x509_certificate((ca.folder / "ca.pem").read_bytes())
    builder = x509.CertificateBuilder(
        old.issuer, old.subject, old.public_key(), 7, old.not_valid_before_utc, NOW + DAY, list(old.extensions)
    )
    (anvil / "ca.pem").write_bytes(builder.sign(key, SHA256()).public_bytes(Encoding.PEM))  # type: ignore[arg-type]
    assert read_certificates(anvil).ends == NOW + DAY


def _other_key(folder: Path) -> None:
    other = authority(folder / "other-ca")
    other.issue("anvil", folder / "other", DAY, NOW)
    shutil.copy(folder / "other" / "key.pem", folder / "key.pem")


def _other_ca(folder: Path) -> None:
    authority(folder / "other-ca")
    shutil.copy(folder / "other-ca" / "ca.pem", folder / "ca.pem")


def _leaf_as_ca(folder: Path) -> None:
    with (folder / "ca.pem").open("a") as file:
        file.write((folder / "cert.pem").read_text())


def _passphrase(folder: Path) -> None:
    text = (folder / "key.pem").read_text()
    (folder / "key.pem").write_text(text.replace("PRIVATE", "ENCRYPTED PRIVATE"))


def _long(folder: Path) -> None:
    with (folder / "cert.pem").open("ab") as file:
        file.write(b"\n" * MAX_FILE)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda folder: (folder / "ca.pem").unlink(), "ca.pem: there is no such file; "),
        (lambda folder: (folder / "cert.pem").unlink(), "cert.pem: there is no such file; "),
        (lambda folder: (folder / "key.pem").unlink(), "key.pem: there is no such file; "),
        (lambda folder: (folder / "ca.pem").write_text(""), "ca.pem: has no readable PEM certificate; "),
        (lambda folder: (folder / "cert.pem").write_text("x"), "cert.pem: has no readable PEM certificate; "),
        (lambda folder: (folder / "key.pem").write_text("x"), "key.pem: has no readable private key; "),
        (_long, "cert.pem: has more than 65,536 bytes; "),
        (_passphrase, "key.pem: has a passphrase, which zscout can't enter; "),
        (_other_key, "key.pem: is not the key of cert.pem; "),
        (_other_ca, "cert.pem: was not issued by a CA in ca.pem (zscout CA "),
        (_leaf_as_ca, "ca.pem: has a certificate that is not a CA's; "),
        (lambda folder: (folder / "key.pem").chmod(0o644), "key.pem: may be read by others (644); chmod 640 "),
        (lambda folder: (folder / "key.pem").chmod(0o620), "key.pem: may be written by others (620); chmod 640 "),
        (lambda folder: (folder / "ca.pem").chmod(0o666), "ca.pem: may be written by others (666); chmod 644 "),
        (lambda folder: (folder / "cert.pem").chmod(0o646), "cert.pem: may be written by others (646); chmod 644 "),
    ],
)
def test_what_can_not_be_used_is_told_in_one_line(anvil: Path, spoil: Callable[[Path], object], words: str) -> None:
    spoil(anvil)
    with pytest.raises(BadInput) as error:
        read_certificates(anvil)
    assert str(error.value).startswith(f"{anvil}/{words}")


def test_a_key_that_its_group_may_read_is_taken(anvil: Path) -> None:
    (anvil / "key.pem").chmod(0o640)
    assert read_certificates(anvil).name == "anvil"


def _signed(
    ca: CertificateAuthority, folder: Path, change: Callable[[x509.Certificate], x509.CertificateBuilder]
) -> None:
    """Puts another certificate of this CA, for the same key, into the folder."""
    key = load_pem_private_key((ca.folder / "ca-key.pem").read_bytes(), None)
    builder = change(x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes()))
    (folder / "cert.pem").write_bytes(builder.sign(key, SHA256()).public_bytes(Encoding.PEM))  # type: ignore[arg-type]


def _like(one: x509.Certificate, subject: str | None = None, purposes: object = None) -> x509.CertificateBuilder:
    name = one.subject if subject is None else x509.Name.from_rfc4514_string(subject)
    extensions = [
        x509.Extension(each.oid, each.critical, x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]))
        if purposes and isinstance(each.value, x509.ExtendedKeyUsage)
        else each
        for each in one.extensions
    ]
    return x509.CertificateBuilder(
        one.issuer, name, one.public_key(), 7, one.not_valid_before_utc, one.not_valid_after_utc, extensions
    )


@pytest.mark.parametrize("subject", ["CN=*", "CN=an/vil", "O=lab", "CN=anvil,CN=ada"])
def test_a_certificate_is_of_one_name_that_may_stand_in_a_key(
    ca: CertificateAuthority, anvil: Path, subject: str
) -> None:
    _signed(ca, anvil, lambda one: _like(one, subject))
    with pytest.raises(BadInput, match=r"cert.pem: .* is not a name; "):
        read_certificates(anvil)


def test_a_certificate_is_for_both_ends_of_a_link(ca: CertificateAuthority, anvil: Path) -> None:
    _signed(ca, anvil, lambda one: _like(one, purposes="server"))
    with pytest.raises(BadInput, match=r"cert.pem: can't be used for zscout: "):
        read_certificates(anvil)


# The CA


def test_a_renewed_certificate_has_a_later_end_and_the_same_key_which_need_not_be_there(
    ca: CertificateAuthority, anvil: Path
) -> None:
    key = (anvil / "key.pem").read_bytes()
    (anvil / "key.pem").unlink()
    later = NOW + 200 * DAY
    assert ca.renew(anvil, 90 * DAY, later) == later + 90 * DAY
    (anvil / "key.pem").write_bytes(key)
    (anvil / "key.pem").chmod(0o600)
    found = read_certificates(anvil)
    assert (found.name, found.ends) == ("anvil", later + 90 * DAY)


def test_renewed_files_keep_their_modes_and_a_new_key_is_made_where_asked(
    ca: CertificateAuthority, anvil: Path
) -> None:
    before = (anvil / "key.pem").read_bytes()
    (anvil / "key.pem").chmod(0o640)
    ca.renew(anvil, 90 * DAY, NOW, new_key=True)
    assert (anvil / "key.pem").read_bytes() != before
    assert (anvil / "key.pem").stat().st_mode & 0o777 == 0o640
    assert read_certificates(anvil).name == "anvil"


def test_a_ca_renews_only_what_itself_or_one_beside_it_has_issued(ca: CertificateAuthority, tmp_path: Path) -> None:
    other = authority(tmp_path / "other-ca")
    other.issue("anvil", tmp_path / "anvil", DAY, NOW)
    before = (tmp_path / "anvil" / "cert.pem").read_bytes()
    with pytest.raises(BadInput, match=r"anvil/cert.pem: was not issued by a CA in .*/ca/ca.pem; "):
        ca.renew(tmp_path / "anvil", DAY, NOW)
    assert (tmp_path / "anvil" / "cert.pem").read_bytes() == before
    with (ca.folder / "ca.pem").open("a") as file:
        file.write((other.folder / "ca.pem").read_text())
    CertificateAuthority.read(ca.folder, NOW).renew(tmp_path / "anvil", DAY, NOW)
    found = read_certificates(tmp_path / "anvil")
    assert found.trusted == tuple(one.name for one in read_cas(ca.folder / "ca.pem"))
    assert found.issuer == found.trusted[0]


def test_a_ca_that_is_broken_open_or_expired_issues_nothing(ca: CertificateAuthority, tmp_path: Path) -> None:
    key = ca.folder / "ca-key.pem"
    with pytest.raises(BadInput, match=r"ca.pem: this CA expired on 2040-04-28 12:00 UTC; "):
        CertificateAuthority.read(ca.folder, NOW + YEARS)
    key.chmod(0o640)
    with pytest.raises(BadInput, match=r"ca-key.pem: may be read by others \(640\); chmod 600 "):
        CertificateAuthority.read(ca.folder, NOW)
    key.chmod(0o600)
    other = authority(tmp_path / "other-ca")
    key.write_bytes((other.folder / "ca-key.pem").read_bytes())
    with pytest.raises(BadInput, match=r"ca-key.pem: does not match any certificate in ca.pem; "):
        CertificateAuthority.read(ca.folder, NOW)
    key.write_text("x")
    with pytest.raises(BadInput, match=r"ca-key.pem: has no readable private key; "):
        CertificateAuthority.read(ca.folder, NOW)
