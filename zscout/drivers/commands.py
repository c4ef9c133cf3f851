"""Commands of radios and robots, read from a command's `do` and checked. `resource_controller.py` has checked the grant
and the time to live before."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final, TypeAlias

import msgspec

from zscout.config.strict import quoted
from zscout.drivers.packets import TICKS
from zscout.keyexpr import BadName, check_rc
from zscout.mesh import Refused
from zscout.types import MAX_CHANNEL, MAX_ROBOT

MAX_LASTS: Final = 5.0
"""Seconds that the wheels may turn without another command."""

RobotId: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=MAX_ROBOT)]
VideoChannel: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=MAX_CHANNEL)]
WheelSpeed: TypeAlias = Annotated[float, msgspec.Meta(ge=-1, le=1)]
DriveDuration: TypeAlias = Annotated[float, msgspec.Meta(ge=1 / TICKS, le=MAX_LASTS)]


class DeviceCommand(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="name"):
    """Base of all commands; `name` is the kind."""


class RadioDrive(DeviceCommand, frozen=True, tag="drive"):
    """Turn a robot's wheels, each -1 to 1 of top speed, for at most `lasts` seconds."""

    robot: RobotId
    left: WheelSpeed
    right: WheelSpeed
    lasts: DriveDuration


class RadioCamera(DeviceCommand, frozen=True, tag="camera"):
    """Set a robot's transmitter to `channel`; 0 switches it off."""

    robot: RobotId
    channel: VideoChannel


class RadioStop(DeviceCommand, frozen=True, tag="stop"):
    """Stop a robot's wheels. `rc`: the RC of the robot, if it commands this without a grant."""

    robot: RobotId
    rc: str | None = None


class RadioHalt(DeviceCommand, frozen=True, tag="halt"):
    """Stop a robot's wheels and switch its transmitter off. `rc` as in RadioStop."""

    robot: RobotId
    rc: str | None = None


class RobotDrive(DeviceCommand, frozen=True, tag="drive"):
    left: WheelSpeed
    right: WheelSpeed
    lasts: DriveDuration


class RobotStop(DeviceCommand, frozen=True, tag="stop"):
    pass


class RobotCamera(DeviceCommand, frozen=True, tag="camera"):
    on: bool


RadioCommand: TypeAlias = RadioDrive | RadioCamera | RadioStop | RadioHalt
RobotCommand: TypeAlias = RobotDrive | RobotStop | RobotCamera


def radio_command(do: Mapping[str, Any]) -> RadioCommand:
    """Raises Refused."""
    order: RadioCommand = _read(do, RadioCommand, ("drive", "camera", "stop", "halt"))
    if isinstance(order, RadioStop | RadioHalt) and order.rc is not None:
        try:
            check_rc(order.rc)
        except BadName as error:
            raise Refused("bad_command", str(error)) from None
    return order


def robot_command(do: Mapping[str, Any]) -> RobotCommand:
    """Raises Refused."""
    order: RobotCommand = _read(do, RobotCommand, ("drive", "camera", "stop"))
    return order


def _read(do: Mapping[str, Any], kind: Any, names: tuple[str, ...]) -> Any:
    name = do.get("name")
    if name not in names:
        raise Refused("unknown_command", f"unknown command {quoted(str(name)[:64])}; there are {', '.join(names)}")
    try:
        return msgspec.convert(do, kind)
    except msgspec.ValidationError as error:
        raise Refused("bad_command", f"{name}: {str(error)[:200]}") from None
