"""Journals of real nodes: what `zscout history`, `usage` and `why` tell, also after a node was killed."""

from __future__ import annotations

import csv
import io
import json
import signal
import sqlite3
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from tests.cli.tools import zscout_soon
from tests.live.bench import granted
from tests.live.lab import PATIENT, Lab, awaited
from zscout.keyexpr import Role
from zscout.messages import Grants
from zscout.services.journal.store import FILE
from zscout.types import Term

pytestmark = pytest.mark.live


async def told(lab: Lab, until: Callable[[dict[str, Any]], object], *args: str) -> dict[str, Any]:
    """What `zscout history --json` tells as soon as it is so."""
    done = await awaited(
        lambda: lab.zscout("history", "--json", *args),
        lambda done: done.returncode == 0 and until(json.loads(done.stdout)),
    )
    return dict(json.loads(done.stdout))


def file_of(lab: Lab, host: str) -> Path:
    return lab.folder / "state" / "zscout" / lab.fleet.name / host / FILE


async def committed(lab: Lab, host: str, *holds: tuple[str, str]) -> None:
    """Waits until one host's own journal has these holds, as (ARC, outcome): what the fleet tells may be another's."""

    async def found() -> set[tuple[str, str]]:
        with closing(sqlite3.connect(f"{file_of(lab, host).as_uri()}?mode=ro", uri=True)) as db:
            return set(db.execute("SELECT arc, outcome FROM holds").fetchall())

    await awaited(found, set(holds).issubset)


@pytest.mark.slow
async def test_what_was_held_is_known_after_a_node_is_killed(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("anvil", "bellows")) as lab:
        lab.node("anvil", "robot/a")
        client = await lab.begun("program")
        lab.node("bellows", "robot/b")
        await lab.ready(client, "robot/b")
        await lab.candidates(client, "anvil", "bellows")
        survey = await client.request("survey", {"robot/b": {}}, min_runtime=600)
        await lab.held_by(client, "robot/b", "survey")
        take = await client.request("take", {"robot/b": {}}, priority=10, min_runtime=600)
        await lab.held_by(client, "robot/b", "take")
        grant = await granted(client, take)
        for _ in range(20):
            await client.command("robot/b", grant, {"name": "echo"})
        both = {"anvil", "bellows"}
        first = await told(
            lab,
            lambda found: (
                [hold["outcome"] for hold in found["holds"]] == ["preempted", ""]
                and {one["host"] for one in found["candidates"] if one["gaps"] is not None} == both
            ),
        )
        assert first["holds"][0]["by"]["arc"] == "take"

        # The leader is killed, with what it has committed; the other goes on, with its own journal.
        for host in both:
            await committed(lab, host, ("survey", "preempted"), ("take", ""))
        await lab.candidates(client, "bellows")
        killed = datetime.now(UTC)
        lab.signal("anvil", signal.SIGKILL)
        lab.nodes["anvil"].wait()
        await lab.living(client, Role.RCM, lambda hosts: hosts == ["bellows"])
        await client.end(take)
        await lab.held_by(client, "robot/b", "survey")
        led = datetime.now(UTC)
        (last,) = [use.seconds for use in (await lab.rc(client, "robot/b")).used if use.grant == grant]
        # What it said while they stood may have been less.
        later = await told(
            lab,
            lambda found: (
                [one["outcome"] for one in found["holds"]] == ["preempted", "released", ""]
                and [one["used_rc_seconds"] for one in found["holds"][:2]] == [0.0, last]
            ),
        )
        used = [one["used"]["robot/b"] for one in later["holds"][:2]]
        assert used == [0.0, last]
        # By the clock of another candidate, which heard it a moment sooner or later.
        assert 0 < last <= later["holds"][1]["held"] + PATIENT
        assert later["holds"][0]["grant"] == first["holds"][0]["grant"]
        assert later["holds"][0]["held"] == pytest.approx(first["holds"][0]["held"], abs=PATIENT)

        # Its file opens again with all that was committed, and it knows since when it was away.
        with sqlite3.connect(file_of(lab, "anvil")) as db:
            assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
            assert db.execute("SELECT arc, outcome FROM holds ORDER BY id").fetchall()[0] == ("survey", "preempted")
        lab.node("anvil", "robot/a")
        again = await told(
            lab,
            lambda found: any(
                gap["cause"] == "off"
                for one in found["candidates"]
                if one["host"] == "anvil"
                for gap in one["gaps"] or ()
            ),
        )
        assert [hold["outcome"] for hold in again["holds"]] == ["preempted", "released", ""]
        # One of the two always ran: no time is unknown, but while nobody led, on a machine where that takes long.
        for gap in again["gaps"]:
            assert killed - timedelta(seconds=PATIENT) < datetime.fromisoformat(gap["began"])
            assert datetime.fromisoformat(gap["ended"]) < led

        # In a pipe: a line for each hold, newest last.
        plain = (await lab.zscout("history", "--rc", "robot/*")).stdout.splitlines()
        assert plain[0].startswith("Holds since ")
        assert plain[1].split() == ["BEGAN", "HELD", "REQUEST", "WHO", "PRIORITY", "WAITED", "END", "DEVICES"]
        assert [line.split()[-1] for line in plain[2:5]] == ["robot/b"] * 3
        assert "preempted by take" in plain[2]
        assert "in force" in plain[4]
        rows = [*csv.DictReader(io.StringIO((await lab.zscout("history", "--csv")).stdout))]
        assert [(row["arc"], row["outcome"], row["rcs"]) for row in rows] == [
            ("survey", "preempted", "robot/b"),
            ("take", "released", "robot/b"),
            ("survey", "", "robot/b"),
        ]
        assert (rows[1]["used"], rows[1]["used_rc_seconds"]) == (f"robot/b={used[1]}", str(used[1]))
        assert (await lab.zscout("history", "--rc", "robot/a")).stdout.startswith("no holds since ")

        by_rc = json.loads((await lab.zscout("usage", "--by", "rc", "--json")).stdout)
        (account,) = by_rc["accounts"]
        assert (account["key"], account["holds"], account["preempted"]) == ("robot/b", 3, 1)
        assert account["used"] >= used[1]
        assert (
            account["thrown_away"]
            == account["preempted_seconds"]
            == pytest.approx(again["holds"][0]["held"], abs=PATIENT)
        )
        by_user = (await lab.zscout("usage")).stdout.splitlines()
        assert by_user[1].split()[:2] == ["USER", "HOLDS"]
        assert by_user[2].split()[1] == "3"
        assert by_user[1].split()[5:7] == ["USED", "WAITED"]

        # A leader that begins anew remembers nothing of it; the journals do.
        await client.end(survey)
        await told(lab, lambda found: [one["outcome"] for one in found["holds"]][2:] == ["released"])
        await committed(lab, "anvil", ("survey", "preempted"), ("survey", "released"))
        await lab.candidates(client, "anvil")
        lab.signal("bellows", signal.SIGKILL)
        lab.nodes["bellows"].wait()
        await lab.living(client, Role.RCM, lambda hosts: hosts == ["anvil"])
        why = await lab.zscout("why", "take")
        assert why.returncode == 0
        assert why.stdout.startswith("take is no longer open\nHolds, from the journals of the candidates\n")
        assert "priority 10, held robot/b\n" in why.stdout
        as_json = json.loads((await lab.zscout("why", survey.id, "--json")).stdout)
        (arc,) = as_json["arcs"]
        assert (arc["state"], [hold["outcome"] for hold in arc["holds"]]) == ("ended", ["preempted", "released"])
        unknown = await lab.zscout("why", "nobody")
        assert unknown.returncode == 1


@pytest.mark.slow
async def test_journals_answer_while_nobody_leads(tmp_path: Path) -> None:
    # Who is deposed leads again after a lease at the earliest, about.
    async with Lab(tmp_path, lease=3 * PATIENT) as lab:
        lab.node("anvil", "robot/a")
        client = await lab.begun("program")
        await client.end(await client.request("survey", {"robot/a": {}}, min_runtime=600))
        await told(lab, lambda found: [hold["outcome"] for hold in found["holds"]] == ["released"])
        above = Grants(Term((await lab.state(client, lambda _: True)).term.counter + 1, "stranger"), 1, 0, 0.5)
        mesh = await lab.manager(client)
        mesh.publisher(mesh.keys.grants, Grants).put(above)
        await lab.living(client, Role.RCM, lambda hosts: not hosts)
        for command, found in (("history", "holds"), ("usage", "accounts")):
            done = await lab.zscout(command, "--json")
            assert (done.returncode, done.stderr) == (0, "")
            assert len(json.loads(done.stdout)[found]) == 1


async def test_where_nobody_is_there_nobody_answers(lab: Lab) -> None:
    done = await zscout_soon("history", env=lab.env)
    assert done.returncode == 3
    assert done.stderr.startswith(f"zscout: no leader is on the mesh of fleet {lab.fleet.name} (no other program")


async def test_a_fleet_without_a_journal_says_so(lab: Lab) -> None:
    lab.node("anvil", "robot/a", extra="[journal]\noff = true")
    await lab.begun("program")
    for command in ("history", "usage"):
        done = await lab.zscout(command)
        assert done.returncode == 1
        assert f"no journal of fleet {lab.fleet.name} can be read" in done.stderr
        assert done.stderr.count("\n") == 1
    assert not file_of(lab, "anvil").exists()
