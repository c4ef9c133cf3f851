"""Moving a running component: something stands by elsewhere, the source hands over to it, and whatever goes
wrong, one of the two goes on. Which one, the hosts are asked where no answer tells.
"""

from __future__ import annotations

from typing import Final

from zscout.balancing.model import SECOND, ComponentId, HostName, Ns
from zscout.placing.entry import Entry, Fate, Moving
from zscout.placing.events import MoveAnswered, StartAnswered
from zscout.placing.ground import ANSWER, Ground
from zscout.placing.keeping import Keeper

STARTS: Final = 3
"""The target is asked so often, if it does not answer."""
HAND_OVER: Final[Ns] = 30 * SECOND
"""A hand-over that says nothing for as long: both hosts are asked how it stands."""
LOOKS: Final = 3
"""Both are asked so often."""
PATIENT_LOOKS: Final = 15
"""So often while one runs and the other stands by: they may be at it still, and what stands by ends itself
after 30 s."""
RETRY: Final[Ns] = 5 * SECOND
"""A drained host tries as long after to move again what would not move."""


class Mover:
    """Moves, one for each component at most. `entry.move` is there exactly while the entry is `moving`."""

    def __init__(self, ground: Ground, keeper: Keeper) -> None:
        self.ground, self.keeper = ground, keeper

    # Beginning

    def asked(self, component: ComponentId, to: HostName | None) -> None:
        """Someone asks for a move; what can't be is refused."""
        ground = self.ground
        entry = ground.entry(component)
        if entry is None:
            ground.refuse(component, "unknown_component", f"there is no component {component}")
        elif entry.move is not None and to in (None, entry.move.to):
            ground.touch(component, asked=True)
        elif entry.move is not None:
            message = f"{component} is moving to {entry.move.to} already: wait for that"
            ground.refuse(component, "move_failed", message)
        elif entry.state != "running":
            message = f"{component} does not run: it is {entry.state.replace('_', ' ')}"
            ground.refuse(component, "not_running", message)
        elif to == entry.host:
            ground.touch(component, asked=True)
        elif not entry.movable:
            ground.refuse(component, "not_movable", f"{component} gives no checkpoint: it can't be moved")
        else:
            fit = ground.fit(entry.spec, but=entry.host, only=to)
            if fit.hosts:
                self.begin(entry, fit.hosts[0].host, "as asked")
                ground.touch(component, asked=True)
            elif to is not None:
                ground.refuse(component, "unknown_host", f"{component} can't move there: {fit.why_none()}")
            else:
                message = f"no other host will do for {component}: {fit.why_none()}"
                ground.refuse(component, "move_failed", message)

    def begin(self, entry: Entry, to: HostName, why: str) -> None:
        """The entry runs and is movable, and `to` is fit for it. `why`: in words."""
        ground = self.ground
        entry.move = Moving(to, ground.fresh(entry.component), why)
        entry.state, entry.reason, entry.stays = "moving", f"moving to {to}, {why}", ""
        # Room is kept for it there; the other name is nobody's, for names have no blanks.
        ground.came(_shadow(entry), entry.spec.kind, to)
        ground.start_standby(entry, entry.move)

    # The target

    def target_answered(self, entry: Entry, move: Moving, answer: StartAnswered) -> None:
        if move.stage != "starting":
            return
        move.start_until = None
        match answer.result:
            case "ok":
                self._hand_over(entry, move)
            case "unknown":
                self._target_silent(entry, move, answer.reason or "it does not answer")
            case _:
                move.target = "ended"
                self._stay(entry, f"{answer.result}: {answer.reason}")

    def _target_silent(self, entry: Entry, move: Moving, reason: str) -> None:
        move.start_until = None
        move.tries += 1
        if move.tries >= STARTS:
            self._stay(entry, reason)
        else:
            self.ground.wake_move(entry, self.ground.now + self.ground.pause(move.tries - 1))

    def _hand_over(self, entry: Entry, move: Moving) -> None:
        move.stage, move.tries, move.target = "handing", 0, "standby"
        self.ground.wake_move(entry, self.ground.now + HAND_OVER)
        self.ground.move(entry, move)
        if not entry.token:
            self._look(entry, move)

    def target_appeared(self, entry: Entry, move: Moving) -> None:
        """Its token: it has taken over. The source says in a moment how long that took."""
        move.token, move.target = True, "running"
        if move.stage == "handing" and move.source == "running":
            self.ground.wake_move(entry, self.ground.now + ANSWER)
        else:
            self._finish(entry, move)

    # The source

    def answered(self, entry: Entry, move: Moving, answer: MoveAnswered) -> None:
        if move.stage == "starting":
            return
        match answer.result:
            case "moved":
                move.source = "ended"
                self._finish(entry, move, answer.dead)
            case "refused" if move.token:
                # It was given back, or was not: one of them says so.
                self._look(entry, move)
            case "refused":
                self._stay(entry, answer.reason)
            case "unknown":
                self._look(entry, move)

    def source_ended(self, entry: Entry, move: Moving, fate: Fate) -> None:
        """The source is gone. Before it handed over: its end is one like any other."""
        if move.stage == "starting":
            self.cancel(entry)
            entry.state = "running"
            self.keeper.ended(entry, fate)
            return
        move.source, move.fate = "ended", fate
        if fate.how == "moved" or move.target == "running":
            self._finish(entry, move)
        else:
            self._look(entry, move)

    def source_vanished(self, entry: Entry, move: Moving) -> None:
        """Its token is gone. As a rule that is so because it handed over, and the answer is on its way."""
        if move.stage == "starting":
            entry.asks = 0
            self.source_woke(entry, move)
        elif move.stage == "handing":
            self.ground.wake_move(entry, self.ground.now + ANSWER)

    def source_woke(self, entry: Entry, move: Moving) -> None:
        if move.stage == "starting" and (fate := self.keeper.check(entry)) is not None:
            self.source_ended(entry, move, fate)

    # What hosts tell

    def told_source(self, entry: Entry, move: Moving, *, runs: bool) -> None:
        if runs and move.stage == "looking":
            move.source = "running"
            self._judge(entry, move)

    def told_target(self, entry: Entry, move: Moving, *, runs: bool, stands_by: bool) -> None:
        """How the target's host has it."""
        if runs:
            move.target = "running"
            if move.stage == "starting":
                self._finish(entry, move)
            elif move.stage == "looking":
                self._judge(entry, move)
        elif stands_by and move.stage == "starting":
            answer = StartAnswered(entry.component, move.incarnation, move.to, "ok")
            self.target_answered(entry, move, answer)
        elif stands_by and move.stage == "looking":
            move.target = "standby"
            self._judge(entry, move)

    def target_ended(self, entry: Entry, move: Moving, reason: str) -> None:
        """For sure, or with its host."""
        move.target, move.token = "ended", False
        if move.stage == "starting":
            self._stay(entry, reason)
        elif move.stage == "looking":
            self._judge(entry, move)

    def target_host_lost(self, entry: Entry, move: Moving) -> None:
        reason = f"host {move.to} is gone"
        if move.source == "ended":
            self._fall(entry, move)
        else:
            self._stay(entry, reason)

    def source_host_lost(self, entry: Entry, move: Moving, host: HostName) -> None:
        self.source_ended(entry, move, Fate("lost", f"host {host} is gone", with_host=True))

    # Which of them goes on

    def _look(self, entry: Entry, move: Moving) -> None:
        """Asks both hosts, or the one that is left."""
        ground = self.ground
        if move.stage != "looking":
            move.stage, move.tries = "looking", 0
        move.tries += 1
        if move.source != "ended":
            move.source = "unknown"
        if not move.token and move.target != "ended":
            move.target = "unknown"
        if move.source != "ended":
            ground.look(entry.component, entry.host)
        if not move.token and move.target != "ended":
            ground.look(entry.component, move.to)
        ground.wake_move(entry, ground.now + ANSWER)
        self._judge(entry, move)

    def _judge(self, entry: Entry, move: Moving) -> None:
        match move.source, move.target:
            case _, "running":
                self._finish(entry, move)
            case "ended", "ended":
                self._fall(entry, move)
            case "ended", "standby" if move.tries > 1 or (move.fate is not None and move.fate.with_host):
                self._fall(entry, move)
            case "running", "ended":
                self._stay(entry, "what stood by there has ended")
            case _:
                pass

    def woke(self, entry: Entry, move: Moving) -> None:
        ground = self.ground
        patient = (move.source, move.target) == ("running", "standby")
        looks = PATIENT_LOOKS if patient else LOOKS
        if move.stage == "starting" and move.start_until is not None:
            self._target_silent(entry, move, "it does not answer")
        elif move.stage == "starting":
            ground.start_standby(entry, move)
        elif move.stage == "handing" or move.tries < looks:
            self._look(entry, move)
        elif move.source == "ended":
            self._fall(entry, move)
        else:
            self._stay(entry, "nobody tells what came of it")

    # Ends of a move

    def _finish(self, entry: Entry, move: Moving, dead: Ns | None = None) -> None:
        """The target runs, and is what the entry is from now on."""
        ground, old, source = self.ground, entry.incarnation, entry.host
        token = entry.token
        self._close(entry)
        ground.left(entry)
        if move.source == "ended" or source is None:
            entry.over.append(old)
        else:
            self.keeper.strays.add(entry.component, old, source, token=token)
        entry.incarnation, entry.host, entry.token = move.incarnation, move.to, move.token
        entry.moves += 1
        entry.dead = dead
        entry.start_until, entry.told, entry.looked, entry.state = None, True, False, "moving"
        entry.why = f"moved from {source}, {move.why}"
        ground.came(entry.component, entry.spec.kind, move.to)
        self.keeper.runs(entry)
        ground.drain_soon(source)

    def _stay(self, entry: Entry, reason: str) -> None:
        """The source goes on. What stands by is stopped, unless it is known to be gone."""
        ground, move = self.ground, entry.move
        if move is None:
            return
        self._close(entry)
        if move.target != "ended":
            self.keeper.strays.add(
                entry.component, move.incarnation, move.to, move.start_until, token=move.token
            )
        entry.state = "running"
        entry.reason = f"it did not move to {move.to}, {move.why}: {reason}"
        entry.asks = 0
        self.keeper.watch(entry)
        ground.drain_soon(entry.host)

    def _fall(self, entry: Entry, move: Moving) -> None:
        """Neither goes on: it is started anew, if it is to be."""
        fate = move.fate or Fate("lost", "it was lost while it moved")
        self.cancel(entry)
        entry.state = "running"
        self.keeper.ended(entry, fate)

    def cancel(self, entry: Entry) -> None:
        """No move any more; what stands by is stopped. The caller says how the entry goes on."""
        move = entry.move
        if move is not None:
            self._close(entry)
            self.keeper.strays.add(
                entry.component, move.incarnation, move.to, move.start_until, token=move.token
            )

    def _close(self, entry: Entry) -> None:
        ground = self.ground
        if entry.move is not None:
            ground.balancer.gone(_shadow(entry))
            ground.ranks.changed(entry.move.to)
        entry.move = None
        entry.retry_at = ground.now + RETRY
        ground.wake_move(entry, None)


def _shadow(entry: Entry) -> ComponentId:
    return f"{entry.component} on its way"
