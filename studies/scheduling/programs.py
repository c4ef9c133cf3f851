"""Programs that request one ARC after the other, played through the core under virtual time. As in real programs, each
request follows the end of the previous one, so a group's later requests depend on its earlier grants."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from zscout.config.scheduling_policy import SchedulingPolicy
from zscout.scheduling import model
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.types import SECOND, ArcId, Ns, Params, RcName


class ProgramJob(NamedTuple):
    """Requested `pause` ns after the end of the previous ARC, for `asked` ns; done after `used` ns, if less: released
    early."""

    pause: Ns
    rcs: tuple[RcName, ...]
    asked: Ns
    used: Ns


@dataclass(slots=True)
class Use:
    """A group's useful and charged RC-seconds; waits in seconds."""

    useful: float = 0.0
    charged: float = 0.0
    done: int = 0
    waited: float = 0.0
    longest: float = 0.0

    @property
    def mean_wait(self) -> float:
        return self.waited / max(1, self.done)


@dataclass(slots=True)
class _Program:
    name: str
    """Unique in its run, and the same in each run."""
    group: str
    jobs: Iterator[ProgramJob]
    job: ProgramJob
    number: int = 0
    asked_at: Ns = 0


@dataclass(slots=True)
class _Run:
    core: Core
    programs: dict[ArcId, _Program] = field(default_factory=dict)
    """By the ARC that a program has requested."""
    coming: list[tuple[Ns, int, _Program | ArcId | None]] = field(default_factory=list)
    """A heap of events: a program requests, an ARC is released, or (None) a minimum runtime is over."""
    pushed: int = 0
    uses: dict[str, Use] = field(default_factory=dict)
    begun: dict[ArcId, Ns] = field(default_factory=dict)

    def push(self, at: Ns, what: _Program | ArcId | None) -> None:
        self.pushed += 1
        heapq.heappush(self.coming, (at, self.pushed, what))

    def ask_next(self, program: _Program, now: Ns) -> None:
        job = next(program.jobs, None)
        if job is not None:
            program.job, program.number = job, program.number + 1
            self.push(now + job.pause, program)

    def event(self, what: _Program | ArcId | None, now: Ns) -> model.Event:
        if what is None:
            return model.Tick()
        if not isinstance(what, _Program):
            return model.Released(what)
        arc, job = f"{what.name}.{what.number}", what.job
        self.programs[arc], what.asked_at = what, now
        needs: dict[RcName, Params] = {rc: {} for rc in job.rcs}
        return model.Requested(model.ArcRequest(arc, f"{what.group}/study", needs, 1, job.asked))

    def note(self, effect: model.Effect, now: Ns) -> None:
        match effect:
            case model.Granted(arc=arc):
                program = self.programs[arc]
                job, use = program.job, self.uses[program.group]
                self.begun[arc] = now
                waited = (now - program.asked_at) / SECOND
                use.waited, use.longest = use.waited + waited, max(use.longest, waited)
                self.push(now + min(job.used, job.asked), arc if job.used < job.asked else None)
            case model.HoldEnded(arc=arc):
                program = self.programs.pop(arc)
                self.used(program, arc, now)
                self.uses[program.group].done += 1
                self.ask_next(program, now)
            case _:
                pass

    def used(self, program: _Program, arc: ArcId, now: Ns) -> None:
        held = min(now - self.begun.pop(arc), program.job.used)
        self.uses[program.group].useful += held * len(program.job.rcs) / SECOND


def play(
    rcs: Sequence[RcName], groups: Mapping[str, Sequence[Iterator[ProgramJob]]], policy: SchedulingPolicy, until: Ns
) -> dict[str, Use]:
    """Each group's use until `until`. Strategy `adaptive`, exclusive RCs, a single priority. Groups are named like
    hosts."""
    run = _Run(Core(Adaptive(), policy), uses={group: Use() for group in groups})
    for group, programs in groups.items():
        for number, jobs in enumerate(programs):
            program = _Program(f"{group}/{number}", group, jobs, ProgramJob(0, (), 0, 0))
            run.ask_next(program, 0)
    now: Ns = 0
    events: list[model.Event] = [model.RcJoined(rc, sharable=False) for rc in rcs]
    while True:
        for effects in play_instant(run.core, now, events, _no_vote):
            for effect in effects:
                run.note(effect, now)
        at = run.coming[0][0] if run.coming else until
        now = min(at, until, run.core.next_change() or until, run.core.next_order() or until)
        if now >= until:
            break
        events = []
        while run.coming and run.coming[0][0] <= now:
            events.append(run.event(heapq.heappop(run.coming)[2], now))
        events = events or [model.Tick()]
    run.core.handle(until, model.Tick())
    for arc in list(run.begun):
        run.used(run.programs[arc], arc, until)
    shares = run.core.charged_in_all()
    for group, use in run.uses.items():
        use.charged = shares.get(group, 0.0)
    return run.uses


def _no_vote(asked: model.Propose) -> model.Vote:
    raise AssertionError(f"{asked.rc} is exclusive")
