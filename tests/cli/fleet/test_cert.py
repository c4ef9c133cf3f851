"""`zscout cert`: from nothing to certificates, renewed and shown, in files that nobody else can read."""

from __future__ import annotations

import json
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from tests.cli.tools import Terminal, zscout_here
from zscout.config.certificate_authority import CertificateAuthority
from zscout.config.certificates import KEYS_VARIABLE, read_certificates, read_places_key
from zscout.config.strict import BadInput

FILES = ("ca.pem", "cert.pem", "key.pem")


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("ZSCOUT_CA", KEYS_VARIABLE):
        monkeypatch.delenv(name, raising=False)


def lasting(folder: str) -> timedelta:
    """From now until its end, in whole hours."""
    return timedelta(hours=round(read_certificates(Path(folder)).ends_in(datetime.now(UTC)) / 3600))


def issued(name: str, days: float, ago: float) -> None:
    """One that was issued so many days `ago`."""
    ca = CertificateAuthority.read(Path("zscout-ca"), datetime.now(UTC))
    ca.issue(name, Path(name), timedelta(days=days), datetime.now(UTC) - timedelta(days=ago))


def shown(capsys: pytest.CaptureFixture[str], *folders: str) -> tuple[int, list[dict[str, Any]]]:
    capsys.readouterr()
    code = zscout_here("cert", "show", "--json", *folders)
    return code, json.loads(capsys.readouterr().out)["certificates"]


def test_a_ca_issues_folders_that_are_ready_to_be_copied(capsys: pytest.CaptureFixture[str]) -> None:
    assert zscout_here("cert", "ca") == 0
    assert zscout_here("cert", "issue", "anvil", "ada", "--to", "out") == 0
    said = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in said] == ["zscout-ca", "out/anvil", "out/ada"]
    assert said[0].endswith("; keep zscout-ca/ca-key.pem secret")
    for name in ("anvil", "ada"):
        assert sorted(one.name for one in Path("out", name).iterdir()) == list(FILES)
        assert read_certificates(Path("out", name)).name == name
        assert lasting(f"out/{name}") == timedelta(days=365)
    secret = [*Path().rglob("*key.pem"), *Path().rglob("*.key")]
    assert [one.stat().st_mode & 0o777 for one in secret] == [0o600] * 4


def test_managers_share_the_key_that_seals_places(capsys: pytest.CaptureFixture[str]) -> None:
    zscout_here("cert", "ca")
    assert zscout_here("cert", "issue", "--manager", "anvil", "--manager", "bellows", "ada") == 0
    keys = {name: read_places_key(Path(name)) for name in ("zscout-ca", "anvil", "bellows", "ada")}
    key = keys["anvil"]
    assert key is not None
    assert len(key) == 32
    assert keys == {"zscout-ca": key, "anvil": key, "bellows": key, "ada": None}
    assert Path("anvil/places.key").stat().st_mode & 0o777 == 0o600
    Path("anvil/places.key").chmod(0o644)
    with pytest.raises(BadInput, match="may be read by others"):
        read_places_key(Path("anvil"))
    Path("bellows/places.key").write_text("short\n")
    with pytest.raises(BadInput, match=r"places\.key: is not 32 hex bytes"):
        read_places_key(Path("bellows"))
    Path("zscout-ca/places.key").unlink()
    capsys.readouterr()
    assert zscout_here("cert", "issue", "--manager", "cart") == 2
    assert "there is no such file; copy it" in capsys.readouterr().err
    assert zscout_here("cert", "issue") == 2


def test_a_certificate_lasts_days_or_what_has_a_unit(capsys: pytest.CaptureFixture[str]) -> None:
    zscout_here("cert", "ca", "ours", "--days", "100")
    for text, lasts in (("30", timedelta(days=30)), ("1.5", timedelta(hours=36)), ("12h", timedelta(hours=12))):
        assert zscout_here("cert", "issue", "anvil", "--ca", "ours", "--days", text, "--force") == 0
        assert lasting("anvil") == lasts
    zscout_here("cert", "issue", "anvil", "--ca", "ours", "--days", "90s", "--force")
    code, (one,) = shown(capsys, "anvil")
    assert (code, one["state"]) == (0, "ends_soon")
    assert 0 < one["ends_in"] <= 91


@pytest.mark.parametrize("words", [("ca",), ("issue", "anvil"), ("issue", "ada", "anvil")])
def test_nothing_is_overwritten_unless_that_is_said(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    zscout_here("cert", "ca")
    zscout_here("cert", "issue", "anvil")
    before = {path: path.read_bytes() for path in Path().rglob("*.pem")}
    capsys.readouterr()
    assert zscout_here("cert", *words) == 2
    assert "; name another folder, or overwrite with --force" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in Path().rglob("*.pem")} == before
    assert zscout_here("cert", *words, "--force") == 0
    assert {path: path.read_bytes() for path in before} != before


def test_certificates_are_renewed_in_place_expired_ones_as_well(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    zscout_here("cert", "ca", "ours")
    monkeypatch.setenv("ZSCOUT_CA", "ours")
    zscout_here("cert", "issue", "anvil")
    Path("ours").rename("zscout-ca")
    monkeypatch.setenv("ZSCOUT_CA", "zscout-ca")
    issued("ada", 1, ago=2)
    keys = [Path(name, "key.pem").read_bytes() for name in ("anvil", "ada")]
    assert shown(capsys, "ada")[0] == 1
    assert zscout_here("cert", "renew", "anvil", "ada", "--days", "60") == 0
    assert [lasting(name) for name in ("anvil", "ada")] == [timedelta(days=60)] * 2
    assert [Path(name, "key.pem").read_bytes() for name in ("anvil", "ada")] == keys
    assert zscout_here("cert", "renew", "anvil", "--new-key") == 0
    assert Path("anvil", "key.pem").read_bytes() != keys[0]
    assert read_certificates(Path("anvil")).name == "anvil"
    assert not [*Path("anvil").glob(".*")]


def test_show_tells_each_state_and_its_exit_code_whether_all_can_be_used(capsys: pytest.CaptureFixture[str]) -> None:
    zscout_here("cert", "ca")
    zscout_here("cert", "issue", "anvil", "broken")
    issued("soon", 9, ago=8)
    issued("late", 1, ago=2)
    issued("early", 9, ago=-2)
    Path("broken", "key.pem").chmod(0o644)
    states = {
        name: (code, one["state"])
        for name in ("anvil", "soon", "zscout-ca", "late", "early", "broken")
        for code, (one,) in [shown(capsys, name)]
    }
    assert states == {
        "anvil": (0, "valid"), "soon": (0, "ends_soon"), "zscout-ca": (0, "valid"), "late": (1, "expired"),
        "early": (1, "not_yet"), "broken": (1, "unusable"),
    }  # fmt: skip
    code, (valid, broken) = shown(capsys, "anvil", "broken")
    assert code == 1
    assert (valid["name"], valid["trusted"], valid["problem"]) == ("anvil", [valid["issuer"]], None)
    assert broken["problem"] == "broken/key.pem: may be read by others (644); chmod 640 broken/key.pem"


def test_show_prints_a_line_for_each_and_takes_the_folder_that_the_environment_names(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    zscout_here("cert", "ca")
    zscout_here("cert", "issue", "anvil", "ada")
    capsys.readouterr()
    monkeypatch.setenv(KEYS_VARIABLE, "ada")
    assert zscout_here("cert", "show") == 0
    head, ada = capsys.readouterr().out.splitlines()
    assert head.split() == ["FOLDER", "NAME", "STATE", "ENDS", "ISSUER", "ABOUT"]
    assert ada.split()[:3] == ["ada", "ada", "valid"]
    zscout_here("cert", "show", "zscout-ca", "nowhere", "anvil")
    lines = capsys.readouterr().out.splitlines()[1:]
    assert lines[0].endswith(" CA")
    assert "nowhere: has no certificate; copy there what `zscout cert issue` made, or name your own" in lines[1]
    assert "trusts zscout CA " in lines[2]


@pytest.mark.live
def test_show_is_a_table_at_a_terminal(tmp_path: Path) -> None:
    zscout_here("cert", "ca")
    zscout_here("cert", "issue", "anvil")
    with Terminal("cert", "show", "anvil", columns=160) as terminal:
        assert terminal.code() == 0
        assert "trusts zscout CA" in terminal.text
        assert "\x1b[" in terminal.raw


def test_without_its_package_what_needs_it_says_so_and_show_works(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    zscout_here("cert", "ca")
    zscout_here("cert", "issue", "anvil")
    capsys.readouterr()
    for name in [name for name in sys.modules if name.partition(".")[0] == "cryptography"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "zscout.config.certificate_authority")
    monkeypatch.setattr(sys, "path", [one for one in sys.path if not Path(one, "cryptography").exists()])
    assert zscout_here("cert", "issue", "ada") == 1
    assert "zscout: this command needs cryptography, which is not installed here; " in capsys.readouterr().err
    assert zscout_here("cert", "show", "anvil") == 0


@pytest.mark.parametrize("name", ["..", ".", "..."])
def test_a_certificate_is_written_into_a_folder_of_its_own(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("inner").mkdir()
    assert zscout_here("cert", "ca") == 0
    for options in ((name,), ("ada", "--manager", name)):
        assert zscout_here("cert", "issue", *options, "--to", "inner") == 2
        assert "can't be the name of a folder" in capsys.readouterr().err
    assert {path.name for path in Path().iterdir()} == {"inner", "zscout-ca"}
    assert not [*Path("inner").iterdir()]
