"""Exit codes of `zscout request`, as the table on docs/how-to/use-in-ci.md has them, and `--infra-exit`."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import CLOCK, end, events, out_of, own
from tests.cli.tools import zscout as in_a_pipe
from tests.hang import HANG
from zscout.cli.main import main

pytestmark = pytest.mark.live

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "use-in-ci.md"
INFRA = 99


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    with fleet_of(tmp_path_factory.mktemp("codes"), "robot/a", "radio/rf0:rate=10") as fleet:
        yield fleet


def own_exit(fleet: CliFleet, *args: str) -> int:
    return fleet.zscout("request", "robot/a", *args, "--", "sh", "-c", "exit 1").returncode


def not_granted(fleet: CliFleet, *args: str) -> int:
    blocker = fleet.holder("blocker", "robot/a", "--priority", "7")
    code = fleet.zscout("request", "robot/a", "--timeout", "0", *args, "--", "true").returncode
    end(blocker)
    return code


def never(fleet: CliFleet, *args: str) -> int:
    return fleet.zscout("request", "radio/rf0:rate=50", *args, "--", "true").returncode


def no_leader(fleet: CliFleet, *args: str) -> int:
    env = {name: value for name, value in fleet.lab.env.items() if name not in ("ZSCOUT_FLEET", "ZSCOUT_HOST")}
    empty = fleet.folder / "empty.toml"
    empty.write_text('[fleet]\nname = "empty"\n[mesh]\nmulticast = false\n')
    return in_a_pipe("--fleet", empty, "request", "robot/a", *args, "--", "true", env=env).returncode


def taken_away(fleet: CliFleet, *args: str) -> int:
    options = ("request", "robot/a", "--name", "victim", *args)
    victim, _ = fleet.begun("begun", *options, "--", "sh", "-c", "echo begun; sleep 1000")
    assert fleet.zscout("release", "victim").returncode == 0
    return victim.wait(HANG)


def time_over(fleet: CliFleet, *args: str) -> int:
    options = ("request", "robot/a", "--min-runtime", "100ms", *args)
    kept, _ = fleet.begun("begun", *options, "--", "sh", "-c", "echo begun; sleep 1000")
    assert fleet.zscout("request", "robot/a", "--", "true").returncode == 0
    return kept.wait(HANG)


def not_executable(fleet: CliFleet, *args: str) -> int:
    plain = fleet.folder / "plain"
    plain.touch()
    return fleet.zscout("request", "robot/a", *args, "--", str(plain)).returncode


def not_found(fleet: CliFleet, *args: str) -> int:
    return fleet.zscout("request", "robot/a", *args, "--", "no-such-program").returncode


def by_signal(fleet: CliFleet, *args: str) -> int:
    return fleet.zscout("request", "robot/a", *args, "--", "sh", "-c", "kill -KILL $$").returncode


CASES: dict[str, Callable[..., int]] = {
    "the command's own": own_exit,
    "128 + n": by_signal,
    "1": not_granted,
    "2": never,
    "3": no_leader,
    "75": taken_away,
    "124": time_over,
    "126": not_executable,
    "127": not_found,
}


def table() -> dict[str, str]:
    """The codes on the page, and what each is with --infra-exit N."""
    rows = re.findall(r"^\| ([^|]+?) \| ([^|]+?) \| ([^|]+?) \|$", PAGE.read_text(), re.MULTILINE)
    return {code: infra for code, infra, _ in rows if code in CASES}


def test_the_page_lists_all_codes() -> None:
    assert table() == {code: "N" if code in ("1", "2", "3", "75", "124") else "the same" for code in CASES}


@pytest.mark.parametrize("infra", [False, True])
@pytest.mark.parametrize("code", CASES)
def test_each_code_is_as_the_page_has_it(fleet: CliFleet, code: str, infra: bool) -> None:
    expected = {"the command's own": 1, "128 + n": 137}.get(code) or int(code)
    if infra and table()[code] == "N":
        expected = INFRA
    assert CASES[code](fleet, *(["--infra-exit", str(INFRA)] if infra else [])) == expected


def test_bad_options_have_the_infra_code_too(capfd: pytest.CaptureFixture[str]) -> None:
    for args, words in (
        (["robot/a", "--prio", "3", "--infra-exit", "99"], "there is no option --prio"),
        (["--infra-exit=99"], "DEVICE... is missing"),
        (["robot/a/b/c", "--infra-exit", "99"], '"a/b/c" is not valid'),
    ):
        assert main.main(["request", *args], standalone_mode=False) == INFRA
        assert words in capfd.readouterr().err
    for value in ("0", "256", "x"):
        assert main.main(["request", "robot/a", "--infra-exit", value], standalone_mode=False) == 2


def test_a_bug_has_the_infra_code_and_its_traceback(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("zscout.cli.common.connected", broken)
    assert main.main(["request", "robot/a", "--infra-exit", "99"], standalone_mode=False) == INFRA
    assert "ZeroDivisionError: a bug" in capfd.readouterr().err
    with pytest.raises(ZeroDivisionError):
        main.main(["request", "robot/a"], standalone_mode=False)


def test_the_json_file_has_the_events_beside_the_words(fleet: CliFleet) -> None:
    path = fleet.folder / "events.json"
    done = fleet.zscout("request", "robot/a", "--json-file", str(path), "--", "sh", "-c", "echo out; exit 4")
    assert (done.returncode, done.stdout) == (4, "out\n")
    assert "request holds robot/a" in done.stderr or "sh holds robot/a" in done.stderr
    granted, ended = [one for one in events(path.read_text()) if one["event"] != "waits"]
    assert (granted["event"], granted["rcs"]) == ("granted", ["robot/a"])
    assert (ended["event"], ended["outcome"], ended["code"]) == ("ended", "released", 4)

    refused = fleet.zscout("take", "radio/rf0:rate=50", "--yes", "--json-file", str(path))
    assert refused.returncode == 2
    assert events(path.read_text()) == [
        {"event": "failed", "code": 2, "reason": "can never start: rate 50 of 10 at radio/rf0; request less"}
    ]


def test_the_json_file_may_be_a_descriptor(fleet: CliFleet) -> None:
    process = fleet.start("request", "robot/a", "--json-file", "1", "--", "true")
    lines = out_of(process).read().splitlines()
    assert process.wait(HANG) == 0, lines
    assert {"granted", "ended"} <= {json.loads(line)["event"] for line in lines if line.startswith("{")}


@pytest.mark.parametrize("target", ["/no/such/folder/file", "999", "0" * 30 + "999999999999999999999"])
def test_a_json_file_that_cannot_be_written_is_bad_input(target: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main.main(["request", "robot/a", "--json-file", target], standalone_mode=False) == 2
    assert "can't be written" in capfd.readouterr().err


def test_a_fifo_without_a_reader_is_not_waited_for(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / "fifo")
    assert main.main(["request", "robot/a", "--json-file", str(tmp_path / "fifo")], standalone_mode=False) == 2
    assert "fifo" in capfd.readouterr().err


def test_timeout_0_tries_once(fleet: CliFleet) -> None:
    blocker = fleet.holder("blocker", "robot/a", "--min-runtime", "10m")
    done = fleet.zscout("request", "robot/a", "--name", "next", "--timeout", "0", "--", "true")
    assert done.returncode == 1
    reason = rf"waits for {own('blocker')}: robot/a, until {CLOCK} at the latest"
    assert re.fullmatch(
        f"zscout: next was not granted at once, and is cancelled: {reason}", done.stderr.splitlines()[-1]
    )
    fleet.state(lambda state: not state.queue)
    end(blocker)


def test_timeout_0_has_what_another_request_yields_and_waits_for_votes(fleet: CliFleet) -> None:
    blocker = fleet.holder("blocker", "robot/a", "--min-runtime", "10m")
    assert fleet.zscout("request", "robot/a", "--priority", "5", "--timeout", "0", "--", "true").returncode == 0
    assert fleet.zscout("request", "radio/rf0:rate=5", "--timeout", "0", "--", "true").returncode == 0
    end(blocker)
