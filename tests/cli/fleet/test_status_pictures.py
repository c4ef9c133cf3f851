"""`zscout status` as people see it: a fleet in words, and its lines at terminals of three widths and in a pipe."""

from __future__ import annotations

import shlex
import time
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from msgspec import structs
from rich.cells import cell_len

from tests import transcripts
from tests.cli.test_words import NOW, Stopped
from zscout import terminal
from zscout.cli.fleet.fleet_view import Devices, FleetView, Host
from zscout.cli.fleet.status import StatusView
from zscout.config.access import AccessPolicy
from zscout.keyexpr import Role, Token
from zscout.messages import (
    BookedDate,
    BookingsTold,
    BookingView,
    Correction,
    HoldView,
    LoadReport,
    RcmState,
    RcState,
    RcView,
    ReasonInfo,
    ReasonParty,
    Unwell,
    WaitView,
    Who,
)
from zscout.types import VERSION, Grant, Place, Term

STORIES = sorted((Path(__file__).parent / "pictures").glob("*.txt"))
TERM = Term(3, "rcm")
PLACE, GRANT = Place(TERM, 1), Grant(TERM, 1)
GIB = 2**30


@pytest.fixture(autouse=True)
def stopped(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "Europe/Berlin")
        time.tzset()
        patch.setattr(terminal, "datetime", Stopped)
        yield
    time.tzset()


def needed(words: str) -> dict[str, dict[str, Decimal]]:
    """`robot/a,radio/rf0:rate=4`."""
    found: dict[str, dict[str, Decimal]] = {}
    for need in words.split(","):
        rc, _, params = need.partition(":")
        found[rc] = {
            name: Decimal(value) for name, _, value in (one.partition("=") for one in params.split(";") if one)
        }
    return found


def asked(name: str, options: dict[str, str]) -> dict[str, Any]:
    """The fields of a hold and of a wait: `survey by=alice@desk of=robot/a`; without `by` only its client is known."""
    user, _, host = options.get("by", "").partition("@")
    who = Who(user, "", options.get("runs", "python3 survey.py"), options.get("says", "")) if user else None
    return {
        "id": f"id-{name}",
        "arc": name,
        "client": f"{host or 'desk'}/c-{name[:8]}",
        "priority": int(options.get("priority", 0)),
        "place": PLACE,
        "needs": needed(options["of"]),
        "min_runtime": Decimal(600),
        "who": who,
    }


class Picture:
    """A player of `pictures/*.txt`: commands add to the fleet, `show WIDTH [NAME...]` and `pipe lines` print it; `^[`
    is an escape, `^J` a newline."""

    def __init__(self) -> None:
        self.state: RcmState | None = RcmState(TERM, 1, "anvil", version=VERSION)
        self.hosts: dict[str, Host] = {}
        self.health: dict[str, RcState] = {}
        self.booked = BookingsTold(NOW.timestamp())
        self.cordoned = set[str]()

    def batch(self, line: str) -> list[str]:
        for command in line.split(" & "):
            kind, name, *words = (word.replace("^[", "\x1b").replace("^J", "\n") for word in shlex.split(command))
            if kind in ("show", "pipe"):
                return self.lines(name, words)
            getattr(self, kind)(name, dict(word.split("=", 1) for word in words))
        return []

    def host(self, name: str, options: dict[str, str]) -> None:
        roles = options.get("has", "node").split(",")
        tokens = {Token(name, role, f"{role}{number}", "i") for number, role in enumerate(roles)}
        load = LoadReport(name, 1, 8, (0.52, 0.5, 0.4), 7, 20 * GIB, 32 * GIB, version=VERSION)
        self.hosts[name] = Host(tokens, load if Role.NODE in roles else None)

    def device(self, name: str, options: dict[str, str]) -> None:
        at, gone = options.get("at", "anvil"), options.get("gone")
        shared = options.get("use") == "shared"
        twins = options["twins"].split(",") if "twins" in options else []
        because = options.get("because", "")
        view = RcView(name, gone is None, shared, [], at, because, float(gone) if gone else None, twins)
        assert self.state is not None
        self.state.rcs.append(view)
        if gone is None:
            self.hosts[at].tokens.add(Token(at, Role.RC, name, "i"))
        figures: dict[str, float] = {
            figure: float(options[figure]) for figure in ("rate", "frozen_seconds") if figure in options
        }
        health = options.get("health", "ok")
        sick = Unwell(options["unwell"], since=180.0, left=45.0) if "unwell" in options else None
        self.health[name] = RcState(name, at, "i", shared, health=health, unwell=sick, figures=figures)
        if (kept := options.get("kept")) is not None:
            start = round(NOW.timestamp()) + {"maintenance": -60, "drained": -60, "broken": -60, "booked": 3600}[kept]
            self.cordoned |= {at} if kept == "drained" else set()
            date = BookedDate(start, start + 120, "open")
            view_of = BookingView(
                id="b1",
                owner="anvil",
                name=f"drain-{at}" if kept == "drained" else "service",
                needs={f"@{at}" if kept == "drained" else name: {}},
                start=date.start,
                priority=0,
                runtime=Decimal(120),
                patience=Decimal(0),
                maintenance=kept != "booked",
                dates=[date],
                maintained=[name] if kept == "drained" else [],
                lasting=kept in ("drained", "broken"),
                broken=kept == "broken",
                who=Who("ada", "", "", "its gripper is bent") if kept == "broken" else None,
            )
            self.booked.bookings.append(view_of)

    def clock(self, name: str, options: dict[str, str]) -> None:
        """`NAME ahead=SECONDS` of a host, or `fleet corrected=SECONDS`."""
        ahead = {name: float(options["ahead"])} if "ahead" in options else {}
        corrected = Correction(float(options["corrected"]), 300.0) if "corrected" in options else self.booked.corrected
        self.booked = structs.replace(self.booked, clocks=self.booked.clocks | ahead, corrected=corrected)

    def hold(self, name: str, options: dict[str, str]) -> None:
        assert self.state is not None
        likely = float(options["likely"]) if "likely" in options else None
        held, left = float(options.get("held", 600)), float(options.get("left", 1200))
        view = HoldView(**asked(name, options), grant=GRANT, held=held, remaining=left, keep=True, ends_in=likely)
        self.state.holds.append(view)

    def wait(self, name: str, options: dict[str, str]) -> None:
        """`behind=survey:robot/a` is the hold in its way; `reason` the words of the leader."""
        assert self.state is not None
        why = None
        if "behind" in options:
            arc, _, rc = options["behind"].partition(":")
            by = next(hold for hold in self.state.holds if hold.arc == arc)
            party = ReasonParty(by.id, by.arc, by.client, by.priority, by.who, by.remaining)
            patterns = [need for need in needed(options["of"]) if "*" in need]
            why = ReasonInfo(options.get("code", "held"), [rc], [party], count=1, patterns=patterns)
        starts = float(options["starts"]) if "starts" in options else None
        view = WaitView(**asked(name, options), waited=300, reason=options.get("reason", ""), starts_in=starts, why=why)
        self.state.queue.append(view)

    def leader(self, name: str, options: dict[str, str]) -> None:
        self.state = None if name == "none" else self.state

    def group(self, name: str, options: dict[str, str]) -> None:
        assert self.state is not None
        self.state.charged[name] = float(options["used"])

    def lines(self, width: str, words: list[str]) -> list[str]:
        fleet = SimpleNamespace(
            name="lab",
            security=None,
            access=AccessPolicy(),
            operator_priority=10,
            scheduling=SimpleNamespace(fair_shares=None),
        )
        seen = SimpleNamespace(
            client=SimpleNamespace(fleet=fleet),
            mesh=SimpleNamespace(links=lambda: 2, now=lambda: 0),
            placer=SimpleNamespace(cordoned=self.cordoned),
            hosts=self.hosts,
            all_hosts=lambda: dict(sorted(self.hosts.items())),
            tokens=lambda role: [token for host in self.hosts.values() for token in host.tokens if token.role == role],
            ending=dict,
            rights=dict,
            faults=dict,
            unrecorded=dict,
            stale=lambda host: False,
        )
        devices = cast("Devices", SimpleNamespace(known=lambda: self.health))
        names = [word for word in words if word != "--devices"]
        shown = StatusView(cast("FleetView", seen), self.state, devices, "--devices" in words, names, self.booked)
        if width == "lines":
            plain = shown.overview(plain=True)
            return [f"|{line}" for table in plain.tables if table.rows for line in table.lines()]
        found = [text for text, _style in shown.overview(plain=False).lines(int(width))]
        assert all(cell_len(line) <= int(width) and terminal.clean(line) == line for line in found)
        return [*(f"|{line}" for line in found), f"({len(found)} lines)"]


@pytest.mark.parametrize("story", STORIES, ids=lambda path: path.stem)
def test_a_fleet_as_people_see_it(story: Path) -> None:
    transcripts.check(Picture(), story)


def test_eight_devices_three_holds_and_two_waiting_fit_a_usual_terminal() -> None:
    text = (Path(__file__).parent / "pictures" / "at_work.txt").read_text(encoding="utf-8")
    counts = [int(line.split("(")[1].split()[0]) for line in text.splitlines() if line.endswith(" lines)")]
    assert counts[1] <= 24, "at 100 columns"
