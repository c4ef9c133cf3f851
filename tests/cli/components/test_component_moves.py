"""`zscout migrate`, `drain` and `logs --follow`: components go from host to host, on a real mesh."""

from __future__ import annotations

import json
import re
import subprocess
import threading
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.behaviors.components.kit import ROOT
from tests.cli.cli_fleet import CliFleet
from tests.cli.tools import end, out_of, read_until
from tests.hang import HANG

pytestmark = pytest.mark.live
OTHER = {"anvil": "bellows", "bellows": "anvil"}


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    """Two nodes, which also know the kind that docs/components.md shows how to write."""
    fleet = CliFleet(tmp_path_factory.mktemp("moves"))
    try:
        install_example(fleet.folder / "site")
        fleet.lab.env["PYTHONPATH"] = f"{fleet.folder / 'site'}:{ROOT}"
        fleet.lab.node("anvil", "robot/a")
        fleet.lab.node("bellows", "robot/b")
        fleet.state(lambda state: {view.rc for view in state.rcs if view.present} == {"robot/a", "robot/b"})
        fleet.balanced("anvil", "bellows")
        yield fleet
    finally:
        fleet.close()


def install_example(folder: Path) -> None:
    """The package of docs/components.md, as if it were installed in `folder`."""
    text = (ROOT / "docs" / "components.md").read_text()
    code, project = (re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)[0] for kind in ("python", "toml"))
    kinds = tomllib.loads(project)["project"]["entry-points"]["zscout.components"]
    (folder / "survey").mkdir(parents=True)
    (folder / "survey" / "__init__.py").write_text(code)
    info = folder / "survey-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: survey\nVersion: 1.0\n")
    lines = "".join(f"{name} = {where}\n" for name, where in kinds.items())
    (info / "entry_points.txt").write_text(f"[zscout.components]\n{lines}")


def start(fleet: CliFleet, name: str, *args: str) -> str:
    """Starts a counter; returns its host."""
    done = fleet.zscout("start", "counter", "--name", name, "--json", *args)
    assert done.returncode == 0, done.stderr
    host: str = json.loads(done.stdout)["host"]
    return host


def stop(fleet: CliFleet, *names: str) -> None:
    done = fleet.zscout("stop", *names)
    assert done.returncode == 0, done.stderr


def follow(fleet: CliFleet, name: str, *args: str) -> subprocess.Popen[str]:
    """`logs --follow`, which does not outlast what these tests wait for: a reader of it is not for ever."""
    process = fleet.start("logs", name, "--follow", *args)
    limit = threading.Timer(4 * HANG, process.kill)
    limit.daemon = True
    limit.start()
    return process


def counted(follower: subprocess.Popen[str], number: int) -> list[str]:
    """The lines up to the first count that is so high: what a process says of its standing still has digits, too."""
    lines: list[str] = []
    for line in out_of(follower):
        lines.append(line.rstrip("\n"))
        if numbers(line) and numbers(line)[0] >= number:
            return lines
    raise AssertionError(f"it never counted to {number}: {lines}")


def kept_by(fleet: CliFleet, host: str, name: str, *, until: Callable[[list[int]], object] = bool) -> list[int]:
    """What the counter that ran there last has counted, as its host keeps it; as soon as that is so."""
    logs = ("logs", name, "--host", host)
    return numbers(fleet.until(lambda done: until(numbers(done.stdout)), *logs).stdout)


def migrate(fleet: CliFleet, *args: str) -> subprocess.CompletedProcess[str]:
    """Asks for a move, again where no host would do: one that stood still has not reported its load lately."""

    def begun(done: subprocess.CompletedProcess[str]) -> bool:
        return "can't move there" not in done.stderr and "no other host will do" not in done.stderr

    return fleet.until(begun, "migrate", *args)


def told(done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.slow
def test_migrating_keeps_the_count_and_followed_output_goes_along(fleet: CliFleet) -> None:
    here = start(fleet, "wanderer", "--set", "period=0.02", "--set", "rc=robot/a")
    there = OTHER[here]
    follower = follow(fleet, "wanderer")
    lines = counted(follower, 20)

    went = migrate(fleet, "wanderer", "--to", there)
    assert (went.returncode, went.stderr) == (0, "")
    assert re.fullmatch(rf"wanderer went from {here} to {there}, out of work for \d+ ms", went.stdout.splitlines()[-1])
    lines += read_until(follower, f"-- wanderer continues on {there}")
    (begins, *_) = kept_by(fleet, there, "wanderer")
    first = kept_by(fleet, here, "wanderer", until=lambda counts: counts[-1:] == [begins - 1])
    back = told(migrate(fleet, "wanderer", "--json"))
    assert (back["from"], back["host"], back["moves"]) == (there, here, 2)
    assert 0 < back["dead"] < HANG
    lines += read_until(follower, f"-- wanderer continues on {here}")

    stop(fleet, "wanderer")
    assert follower.wait(HANG) == 0
    lines += out_of(follower).read().splitlines()
    assert lines[-1].startswith("-- wanderer has ended")
    # Every count once and in order, over three processes on two hosts, as these have kept it.
    third = kept_by(fleet, here, "wanderer")
    second = kept_by(fleet, there, "wanderer", until=lambda counts: counts[-1:] == [third[0] - 1])
    kept = [*first, *second, *third]
    assert kept == list(range(1, kept[-1] + 1))
    # Who follows misses what came last on a host that stood still as it was asked for that, and nothing comes twice.
    counts = numbers("\n".join(lines))
    assert counts == sorted(set(counts))
    assert set(counts) <= set(kept)
    assert counts[-1] == kept[-1]


@pytest.mark.essential
def test_the_example_of_the_docs_moves_with_its_hold(fleet: CliFleet) -> None:
    done = fleet.zscout("start", "survey", "--set", "robot=robot/a", "--json")
    assert done.returncode == 0, done.stderr
    here = json.loads(done.stdout)["host"]
    (before,) = fleet.state(lambda state: [hold.arc for hold in state.holds] == ["survey"]).holds
    moved = migrate(fleet, "survey")
    assert moved.returncode == 0, moved.stderr
    (after,) = fleet.state(lambda state: [hold.client.split("/")[0] for hold in state.holds] == [OTHER[here]]).holds
    assert (before.arc, before.client) == ("survey", f"{here}/{before.client.split('/')[1]}")
    assert (after.id, after.client.split("/")[0]) == (before.id, OTHER[here])
    assert after.held > before.held, "it is the same hold"
    stop(fleet, "survey")
    assert fleet.idle("robot/a")


@pytest.mark.slow
def test_what_can_not_be_migrated_is_one_line(fleet: CliFleet) -> None:
    here = start(fleet, "stayer")
    assert fleet.zscout("migrate", "stayer", "--to", here).stdout == f"stayer is on {here} already\n"

    def both_seen(done: subprocess.CompletedProcess[str]) -> bool:
        return "anvil, bellows" in done.stderr or "bellows?" in done.stderr

    nowhere = fleet.until(both_seen, "migrate", "stayer", "--to", "nowhere")
    assert (nowhere.returncode, nowhere.stdout) == (2, "")
    assert nowhere.stderr.startswith('zscout: --to: unknown host "nowhere"; there are: anvil, bellows')
    near = fleet.until(both_seen, "migrate", "stayer", "--to", "bellow")
    assert (near.returncode, near.stderr) == (2, 'zscout: --to: unknown host "bellow"; did you mean bellows?\n')
    nobody = fleet.zscout("migrate", "stayr")
    assert (nobody.returncode, nobody.stdout) == (1, "")
    assert nobody.stderr == 'zscout: unknown component "stayr"; did you mean stayer?\n'
    stop(fleet, "stayer")
    ended = fleet.zscout("migrate", "stayer")
    assert ended.returncode == 1
    assert ended.stderr.startswith("zscout: stayer was not moved: ")


@pytest.mark.slow
def test_drain_empties_a_host_and_names_what_stays(fleet: CliFleet) -> None:
    hosts = {name: start(fleet, name, "--host", "anvil", "--host", "bellows") for name in ("one", "two")}
    pinned = start(fleet, "pinned", "--host", hosts["one"])
    assert pinned == hosts["one"]
    here, there = pinned, OTHER[pinned]

    fleet.zscout("drain", here, "--timeout", "1")
    # Why it stays is known to who is told it anew.
    fleet.shown("components", "--json", until=lambda text: "no other host will do: " in text)
    late = fleet.zscout("drain", here, "--timeout", "3")
    assert late.returncode == 1
    assert late.stderr.startswith(f"zscout: {here} is not empty after 3.0 s: ")
    assert f"pinned stays ({here} is drained, and no other host will do: " in late.stderr
    assert late.stderr.endswith(f"; {here} stays cordoned; to use it again: zscout uncordon {here}\n")
    stop(fleet, "pinned")
    drained = told(fleet.zscout("drain", here, "--json"))
    assert drained["stay"] == []
    assert start(fleet, "three") == there
    places = {
        one["component"]: one["host"]
        for one in told(fleet.zscout("components", "--json"))["components"]
        if one["state"] == "running"
    }
    assert places == {"one": there, "two": there, "three": there}

    assert fleet.zscout("uncordon", here).stdout == f"{here} is used again\n"
    plain = fleet.zscout("drain", there)
    assert plain.returncode == 0, plain.stderr
    assert f"one went to {here}, out of work for " in plain.stdout
    assert plain.stdout.endswith(
        f"{there} is empty; {there} stays cordoned; to use it again: zscout uncordon {there}\n"
    )
    assert fleet.zscout("uncordon", there).returncode == 0
    stop(fleet, "one", "two", "three")


def numbers(output: str) -> list[int]:
    """What a counter printed, without warnings that its process stood still."""
    return [int(line) for line in output.splitlines() if line.isdecimal()]


@pytest.mark.slow
def test_logs_of_what_runs_and_of_what_has_ended(fleet: CliFleet) -> None:
    here = start(fleet, "speaker", "--set", "period=0.01")
    follower = follow(fleet, "speaker", "--lines", "0")
    counted(follower, 50)
    stop(fleet, "speaker")
    assert follower.wait(HANG) == 0

    def answered(done: subprocess.CompletedProcess[str]) -> bool:
        return done.returncode == 0

    every = fleet.until(answered, "logs", "speaker")
    counts = numbers(every.stdout)
    assert counts == list(range(1, len(counts) + 1))
    some = fleet.until(answered, "logs", "speaker", "--lines", "2", "--host", here)
    assert some.stdout.splitlines() == every.stdout.splitlines()[-2:]
    elsewhere = fleet.zscout("logs", "speaker", "--host", OTHER[here])
    assert (elsewhere.returncode, elsewhere.stdout) == (1, "")
    assert elsewhere.stderr.startswith(f"zscout: {OTHER[here]} has no output of speaker; leave --host out")
    nobody = fleet.zscout("logs", "nobody")
    assert nobody.returncode == 1
    assert nobody.stderr.startswith('zscout: unknown component "nobody"; ')


@pytest.mark.slow
def test_followed_output_begins_when_the_component_does(fleet: CliFleet) -> None:
    begun = fleet.zscout("start", "counter", "--name", "later", "--host", "clamp", "--no-wait")
    assert begun.returncode == 0, begun.stderr
    none = fleet.zscout("logs", "later")
    assert none.returncode == 1
    assert "no host has output of later: it waits for a host: " in none.stderr
    follower = follow(fleet, "later")
    clamp = fleet.lab.node("clamp")
    try:
        counted(follower, 1)
        stop(fleet, "later")
        assert follower.wait(HANG) == 0
    finally:
        end(follower)
        clamp.terminate()
        clamp.wait(HANG)


@pytest.mark.slow
def test_followed_output_goes_over_when_a_host_dies(fleet: CliFleet) -> None:
    clamp = fleet.lab.node("clamp")
    # From now on it is known to the balancer.
    start(fleet, "first", "--host", "clamp")
    stop(fleet, "first")
    hosts = ("--host", "clamp", "--host", "bellows")
    if start(fleet, "survivor", "--set", "period=0.02", *hosts) != "clamp":
        assert migrate(fleet, "survivor").returncode == 0
    follower = follow(fleet, "survivor")
    counted(follower, 20)
    clamp.kill()
    lines = read_until(follower, "-- survivor continues on bellows")
    # It was not handed over: it begins anew.
    assert numbers("\n".join(counted(follower, 3))) == [1, 2, 3]
    # What it still wrote there, if that was read before its host died.
    assert all(number > 20 for number in numbers("\n".join(lines[:-1])))
    stop(fleet, "survivor")
    assert follower.wait(HANG) == 0
