"""The node file of a served building: its devices as the drivers of a real one would be told of them."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from zscout.simulation.bodies import WARM_UP
from zscout.simulation.radio_line import BITS, MAX_BAUD, MIN_BAUD
from zscout.simulation.serve import Served

RADIO: Final = "radio/rf0"
BOUND: Final = 0.25
"""Seconds that a packet may wait on a quick line ..."""
BOUND_BYTES: Final = 60
"""... or as long as so many bytes take."""
MAX_BOUND: Final = 10.0
MIN_RATE: Final = 0.1
MAX_RATE: Final = 60.0
"""Of a framegrabber's frames a second."""


def video_name(channel: int) -> str:
    """The video RC of a channel."""
    return f"video/ch{channel}"


def node_file(served: Served, *, fleet: Path | None, framegrabbers: int) -> str:
    """TOML with an RC for the radio, each robot, each video channel and `framegrabbers` receivers that tune
    in to any of them. Times are ours: a building twice as fast warms up its cameras in half of the time."""
    speed = served.speed
    channels = {video_name(number + 1): number + 1 for number in range(len(served.channels))}
    sources = {rc: _text(served.video.url(served.channels[number - 1])) for rc, number in channels.items()}
    baud = min(max(served.radio.baud, MIN_BAUD), MAX_BAUD)
    bound = min(MAX_BOUND, max(BOUND, BOUND_BYTES * BITS / baud))
    port = served.radio.link.absolute() if served.radio.link is not None else served.radio.port
    node = {} if fleet is None else {"fleet": _text(str(fleet.absolute()))}
    rate = min(MAX_RATE, max(MIN_RATE, served.frame_rate * speed))
    tables = [
        "# The devices of a simulated building, written by zscout simulate. For: zscout-node THIS_FILE\n",
        _table("[node]", node),
        _rc(RADIO, "radio", port=_text(str(port)), baud=str(baud), bound=_number(bound)),
    ]
    tables += [
        _rc(
            f"robot/{robot.name}",
            "robot",
            id=str(robot.id),
            radio=_text(RADIO),
            channels=_inline({rc: str(number) for rc, number in channels.items()}),
            warm_up=_number(WARM_UP / speed),
        )
        for robot in served.plan.robots
    ]
    tables += [_rc(rc, "video") for rc in channels]
    tables += [
        _rc(f"framegrabber/fgrab{number + 1}", "framegrabber", sources=_inline(sources), rate=_number(rate))
        for number in range(framegrabbers)
    ]
    return "\n".join(tables)


def _rc(name: str, driver: str, **keys: str) -> str:
    return _table("[[rc]]", {"name": _text(name), "driver": _text(driver)} | keys)


def _table(head: str, keys: dict[str, str]) -> str:
    return head + "\n" + "".join(f"{key} = {value}\n" for key, value in keys.items())


def _inline(keys: dict[str, str]) -> str:
    return "{ " + ", ".join(f"{_text(key)} = {value}" for key, value in keys.items()) + " }"


def _text(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(char if char.isprintable() else f"\\U{ord(char):08X}" for char in escaped) + '"'


def _number(value: float) -> str:
    """With three decimals at most, never a power of ten."""
    return f"{round(value, 3):g}"
