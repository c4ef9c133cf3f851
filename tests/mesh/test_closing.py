"""Leaving the mesh takes a bounded time, whatever Zenoh does."""

from __future__ import annotations

import asyncio
import threading
import time
from typing import Any

import pytest

from zscout.mesh import zenoh_mesh


class StuckSession:
    """A Zenoh session that never closes."""

    def __init__(self) -> None:
        self.closing = threading.Event()
        self.released = threading.Event()

    def close(self) -> None:
        self.closing.set()
        self.released.wait(20)


def test_a_session_that_does_not_close_holds_up_neither_the_caller_nor_the_end_of_its_loop(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(zenoh_mesh, "CLOSE_TIMEOUT", 0.05)
    session: Any = StuckSession()
    before = time.monotonic()
    asyncio.run(zenoh_mesh.ZenohTransport(session).close())
    assert time.monotonic() - before < 10
    assert session.closing.is_set()
    assert "did not close" in caplog.text
    session.released.set()


def test_a_caller_that_is_cancelled_while_it_leaves_has_the_session_closed() -> None:
    session: Any = StuckSession()

    async def main() -> None:
        leaving = asyncio.create_task(zenoh_mesh.ZenohTransport(session).close())
        await asyncio.sleep(0)
        leaving.cancel()
        await asyncio.wait([leaving])
        assert leaving.cancelled()

    asyncio.run(main())
    assert session.closing.wait(10)
    session.released.set()
