"""Devices in the node file: what each driver is told in its [[rc]] table, and nothing that is another's."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from typing import Annotated, Final, Literal, TypeAlias, get_args

from msgspec import Meta, Struct

from zscout.packets import MAX_CHANNEL, MAX_ROBOT
from zscout.scheduling.model import Ns
from zscout.strict import Where, check_rc_name, quoted, seconds_to_ns

Driver = Literal["exclusive", "capacity", "radio", "robot", "video", "framegrabber"]

MAX_CHANNELS: Final = 64
"""Video RCs that one robot or framegrabber knows."""
MAX_SOURCE: Final = 1_000
"""Characters of a port or source."""
KEYS: Final[Mapping[str, tuple[str, ...]]] = {
    "exclusive": ("activation",),
    "capacity": ("capacity", "activation"),
    "radio": ("port", "baud", "bound"),
    "robot": ("id", "radio", "channels", "warm_up", "dead_man"),
    "video": (),
    "framegrabber": ("source", "sources", "rate", "quality"),
}
"""What may stand in the table of each driver, beside `name` and `driver`."""


class Radio(Struct, frozen=True, tag="radio"):
    """A serial line to a transmitter."""

    port: str
    """For pyserial's `serial_for_url`."""
    baud: int
    bound: Ns
    """The longest that a packet may wait."""


class Robot(Struct, frozen=True, tag="robot"):
    """A robot that is driven over a radio."""

    id: int
    radio: str
    """The radio RC that carries its halt."""
    channels: Mapping[str, int]
    """Of its camera's transmitter, by video RC."""
    warm_up: Ns
    dead_man: Ns
    """After this long without a command the wheels are stopped."""


class Video(Struct, frozen=True, tag="video"):
    """A video channel."""


class Framegrabber(Struct, frozen=True, tag="framegrabber"):
    """A receiver of pictures."""

    sources: Mapping[str, str]
    """An OpenCV source for each video RC; "" alone where it has one for all."""
    rate: float
    """Frames a second that are published at most."""
    quality: int
    """Of the JPEG, 1 to 100."""


Device: TypeAlias = Radio | Robot | Video | Framegrabber


class DeviceTable(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The devices' part of an [[rc]] table, as it is written. None: not written."""

    port: str | None = None
    baud: Annotated[int, Meta(ge=300, le=1_000_000)] | None = None
    bound: Decimal | None = None
    id: Annotated[int, Meta(ge=0, le=MAX_ROBOT)] | None = None
    radio: str | None = None
    channels: (
        Annotated[dict[str, Annotated[int, Meta(ge=1, le=MAX_CHANNEL)]], Meta(max_length=MAX_CHANNELS)] | None
    ) = None
    warm_up: Decimal | None = None
    dead_man: Decimal | None = None
    source: str | None = None
    sources: Annotated[dict[str, str], Meta(max_length=MAX_CHANNELS)] | None = None
    rate: Annotated[float, Meta(ge=0.1, le=60)] | None = None
    quality: Annotated[int, Meta(ge=1, le=100)] | None = None


def check_keys(written: Mapping[str, object], driver: Driver, at: Where) -> None:
    """Refuses the keys of other drivers. Raises BadInput."""
    for key, value in written.items():
        if value is not None and key not in ("name", "driver", *KEYS[driver]):
            others = [quoted(other) for other in get_args(Driver) if key in KEYS[other]]
            raise (at / key).bad(
                f'the driver "{driver}" has none', f"remove it, or write driver = {' or '.join(others)}"
            )


def device(table: DeviceTable, name: str, driver: Driver, at: Where) -> Device | None:
    """The device of an RC; None for a driver that is none of a device. Raises BadInput."""
    if driver in ("exclusive", "capacity"):
        return None
    kind = name.partition("/")[0]
    if kind != driver:
        raise (at / "name").bad(
            f'{quoted(name)} is no {driver}, as driver = "{driver}" says',
            f"name it {driver}/{name.partition('/')[2]}, or choose another driver",
        )
    match driver:
        case "radio":
            return _radio(table, at)
        case "robot":
            return _robot(table, at)
        case "framegrabber":
            return _framegrabber(table, at)
        case _:
            return Video()


def _radio(table: DeviceTable, at: Where) -> Radio:
    bound = Decimal("0.25") if table.bound is None else table.bound
    return Radio(
        port=_source(table.port, at / "port", 'port = "/dev/ttyUSB0"'),
        baud=9600 if table.baud is None else table.baud,
        bound=seconds_to_ns(bound, at / "bound", low=Decimal("0.01"), high=Decimal(10)),
    )


def _robot(table: DeviceTable, at: Where) -> Robot:
    if table.id is None:
        raise (at / "id").bad("is missing", "add the id that its packets carry, as in id = 33")
    if table.radio is None:
        raise (at / "radio").bad(
            "is missing", 'add the radio that carries its halt, as in radio = "radio/rf0"'
        )
    _of_kind(table.radio, "radio", at / "radio")
    channels: dict[int, str] = {}
    for video, channel in (table.channels or {}).items():
        here = at / "channels" / video
        _of_kind(video, "video", here)
        if channel in channels:
            raise here.bad(f"is {channel}, as {channels[channel]} is", "give each its own channel")
        channels[channel] = video
    warm_up = Decimal(2) if table.warm_up is None else table.warm_up
    dead_man = Decimal("0.5") if table.dead_man is None else table.dead_man
    return Robot(
        id=table.id,
        radio=table.radio,
        channels={video: channel for channel, video in channels.items()},
        warm_up=seconds_to_ns(warm_up, at / "warm_up", high=Decimal(60)),
        dead_man=seconds_to_ns(dead_man, at / "dead_man", low=Decimal("0.05"), high=Decimal(5)),
    )


def _framegrabber(table: DeviceTable, at: Where) -> Framegrabber:
    if table.source is not None and table.sources is not None:
        raise (at / "sources").bad("stands beside source", "remove one of the two")
    if table.sources is not None:
        if not table.sources:
            raise (at / "sources").bad("is empty", 'add one, as in "video/ch1" = "/dev/video0"')
        sources = {}
        for video, source in table.sources.items():
            _of_kind(video, "video", at / "sources" / video)
            sources[video] = _source(source, at / "sources" / video, f'"{video}" = "/dev/video0"')
    else:
        sources = {"": _source(table.source, at / "source", 'source = "/dev/video0", or a table sources')}
    return Framegrabber(
        sources=sources,
        rate=10.0 if table.rate is None else table.rate,
        quality=80 if table.quality is None else table.quality,
    )


def _of_kind(name: str, kind: str, at: Where) -> None:
    check_rc_name(name, at)
    if not name.startswith(f"{kind}/"):
        raise at.bad(f"{quoted(name)} is no {kind}", f'name one, as in "{kind}/..."')


def _source(text: str | None, at: Where, example: str) -> str:
    if text is None:
        raise at.bad("is missing", f"add it, as in {example}")
    if not text or len(text) > MAX_SOURCE or not text.isprintable():
        raise at.bad(f"{quoted(text)} can't be opened", f"name what to open, as in {example}")
    return text
