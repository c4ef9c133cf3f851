"""What a held framegrabber shows: the newest picture, as an array."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from zscout.behaviors.client.client import Client
from zscout.behaviors.perception.lens import COLUMNS, ROWS, Picture, grey_picture
from zscout.mesh import FrameWatch
from zscout.types import Grant, Ns


@dataclass(frozen=True, slots=True)
class CameraPicture:
    """A picture as a Scout's camera gives it, whatever size it came in."""

    picture: Picture
    scale: tuple[float, float]
    """By which its columns and rows are multiplied for those of the frame."""
    number: int
    time: float
    """By the framegrabber's clock."""
    arrived: Ns
    """By this host's."""


class CameraFeed:
    """The pictures of one framegrabber that were taken under one grant. A context manager."""

    def __init__(self, client: Client, framegrabber: str, grant: Grant) -> None:
        self._client, self._key, self._grant = client, client.mesh.keys.frame(framegrabber), grant
        self.others = 0
        """Frames taken under another grant: not ours to look at."""
        self.broken = 0
        """Frames that are no JPEG, or too large."""

    def __enter__(self) -> Self:
        self._watch: FrameWatch = self._client.mesh.frames(self._key)
        return self

    def __exit__(self, *exc: object) -> None:
        self._watch.close()

    async def next_picture(self, timeout: float) -> CameraPicture | None:
        """The newest picture that was not looked at yet; None if none came within `timeout` seconds, or only
        one that is of no use."""
        frame = await self._watch.next(timeout)
        if frame is None:
            return None
        head = frame.head
        if head.grant != self._grant:
            self.others += 1
            return None
        picture = grey_picture(frame.jpeg)
        if picture is None:
            self.broken += 1
            return None
        height, width = picture.shape
        if (height, width) != (ROWS, COLUMNS):
            picture = np.asarray(cv2.resize(picture, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA), np.uint8)
        return CameraPicture(picture, (width / COLUMNS, height / ROWS), head.number, head.time, frame.arrived)
