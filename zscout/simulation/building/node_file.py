"""The node file of a served building, configured as for a real building's devices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from zscout.simulation.building.bodies import WARM_UP
from zscout.simulation.building.radio_line import BITS, MAX_BAUD, MIN_BAUD
from zscout.simulation.building.serve import Served

RADIO: Final = "radio/rf0"
# A packet may wait BOUND seconds, or as long as BOUND_BYTES take on a slow line, at most MAX_BOUND seconds.
BOUND: Final = 0.25
BOUND_BYTES: Final = 60
MAX_BOUND: Final = 10.0
MIN_RATE: Final = 0.1  # frames per second of a framegrabber
MAX_RATE: Final = 60.0


@dataclass(frozen=True, slots=True)
class DeviceTables:
    radio: str
    robots: list[str]
    videos: list[str]
    framegrabbers: list[str]


def device_tables(
    *,
    port: str,
    baud: int,
    bound: float,
    robots: Mapping[str, int],
    urls: Sequence[str],
    warm_up: float,
    rate: float,
    framegrabbers: int,
) -> DeviceTables:
    """A radio at serial `port`, `robots` (ids on the air by RC), a video channel for each of `urls`, and
    `framegrabbers` that tune in to any of them at `rate` frames a second; `bound`, `warm_up` in seconds."""
    videos = [video_name(number) for number, _ in enumerate(urls, 1)]
    channels = _inline({rc: str(number) for number, rc in enumerate(videos, 1)})
    sources = _inline({rc: _text(url) for rc, url in zip(videos, urls, strict=True)})
    common = {"radio": _text(RADIO), "channels": channels, "warm_up": _number(warm_up)}
    return DeviceTables(
        rc_table(RADIO, "radio", port=_text(port), baud=str(baud), bound=_number(bound)),
        [rc_table(name, "robot", id=str(number), **common) for name, number in robots.items()],
        [rc_table(rc, "video") for rc in videos],
        [
            rc_table(framegrabber_name(number), "framegrabber", sources=sources, rate=_number(rate))
            for number in range(1, framegrabbers + 1)
        ],
    )


def video_name(channel: int) -> str:  # from 1
    return f"video/ch{channel}"


def framegrabber_name(number: int) -> str:  # from 1
    return f"framegrabber/fgrab{number}"


def node_file(served: Served, *, fleet: Path | None, framegrabbers: int) -> str:
    """All devices in real time: a building at double speed warms up its cameras in half the time."""
    speed = served.speed
    baud = min(max(served.radio.baud, MIN_BAUD), MAX_BAUD)
    devices = device_tables(
        port=str(served.radio.link.absolute() if served.radio.link is not None else served.radio.port),
        baud=baud,
        bound=min(MAX_BOUND, max(BOUND, BOUND_BYTES * BITS / baud)),
        robots={f"robot/{robot.name}": robot.id for robot in served.plan.robots},
        urls=[served.video.url(channel) for channel in served.channels],
        warm_up=WARM_UP / speed,
        rate=min(MAX_RATE, max(MIN_RATE, served.frame_rate * speed)),
        framegrabbers=framegrabbers,
    )
    head = "# The devices of a simulated building, written by zscout simulate. For: zscout-node THIS_FILE\n"
    node = _table("[node]", {} if fleet is None else {"fleet": _text(str(fleet.absolute()))})
    return "\n".join([head, node, devices.radio, *devices.robots, *devices.videos, *devices.framegrabbers])


def rc_table(name: str, driver: str, **keys: str) -> str:
    """The [[rc]] table of a device; the values of `keys` are TOML."""
    return _table("[[rc]]", {"name": _text(name), "driver": _text(driver)} | keys)


def _table(head: str, keys: dict[str, str]) -> str:
    return head + "\n" + "".join(f"{key} = {value}\n" for key, value in keys.items())


def _inline(keys: dict[str, str]) -> str:
    return "{ " + ", ".join(f"{_text(key)} = {value}" for key, value in keys.items()) + " }"


def _text(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(char if char.isprintable() else f"\\U{ord(char):08X}" for char in escaped) + '"'


def _number(value: float) -> str:
    """At most three decimals, never an exponent."""
    return f"{round(value, 3):g}"
