"""The [[rc]] tables of a node file: one struct for each driver, told apart by the key `driver`."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from typing import Annotated, Final, TypeAlias

from msgspec import Meta, Struct

from zscout.config.strict import Where, amounts, check_name, check_rc_name, key, quoted, seconds
from zscout.types import MAX_CHANNEL, MAX_ROBOT, SECOND, Ns

MAX_CHANNELS: Final = 64
"""Video RCs that one robot or framegrabber knows."""
MAX_SOURCE: Final = 1_000
"""Characters of a port or source."""
MAX_PARAMETERS: Final = 64
"""Capacities of one RC."""

A_PORT: Final = 'port = "/dev/ttyUSB0"'
AN_ID: Final = "that its packets carry, as in id = 33"
A_RADIO: Final = 'that carries its halt, as in radio = "radio/rf0"'
A_SOURCE: Final = 'source = "/dev/video0", or a table sources'

Activation: TypeAlias = Annotated[Ns, seconds("0", "3600", "From a grant until the device can be used.")]


class RcTable(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="driver"):
    """An RC that the node runs."""

    name: Annotated[str, key("`kind/name`.", example="robot/scout33")]


class ExclusiveRc(RcTable, frozen=True, tag="exclusive"):
    """A device that one ARC holds at a time; it needs no driver of its own."""

    activation: Activation = 0


class CapacityRc(RcTable, frozen=True, tag="capacity"):
    """A device that several ARCs share within its capacity."""

    capacity: Annotated[
        Mapping[str, Decimal],
        key("Greatest sum of each bandwidth parameter.", most=MAX_PARAMETERS, example={"command_rate": 10}),
    ] = {}
    activation: Activation = 0


class RadioRc(RcTable, frozen=True, tag="radio"):
    """A serial line to a transmitter."""

    port: Annotated[
        str, key("For pyserial's `serial_for_url`.", example="/dev/ttyUSB0", remedy=f"add it, as in {A_PORT}")
    ]
    baud: Annotated[int, key("Of the line.", 300, 1_000_000, unit="bit/s")] = 9_600
    bound: Annotated[Ns, seconds("0.01", "10", "The longest that a packet may wait.")] = SECOND // 4


class RobotRc(RcTable, frozen=True, tag="robot"):
    """A robot that is driven over a radio."""

    id: Annotated[int, key("That its packets carry.", 0, MAX_ROBOT, example=33, remedy=f"add the id {AN_ID}")]
    radio: Annotated[str, key("The RC that carries its halt.", example="radio/rf0", remedy=f"add the radio {A_RADIO}")]
    channels: Annotated[
        Mapping[str, Annotated[int, Meta(ge=1, le=MAX_CHANNEL)]],
        key("Of its camera's transmitter, by video RC.", most=MAX_CHANNELS, example={"video/ch1": 1}),
    ] = {}
    warm_up: Annotated[Ns, seconds("0", "60", "Of its camera, once it is switched on.")] = 2 * SECOND
    dead_man: Annotated[Ns, seconds("0.05", "5", "Its wheels are stopped this long after the last drive command.")] = (
        SECOND // 2
    )


class VideoRc(RcTable, frozen=True, tag="video"):
    """A video channel."""


class FramegrabberRc(RcTable, frozen=True, tag="framegrabber"):
    """A receiver of frames. It has either one source, or one for each video RC."""

    source: Annotated[str | None, key("For OpenCV, whatever it shows.", example="/dev/video0")] = None
    sources: Annotated[
        Annotated[Mapping[str, str], Meta(max_length=MAX_CHANNELS)] | None,
        key("For OpenCV, of each video RC.", example={"video/ch1": "/dev/video0"}),
    ] = None
    rate: Annotated[float, key("Published at most.", 0.1, 60, unit="frames/s")] = 10.0
    quality: Annotated[int, key("Of the JPEG.", 1, 100)] = 80

    @property
    def by_video(self) -> Mapping[str, str]:
        """The source of each video RC; "" alone where one serves for all."""
        return {"": self.source} if self.source is not None else self.sources or {}


RcConfig: TypeAlias = ExclusiveRc | CapacityRc | RadioRc | RobotRc | VideoRc | FramegrabberRc


def check_rc(rc: RcConfig, at: Where) -> None:
    """Refuses what no type can: names of another kind, sources that stand twice. Raises BadInput."""
    check_rc_name(rc.name, at / "name")
    if isinstance(rc, RadioRc | RobotRc | VideoRc | FramegrabberRc):
        driver = str(rc.__struct_config__.tag)
        kind, _, name = rc.name.partition("/")
        if kind != driver:
            raise (at / "name").bad(
                f'{quoted(rc.name)} is no {driver}, as driver = "{driver}" says',
                f"name it {driver}/{name}, or choose another driver",
            )
    match rc:
        case CapacityRc():
            if not rc.capacity:
                raise (at / "capacity").bad("is missing or empty", "add one, as in capacity = { command_rate = 10 }")
            for parameter in rc.capacity:
                check_name(parameter, at / "capacity")
            amounts(rc.capacity, at / "capacity")
        case RadioRc():
            _check_source(rc.port, at / "port", A_PORT)
        case RobotRc():
            check_rc_name(rc.radio, at / "radio", "radio")
            channels: dict[int, str] = {}
            for video, channel in rc.channels.items():
                here = at / "channels" / video
                check_rc_name(video, here, "video")
                if channel in channels:
                    raise here.bad(f"is {channel}, as {channels[channel]} is", "give each its own channel")
                channels[channel] = video
        case FramegrabberRc():
            if rc.source is not None and rc.sources is not None:
                raise (at / "sources").bad("stands beside source", "remove one of the two")
            if rc.source is not None:
                _check_source(rc.source, at / "source", A_SOURCE)
            elif rc.sources is None:
                raise (at / "source").bad("is missing", f"add it, as in {A_SOURCE}")
            elif not rc.sources:
                raise (at / "sources").bad("is empty", 'add one, as in "video/ch1" = "/dev/video0"')
            for video, source in (rc.sources or {}).items():
                check_rc_name(video, at / "sources" / video, "video")
                _check_source(source, at / "sources" / video, f'"{video}" = "/dev/video0"')


def _check_source(text: str, at: Where, example: str) -> None:
    if not text or len(text) > MAX_SOURCE or not text.isprintable():
        raise at.bad(f"{quoted(text)} can't be opened", f"name what to open, as in {example}")
