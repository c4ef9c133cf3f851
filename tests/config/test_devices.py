"""Devices in a node file: what good tables mean, and the exact line that each kind of bad one ends in."""

from __future__ import annotations

import subprocess
import sys

import pytest
from msgspec import structs

from tests.config.kit import RC_RULE, short, write
from zscout.config.devices import ExclusiveRc, FramegrabberRc, RadioRc, RcConfig, RobotRc, VideoRc
from zscout.config.node import load_node
from zscout.config.strict import BadInput
from zscout.drivers.registry import driver_for
from zscout.messages import MotionLimits
from zscout.types import SECOND


def table(name: str, **keys: str) -> str:
    kind = name.partition("/")[0]
    lines = [f'name = "{name}"', f'driver = "{keys.pop("driver", kind)}"']
    lines += [f"{key} = {value}" for key, value in keys.items()]
    return "[[rc]]\n" + "\n".join(lines) + "\n"


def device(text: str) -> RcConfig:
    (rc,) = load_node(write("node.toml", text)).rcs
    return rc


def robot(**keys: str) -> str:
    return table("robot/a", **({"id": "33", "radio": '"radio/r"'} | keys))


def radio(**keys: str) -> str:
    return table("radio/r", **({"port": '"/dev/ttyUSB0"'} | keys))


def psu(**keys: str) -> str:
    return table("psu/a", driver="command", **({"safe": '["psu"]'} | keys))


BAD = {
    table("radio/r"): 'rc[0].port (radio/r): is missing; add it, as in port = "/dev/ttyUSB0"',
    radio(port=r'"\u0000"'): (
        'rc[0].port (radio/r): "\\x00" can\'t be opened; name what to open, as in port = "/dev/ttyUSB0"'
    ),
    radio(port='"socket://mast:7002"', dtr="false"): (
        "rc[0].dtr (radio/r): has no effect on socket://; remove it, or use rfc2217://"
    ),
    radio(rts='"low"'): 'rc[0].rts (radio/r): is the text "low"; write true or false',
    radio(capacity="{ command_rate = 1 }"): (
        'rc[0].capacity (radio/r): driver "radio" does not take it; remove it, or write driver = "capacity"'
    ),
    radio(activation="1"): (
        'rc[0].activation (radio/r): driver "radio" does not take it; '
        'remove it, or write driver = "exclusive", "capacity" or "command"'
    ),
    table("radio/r", driver="capacity", capacity="{ a = 1 }", port='"/dev/x"'): (
        'rc[0].port (radio/r): driver "capacity" does not take it; remove it, or write driver = "radio"'
    ),
    table("mast/r", driver="radio", port='"/dev/x"'): (
        'rc[0].name: "mast/r" does not fit driver = "radio"; name it radio/r, or choose another driver'
    ),
    table("robot/a", radio='"radio/r"'): (
        "rc[0].id (robot/a): is missing; add the id that its packets carry, as in id = 33"
    ),
    table("robot/a", id="33"): (
        'rc[0].radio (robot/a): is missing; add the radio that carries its halt, as in radio = "radio/rf0"'
    ),
    robot(radio='"r"'): f'rc[0].radio (robot/a): "r" is not the name of a device; {RC_RULE}',
    robot(radio='"video/r"'): ('rc[0].radio (robot/a): "video/r" is not a radio; name one, as in "radio/..."'),
    robot(channels='{ "radio/r" = 1 }'): (
        'rc[0].channels."radio/r" (robot/a): "radio/r" is not a video; name one, as in "video/..."'
    ),
    robot(channels='{ "video/1" = 1, "video/2" = 1 }'): (
        'rc[0].channels."video/2" (robot/a): 1 is also the channel of video/1; give each its own channel'
    ),
    robot(warmup="1"): "rc[0].warmup (robot/a): unknown key; did you mean warm_up?",
    table("framegrabber/f"): (
        'rc[0].source (framegrabber/f): is missing; add it, as in source = "/dev/video0", or a table sources'
    ),
    table("framegrabber/f", source='"a"', sources='{ "video/1" = "b" }'): (
        "rc[0].sources (framegrabber/f): can't be used with source; remove one of the two"
    ),
    table("framegrabber/f", sources="{}"): (
        'rc[0].sources (framegrabber/f): is empty; add one, as in "video/ch1" = "/dev/video0"'
    ),
    table("framegrabber/f", source='"a"', ignore='["0,0,1,1", "0,0,1,2"]'): (
        'rc[0].ignore (framegrabber/f): "0,0,1,2" is not a region; write numbers from 0 to 1 with commas, two '
        "opposite corners of a rectangle or three or more of a polygon, as in 0,0,0.4,0.1"
    ),
    table("framegrabber/f", source='"a"', ignore='["0,0,1,1,0.5"]'): (
        'rc[0].ignore (framegrabber/f): "0,0,1,1,0.5" has 5 numbers; write x and y of two opposite corners of a '
        "rectangle or three or more of a polygon, as in 0,0,0.4,0.1"
    ),
    table("framegrabber/f", source='"a"', ignore='["0,0.5,1,0.5"]'): (
        'rc[0].ignore (framegrabber/f): "0,0.5,1,0.5" covers nothing; write two opposite corners of a rectangle or '
        "three or more of a polygon, as in 0,0,0.4,0.1"
    ),
    table("framegrabber/f", source='"a"', ignore=str([",".join("0011" * 15)] * 4).replace("'", '"')): (
        "rc[0].ignore (framegrabber/f): has 4 regions with 120 corners; at most 16 regions with 100 corners are allowed"
    ),
    table("framegrabber/f", sources='{ ch1 = "b" }'): (
        f'rc[0].sources.ch1 (framegrabber/f): "ch1" is not the name of a device; {RC_RULE}'
    ),
}


@pytest.mark.parametrize(("text", "line"), BAD.items(), ids=map(short, BAD))
def test_a_bad_device_is_one_line_that_says_how_to_mend_it(text: str, line: str) -> None:
    with pytest.raises(BadInput) as bad:
        device(text)
    assert str(bad.value) == f"node.toml: {line}"


def test_what_a_table_says_and_what_it_leaves_out() -> None:
    assert device(radio()) == RadioRc(name="radio/r", port="/dev/ttyUSB0", baud=9600, bound=SECOND // 4)
    assert device(radio(port='"socket://mast:4001"', baud="1200", bound="1.5")) == RadioRc(
        name="radio/r", port="socket://mast:4001", baud=1200, bound=3 * SECOND // 2
    )
    plain = RobotRc(name="robot/a", id=33, radio="radio/r", channels={}, warm_up=2 * SECOND, dead_man=SECOND // 2)
    assert device(robot()) == plain
    channels = {"video/1": 1, "video/2": 15}
    told = robot(channels='{ "video/1" = 1, "video/2" = 15 }', warm_up="0", dead_man="0.3")
    assert device(told) == structs.replace(plain, channels=channels, warm_up=0, dead_man=3 * SECOND // 10)
    assert device(table("video/1")) == VideoRc(name="video/1")
    grabber = device(table("framegrabber/f", source='"/dev/video0"'))
    assert isinstance(grabber, FramegrabberRc)
    assert (grabber.by_video, grabber.rate, grabber.quality) == ({"": "/dev/video0"}, 10.0, 80)
    # An IP camera has the name of any kind.
    camera = device(table("camera/door", driver="framegrabber", source='"rtsp://door/main"'))
    assert isinstance(camera, FramegrabberRc)
    assert (camera.name, camera.by_video) == ("camera/door", {"": "rtsp://door/main"})
    grabber = device(table("framegrabber/f", sources='{ "video/1" = "http://a/1" }', rate="2.5", quality="60"))
    assert isinstance(grabber, FramegrabberRc)
    assert (grabber.by_video, grabber.rate, grabber.quality) == ({"video/1": "http://a/1"}, 2.5, 60)
    assert grabber.motion is None
    limited = table("framegrabber/f", source='"a"', ignore='["0,0,0.4,0.1"]', min_area="0.01", min_duration="1.5")
    grabber = device(limited)
    assert isinstance(grabber, FramegrabberRc)
    assert grabber.motion == MotionLimits([[0, 0, 0.4, 0.1]], 0.01, 1.5)
    assert device(table("robot/a", driver="exclusive")) == ExclusiveRc(name="robot/a")


def test_every_device_has_its_driver() -> None:
    text = radio() + robot() + table("video/1") + table("robot/b", driver="exclusive", activation="1.5")
    drivers = [driver_for(rc) for rc in load_node(write("node.toml", text)).rcs]
    names = ["RadioDriver", "RobotDriver", "VideoDriver", "ExclusiveDriver"]
    assert [type(driver).__name__ for driver in drivers] == names
    assert [driver.activation for driver in drivers] == [0, 2, 0, 1.5]
    assert [driver.sharable for driver in drivers] == [True, False, True, False]


@pytest.mark.live
def test_a_node_without_such_devices_loads_nothing_heavy() -> None:
    look = "import sys, zscout.node; print({'serial', 'cv2', 'rerun'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
