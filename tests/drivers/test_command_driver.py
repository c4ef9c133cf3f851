"""The driver `command`: real programs, in their order, within their bounds."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager
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

pytestmark = [pytest.mark.live, pytest.mark.real_time]

TELL = 'echo "$ZSCOUT_DO" >> told; '


class Rc:
    """What the driver has of its RC."""

    name = "psu/bench"
    health = "ok"

    def __init__(self) -> None:
        self.supervisor = Supervisor(self.name, lambda _error: None)
        self.instances = SimpleNamespace(state=InstanceState.SERVES)
        self.informed = asyncio.Event()
        self.informed.set()
        self.said: list[str] = []
        self.news = asyncio.Event()

    def fail(self, why: str) -> None:
        self._say(why)

    def unwell(self, why: str) -> None:
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
    monkeypatch.setattr(command_driver, "RETRY_PAUSES_S", (0.05, 0.1))
    monkeypatch.setattr(command_driver, "OPENING", HANG)
    yield
    asyncio.run(until(lambda: not any(map(alive, told("pids")))))  # who was killed may take a moment to go


@asynccontextmanager
async def play(
    *,
    timeout: float = HANG,
    every: float = 0.05,
    parameters: Mapping[str, Decimal] = MappingProxyType({}),
    state: InstanceState = InstanceState.SERVES,
    informed: bool = True,
    **scripts: str,
) -> AsyncIterator[tuple[CommandDriver, Rc]]:
    """A driver whose commands are these shell scripts."""
    rc = Rc()
    rc.instances.state = state
    if not informed:
        rc.informed.clear()
    bounds: dict[str, Any] = {"timeout": round(timeout * SECOND), "every": round(every * SECOND)}
    words: dict[str, Any] = {name: ("sh", "-c", script) for name, script in scripts.items()}
    driver = CommandDriver.configured(CommandRc(name=rc.name, parameters=parameters, **bounds, **words))
    try:
        await driver.open(rc)  # type: ignore[arg-type]
        yield driver, rc
    finally:
        await rc.supervisor.close()


async def over(driver: CommandDriver) -> None:
    await driver.end(holder(1))
    await driver.safe()


async def test_each_is_run_in_its_turn_and_told_what_it_is_about() -> None:
    start = TELL + 'echo "$ZSCOUT_RC $ZSCOUT_ARC $ZSCOUT_CLIENT $ZSCOUT_PARAMETERS" > about'
    async with play(start=start, stop=TELL, safe=TELL) as (driver, rc):
        assert told() == ["safe"]
        one = structs.replace(holder(1, "survey"), params={})
        await driver.begin(one)
        await until(lambda: bool(told("about")))
        await driver.end(one)
        await driver.safe()
        assert told() == ["safe", "start", "stop", "safe"]
        assert told("about") == ["psu/bench", "survey", "h/client", "{}"]
        assert (driver.figures()["starts"], driver.figures()["failures"], rc.said) == (1, 0, [])


async def test_a_start_that_has_ended_begins_no_longer() -> None:
    async with play(start="until test -e go; do sleep 0.05; done; " + TELL) as (driver, _rc):
        await driver.begin(holder(1))
        put("go")
        await until(lambda: driver.begins_for() == 0)
        assert told() == ["start"]


async def test_it_takes_the_parameters_that_it_declares_and_no_others_reach_it() -> None:
    parameters = {"voltage": Decimal(30), "current": Decimal(2)}
    async with play(parameters=parameters, start='echo "$ZSCOUT_PARAMETERS" > about') as (driver, _rc):
        assert driver.parameters() == [Parameter("voltage", bound=Decimal(30)), Parameter("current", bound=Decimal(2))]
        # As from a client that has its door not checked.
        asked = {"voltage": Decimal("12.5"), "current": Decimal(3), "$(reboot)": Decimal(1)}
        await driver.begin(structs.replace(holder(1), params=asked))
        await until(lambda: bool(told("about")))
        assert told("about") == ['{"voltage":', "12.5}"]


def test_without_any_it_takes_none() -> None:
    assert CommandDriver(CommandRc(name="psu/bench")).parameters() == []


async def test_a_hold_that_goes_on_in_another_client_is_not_started_again() -> None:
    async with play(start=TELL, stop=TELL) as (driver, _rc):
        await driver.begin(holder(1, "survey"))
        await driver.begin(holder(2, "survey", "h/heir"))
        await until(lambda: told() == ["start"])
        await driver.end(holder(2, "survey", "h/heir"))
        await driver.safe()
        assert told() == ["start", "stop"]


async def test_a_start_that_fails_loses_the_device_with_its_last_line_until_it_was_made_safe() -> None:
    async with play(start="echo first; printf 'no such\\033[2J power\\n\\n'; exit 3", safe=TELL) as (driver, rc):
        await driver.begin(holder(1))
        await rc.until("start ended with exit code 3: no such [2J power")
        await driver._check()
        assert "ok" not in rc.said
        await over(driver)
        await rc.until("ok")


async def test_a_start_that_fails_again_and_again_is_tried_ever_more_slowly_and_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(command_driver, "RETRY_PAUSES_S", (0.05, 0.3))
    clock = asyncio.get_running_loop().time
    # That its health is good again at once makes no difference.
    async with play(start="exit 3", health="true", safe="true", every=0.01) as (driver, rc):
        for pause in (0.05, 0.1, 0.2, 0.3, 0.3):
            rc.said.clear()
            await driver.begin(holder(1))
            await rc.until("start ended with exit code 3")
            failed = clock()
            await over(driver)
            await rc.until("ok")
            assert clock() - failed > 0.9 * pause
            said = rc.said[0]
        assert said == "start ended with exit code 3 (5 times in a row; tried again in 0.3 s)"


async def test_a_device_that_can_not_be_made_safe_is_lost_and_tried_until_it_is() -> None:
    async with play(safe="test -e there") as (_driver, rc):
        assert rc.health.startswith("safe ended with exit code 1")
        put("there")
        await rc.until("ok")


async def test_health_is_looked_at_and_it_comes_back_by_itself() -> None:
    async with play(health="cat ill; test ! -s ill") as (driver, rc):
        assert rc.said == []
        await driver.begin(holder(1))
        put("ill", "no answer\n")
        await rc.until("health ended with exit code 1: no answer")
        await over(driver)
        put("ill")
        await rc.until("ok")


async def test_a_health_that_hangs_holds_up_no_safe_state() -> None:
    async with play(health="test -e go || exit 0; echo $$ >> pids; sleep 1000", safe=TELL) as (driver, rc):
        async with asyncio.timeout(HANG / 2):  # its own limit is HANG
            put("go")
            await until(lambda: bool(told("pids")))
            await driver.safe()
        assert "safe" in told()
        assert not any(said.startswith("health") and "killed" in said for said in rc.said)


async def test_what_takes_too_long_is_killed_with_all_that_it_started() -> None:
    start = 'trap "" TERM; sleep 1000 & echo $$ $! > pids; echo on my way; wait'
    # Whether it comes so far in time is the machine's business: it is given more until it does.
    for seconds in (1, 4, 16, 64):
        async with play(timeout=seconds, start=start) as (driver, rc):
            await driver.begin(holder(1))
            await rc.until("start was")
        if rc.said[0].endswith("on my way"):
            break
    assert rc.said == [f"start was killed: it took longer than {seconds} s: on my way"]
    assert len(told("pids")) == 2


async def test_what_is_left_of_a_command_that_has_ended_is_killed() -> None:
    async with play(start="sleep 1000 & echo $! > pids") as (driver, _rc):
        await driver.begin(holder(1))
        await until(lambda: bool(told("pids")))
        (pid,) = told("pids")
        await until(lambda: not alive(pid))


async def test_a_command_that_writes_without_end_is_held_back_and_only_the_last_is_kept() -> None:
    async with play(start="head -c 300000 /dev/zero | tr '\\0' y; exit 5") as (driver, rc):
        await driver.begin(holder(1))
        await rc.until("start")
        (said,) = rc.said
        assert said.startswith("start ended with exit code 5: ")
        assert set(said.partition("5: ")[2]) == {"y"}
        assert len(said) <= command_driver.MAX_REASON + 40


async def test_of_what_is_written_the_end_is_kept() -> None:
    reader = asyncio.StreamReader()
    reader.feed_data(b"x" * 2 * command_driver.KEPT_OUTPUT + b"\nlast")
    reader.feed_eof()
    tail = command_driver.OutputTail(reader)
    await tail.drain()
    assert (tail.last_line, len(tail._kept)) == (": last", command_driver.KEPT_OUTPUT)


async def test_a_program_that_is_not_there_is_the_reason() -> None:
    rc = Rc()
    driver = CommandDriver(CommandRc(name=rc.name, safe=("/no/such/psu", "off")))
    await driver.open(rc)  # type: ignore[arg-type]
    assert rc.said == ["safe can't be run: /no/such/psu: No such file or directory"]
    await rc.supervisor.close()


async def test_a_start_that_goes_on_holds_up_nobody_and_ends_with_its_hold() -> None:
    async with play(start="echo $$ >> pids; sleep 1000", stop=TELL, safe=TELL) as (driver, rc):
        assert driver.begins_for() == 0
        await driver.begin(holder(1))
        await until(lambda: bool(told("pids")))
        assert 0 < driver.begins_for() <= HANG
        assert rc.said == []
        await over(driver)
        assert (driver.begins_for(), told(), rc.said) == (0, ["safe", "stop", "safe"], [])


async def test_a_safe_state_that_its_rc_does_not_wait_for_is_made_later() -> None:
    async with play(start="exit 0", safe="echo $$ > pids; test ! -s slow || sleep 1000") as (driver, rc):
        await driver.begin(holder(1))
        await driver.end(holder(1))
        put("slow", "1")
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.3):
                await driver.safe()
        assert rc.said == ["it was not made safe in time"]
        put("slow")
        await rc.until("ok")


async def test_a_node_that_ends_stops_and_makes_safe() -> None:
    async with play(start=TELL, stop=TELL, safe=TELL) as (driver, rc):
        await driver.begin(holder(1))
        await until(lambda: told() == ["safe", "start"])
        await rc.supervisor.close()
        await driver.safe()
        assert told() == ["safe", "start", "stop", "safe"]


async def test_one_that_stands_by_leaves_the_device_alone_until_it_is_used() -> None:
    async with play(state=InstanceState.STANDS_BY, safe=TELL, health=TELL) as (driver, rc):
        await rc.until("it was not made safe: it is on standby")
        await driver.safe()  # as its node ends
        assert told() == []
        rc.instances.state = InstanceState.OFFERED
        await rc.until("ok")
        assert told()[:2] == ["safe", "health"]


async def test_the_device_is_left_alone_until_it_is_known_who_serves() -> None:
    async with play(informed=False, safe=TELL, health=TELL) as (_, rc):
        assert rc.said == ["it was not made safe yet"]
        rc.instances.state = InstanceState.STANDS_BY
        rc.informed.set()
        await rc.until("it was not made safe: it is on standby")
        assert told() == []
        rc.instances.state = InstanceState.OFFERED
        await rc.until("ok")
        assert told()[:2] == ["safe", "health"]


async def test_one_that_stands_by_from_now_on_ends_its_own_hold_in_order() -> None:
    async with play(start=TELL, stop=TELL, safe=TELL) as (driver, rc):
        await driver.begin(holder(1))
        await until(lambda: told() == ["safe", "start"])
        rc.instances.state = InstanceState.STANDS_BY
        await over(driver)
        assert told() == ["safe", "start", "stop", "safe"]
