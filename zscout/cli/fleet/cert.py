"""`zscout cert`: make, renew and show the certificates of a secured fleet."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from zscout import terminal
from zscout.cli import common
from zscout.cli.common import F, Parsed
from zscout.config import strict
from zscout.config.certificates import (
    CA,
    CA_KEY,
    CERT,
    KEY,
    KEYS_VARIABLE,
    Certificates,
    Validity,
    read_cas,
    read_certificates,
    shown,
)
from zscout.config.strict import BadInput, quoted
from zscout.terminal import Table

if TYPE_CHECKING:
    from zscout.config.certificate_authority import CertificateAuthority

CA_FOLDER: Final = Path("zscout-ca")
MAX_DAYS: Final = 36_525
STYLES: Final = {"valid": "green", "ends_soon": "yellow"}
"""Styles of usable certificates."""
FOLDER: Final = click.Path(file_okay=False, path_type=Path)


def _parse_days(text: str, option: str) -> timedelta:
    """Parse days (`90`) or a duration (`12h`). Raises BadInput."""
    seconds = strict.parse_duration(f"{text}d") or strict.parse_duration(text)
    if not seconds or not 1 <= seconds <= MAX_DAYS * 86_400:
        raise BadInput(f"{option}: {quoted(text)} is not a time up to {MAX_DAYS:,} days; write it as in 90, 12h, 90s")
    return timedelta(seconds=float(seconds))


def days_option(default: str) -> Callable[[F], F]:
    """`--days`; the parameter is `lasts`."""
    kind = Parsed("days", _parse_days)
    return click.option("--days", "lasts", type=kind, default=default, help="Validity in days, or as in 12h.")


ca_option = click.option(
    "--ca", type=FOLDER, default=CA_FOLDER, envvar="ZSCOUT_CA", show_envvar=True, help="The folder of the CA."
)


@click.group()
def cert() -> None:
    """Make, renew and show the certificates of a secured fleet.

    A certificate of a machine or person is a folder with ca.pem, cert.pem and key.pem. All commands but `show` need
    the package cryptography.

    \b
    Examples:
      zscout cert ca
      zscout cert issue --manager anvil --manager bellows ada
      zscout cert renew anvil bellows
      zscout cert show anvil --json
    """


@cert.command()
@click.argument("folder", type=FOLDER, default=CA_FOLDER)
@days_option("3650")
@click.option("--force", is_flag=True, help="Overwrite an existing CA: its certificates can't be renewed then.")
def ca(folder: Path, lasts: timedelta, force: bool) -> None:
    """Make a CA in FOLDER. Keep its key secret.

    With ca-key.pem anyone can issue certificates in any name: keep it on one machine, best outside the fleet.

    \b
    Examples:
      zscout cert ca
      zscout cert ca vault/zscout-ca --days 1825
    """
    from zscout.config.certificate_authority import CertificateAuthority

    _check_free(folder, (CA, CA_KEY), force)
    with _writing():
        made = CertificateAuthority.make(folder, lasts, datetime.now(UTC))
    terminal.print_line(f"{folder}: {made.name}, until {shown(made.ends)}; keep {folder / CA_KEY} secret")


@cert.command()
@click.argument("name", type=common.NAME, nargs=-1)
@ca_option
@click.option("--to", type=FOLDER, default=Path(), help="Make the folder NAME here.")
@days_option("365")
@click.option(
    "--manager",
    "managers",
    metavar="NAME",
    type=common.NAME,
    multiple=True,
    help="A NAME that may lead: its folder also gets the key by which managers seal places.",
)
@click.option("--force", is_flag=True, help="Overwrite an existing certificate.")
def issue(name: tuple[str, ...], ca: Path, to: Path, lasts: timedelta, managers: tuple[str, ...], force: bool) -> None:
    """Make a folder NAME with a certificate, for each of these machines or persons.

    A machine has the name of its host in the node file, a person the name under [roles] of the fleet file. The
    certificate proves the name of a sender: give each machine and person a name of its own.

    \b
    Examples:
      zscout cert issue --manager anvil --manager bellows ada
      zscout cert issue wall --days 30
    """
    authority = _authority(ca)
    if not name and not managers:
        raise BadInput("name at least one machine or person")
    if dots := next((owner for owner in (*managers, *name) if not owner.strip(".")), None):
        raise BadInput(f"{quoted(dots)} can't be the name of a folder; use a letter or a digit")
    for owner in (*managers, *name):
        _check_free(to / owner, (CA, CERT, KEY), force)
    for owner in (*managers, *name):
        with _writing():
            ends = authority.issue(owner, to / owner, lasts, datetime.now(UTC), manager=owner in managers)
        terminal.print_line(f"{to / owner}: until {shown(ends)}; copy this folder to {owner} and its key nowhere else")


@cert.command()
@click.argument("folders", metavar="FOLDER...", type=FOLDER, nargs=-1, required=True)
@ca_option
@days_option("365")
@click.option("--new-key", is_flag=True, help="Make a new key as well.")
def renew(folders: tuple[Path, ...], ca: Path, lasts: timedelta, new_key: bool) -> None:
    """Renew the certificates in these folders in place, expired ones as well.

    The key stays, so copy only cert.pem and ca.pem to the hosts; key.pem need not be here. Running programs use the new
    certificate for new links, and keep their present links.

    \b
    Examples:
      zscout cert renew anvil bellows ada
      zscout cert renew anvil --new-key
    """
    authority = _authority(ca)
    for folder in folders:
        with _writing():
            ends = authority.renew(folder, lasts, datetime.now(UTC), new_key=new_key)
        terminal.print_line(f"{folder}: until {shown(ends)}")


@cert.command()
@click.argument("folders", metavar="[FOLDER]...", type=FOLDER, nargs=-1)
@common.json_option("Print one JSON object.")
def show(folders: tuple[Path, ...], as_json: bool) -> int:
    """Show name, end and problems of the certificates in these folders.

    Without FOLDER the command shows the folder in $ZSCOUT_KEYS. FOLDER may be a CA's. Exit code 1: a certificate has
    expired, is not valid yet, or can't be used.

    \b
    Examples:
      zscout cert show anvil bellows ada
      zscout cert show zscout-ca
      zscout cert show anvil --json | jq '.certificates[0].ends_in'
    """
    if not folders:
        variable = os.environ.get(KEYS_VARIABLE)
        if not variable:
            raise BadInput(f"no folder is given; name a folder, or set ${KEYS_VARIABLE}")
        folders = (Path(variable),)
    now = datetime.now(UTC)
    found = [certificate for folder in folders for certificate in _found(folder, now)]
    if as_json:
        terminal.print_json({"certificates": found})
    else:
        _print(found)
    return int(any(certificate["state"] not in STYLES for certificate in found))


def _found(folder: Path, now: datetime) -> Iterator[dict[str, Any]]:
    """Yield the object of `--json` for a folder; for the folder of a CA an object for each CA in ca.pem."""
    nothing: dict[str, Any] = dict.fromkeys(("name", "ends", "ends_in", "issuer", "trusted", "problem"))
    held: list[Certificates] | list[Validity]
    try:
        held = read_cas(folder / CA) if (folder / CA_KEY).exists() else [read_certificates(folder)]
    except BadInput as error:
        yield {"folder": str(folder), "state": "unusable", **nothing, "problem": str(error)}
        return
    for certificate in held:
        more = (
            {"issuer": certificate.issuer, "trusted": certificate.trusted}
            if isinstance(certificate, Certificates)
            else {}
        )
        shared = {"name": certificate.name, "ends": certificate.ends.isoformat(), "ends_in": certificate.ends_in(now)}
        yield {"folder": str(folder), "state": _state(certificate, now), **nothing, **shared, **more}


def _state(validity: Validity, now: datetime) -> str:
    if now < validity.begins:
        return "not_yet"
    if now >= validity.ends:
        return "expired"
    return "ends_soon" if validity.soon(now) else "valid"


def _print(found: list[dict[str, Any]]) -> None:
    rows = []
    for certificate in found:
        state = certificate["state"].replace("_", " ")
        if certificate["name"] is None:
            rows.append((certificate["folder"], "-", state, "-", "-", certificate["problem"]))
            continue
        ends = shown(datetime.fromisoformat(certificate["ends"]))
        left = f"{ends} ({terminal.span(certificate['ends_in'])})" if certificate["ends_in"] > 0 else ends
        about = "CA" if certificate["trusted"] is None else f"trusts {', '.join(certificate['trusted'])}"
        rows.append((certificate["folder"], certificate["name"], state, left, certificate["issuer"] or "-", about))
    columns = ("FOLDER", "NAME", "STATE", "ENDS", "ISSUER", "ABOUT")
    Table("", columns, rows, [STYLES.get(certificate["state"], "red") for certificate in found], ("ISSUER",)).print()


def _authority(folder: Path) -> CertificateAuthority:
    from zscout.config.certificate_authority import CertificateAuthority

    return CertificateAuthority.read(folder, datetime.now(UTC))


def _check_free(folder: Path, names: tuple[str, ...], force: bool) -> None:
    there = [name for name in names if (folder / name).exists()]
    if there and not force:
        raise BadInput(f"{folder}: already has {' and '.join(there)}; name another folder, or overwrite with --force")


@contextmanager
def _writing() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        raise common.Failed(f"{where}can't be written: {error.strerror}") from None
