"""The [[rc]] tables of a node file: a struct for each driver that comes with zscout, selected by the key `driver`.

Options of other drivers are checked when the driver is loaded (`drivers/registry.py`)."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Annotated, Any, Final, Literal, TypeAlias, get_args

from msgspec import Meta, Struct, structs

from zscout.config.strict import Where, amounts, check_name, check_rc_name, convert, key, quoted, seconds
from zscout.messages import MAX_REGION, MAX_REGIONS, MotionLimits
from zscout.types import MAX_CHANNEL, MAX_ROBOT, SECOND, Ns

MAX_CHANNELS: Final = 64
"""Video RCs of a robot or framegrabber."""
MAX_SOURCE: Final = 1_000
"""Characters of a port or source."""
MAX_PARAMETERS: Final = 64
"""Capacities of one RC."""
MAX_WORDS: Final = 64
"""Words of one command."""

A_PORT: Final = 'port = "/dev/ttyUSB0"'
AN_ID: Final = "that its packets carry, as in id = 33"
A_RADIO: Final = 'that carries its halt, as in radio = "radio/rf0"'
A_COMMAND: Final = 'safe = ["psu", "off"]'
A_SOURCE: Final = 'source = "/dev/video0", or a table sources'

MAX_CORNERS: Final = 100
"""Corners of all regions of one framegrabber: each frame carries them."""
MAX_MIN_AREA: Final = 0.5
MAX_MIN_DURATION: Final = 60
A_REGION: Final = "two opposite corners of a rectangle or three or more of a polygon, as in 0,0,0.4,0.1"

_SHARE: Final = re.compile(r"[0-9]{1,3}(\.[0-9]{0,9})?|\.[0-9]{1,9}", re.ASCII)

Words: TypeAlias = tuple[str, ...]
"""A program and its arguments; no shell reads them."""
SETTLE: Final[Ns] = 5 * SECOND
Activation: TypeAlias = Annotated[Ns, seconds("0", "3600", "Time from a grant until the device can be used.")]


class AnyRc(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys of every RC, with any driver."""

    name: Annotated[str, key("`kind/name`.", example="robot/scout33")]
    settle: Annotated[
        Ns,
        seconds(
            "0.5", "60", "Time for a direct program to end after its hold, and for the driver to reach safe state."
        ),
    ] = SETTLE
    begin_within: Annotated[
        Ns | None,
        seconds("0", "86400", "The longest time from a grant until the device is ready. Default: given by its driver."),
    ] = None

    tolerate: Annotated[
        Ns | None,
        seconds("0", "86400", "A holder keeps an unwell device this long. Default: 60 for `command`, else 0."),
    ] = None
    tolerate_free: Annotated[Ns, seconds("0", "86400", "A free device is unwell this long before it is lost.")] = 0
    tolerate_max: Annotated[
        Ns | None,
        seconds(
            "0",
            "86400",
            "The longest outage that a holder may announce. Default: 3600 for `command`, else as `tolerate`.",
        ),
    ] = None


class RcTable(AnyRc, frozen=True, tag_field="driver"):
    """An RC whose driver comes with zscout."""


class PluginRc(AnyRc, frozen=True):
    """An RC whose driver is installed beside zscout; only the driver knows its options."""

    driver: str
    options: Mapping[str, Any]
    """From the file, unchecked."""
    at: Where


class ExclusiveRc(RcTable, frozen=True, tag="exclusive"):
    """A device for a single ARC at a time, without a driver."""

    activation: Activation = 0


class CapacityRc(RcTable, frozen=True, tag="capacity"):
    """A device that several ARCs share within its capacity, without a driver."""

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
    baud: Annotated[int, key("Rate of the line.", 300, 1_000_000, unit="bit/s")] = 9_600
    bound: Annotated[Ns, seconds("0.01", "10", "The longest time that a packet may wait.")] = SECOND // 4
    dtr: Annotated[bool | None, key("State of DTR while the port is open; it may reset a board.", example=False)] = None
    rts: Annotated[bool | None, key("State of RTS while the port is open.", example=False)] = None


class RobotRc(RcTable, frozen=True, tag="robot"):
    """A robot that is driven over a radio."""

    id: Annotated[int, key("Id in its packets.", 0, MAX_ROBOT, example=33, remedy=f"add the id {AN_ID}")]
    radio: Annotated[str, key("The RC that carries its halt.", example="radio/rf0", remedy=f"add the radio {A_RADIO}")]
    channels: Annotated[
        Mapping[str, Annotated[int, Meta(ge=1, le=MAX_CHANNEL)]],
        key("Channels of its camera's transmitter, by video RC.", most=MAX_CHANNELS, example={"video/ch1": 1}),
    ] = {}
    warm_up: Annotated[Ns, seconds("0", "60", "Warm-up time of its camera.")] = 2 * SECOND
    dead_man: Annotated[Ns, seconds("0.05", "5", "The wheels stop this long after the last drive command.")] = (
        SECOND // 2
    )


class CommandRc(RcTable, frozen=True, tag="command"):
    """A device switched by the user's own commands, which run on the node as the node's user."""

    start: Annotated[Words, key("Command at the begin of a hold.", example=["psu", "on"])] = ()
    stop: Annotated[Words, key("Command at the end of a hold.", example=["psu", "save"])] = ()
    safe: Annotated[
        Words, key("Command when the device becomes free, and when the node starts and ends.", example=["psu", "off"])
    ] = ()
    health: Annotated[
        Words, key("Command that checks the device: exit code 0 if it works.", example=["psu", "ping"])
    ] = ()
    parameters: Annotated[
        Mapping[str, Decimal],
        key("Greatest value of each parameter of a request.", most=MAX_PARAMETERS, example={"voltage": 30}),
    ] = {}
    every: Annotated[Ns, seconds("0.5", "3600", "Pause between two runs of `health`.")] = 10 * SECOND
    timeout: Annotated[Ns, seconds("0.1", "600", "Time after which a command and its children are killed.")] = (
        5 * SECOND
    )
    activation: Activation = 0


class VideoRc(RcTable, frozen=True, tag="video"):
    """A video channel."""


class FramegrabberRc(RcTable, frozen=True, tag="framegrabber"):
    """A receiver of frames, with a single source or one for each video RC."""

    source: Annotated[str | None, key("OpenCV's name of the source.", example="/dev/video0")] = None
    sources: Annotated[
        Annotated[Mapping[str, str], Meta(max_length=MAX_CHANNELS)] | None,
        key("OpenCV's name of the source of each video RC.", example={"video/ch1": "/dev/video0"}),
    ] = None
    rate: Annotated[float, key("Greatest rate of published frames.", 0.1, 60, unit="frames/s")] = 10.0
    quality: Annotated[int, key("Quality of the JPEGs.", 1, 100)] = 80
    picture_within: Annotated[Ns, seconds("0.5", "600", "The longest time between two pictures of the source.")] = (
        3 * SECOND // 2
    )
    still_after: Annotated[
        Ns | None,
        seconds(
            "0", "86400", "A source is frozen after this time of identical pictures; 0: never. Default: 10, files 0."
        ),
    ] = None
    transport: Annotated[
        Literal["tcp", "udp"], key("Transport of `rtsp://`; `udp` falls back to TCP.", example="udp")
    ] = "tcp"
    ignore: Annotated[
        tuple[str, ...], key("Regions in which motion does not count.", most=MAX_REGIONS, example=["0,0,0.4,0.1"])
    ] = ()
    min_area: Annotated[float, key("Least share of the picture that a moving object covers.", 0, MAX_MIN_AREA)] = 0.0
    min_duration: Annotated[Ns, seconds("0", str(MAX_MIN_DURATION), "Shorter motion is not reported.")] = 0

    @property
    def by_video(self) -> Mapping[str, str]:
        """The source of each video RC; a single source has the key ""."""
        return {"": self.source} if self.source is not None else self.sources or {}

    @property
    def motion(self) -> MotionLimits | None:
        """None if no limit differs from its default."""
        regions = [parse_region(text) for text in self.ignore]
        limits = MotionLimits(regions, self.min_area, self.min_duration / SECOND)
        return limits if limits != MotionLimits() else None


BuiltInRc: TypeAlias = ExclusiveRc | CapacityRc | CommandRc | RadioRc | RobotRc | VideoRc | FramegrabberRc
RcConfig: TypeAlias = BuiltInRc | PluginRc

_BUILT_IN: Final[Any] = BuiltInRc
BUILT_IN: Final = frozenset(str(rc.__struct_config__.tag) for rc in get_args(BuiltInRc))
"""Names of the drivers that come with zscout."""


def read_rc(table: Mapping[str, Any], at: Where) -> RcConfig:
    """Read an [[rc]] table and check it as far as possible without its driver. Raises BadInput."""
    driver = table.get("driver")
    if isinstance(driver, str) and driver not in BUILT_IN:
        common = {field.encode_name for field in structs.fields(AnyRc)}
        keys = convert({name: value for name, value in table.items() if name in common}, AnyRc, at)
        options = {name: value for name, value in table.items() if name not in common | {"driver"}}
        check_rc_name(keys.name, at / "name")
        check_name(driver, at / "driver")
        return PluginRc(**structs.asdict(keys), driver=driver, options=options, at=at)
    rc: BuiltInRc = convert(table, _BUILT_IN, at)
    _check_rc(rc, at)
    return rc


def _check_rc(rc: BuiltInRc, at: Where) -> None:
    """Checks beyond the types, such as names and duplicate channels. Raises BadInput."""
    check_rc_name(rc.name, at / "name")
    if isinstance(rc, RadioRc | RobotRc | VideoRc):
        driver = str(rc.__struct_config__.tag)
        kind, _, name = rc.name.partition("/")
        if kind != driver:
            raise (at / "name").bad(
                f'{quoted(rc.name)} does not fit driver = "{driver}"',
                f"name it {driver}/{name}, or choose another driver",
            )
    match rc:
        case CapacityRc():
            if not rc.capacity:
                raise (at / "capacity").bad("is missing or empty", "add one, as in capacity = { command_rate = 10 }")
            for parameter in rc.capacity:
                check_name(parameter, at / "capacity")
            amounts(rc.capacity, at / "capacity")
        case CommandRc():
            if not (rc.start or rc.stop or rc.safe or rc.health):
                raise (at / "safe").bad("is missing, and so are start, stop and health", f"add one, as in {A_COMMAND}")
            for name in ("start", "stop", "safe", "health"):
                _check_words(getattr(rc, name), at / name)
            for parameter in rc.parameters:
                check_name(parameter, at / "parameters")
            amounts(rc.parameters, at / "parameters")
        case RadioRc():
            _check_source(rc.port, at / "port", A_PORT)
            for name in ("dtr", "rts"):
                if getattr(rc, name) is not None and rc.port.lower().startswith("socket://"):
                    raise (at / name).bad("has no effect on socket://", "remove it, or use rfc2217://")
        case RobotRc():
            check_rc_name(rc.radio, at / "radio", "radio")
            channels: dict[int, str] = {}
            for video, channel in rc.channels.items():
                here = at / "channels" / video
                check_rc_name(video, here, "video")
                if channel in channels:
                    raise here.bad(f"{channel} is also the channel of {channels[channel]}", "give each its own channel")
                channels[channel] = video
        case FramegrabberRc():
            if rc.source is not None and rc.sources is not None:
                raise (at / "sources").bad("can't be used with source", "remove one of the two")
            if rc.source is not None:
                _check_source(rc.source, at / "source", A_SOURCE)
            elif rc.sources is None:
                raise (at / "source").bad("is missing", f"add it, as in {A_SOURCE}")
            elif not rc.sources:
                raise (at / "sources").bad("is empty", 'add one, as in "video/ch1" = "/dev/video0"')
            for video, source in (rc.sources or {}).items():
                check_rc_name(video, at / "sources" / video, "video")
                _check_source(source, at / "sources" / video, f'"{video}" = "/dev/video0"')
            try:
                check_regions([parse_region(region) for region in rc.ignore], at / "ignore")
            except ValueError as error:
                raise (at / "ignore").bad(*str(error).rsplit("; ", 1)) from None


def parse_region(text: str) -> list[float]:
    """x and y of each corner in turn, as shares of the picture's width and height from the upper left; two corners are
    opposite ones of a rectangle. Raises ValueError."""
    parts = text.split(",")
    numbers = [float(part) for part in parts if _SHARE.fullmatch(part.strip()) and float(part) <= 1]
    if len(numbers) < len(parts):
        raise ValueError(f"{quoted(text)} is not a region; write numbers from 0 to 1 with commas, {A_REGION}")
    if len(numbers) % 2 or not 4 <= len(numbers) <= MAX_REGION:
        raise ValueError(f"{quoted(text)} has {len(numbers)} numbers; write x and y of {A_REGION}")
    if len({*numbers[::2]}) < 2 or len({*numbers[1::2]}) < 2:
        raise ValueError(f"{quoted(text)} covers nothing; write {A_REGION}")
    return [round(number, 4) for number in numbers]


def check_regions(regions: Sequence[list[float]], at: Where) -> None:
    """Raises BadInput for more regions than the head of a frame holds."""
    corners = sum(map(len, regions)) // 2
    if len(regions) > MAX_REGIONS or corners > MAX_CORNERS:
        what = f"has {len(regions)} regions with {corners} corners"
        raise at.bad(what, f"at most {MAX_REGIONS} regions with {MAX_CORNERS} corners are allowed")


def _check_source(text: str, at: Where, example: str) -> None:
    if not text or len(text) > MAX_SOURCE or not text.isprintable():
        raise at.bad(f"{quoted(text)} can't be opened", f"name what to open, as in {example}")


def _check_words(words: Words, at: Where) -> None:
    if len(words) > MAX_WORDS:
        raise at.bad(f"has {len(words):,} words", f"at most {MAX_WORDS} are allowed; put them into a script")
    if words and not words[0]:
        raise at.bad("has no program", f"name one first, as in {A_COMMAND}")
    for number, word in enumerate(words):
        if "\0" in word or len(word) > MAX_SOURCE:
            raise at.item(number).bad(f"{quoted(word)} can't be an argument", f"{MAX_SOURCE:,} characters at most")
