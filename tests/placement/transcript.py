"""Stories of the placer's core as text (see `tests/transcripts.py`). Its commands:

at TIME                                 sets the clock for what follows; `at TIME COMMAND` too
until TIME                              lets time pass: each wake that was asked for is a batch of its own
lead COUNTER [rebalance]                a new placer, which inherits what the one before it knew
host HOST [cores=N] [speed=X] [load=X] [memory=MB] [labels=A,B]     its node is there, and reports on
report HOST ...                         from now on it reports so        silent HOST    no more reports
kind KIND cpu=X [memory=MB]             what a kind is known to use
place NAME [kind=K] [restart=R] [hosts=A,B] [labels=A,B] [memory=MB] [policy=P] [metric=M] [n=ANY]
end NAME       move NAME [HOST]         drain HOST       uncordon HOST       tick
maintained [HOST ...]                   the hosts in maintenance, from now on
start NAME INC HOST ok|refused|failed|unknown [movable] [final] [bad_params] [REASON]
stop NAME INC HOST done|said|unknown    `done`: and its token is gone; `said`: that is all
moved NAME INC HOST moved|refused|unknown [dead=S] [REASON]
appeared NAME INC HOST                  vanished NAME INC HOST
told HOST [only=NAME] [kinds=A,B] NAME:INC:PHASE[:movable][:bad_params][:WHY] ...   PHASE: starting standby running,
                                        or an end
seen HOST      lost HOST                its node, without a report
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any

from msgspec.structs import replace

from tests.placement.test_balancer import report
from tests.transcripts import ns, seconds, settings
from zscout import messages
from zscout.config.fleet import PlacementPolicy
from zscout.placement.balancer import Balancer
from zscout.placement.events import (
    ComponentChanged,
    ComponentsListed,
    HostCommand,
    HostJoined,
    HostLost,
    Inherited,
    Maintained,
    MoveAnswered,
    PlacementRefused,
    PlacerEffect,
    PlacerEvent,
    PlacerWakeAt,
    StartAnswered,
    StopAnswered,
    TokenAppeared,
    TokenVanished,
)
from zscout.placement.model import REPORT_EVERY, Profile
from zscout.placement.placer import Placer
from zscout.types import HostName, Ns

MEGABYTE = 1_000_000
MOST_WAKES = 1_000
"""Of one `until`: a placer that never rests is a fault."""


@dataclass
class PlacerPlayer:
    """A placer with the balancer that it asks; whose hosts report whenever time passes."""

    balancer: Balancer = field(default_factory=lambda: Balancer(Random(1)))  # noqa: S311
    now: Ns = 0
    wake: Ns | None = None
    reports: dict[HostName, dict[str, Any]] = field(default_factory=dict)
    number: int = 0

    def __post_init__(self) -> None:
        self.placer = Placer(self.balancer, 1)
        self.specs: dict[str, messages.ComponentSpec] = {}

    def batch(self, line: str) -> list[str]:
        events: list[PlacerEvent] = []
        for command in line.split(";"):
            words = command.split()
            if words[0] == "at":
                self.pass_to(ns(words[1]))
                words = words[2:]
            if words[:1] == ["until"]:
                return self.wait(ns(words[1]))
            if words[:1] == ["stop"] and words[-1] == "done":
                events.append(TokenVanished(words[1], int(words[2]), words[3]))
            if words[:1] == ["lead"]:
                events += self.lead(int(words[1]), rebalance="rebalance" in words)
            elif words and (event := self.event(words[0], words[1:])) is not None:
                events.append(event)
        if not events and words != ["tick"]:
            return []
        return self.handle(*events) or ["nothing"]

    def handle(self, *events: PlacerEvent) -> list[str]:
        found = []
        for effect in self.placer.handle(self.now, *events):
            if isinstance(effect, PlacerWakeAt):
                self.wake = effect.at
            found.append(self.print(effect))
        return found

    def pass_to(self, now: Ns) -> None:
        self.now = now
        self.number += 1
        for host in self.reports:
            self.report(host)

    def wait(self, until: Ns) -> list[str]:
        """Wakes and reports up to then."""
        found: list[str] = []
        for _ in range(MOST_WAKES):
            due = min(until, self.now + REPORT_EVERY, until if self.wake is None else max(self.wake, self.now))
            self.pass_to(due)
            if self.wake is not None and self.wake <= due:
                found += [f"at {seconds(due)}: {line}" for line in self.handle()]
            if due == until:
                return found
        raise ValueError(f"woke {MOST_WAKES} times")

    def lead(self, counter: int, *, rebalance: bool) -> list[PlacerEvent]:
        records = tuple(self.placer.components.values())
        cordoned = self.placer.cordoned - {*self.placer.maintained}  # as candidates keep it
        self.balancer.cordoned.clear()
        self.placer, self.wake = Placer(self.balancer, counter, PlacementPolicy(rebalance=rebalance)), None
        return [Inherited(records, cordoned)]

    def report(self, host: HostName) -> None:
        known = self.reports[host]
        memory = int(known.get("memory", 4_000)) * MEGABYTE
        figures = {key: float(known.get(key, 1)) for key in ("cores", "speed")}
        told = report(
            host, self.number, float(known.get("load", 0)), labels=tuple(_names(known.get("labels"))), **figures
        )
        self.balancer.reported(self.now, replace(told, memory_available=memory, memory_total=2 * memory))

    def event(self, verb: str, words: Sequence[str]) -> PlacerEvent | None:
        match verb, *words:
            case "host" | "report", host, *options:
                self.number += 1
                self.reports[host] = settings(options, "cores", "speed", "load", "memory", "labels")
                self.report(host)
                return HostJoined(host) if verb == "host" else None
            case "silent", host:
                del self.reports[host]
                return None
            case "maintained", *hosts:
                return Maintained(frozenset(hosts))
            case "kind", kind, *options:
                known = settings(options, "cpu", "memory")
                memory = int(known.get("memory", 64)) * MEGABYTE
                self.balancer.profiles[kind] = Profile(float(known["cpu"]), memory, 9)
                return None
            case "place", name, *options:
                self.specs[name] = _spec(options)
                return messages.PlaceComponent(name, self.specs[name])
            case "start", name, incarnation, host, result, *rest:
                return _start_answered(name, int(incarnation), host, result, rest)
            case "stop", name, incarnation, host, "done" | "said" | "unknown" as result:
                return StopAnswered(name, int(incarnation), host, done=result != "unknown")
            case "moved", name, incarnation, host, result, *rest:
                return _move_answered(name, int(incarnation), host, result, rest)
            case "told", host, *rest:
                only = next((word[5:] for word in rest if word.startswith("only=")), None)
                kinds = next((frozenset(_names(word[6:])) for word in rest if word.startswith("kinds=")), None)
                told = [self.seen(host, word) for word in rest if not word.startswith(("only=", "kinds="))]
                return ComponentsListed(host, tuple(told), only, kinds)
            case "lost", host:
                self.reports.pop(host, None)
                return HostLost(host)
            case ("tick",):
                return None
        others: dict[str, Callable[..., PlacerEvent]] = {
            "end": messages.EndComponent,
            "move": lambda name, to=None: messages.MigrateComponent(name, to),
            "drain": messages.DrainHost,
            "uncordon": messages.UncordonHost,
            "appeared": lambda name, incarnation, host: TokenAppeared(name, int(incarnation), host),
            "vanished": lambda name, incarnation, host: TokenVanished(name, int(incarnation), host),
            "seen": HostJoined,
        }
        if verb not in others:
            raise ValueError(f"no such command: {' '.join([verb, *words])}")
        return others[verb](*words)

    def seen(self, host: HostName, word: str) -> messages.ComponentView:
        name, incarnation, phase, *rest = word.split(":")
        lives = phase in {"starting", "standby", "running"}
        movable = "movable" in rest
        return messages.ComponentView(
            component=name,
            incarnation=int(incarnation),
            host=host,
            spec=self.specs.get(name, messages.ComponentSpec("job")),
            phase=phase if lives else "ended",  # type: ignore[arg-type]
            movable=movable,
            ended=None if lives or phase == "lost" else phase,  # type: ignore[arg-type]
            reason=" ".join(part for part in rest if part not in ("movable", "bad_params")).replace("_", " "),
            bad_params="bad_params" in rest,
        )

    def print(self, effect: PlacerEffect) -> str:
        match effect:
            case HostCommand(host, messages.StartComponent(component, incarnation, _, standby)):
                return f"start {component} {incarnation} on {host}" + (" to stand by" if standby else "")
            case HostCommand(host, messages.StopComponent(component, incarnation)):
                return f"stop {component} {incarnation} on {host}"
            case HostCommand(host, messages.MoveComponent(component, incarnation, to, to_incarnation)):
                return f"move {component} {incarnation} on {host} to {to_incarnation} on {to}"
            case HostCommand(host, messages.ListComponents(component)):
                return f"look at {host} for {component}"
            case ComponentChanged(component, placement):
                return f"forgotten {component}" if placement is None else _print(placement)
            case PlacementRefused(about, code, message):
                return f"refused {about} {code}: {message}"
            case PlacerWakeAt(at):
                return "wake " + ("never" if at is None else f"at {seconds(at)}")
            case _:
                raise AssertionError(effect)


def _print(record: messages.Placement) -> str:
    words = [f"{record.component}: {record.state}"]
    words += [f"on {record.host}"] if record.host else []
    words += [f"to {record.to}"] if record.to else []
    words += [f"({record.incarnation})"] if record.incarnation else []
    words += [] if record.wanted else ["unwanted"]
    words += ["movable"] if record.movable else []
    words += [f"restarts={record.restarts}"] if record.restarts else []
    words += [f"moves={record.moves}"] if record.moves else []
    words += [f"dead={record.dead:g}"] if record.dead is not None else []
    return " ".join(words) + (f": {record.reason}" if record.reason else "")


def _start_answered(name: str, incarnation: int, host: str, result: str, rest: list[str]) -> StartAnswered:
    if result not in {"ok", "refused", "failed", "unknown"}:
        raise ValueError(f"no such result: {result}")
    words = [word for word in rest if word not in {"movable", "final", "bad_params"}]
    return StartAnswered(
        name,
        incarnation,
        host,
        result,  # type: ignore[arg-type]
        reason=" ".join(words),
        movable="movable" in rest,
        again="final" not in rest,
        bad_params="bad_params" in rest,
    )


def _move_answered(name: str, incarnation: int, host: str, result: str, rest: list[str]) -> MoveAnswered:
    if result not in {"moved", "refused", "unknown"}:
        raise ValueError(f"no such result: {result}")
    dead = next((float(word[5:]) for word in rest if word.startswith("dead=")), 0.0)
    words = [word for word in rest if not word.startswith("dead=")]
    return MoveAnswered(name, incarnation, host, result, " ".join(words), dead)  # type: ignore[arg-type]


def _spec(options: list[str]) -> messages.ComponentSpec:
    known = settings(options, "kind", "restart", "hosts", "labels", "memory", "policy", "metric", "n")
    return messages.ComponentSpec(
        kind=known.get("kind", "job"),
        restart=known.get("restart", "on_failure"),
        metric=known.get("metric", "composite"),
        policy=known.get("policy", "pending"),
        labels=_names(known.get("labels")),
        memory=int(known.get("memory", 0)) * MEGABYTE,
        hosts=_names(known["hosts"]) if "hosts" in known else None,
        params={"n": known["n"]} if "n" in known else {},
    )


def _names(text: str | None) -> list[str]:
    return sorted(text.split(",")) if text else []
