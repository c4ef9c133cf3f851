"""Serves a node's figures over HTTP, `GET /metrics` alone.

Figures are read in the event loop, and formatted in a thread, one at a time, at most once in `FRESH` seconds."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Final

from zscout.services.metrics.exposition import CONTENT_TYPE, Exposition
from zscout.services.metrics.figures import Samples
from zscout.services.plain_http import Page, PlainHttpServer

FRESH: Final = 1.0  # seconds for which a text is reused


class MetricsServer(PlainHttpServer):
    where = "figures are at /metrics"

    def __init__(self, read: Callable[[], Samples], bind: str, port: int) -> None:
        super().__init__("figures", bind, port)
        self._read = read
        self._exposition = Exposition()
        self._rendering = asyncio.Lock()
        self._text, self._made = b"", float("-inf")

    async def page(self, path: str) -> Page | None:
        if path != "/metrics":
            return None
        async with self._rendering:
            if time.monotonic() - self._made > FRESH:
                samples = self._read()
                self._text = await asyncio.to_thread(self._exposition.render, samples)
                self._made = time.monotonic()
            return Page(self._text, CONTENT_TYPE)
