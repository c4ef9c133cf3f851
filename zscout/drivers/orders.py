"""What radios and robots are told to do, read from a command's `do` and checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final, TypeAlias

import msgspec

from zscout.keyexpr import BadName, check_rc
from zscout.mesh import Refused
from zscout.packets import MAX_CHANNEL, MAX_ROBOT, TICKS

MIN_LASTS: Final = 1 / TICKS
MAX_LASTS: Final = 5.0
"""Seconds that the wheels may turn without another command."""

Robot: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=MAX_ROBOT)]
Channel: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=MAX_CHANNEL)]
Wheel: TypeAlias = Annotated[float, msgspec.Meta(ge=-1, le=1)]
Lasts: TypeAlias = Annotated[float, msgspec.Meta(ge=MIN_LASTS, le=MAX_LASTS)]


class Order(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="name"):
    """Base of all orders; `name` tells which it is."""


class RadioDrive(Order, frozen=True, tag="drive"):
    """Turns a robot's wheels, each -1 to 1 of top speed, for `lasts` seconds at most."""

    robot: Robot
    left: Wheel
    right: Wheel
    lasts: Lasts


class RadioCamera(Order, frozen=True, tag="camera"):
    """A robot's transmitter on `channel`; 0 switches it off."""

    robot: Robot
    channel: Channel


class RadioStop(Order, frozen=True, tag="stop"):
    """A robot's wheels stop. `rc` is the robot RC that says so, where no grant stands behind it."""

    robot: Robot
    rc: str | None = None


class RadioHalt(Order, frozen=True, tag="halt"):
    """A robot's wheels stop and its transmitter goes off. `rc` as above."""

    robot: Robot
    rc: str | None = None


class Drive(Order, frozen=True, tag="drive"):
    left: Wheel
    right: Wheel
    lasts: Lasts


class Stop(Order, frozen=True, tag="stop"):
    pass


class Camera(Order, frozen=True, tag="camera"):
    on: bool


RadioOrder: TypeAlias = RadioDrive | RadioCamera | RadioStop | RadioHalt
RobotOrder: TypeAlias = Drive | Stop | Camera
_NAMES: Final = ("drive", "camera", "stop", "halt")


def radio_order(do: Mapping[str, Any]) -> RadioOrder:
    """What a radio is told. Raises Refused."""
    order: RadioOrder = _read(do, RadioOrder, _NAMES)
    if isinstance(order, RadioStop | RadioHalt) and order.rc is not None:
        try:
            check_rc(order.rc)
        except BadName as error:
            raise Refused("bad_command", str(error)) from None
    return order


def robot_order(do: Mapping[str, Any]) -> RobotOrder:
    """What a robot is told. Raises Refused."""
    order: RobotOrder = _read(do, RobotOrder, _NAMES[:3])
    return order


def _read(do: Mapping[str, Any], kind: Any, names: tuple[str, ...]) -> Any:
    name = do.get("name")
    if name not in names:
        known = ", ".join(names)
        raise Refused("unknown_command", f"this device does not know {str(name)[:64]!r}; it knows {known}")
    try:
        return msgspec.convert(do, kind)
    except msgspec.ValidationError as error:
        raise Refused("bad_command", f"{name}: {str(error)[:200]}") from None
