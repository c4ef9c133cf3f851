"""What fails in a service is logged once, fails its owner once, and ends what else the service runs."""

from __future__ import annotations

import asyncio
import gc
import logging
from contextlib import AsyncExitStack

import pytest
import uvloop

from tests.hang import HANG
from zscout.keyexpr import BadName
from zscout.mesh import supervision
from zscout.mesh.exchange import Refused
from zscout.mesh.supervision import AFTERMATH_NS, StallWatch, Supervisor, done_within, supervised
from zscout.testing.virtual_time import VirtualTimeLoop
from zscout.types import SECOND, Ns


class Owner:
    def __init__(self) -> None:
        self.failures: list[Exception] = []
        self.failed = asyncio.Event()
        self.supervisor = Supervisor("owner", self.on_failure)

    def on_failure(self, error: Exception) -> None:
        self.failures.append(error)
        self.failed.set()


@pytest.fixture
def owner(stack: AsyncExitStack) -> Owner:
    owner = Owner()
    stack.push_async_callback(owner.supervisor.close)
    return owner


async def forever() -> None:
    await asyncio.Event().wait()


async def explode(message: str = "boom") -> None:
    raise ValueError(message)


def fail() -> None:
    raise ValueError("boom")


def errors(caplog: pytest.LogCaptureFixture) -> list[logging.LogRecord]:
    return [record for record in caplog.records if record.levelno >= logging.ERROR]


def has_traceback(record: logging.LogRecord, of: str) -> bool:
    return record.exc_info is not None and of in logging.Formatter().formatException(record.exc_info)


@pytest.fixture(params=[asyncio.new_event_loop, uvloop.new_event_loop], ids=["asyncio", "uvloop"])
def runner(request: pytest.FixtureRequest) -> asyncio.Runner:
    return asyncio.Runner(loop_factory=request.param)


def test_a_task_that_raises_is_logged_once_fails_its_owner_once_and_ends_its_siblings(
    runner: asyncio.Runner, caplog: pytest.LogCaptureFixture
) -> None:
    async def story() -> None:
        owner = Owner()
        sibling = owner.supervisor.spawn(forever())
        timer = owner.supervisor.call_later(60, fail)
        owner.supervisor.spawn(explode(), "exploder")
        await owner.failed.wait()
        with pytest.raises(asyncio.CancelledError):
            await sibling
        assert timer.cancelled()
        assert [str(error) for error in owner.failures] == ["boom"]
        assert owner.supervisor.error is owner.failures[0]
        assert not owner.supervisor.active
        await owner.supervisor.close()

    with runner:
        runner.run(story())
    gc.collect()
    (record,) = errors(caplog)
    assert record.getMessage() == "owner failed"
    assert has_traceback(record, "in explode")


async def test_two_that_fail_together_fail_the_owner_once_and_are_both_logged(
    owner: Owner, caplog: pytest.LogCaptureFixture
) -> None:
    owner.supervisor.spawn(explode("first"))
    owner.supervisor.spawn(explode("second"))
    await owner.failed.wait()
    await owner.supervisor.close()
    assert [str(error) for error in owner.failures] == ["first"]
    assert [str(record.exc_info[1]) for record in errors(caplog) if record.exc_info] == ["first", "second"]


async def test_an_error_that_is_awaited_in_a_sibling_is_logged_once(
    owner: Owner, caplog: pytest.LogCaptureFixture
) -> None:
    task = owner.supervisor.spawn(explode())

    async def wait() -> None:
        await asyncio.wait([task])
        task.result()

    waiter = owner.supervisor.spawn(wait())
    with pytest.raises((ValueError, asyncio.CancelledError)):
        await waiter
    await owner.supervisor.close()
    assert (len(owner.failures), len(errors(caplog))) == (1, 1)


def test_a_timer_that_raises_fails_the_owner(runner: asyncio.Runner, caplog: pytest.LogCaptureFixture) -> None:
    async def story() -> None:
        owner = Owner()
        sibling = owner.supervisor.spawn(forever())
        owner.supervisor.call_later(0.001, fail)
        await owner.failed.wait()
        with pytest.raises(asyncio.CancelledError):
            await sibling
        await owner.supervisor.close()

    with runner:
        runner.run(story())
    (record,) = errors(caplog)
    assert has_traceback(record, "in fail")


async def test_a_handler_that_raises_fails_the_owner_and_is_not_called_again(owner: Owner) -> None:
    calls: list[int] = []

    def handle(value: int) -> None:
        calls.append(value)
        fail()

    guarded = owner.supervisor.guard(handle)
    with pytest.raises(Refused) as refused:
        guarded(1)
    assert refused.value.problem.code == "internal"
    guarded(2)
    assert (calls, [str(error) for error in owner.failures]) == ([1], ["boom"])


@pytest.mark.parametrize("answer", [Refused("busy", "ask again"), BadName("no name")])
async def test_a_handler_that_refuses_has_not_failed(owner: Owner, answer: Exception) -> None:

    def refuse() -> None:
        raise answer

    with pytest.raises(type(answer)) as raised:
        owner.supervisor.guard(refuse)()
    assert raised.value is answer
    assert owner.failures == []
    assert owner.supervisor.active


async def test_an_owner_that_fails_to_handle_a_failure_is_logged_and_its_tasks_end(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def on_failure(error: Exception) -> None:
        raise KeyError("twice")

    supervisor = Supervisor("owner", on_failure)
    sibling = supervisor.spawn(forever())
    supervisor.spawn(explode())
    async with asyncio.timeout(HANG):
        with pytest.raises(asyncio.CancelledError):
            await sibling
    assert [record.getMessage() for record in errors(caplog)] == ["owner failed", "owner could not handle its failure"]
    assert has_traceback(errors(caplog)[1], "in on_failure")


async def test_a_task_that_ends_or_is_cancelled_by_itself_has_not_failed(
    owner: Owner, caplog: pytest.LogCaptureFixture
) -> None:
    other, one = owner.supervisor.spawn(forever()), owner.supervisor.spawn(forever())
    await owner.supervisor.spawn(asyncio.sleep(0, result=None))
    one.cancel()
    await asyncio.wait([one])
    assert owner.failures == []
    assert not other.done()
    await owner.supervisor.close()
    assert not errors(caplog)


async def test_close_awaits_all_and_nothing_starts_afterwards(owner: Owner) -> None:
    ended: list[str] = []

    async def work() -> None:
        try:
            await forever()
        finally:
            await asyncio.sleep(0.01)
            ended.append("work")

    owner.supervisor.spawn(work())
    await asyncio.sleep(0)
    await owner.supervisor.close()
    assert ended == ["work"]
    late = owner.supervisor.spawn(work())
    with pytest.raises(asyncio.CancelledError):
        await late
    assert owner.supervisor.call_later(0, fail).cancelled()
    owner.supervisor.guard(fail)()
    assert (ended, owner.failures) == (["work"], [])


async def test_close_is_bounded(
    owner: Owner, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(supervision, "CLOSE_TIMEOUT", 0.05)

    release = asyncio.Event()

    async def stubborn() -> None:
        while not release.is_set():
            try:
                await release.wait()
            except asyncio.CancelledError:
                continue

    task = owner.supervisor.spawn(stubborn(), "stubborn")
    await asyncio.sleep(0)
    await owner.supervisor.close()
    assert not task.done()
    release.set()
    await task
    (record,) = errors(caplog)
    assert record.getMessage() == "owner: stubborn did not end within 0.05 s of its cancellation"


async def test_a_task_may_close_its_own_supervisor(owner: Owner) -> None:
    sibling = owner.supervisor.spawn(forever())

    async def end() -> str:
        await owner.supervisor.close()
        return "closed"

    assert await owner.supervisor.spawn(end()) == "closed"
    assert sibling.cancelled()


async def test_an_owner_that_is_cancelled_while_it_closes_has_cancelled_its_tasks(owner: Owner) -> None:
    cancelled, release = asyncio.Event(), asyncio.Event()

    async def slow() -> None:
        try:
            await forever()
        finally:
            cancelled.set()
            await release.wait()

    task = owner.supervisor.spawn(slow())

    async def own() -> None:
        try:
            await forever()
        finally:
            await owner.supervisor.close()

    owning = asyncio.create_task(own())
    await asyncio.sleep(0)
    owning.cancel()
    await cancelled.wait()
    owning.cancel()
    await asyncio.wait([owning])
    assert owning.cancelled()
    assert not task.done()
    release.set()
    await asyncio.wait([task])
    assert task.cancelled()


async def test_done_within_tells_its_own_timeout_from_the_work_s() -> None:
    async def work() -> None:
        raise TimeoutError("of the work")

    assert not await done_within(1, asyncio.sleep(2))
    assert await done_within(1, asyncio.sleep(0.5))
    with pytest.raises(TimeoutError, match="of the work"):
        await done_within(1, work())


async def test_what_fails_beside_a_body_fails_the_body() -> None:
    async def broken() -> None:
        await asyncio.sleep(1)
        raise RuntimeError("broken")

    async def body() -> None:
        async with supervised("tree") as supervisor:
            supervisor.spawn(broken())
            await asyncio.sleep(3600)

    with pytest.raises(RuntimeError, match="broken"):
        await body()


async def test_a_body_that_is_cancelled_from_outside_stays_so() -> None:
    async def body(ended: list[str]) -> None:
        async def work() -> None:
            try:
                await asyncio.sleep(3600)
            finally:
                ended.append("work")

        async with supervised("tree") as supervisor:
            supervisor.spawn(work())
            await asyncio.sleep(3600)

    ended: list[str] = []
    task = asyncio.create_task(body(ended))
    await asyncio.sleep(1)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert ended == ["work"]


# A process that stood still


def _loop() -> VirtualTimeLoop:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualTimeLoop)
    return loop


def _now() -> Ns:
    return round(_loop().time() * SECOND)


async def test_a_stall_is_measured_and_soon_over() -> None:
    watch = StallWatch(_now).start()
    await asyncio.sleep(10.05)
    assert not watch.fresh()
    assert watch.waited_through(_now()) == 0
    _loop().jump(3.0)  # nothing runs meanwhile
    assert watch.fresh()
    arrived = _now()
    assert watch.waited_through(arrived) == pytest.approx(2.8 * SECOND, rel=0.001)
    await asyncio.sleep(AFTERMATH_NS / SECOND + 0.01)
    assert not watch.fresh()
    assert watch.waited_through(_now()) == 0
    assert watch.waited_through(arrived) > 0
    watch.stop()


async def test_a_short_delay_is_no_stall() -> None:
    watch = StallWatch(_now).start()
    await asyncio.sleep(1)
    _loop().jump(0.35)
    assert not watch.fresh()
    watch.stop()
