"""The server of figures over real sockets: what Prometheus gets, and what others do to it."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.hang import HANG
from zscout.services.metrics import server as figures_server
from zscout.services.metrics.figures import FAMILIES, Histogram, Samples
from zscout.services.metrics.server import MetricsServer
from zscout.services.plain_http import MAX_CONNECTIONS, MAX_HEAD, Page

pytestmark = pytest.mark.real_time


def everything() -> Samples:
    """Each metric once."""
    found: Samples = {}
    for name, family in FAMILIES.items():
        labels = tuple(f'a "{label}"\n' for label in family.labels)
        histogram = Histogram((-1.0, 0.0, 2.5))
        histogram.add(1.0)
        found[name] = {labels: histogram.read() if family.kind == "histogram" else 3.5}
    return found


@asynccontextmanager
async def served(read: Callable[[], Samples] = everything) -> AsyncIterator[MetricsServer]:
    server = MetricsServer(read, "127.0.0.1", 0)
    await server.start()
    try:
        yield server
    finally:
        await server.stop()


async def say(server: MetricsServer, request: bytes) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    writer.write(request)
    try:
        return await reader.read()
    except ConnectionResetError:
        return b"reset"
    finally:
        writer.close()


async def test_each_metric_is_written_as_its_family_says() -> None:
    async with served() as server:
        head, _, text = (await say(server, b"GET /metrics HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")).partition(b"\r\n\r\n")
    assert head.splitlines()[0] == b"HTTP/1.1 200 OK"
    assert f"Content-Length: {len(text)}".encode() in head
    found = {family.name: family for family in text_string_to_metric_families(text.decode())}
    assert "process_cpu_seconds" in found
    for name, family in FAMILIES.items():
        written = found[name.removesuffix("_total")]
        assert (written.type, written.documentation) == (family.kind, family.help)
        for sample in written.samples:
            assert {*sample.labels} - {"le"} == {*family.labels}
            assert all(sample.labels[label] == f'a "{label}" ' for label in family.labels)
    buckets = [(one.labels["le"], one.value) for one in found["zscout_forecast_error_seconds"].samples]
    assert buckets == [("-1.0", 0), ("0.0", 0), ("2.5", 1), ("+Inf", 1)]


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        (b"HEAD /metrics HTTP/1.0\r\n\r\n", b"HTTP/1.1 200 OK\r\n"),
        (b"GET /metrics?x=1 HTTP/1.1\r\n\r\n", b"HTTP/1.1 200 OK\r\n"),
        (b"POST /metrics HTTP/1.1\r\n\r\n", b"HTTP/1.1 405 Method Not Allowed\r\n"),
        (b"GET / HTTP/1.1\r\n\r\n", b"HTTP/1.1 404 Not Found\r\n"),
        (b"\x16\x03\x01\r\n\r\n", b"HTTP/1.1 404 Not Found\r\n"),
    ],
)
async def test_other_requests_are_answered_in_a_line(request_: bytes, answer: bytes) -> None:
    async with served() as server:
        assert (await say(server, request_)).startswith(answer)


async def test_who_sends_too_much_or_nothing_is_shut_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MetricsServer, "timeout", 0.2)
    async with served() as server:
        assert await say(server, b"x" * 10 * MAX_HEAD) in (b"", b"reset")
        assert await say(server, b"GET /metrics HTTP/1.1\r\n") in (b"", b"reset")


@pytest.mark.parametrize("sent", [b"", b"GET /metrics", b"GET /metrics HTTP/1.1\r\nHost: x"])
async def test_slow_connections_keep_nobody_from_an_answer(sent: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MetricsServer, "timeout", HANG * 10)
    async with served() as server:
        slow = [await asyncio.open_connection("127.0.0.1", server.port) for _ in range(MAX_CONNECTIONS + 8)]
        for _, writer in slow:
            writer.write(sent)
        assert b" 200 OK" in await say(server, b"GET /metrics HTTP/1.1\r\n\r\n")
        # The oldest made room; the others may still ask.
        assert await slow[0][0].read() == b""
        slow[-1][1].write(b" HTTP/1.1\r\n\r\n" if sent else b"GET /metrics HTTP/1.1\r\n\r\n")
        assert (await slow[-1][0].read()).startswith(b"HTTP/1.1 ")
        for _, writer in slow:
            writer.close()


async def test_a_request_that_is_answered_is_not_shut_out_by_slow_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MetricsServer, "timeout", HANG * 10)
    asked, go_on = asyncio.Event(), asyncio.Event()

    class Slow(MetricsServer):
        async def page(self, path: str) -> Page | None:
            asked.set()
            await go_on.wait()
            return await super().page(path)

    server = Slow(everything, "127.0.0.1", 0)
    await server.start()
    first = asyncio.create_task(say(server, b"GET /metrics HTTP/1.1\r\n\r\n"))
    await asked.wait()
    slow = [await asyncio.open_connection("127.0.0.1", server.port) for _ in range(3 * MAX_CONNECTIONS)]
    await slow[0][0].read()
    go_on.set()
    assert b" 200 OK" in await first
    for _, writer in slow:
        writer.close()
    await server.stop()


@pytest.mark.parametrize(
    ("host", "status"),
    [
        (b"127.0.0.1:9464", b"200"),
        (b"[::1]:9464", b"200"),
        (b"localhost", b"200"),
        (b"LOCALHOST.:1", b"200"),
        (socket.gethostname().encode() + b":9464", b"200"),
        (b"evil.example", b"421"),
        (socket.gethostname().encode() + b".evil.example", b"421"),
        (b"127.0.0.1.evil.example", b"421"),
        (b"localhost\r\nHost: evil.example", b"421"),
        (b"", b"421"),
        (b"\xff\x1b[2J", b"421"),
    ],
)
async def test_only_names_of_this_host_are_answered(host: bytes, status: bytes) -> None:
    async with served() as server:
        answer = await say(server, b"GET /metrics HTTP/1.1\r\nHost: " + host + b"\r\nAccept: */*\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 " + status)


async def test_figures_are_read_once_a_second_however_many_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures_server, "FRESH", HANG)  # or once in whatever this takes
    read = 0

    def samples() -> Samples:
        nonlocal read
        read += 1
        return everything()

    async with served(samples) as server:
        asks = (say(server, b"GET /metrics HTTP/1.1\r\n\r\n") for _ in range(MAX_CONNECTIONS))
        answers = {*await asyncio.gather(*asks)}
        assert len(answers) == 1
    assert read == 1


async def test_a_fault_of_the_figures_is_logged_and_ends_nothing(caplog: pytest.LogCaptureFixture) -> None:
    def samples() -> Samples:
        raise KeyError("a fault")

    async with served(samples) as server:
        for _ in range(3):
            assert await say(server, b"GET /metrics HTTP/1.1\r\n\r\n") in (b"", b"reset")
    assert [record.message for record in caplog.records] == ["figures can't be served: KeyError('a fault')"]
