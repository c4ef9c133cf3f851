"""`zscout drive`: an operator drives a robot by keyboard or game pad."""

from __future__ import annotations

import asyncio
import importlib
import os
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from zscout import terminal
from zscout.cli import common, completion
from zscout.cli.requests.options import parse_rc
from zscout.config.strict import BadInput, quoted
from zscout.scheduling.reason import waits
from zscout.types import SECOND

if TYPE_CHECKING:
    from zscout.behaviors.teleop import Teleop, Way
    from zscout.cli.operator.picture_recording import PictureRecording

REFRESH_INTERVAL_S: Final = 0.2
"""Interval between two drawings of the live line."""
MAX_RATE: Final = 50.0

WAYS: Final[dict[Way, tuple[bytes, ...]]] = {
    "forward": (b"w", b"\x1b[A", b"\x1bOA"),
    "back": (b"s", b"\x1b[B", b"\x1bOB"),
    "right": (b"d", b"\x1b[C", b"\x1bOC"),
    "left": (b"a", b"\x1b[D", b"\x1bOD"),
}
"""Driving keys: w a s d, and arrows in both forms that terminals send."""
KEYS: Final = {key: way for way, keys in WAYS.items() for key in keys}

PAD_EVENT: Final = struct.Struct("<IhBB")
"""An event of Linux's joystick interface: time in ms, value, type, number (Documentation/input/joydev)."""
AXIS: Final = 0x02
BUTTON: Final = 0x01
INITIAL: Final = 0x80
ACROSS, ALONG = 0, 1
"""Axes of the left stick."""
FULL_DEFLECTION: Final = 32_767

HELP: Final = "arrows or wasd drive · space stops · + - speed · g releases · q ends"


def _rc_option(kind: str) -> Callable[[common.F], common.F]:
    """`--radio RC` and the like. Default: any RC of this kind. Cameras may have names of any kind."""
    other = kind == "framegrabber"
    rc = common.Parsed("rc", lambda text, _: parse_rc(text, kind, pattern=True, other_kinds=other))
    return click.option(f"--{kind}", default=f"{kind}/*", type=rc, shell_complete=completion.rcs)


@click.command()
@click.argument(
    "robot", type=common.Parsed("rc", lambda text, _: parse_rc(text, "robot")), shell_complete=completion.rcs
)
@_rc_option("radio")
@_rc_option("video")
@_rc_option("framegrabber")
@click.option(
    "--rate", type=click.FloatRange(0.5, MAX_RATE), default=5.0, help="Commands per second, requested from the radio."
)
@click.option("--speed", type=click.FloatRange(0.1, 1.0), default=0.6, help="Share of the robot's top speed.")
@click.option("--stand-by", is_flag=True, help="Take the robot at the first driving key, not at once.")
@click.option("--pad", type=click.Path(path_type=Path), metavar="DEVICE", help="Also drive by a game pad's stick.")
@click.option("--no-picture", is_flag=True, help="Drive without looking.")
@click.option("--no-view", is_flag=True, help="Open no viewer; print the picture's address.")
@click.option("--record", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE.rrd", help="Record pictures.")
@common.json_option("Print one JSON object on a line for each event.")
@common.runs
async def drive(
    robot: str,
    radio: str,
    video: str,
    framegrabber: str,
    rate: float,
    speed: float,
    stand_by: bool,
    pad: Path | None,
    no_picture: bool,
    no_view: bool,
    record: Path | None,
    as_json: bool,
) -> None:
    """Take ROBOT with a radio, a video channel and a framegrabber, and drive it.

    The command takes them at the fleet's operator priority without asking. Preempted holders continue when you release
    the robot, with g or q, or when this terminal closes. The robot stops whenever you let go of the keys. The Rerun
    viewer shows the picture; on a host without a display the command prints its address.

    Keys: arrows or w a s d drive, space stops, + and - change the speed, g releases the robot and the next driving
    key takes it again, q ends. On a pad the left stick drives, button 0 stops, button 1 releases the robot.

    \b
    Examples:
      zscout drive robot/scout33
      zscout drive scout33 --stand-by --rate 10
      zscout drive robot/scout33 --pad /dev/input/js0 --record runs/scout33.rrd
    """
    from zscout.behaviors.sensor_net.held_robot import RobotNeeds

    needs = RobotNeeds(robot, radio, video, framegrabber, rate)
    if fault := needs.shared_camera():
        raise BadInput(f"--framegrabber: {fault}; name another device")
    if not sys.stdin.isatty():
        raise BadInput("standard input is not a terminal, and zscout drive reads keys; run it at a terminal")
    common.check_recording("--record", record)
    from zscout.behaviors.teleop import Pilot, Teleop

    fleet = common.the_fleet()
    async with AsyncExitStack() as stack:
        client = await stack.enter_async_context(common.connected("drive", fleet))
        state = await common.state_of(client)
        if all(rc.rc != robot for rc in state.rcs):
            there = sorted(rc.rc for rc in state.rcs if rc.rc.startswith("robot/"))
            hint = common.hint_at(robot, there, "and there are none on the mesh", "known")
            raise BadInput(f"unknown robot {quoted(robot)}{hint}")
        pilot, end = Pilot(speed), asyncio.Event()
        console = stack.enter_context(_Console(robot, as_json=as_json))
        teleop = Teleop(client, needs, pilot, priority=fleet.operator_priority, changed=lambda: console.update(teleop))
        hands = Hands(teleop, end)
        stack.enter_context(terminal.typed_keys(hands.key, end.set))
        if pad is not None:
            stack.enter_context(game_pad(pad, hands.moved, hands.button))
        if not stand_by:
            teleop.take()

        async def look() -> None:
            stream = await _stream(stack, robot, record, console, view=not no_view)
            await show_pictures(teleop, stream, console)

        works = [end.wait(), teleop.run(), console.keep_drawing(teleop)]
        await common.first_of(*works, *([] if no_picture else [look()]))
    console.event("ended", "released")


async def _stream(
    stack: AsyncExitStack, robot: str, record: Path | None, console: _Console, *, view: bool
) -> PictureRecording:
    """Start the picture's stream, with a window if there is a display."""
    from zscout.cli.fleet.view import WINDOW_ARGUMENTS, has_display, viewer
    from zscout.ports import free_port

    # On a busy machine Rerun takes seconds to load: load it in a thread, so that the operator can drive already.
    await asyncio.to_thread(importlib.import_module, "zscout.cli.operator.picture_recording")
    from zscout.cli.operator.picture_recording import PictureRecording

    stream = stack.enter_context(PictureRecording("drive", robot, port=free_port("127.0.0.1", 0), file=record))
    window = view and has_display()
    words = f"picture at {stream.url}" if window else f"see the picture with: rerun {stream.url}"
    console.event("picture", words, url=stream.url)
    if window:
        await stack.enter_async_context(viewer(*WINDOW_ARGUMENTS, "--connect", stream.url))
    return stream


async def show_pictures(teleop: Teleop, stream: PictureRecording, console: _Console) -> None:
    """Record each newest picture of the held framegrabber, without end."""
    mesh = teleop.client.mesh
    zero = mesh.now()
    while True:
        robot, held = teleop.robot, teleop.held
        if robot is None or held is None:
            await asyncio.sleep(REFRESH_INTERVAL_S)
            continue
        stream.words((mesh.now() - zero) / SECOND, f"{robot.robot} is yours, seen through {robot.framegrabber}")
        with closing(mesh.frames(mesh.keys.frame(robot.framegrabber))) as frames:
            while teleop.robot is robot:
                frame = await frames.next(REFRESH_INTERVAL_S)
                if frame is not None and frame.head.grant == held.grant:
                    stream.picture((frame.arrived - zero) / SECOND, frame.jpeg)
                    console.seen(frame.arrived)


class _Console(terminal.LiveLine):
    """The operator's output: a live line, or JSON lines."""

    def __init__(self, robot: str, *, as_json: bool) -> None:
        super().__init__(shown=not as_json)
        self._robot, self._as_json = robot, as_json
        self._pictures: list[int] = []
        self._printed: object = None

    def event(self, event: str, words: str, **more: Any) -> None:
        if self._as_json:
            terminal.print_json({"event": event, "robot": self._robot, **more})
        else:
            self.print(words)

    def update(self, teleop: Teleop) -> None:
        now = (teleop.state, teleop.why, teleop.takeover)
        if now == self._printed:
            return
        before, self._printed = self._printed, now
        if teleop.state == "driving" and teleop.takeover is not None:
            words = f"{self._robot} obeys, {1000 * teleop.takeover:.0f} ms after you took it"
            self.event("driving", words, takeover=teleop.takeover)
        elif teleop.state == "driving":
            rcs = ", ".join(teleop.held.rcs if teleop.held else [])
            self.event("taken", f"{self._robot} is yours: {rcs}")
        elif teleop.state == "waiting":
            self.event("waiting", f"{self._robot} {waits(teleop.why, teleop.reason)}", why=teleop.why)
        elif before is not None:
            self.event("free", f"{self._robot} is released")

    def seen(self, at: int) -> None:
        self._pictures = [arrived for arrived in self._pictures if at - arrived < SECOND] + [at]

    async def keep_drawing(self, teleop: Teleop) -> None:
        while True:
            if self.watched:
                self._picture(teleop)
            await asyncio.sleep(REFRESH_INTERVAL_S)

    def _picture(self, teleop: Teleop) -> None:
        from rich.text import Text

        now = teleop.client.mesh.now()
        pictures = sum(now - at < SECOND for at in self._pictures)
        wheels = teleop.pilot.wheels(now / SECOND)
        colour = {"driving": "bold green", "waiting": "yellow", "free": "dim"}[teleop.state]
        state = waits(teleop.why, teleop.reason) if teleop.state == "waiting" and teleop.why else teleop.state
        line = Text().append(f"{self._robot}  {terminal.clean(state)}", style=colour)
        if teleop.why and teleop.state != "waiting":
            line.append(f": {terminal.clean(teleop.why)}")
        if teleop.robot is not None:
            line.append(f"  wheels {wheels.left:+.1f} {wheels.right:+.1f}  speed {teleop.pilot.speed:.1f}")
            line.append(f"  {pictures} pictures/s  {teleop.robot.sent} commands")
            if teleop.robot.refused:
                line.append(f", {teleop.robot.refused} refused", style="red")
        self.draw(line.append(f"\n{HELP}", style="dim"))


class Hands:
    def __init__(self, teleop: Teleop, end: asyncio.Event) -> None:
        self.teleop, self.pilot, self._end = teleop, teleop.pilot, end

    def _now(self) -> float:
        return self.teleop.client.mesh.now() / SECOND

    def key(self, key: bytes) -> None:
        if key in KEYS:
            self.pilot.press(self._now(), KEYS[key])
            self.teleop.take()
        elif key in (b" ", b"x"):
            self.pilot.stop()
        elif key in (b"+", b"="):
            self.pilot.faster(1)
        elif key in (b"-", b"_"):
            self.pilot.faster(-1)
        elif key == b"g":
            self.teleop.give_back()
        elif key in (b"q", b"\x04"):
            self._end.set()
        self.teleop.wake()

    def moved(self, forward: float, right: float) -> None:
        self.pilot.stick(self._now(), forward, right)
        if not self.pilot.wheels(self._now()).still:
            self.teleop.take()
        self.teleop.wake()

    def button(self, number: int) -> None:
        if number == 0:
            self.pilot.stop()
            self.teleop.wake()
        elif number == 1:
            self.teleop.give_back()


@contextmanager
def game_pad(device: Path, moved: Callable[[float, float], None], button: Callable[[int], None]) -> Iterator[None]:
    """Call `moved(forward, right)`, -1 to 1 each, when the left stick moves (0, 0 if unplugged), and `button` with the
    number of a pressed button. Raises BadInput if the device can't be opened."""
    try:
        descriptor = os.open(device, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise BadInput(
            f"--pad: {quoted(str(device))} can't be opened ({error.strerror}); name a joystick, as in /dev/input/js0"
        ) from None
    loop = asyncio.get_running_loop()
    stick = {ACROSS: 0.0, ALONG: 0.0}

    def readable() -> None:
        try:
            events = os.read(descriptor, PAD_EVENT.size * 64)
        except BlockingIOError:
            return
        except OSError:
            events = b""
        if not events:
            loop.remove_reader(descriptor)
            moved(0.0, 0.0)
        whole = len(events) // PAD_EVENT.size * PAD_EVENT.size
        for _, value, kind, number in PAD_EVENT.iter_unpack(events[:whole]):
            if kind & ~INITIAL == AXIS and number in stick:
                stick[number] = value / FULL_DEFLECTION
                # The interface reports forward as negative.
                moved(-stick[ALONG], stick[ACROSS])
            elif kind == BUTTON and value:
                button(number)

    loop.add_reader(descriptor, readable)
    try:
        yield
    finally:
        loop.remove_reader(descriptor)
        os.close(descriptor)
