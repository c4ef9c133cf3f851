"""What behaviors say, kept at a rate that a recording can bear: pure; time is passed in, in seconds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from zscout.keyexpr import Sender
from zscout.messages import BehaviorSaid

RATE: Final = 20.0
"""Sayings of one sender kept in a second."""
BURST: Final = 20.0
MAX_WAITING: Final = 256
"""Paths of one sender whose newest saying waits for its turn."""
MAX_SENDERS: Final = 1_000
TELL_EVERY: Final = 10.0
"""Seconds between two words on what was left out of a sender's."""


@dataclass(slots=True)
class _Speaker:
    allowance: float
    at: float
    waiting: dict[str, BehaviorSaid] = field(default_factory=dict)
    """The newest saying of each path that came too fast, oldest first."""
    dropped: int = 0
    told: float = -TELL_EVERY

    def may_speak(self, at: float) -> bool:
        """A token bucket."""
        self.allowance = min(BURST, self.allowance + RATE * max(0.0, at - self.at))
        self.at = at
        if self.allowance < 1:
            return False
        self.allowance -= 1
        return True


class Throttle:
    """Passes on what each sender says, at most `RATE` a second. What comes faster waits, and of each path
    only the newest is kept: however much was left out, what is passed on last is how it is."""

    def __init__(self) -> None:
        self._speakers: dict[Sender, _Speaker] = {}

    def said(self, at: float, sender: Sender, said: BehaviorSaid) -> BehaviorSaid | None:
        """The saying itself if it is to be taken now."""
        speaker = self._speakers.pop(sender, None)
        if speaker is None:
            if len(self._speakers) >= MAX_SENDERS:
                del self._speakers[next(iter(self._speakers))]
            speaker = _Speaker(BURST, at)
        self._speakers[sender] = speaker
        if not speaker.waiting and speaker.may_speak(at):
            return said
        if speaker.waiting.pop(said.path, None) is not None:
            speaker.dropped += 1
        if len(speaker.waiting) >= MAX_WAITING:
            speaker.dropped += 1
        else:
            speaker.waiting[said.path] = said
        return None

    def due(self, at: float) -> Iterator[tuple[Sender, BehaviorSaid]]:
        """What has waited and is to be taken now."""
        for sender, speaker in self._speakers.items():
            while speaker.waiting and speaker.may_speak(at):
                yield sender, speaker.waiting.pop(next(iter(speaker.waiting)))

    def dropped(self, at: float) -> Iterator[tuple[Sender, int]]:
        """Senders of whom something was left out, and how much since it was told last."""
        for sender, speaker in self._speakers.items():
            if speaker.dropped and at - speaker.told >= TELL_EVERY:
                speaker.told, count, speaker.dropped = at, speaker.dropped, 0
                yield sender, count

    def forget(self, sender: Sender) -> None:
        self._speakers.pop(sender, None)
