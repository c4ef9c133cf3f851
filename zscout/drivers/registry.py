"""Which driver an RC of a node file has. A new one is a table in `config/devices.py` and a case here."""

from __future__ import annotations

from zscout.config.devices import CapacityRc, ExclusiveRc, FramegrabberRc, RadioRc, RcConfig, RobotRc, VideoRc
from zscout.drivers.driver import Driver
from zscout.drivers.generic import CapacityDriver, ExclusiveDriver, VideoDriver
from zscout.messages import exact_amounts
from zscout.types import SECOND


def driver_for(rc: RcConfig) -> Driver:
    # What a device needs is loaded where there is one: pyserial, OpenCV.
    match rc:
        case RadioRc():
            from zscout.drivers.radio import RadioDriver

            return RadioDriver(rc.port, baud=rc.baud, bound=rc.bound / SECOND)
        case RobotRc():
            from zscout.drivers.robot import RobotDriver

            return RobotDriver(
                rc.id, radio=rc.radio, channels=rc.channels, warm_up=rc.warm_up / SECOND, dead_man=rc.dead_man / SECOND
            )
        case VideoRc():
            return VideoDriver()
        case FramegrabberRc():
            from zscout.drivers.framegrabber import FramegrabberDriver

            return FramegrabberDriver(rc.by_video, rate=rc.rate, quality=rc.quality)
        case CapacityRc():
            return CapacityDriver(exact_amounts(rc.capacity), activation=rc.activation / SECOND)
        case ExclusiveRc():
            return ExclusiveDriver(activation=rc.activation / SECOND)
