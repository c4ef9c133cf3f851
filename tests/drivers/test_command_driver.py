"""The driver `command`: real programs, in their order, within their bounds."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Mapping
from decimal import Decimal
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import pytest
from msgspec import structs

from tests.drivers.rcs import holder
from tests.hang import HANG
from zscout.config.devices import CommandRc
from zscout.drivers import command_driver
from zscout.drivers.command_driver import CommandDriver
from zscout.drivers.instances import InstanceState
from zscout.mesh import Supervisor
from zscout.messages import Parameter
from zscout.types import SECOND

TELL = 'echo "$ZSCOUT_DO" >> told; '


class Rc:
    """What the driver has of its RC."""

    name = "psu/bench"
    health = "ok"

    def __init__(self) -> None:
        self.supervisor = Supervisor(self.name, lambda _error: None)
        self.instances = SimpleNamespace(state=InstanceState.SERVES)
        self.said: list[str] = []
        self.news = asyncio.Event()

    def fail(self, why: str) -> None:
        self._say(why)

    def recover(self) -> None:
        self._say("ok")

    def _say(self, what: str) -> None:
        self.health = what
        self.said.append(what)
        self.news.set()

    async def until(self, health: str) -> None:
        """Waits until the RC has said that of its health."""
        async with asyncio.timeout(HANG):
            while not any(said.startswith(health) for said in self.said):
                self.news.clear()
                await self.news.wait()


def told(file: str = "told") -> list[str]:
    """The words that the commands have written there."""
    path = Path(file)
    return path.read_text().split() if path.exists() else []


def alive(pid: str) -> bool:
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False


async def until(ask: Callable[[], bool]) -> None:
    """Waits for what no event tells of."""
    async with asyncio.timeout(HANG / 2):
        while True:
            if ask():
                return
            await asyncio.sleep(0.01)


def put(file: str, text: str = "") -> None:
    Path(file).write_text(text)


@pytest.fixture(autouse=True)
def _quick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A folder of its own, and a second try that does not take long; nothing is left behind."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command_driver, "AGAIN", (0.05, 0.1))
    monkeypatch.setattr(command_driver, "OPENING", HANG)
    yield
    asyncio.run(until(lambda: not any(map(alive, told("pids")))))  # who was killed may take a moment to go


def play(
    story: Callable[[CommandDriver, Rc], Awaitable[None]],
    *,
    timeout: float = HANG,
    every: float = 0.05,
    parameters: Mapping[str, Decimal] = MappingProxyType({}),
    state: InstanceState = InstanceState.SERVES,
    **scripts: str,
) -> None:
    """Plays a story with a driver whose commands are these shell scripts."""

    async def run() -> None:
        rc = Rc()
        rc.instances.state = state
        bounds: dict[str, Any] = {"timeout": round(timeout * SECOND), "every": round(every * SECOND)}
        words: dict[str, Any] = {name: ("sh", "-c", script) for name, script in scripts.items()}
        driver = CommandDriver.configured(CommandRc(name=rc.name, parameters=parameters, **bounds, **words))
        try:
            await driver.open(rc)  # type: ignore[arg-type]
            await story(driver, rc)
        finally:
            await rc.supervisor.close()

    asyncio.run(run())


def test_each_is_run_in_its_turn_and_told_what_it_is_about() -> None:
    async def story(driver: CommandDriver, rc: Rc) -> None:
        assert told() == ["safe"]
        one = structs.replace(holder(1, "survey"), params={})
        await driver.begin(one)
        await until(lambda: bool(told("about")))
        await driver.end(one)
        await driver.safe()
        assert told() == ["safe", "start", "stop", "safe"]
        assert told("about") == ["psu/bench", "survey", "h/client", "{}"]
        assert driver.figures()["starts"] == 1
        assert driver.figures()["failures"] == 0
        assert rc.said == []

    start = TELL + 'echo "$ZSCOUT_RC $ZSCOUT_ARC $ZSCOUT_CLIENT $ZSCOUT_PARAMETERS" > about'
    play(story, start=start, stop=TELL, safe=TELL)


def test_a_start_that_has_ended_begins_no_longer() -> None:
    async def story(driver: CommandDriver, _rc: Rc) -> None:
        await driver.begin(holder(1))
        put("go")
        await until(lambda: driver.begins_for() == 0)
        assert told() == ["start"]

    play(story, start="until test -e go; do sleep 0.05; done; " + TELL)


def test_it_takes_the_parameters_that_it_declares_and_no_others_reach_it() -> None:
    async def story(driver: CommandDriver, _rc: Rc) -> None:
        assert driver.parameters() == [Parameter("voltage", bound=Decimal(30)), Parameter("current", bound=Decimal(2))]
        # As from a client that has its door not checked.
        asked = {"voltage": Decimal("12.5"), "current": Decimal(3), "$(reboot)": Decimal(1)}
        await driver.begin(structs.replace(holder(1), params=asked))
        await until(lambda: bool(told("about")))
        assert told("about") == ['{"voltage":', "12.5}"]

    parameters = {"voltage": Decimal(30), "current": Decimal(2)}
    play(story, parameters=parameters, start='echo "$ZSCOUT_PARAMETERS" > about')


def test_without_any_it_takes_none() -> None:
    assert CommandDriver(CommandRc(name="psu/bench")).parameters() == []


def test_a_hold_that_goes_on_in_another_client_is_not_started_again() -> None:
    async def story(driver: CommandDriver, _rc: Rc) -> None:
        await driver.begin(holder(1, "survey"))
        await driver.begin(holder(2, "survey", "h/heir"))
        await until(lambda: told() == ["start"])
        await driver.end(holder(2, "survey", "h/heir"))
        await driver.safe()
        assert told() == ["start", "stop"]

    play(story, start=TELL, stop=TELL)


def test_a_start_that_fails_loses_the_device_with_its_last_line_until_it_was_made_safe() -> None:
    async def story(driver: CommandDriver, rc: Rc) -> None:
        await driver.begin(holder(1))
        await rc.until("start ended with exit code 3: no such [2J power")
        await driver._look()
        assert "ok" not in rc.said
        await driver.end(holder(1))
        await driver.safe()
        await rc.until("ok")

    play(story, start="echo first; printf 'no such\\033[2J power\\n\\n'; exit 3", safe=TELL)


def test_a_device_that_can_not_be_made_safe_is_lost_and_tried_until_it_is() -> None:
    async def story(_driver: CommandDriver, rc: Rc) -> None:
        assert rc.health.startswith("safe ended with exit code 1")
        put("there")
        await rc.until("ok")

    play(story, safe="test -e there")


def test_health_is_looked_at_and_it_comes_back_by_itself() -> None:
    async def story(driver: CommandDriver, rc: Rc) -> None:
        assert rc.said == []
        await driver.begin(holder(1))
        put("ill", "no answer\n")
        await rc.until("health ended with exit code 1: no answer")
        await driver.end(holder(1))
        await driver.safe()
        put("ill")
        await rc.until("ok")

    play(story, health="cat ill; test ! -s ill")


def test_a_health_that_hangs_holds_up_no_safe_state() -> None:
    async def story(driver: CommandDriver, rc: Rc) -> None:
        async with asyncio.timeout(HANG / 2):  # its own limit is HANG
            put("go")
            await until(lambda: bool(told("pids")))
            await driver.safe()
        assert "safe" in told()
        assert not any(said.startswith("health") and "killed" in said for said in rc.said)

    play(story, health="test -e go || exit 0; echo $$ >> pids; sleep 1000", safe=TELL)


def test_what_takes_too_long_is_killed_with_all_that_it_started() -> None:
    said: list[str] = []

    async def story(driver: CommandDriver, rc: Rc) -> None:
        await driver.begin(holder(1))
        await rc.until("start was")
        said[:] = rc.said

    start = 'trap "" TERM; sleep 1000 & echo $$ $! > pids; echo on my way; wait'
    # Whether it comes so far in time is the machine's business: it is given more until it does.
    for seconds in (1, 4, 16, 64):
        play(story, timeout=seconds, start=start)
        if said[0].endswith("on my way"):
            break
    assert said == [f"start was killed: it took longer than {seconds} s: on my way"]
    assert len(told("pids")) == 2


def test_what_is_left_of_a_command_that_has_ended_is_killed() -> None:
    async def story(driver: CommandDriver, rc: Rc) -> None:
        await driver.begin(holder(1))
        await until(lambda: bool(told("pids")))
        (pid,) = told("pids")
        await until(lambda: not alive(pid))

    play(story, start="sleep 1000 & echo $! > pids")


def test_a_command_that_writes_without_end_is_held_back_and_only_the_last_is_kept() -> None:
    async def story(driver: CommandDriver, rc: Rc) -> None:
        await driver.begin(holder(1))
        await rc.until("start")
        (said,) = rc.said
        assert said.startswith("start ended with exit code 5: ")
        assert set(said.partition("5: ")[2]) == {"y"}
        assert len(said) <= command_driver.MAX_REASON + 40

    play(story, start="head -c 300000 /dev/zero | tr '\\0' y; exit 5")


def test_of_what_is_written_the_end_is_kept() -> None:
    async def read() -> None:
        reader = asyncio.StreamReader()
        reader.feed_data(b"x" * 2 * command_driver.KEPT_OUTPUT + b"\nlast")
        reader.feed_eof()
        tail = command_driver.OutputTail(reader)
        await tail.drain()
        assert tail.said == ": last"
        assert len(tail._kept) == command_driver.KEPT_OUTPUT

    asyncio.run(read())


def test_a_program_that_is_not_there_is_the_reason() -> None:
    async def run() -> None:
        rc = Rc()
        driver = CommandDriver(CommandRc(name=rc.name, safe=("/no/such/psu", "off")))
        await driver.open(rc)  # type: ignore[arg-type]
        assert rc.said == ["safe can't be run: /no/such/psu: No such file or directory"]
        await rc.supervisor.close()

    asyncio.run(run())


def test_a_start_that_goes_on_holds_up_nobody_and_ends_with_its_hold() -> None:
    async def story(driver: CommandDriver, rc: Rc) -> None:
        assert driver.begins_for() == 0
        await driver.begin(holder(1))
        await until(lambda: bool(told("pids")))
        assert 0 < driver.begins_for() <= HANG
        assert rc.said == []
        await driver.end(holder(1))
        await driver.safe()
        assert driver.begins_for() == 0
        assert told() == ["safe", "stop", "safe"]
        assert rc.said == []

    play(story, start="echo $$ >> pids; sleep 1000", stop=TELL, safe=TELL)


def test_a_safe_state_that_its_rc_does_not_wait_for_is_made_later() -> None:
    async def story(driver: CommandDriver, rc: Rc) -> None:
        await driver.begin(holder(1))
        await driver.end(holder(1))
        put("slow", "1")
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.3):
                await driver.safe()
        assert rc.said == ["it was not made safe in time"]
        put("slow")
        await rc.until("ok")

    play(story, start="exit 0", safe="echo $$ > pids; test ! -s slow || sleep 1000")


def test_a_node_that_ends_stops_and_makes_safe() -> None:
    async def story(driver: CommandDriver, rc: Rc) -> None:
        await driver.begin(holder(1))
        await until(lambda: told() == ["safe", "start"])
        await rc.supervisor.close()
        await driver.safe()
        assert told() == ["safe", "start", "stop", "safe"]

    play(story, start=TELL, stop=TELL, safe=TELL)


def test_one_that_stands_by_leaves_the_device_alone_until_it_is_used() -> None:
    async def story(driver: CommandDriver, rc: Rc) -> None:
        await rc.until("it was not made safe: it stands by")
        await driver.safe()  # as its node ends
        assert told() == []
        rc.instances.state = InstanceState.OFFERED
        await rc.until("ok")
        assert told()[:2] == ["safe", "health"]

    play(story, state=InstanceState.STANDS_BY, safe=TELL, health=TELL)


def test_one_that_stands_by_from_now_on_ends_its_own_hold_in_order() -> None:
    async def story(driver: CommandDriver, rc: Rc) -> None:
        await driver.begin(holder(1))
        await until(lambda: told() == ["safe", "start"])
        rc.instances.state = InstanceState.STANDS_BY
        await driver.end(holder(1))
        await driver.safe()
        assert told() == ["safe", "start", "stop", "safe"]

    play(story, start=TELL, stop=TELL, safe=TELL)
