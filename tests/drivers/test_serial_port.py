"""Ports by all their names, and what becomes of bytes that a network port has accepted and its peer has not."""

from __future__ import annotations

import asyncio
import ctypes
import os
import re
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
import serial
from serial import rfc2217

from studies.chaos.net import NOWHERE, NoNamespaces, check, ip
from tests.drivers.ptys import PtyLine
from tests.drivers.test_serial_line import Ear
from tests.hang import HANG
from zscout.drivers.packets import DrivePacket, HaltPacket, Packet, PacketDecoder, encode
from zscout.drivers.serial_line import SerialLine
from zscout.drivers.serial_port import TIMEOUT, SerialPort, plain
from zscout.mesh import clock
from zscout.types import SECOND

pytestmark = pytest.mark.real_time
CLONE_NEWNET = 0x40000000
ALL_BYTES = bytes(range(256))
_NET = os.getpid() % 16_384 * 4
NEAR, FAR = (f"198.18.{_NET >> 8}.{_NET % 256 + end}" for end in (1, 2))
"""Addresses of this process alone: others run these tests on the same machine."""


class Peer:
    """The other end of a network port: it serves one connection at a time, and reads only while `reads` is set.
    `speaks`: RFC 2217, by pyserial's own server."""

    def __init__(self, *, speaks: bool = False, space: str = "", host: str = "127.0.0.1") -> None:
        self.speaks = speaks
        self.got = b""
        self.accepted = 0
        self.reads = threading.Event()
        self.reads.set()
        self.line: Any = None
        """The port behind it, as an RFC 2217 server has it."""
        self.listener = within(space, lambda: socket.create_server((host, 0)))
        self.listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.port = self.listener.getsockname()[1]
        self._connection: socket.socket | None = None
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        return f"{'rfc2217' if self.speaks else 'socket'}://127.0.0.1:{self.port}"

    @property
    def packets(self) -> list[Packet]:
        return list(PacketDecoder().feed(self.got))

    def hang_up(self) -> None:
        if self._connection is not None:
            with suppress(OSError):
                self._connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self.reads.set()
        with suppress(OSError):
            self.listener.shutdown(socket.SHUT_RDWR)
        self.hang_up()
        self._thread.join(HANG)
        self.listener.close()

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                self._connection, _ = self.listener.accept()
                self.accepted += 1
                with self._connection as connection, suppress(ConnectionError):
                    self._read(connection)

    def _read(self, connection: socket.socket) -> None:
        manager: Any = None
        if self.speaks:
            self.line = serial.serial_for_url("loop://", timeout=0)
            writer: Any = _Writer(connection)
            manager = rfc2217.PortManager(self.line, writer)
        while True:
            self.reads.wait()
            data = connection.recv(4096)
            if not data:
                return
            self.got += b"".join(manager.filter(data)) if manager else data


class _Writer:
    def __init__(self, connection: socket.socket) -> None:
        self.write = connection.sendall


def within(space: str, call: Callable[[], Any]) -> Any:
    """What `call` returns within a network namespace; a socket stays there."""
    if not space:
        return call()
    result: list[Any] = []

    def run() -> None:
        with Path(f"/run/netns/{space}").open() as there:
            assert ctypes.CDLL(None, use_errno=True).setns(there.fileno(), CLONE_NEWNET) == 0
        result.append(call())

    thread = threading.Thread(target=run)
    thread.start()
    thread.join(HANG)
    return result[0]


@contextmanager
def peer(**how: Any) -> Iterator[Peer]:
    made = Peer(**how)
    try:
        yield made
    finally:
        made.close()


def line_to(url: str, ear: Ear, **lines: bool) -> SerialLine:
    port = SerialPort(url, 9600, **lines)
    return SerialLine(port, up=ear.line_up, down=ear.line_down, wrote=ear.line_wrote)


def relative(path: Path) -> str:
    return os.path.relpath(path)


async def met(true: Callable[[], Any]) -> None:
    async with asyncio.timeout(HANG):
        while not true():  # noqa: ASYNC110 - a thread's
            await asyncio.sleep(0.01)


@pytest.mark.parametrize("speaks", [False, True], ids=["socket", "rfc2217"])
async def test_a_network_port_carries_all_bytes_and_its_end_is_noticed(speaks: bool) -> None:
    with peer(speaks=speaks) as there:
        ear = Ear()
        line = line_to(there.url, ear, dtr=False, rts=True) if speaks else line_to(there.url, ear)
        await ear.until(lambda: ear.told == ["up"])
        if speaks:
            assert (there.line.dtr, there.line.rts) == (False, True)
        assert line.write(ALL_BYTES)
        await met(lambda: there.got == ALL_BYTES)
        there.hang_up()
        await ear.until(lambda: len(ear.told) > 1)
        assert "was cut off" in ear.told[1]
        await ear.until(lambda: ear.told[-1] == "up")
        await line.stop()


@pytest.mark.parametrize("speaks", [False, True], ids=["socket", "rfc2217"])
async def test_what_a_peer_does_not_take_is_not_sent_later(speaks: bool) -> None:
    with peer(speaks=speaks) as there:
        ear = Ear()
        line = line_to(there.url, ear)
        await ear.until(lambda: ear.told == ["up"])
        there.reads.clear()
        block, sent = b"x" * 50_000, 0
        while len(ear.told) == 1:
            written = ear.wrote
            if line.write(block):
                sent += 1
                assert sent < 1_000
            await ear.until(lambda written=written: ear.wrote > written or len(ear.told) > 1)  # type: ignore[misc]
        assert "took nothing" in ear.told[1]
        there.reads.set()
        await ear.until(lambda: ear.told[-1] == "up")
        late = encode(HaltPacket(3, 1))
        await ear.until(lambda: line.write(late))
        await met(lambda: there.got.endswith(late))
        # What lay at the peer itself is all that came.
        assert len(there.got) < sent * len(block)
        await line.stop()


async def test_what_is_too_old_when_its_turn_comes_is_not_written() -> None:
    with peer() as there:
        ear = Ear()
        line = line_to(there.url, ear)
        await ear.until(lambda: ear.told == ["up"])
        assert line.write(b"old", until=clock.now() - 1)
        assert line.write(b"new", until=clock.now() + 3600 * SECOND)
        await ear.until(lambda: ear.wrote == 2)
        await met(lambda: there.got)
        assert there.got == b"new"
        await line.stop()


@pytest.mark.parametrize(("taken_at", "is_same"), [("127.0.0.2", True), ("127.0.0.1", False)])
def test_after_a_failure_it_comes_from_the_same_port_where_that_is_free(taken_at: str, is_same: bool) -> None:
    with peer() as there:
        there.reads.clear()  # so that it does not close its end: this one would be kept for a minute then
        port = SerialPort(there.url, 9600)
        first = source_of(port)
        # Another program's, as any of them may have it before the port is opened again.
        with socket.create_server((taken_at, first[1])):
            assert (source_of(port) == first) is is_same


def source_of(port: SerialPort) -> Any:
    """The local end of a connection that is opened, and fails."""
    port.open()
    source = port._socket.getsockname()
    port.close(discard=True)
    return source


@pytest.fixture
def away() -> Iterator[str]:
    """A network namespace at the end of a cable of this machine, at FAR; see `reach`."""
    try:
        check()
    except NoNamespaces as why:
        pytest.skip(str(why))
    space, near = f"zl{os.getpid()}", f"zl{os.getpid()}n"
    ip("netns", "add", space)
    try:
        ip("link", "add", near, "type", "veth", "peer", "name", "far", "address", "02:00:00:00:00:02", "netns", space)
        ip("addr", "add", f"{NEAR}/30", "dev", near)
        ip("link", "set", near, "up")
        ip("-n", space, "addr", "add", f"{FAR}/30", "dev", "far")
        ip("-n", space, "link", "set", "far", "up")
        reach(space)
        yield space
    finally:
        for undo in (("netns", "del", space), ("link", "del", near)):
            subprocess.run(["ip", *undo], capture_output=True, check=False, timeout=HANG)


def reach(space: str, address: str = "02:00:00:00:00:02") -> None:
    """With a wrong hardware address, what is sent there is lost without a word."""
    ip("neigh", "replace", FAR, "lladdr", address, "nud", "permanent", "dev", f"{space}n")


@pytest.mark.live
@pytest.mark.slow
@pytest.mark.parametrize("speaks", [False, True], ids=["socket", "rfc2217"])
async def test_a_peer_that_goes_without_a_word_gets_nothing_old_when_it_is_back(away: str, speaks: bool) -> None:
    with peer(speaks=speaks, space=away, host=FAR) as there:
        ear = Ear()
        line = line_to(there.url.replace("127.0.0.1", FAR), ear)
        await ear.until(lambda: ear.told == ["up"])
        assert line.write(encode(HaltPacket(1, 0)))
        await met(lambda: there.packets)
        await asyncio.to_thread(reach, away, NOWHERE)
        number = 0
        while len(ear.told) == 1:
            number += line.write(encode(DrivePacket(1, number % 256, 1, 1, 5.0)))
            await ear.until(lambda number=number: ear.wrote > number or len(ear.told) > 1)  # type: ignore[misc]
            await asyncio.sleep(0.05)
        assert re.search("took nothing|was cut off", ear.told[1])
        await asyncio.to_thread(reach, away)
        # The peer has noticed nothing, and serves one connection at a time: it lets go of the first.
        await ear.until(lambda: ear.told[-1] == "up")
        assert line.write(encode(HaltPacket(2, 0)))
        await met(lambda: there.packets[-1] == HaltPacket(2, 0))
        assert there.packets == [HaltPacket(1, 0), HaltPacket(2, 0)]
        assert number > 0
        await line.stop()


@pytest.mark.live
@pytest.mark.slow
async def test_a_silent_peer_is_noticed_though_nothing_is_written(away: str) -> None:
    with peer(space=away, host=FAR) as there:
        ear = Ear()
        line = line_to(there.url.replace("127.0.0.1", FAR), ear)
        await ear.until(lambda: ear.told == ["up"])
        await asyncio.to_thread(reach, away, NOWHERE)
        await ear.until(lambda: len(ear.told) > 1)
        assert re.search("took nothing|was cut off", ear.told[1])
        await line.stop()


@pytest.mark.parametrize("form", ["{link}", "alt://{link}", "spy://{link}", "{relative}", "{true}"])
async def test_a_device_is_locked_under_all_its_names(tmp_path: Path, form: str) -> None:
    pty, ear, second = PtyLine(tmp_path / "tty"), Ear(), Ear()
    line = line_to(str(pty.link), ear)
    await ear.until(lambda: ear.told == ["up"])
    (tmp_path / "by-id").symlink_to(pty.link)
    names = {"link": tmp_path / "by-id", "relative": relative(pty.link), "true": pty.link.resolve()}
    other = line_to(form.format(**names), second)
    await second.until(lambda: second.told)
    assert "is used by another device of this node" in second.told[0]
    await line.stop()
    await second.until(lambda: second.told[-1] == "up")
    await other.stop()
    pty.unplug()


@pytest.mark.parametrize("form", ["socket://localhost:{}", "rfc2217://[::1]:{}", "SOCKET://[::ffff:127.0.0.1]:{}"])
async def test_a_network_port_is_locked_under_all_its_names(form: str) -> None:
    with peer() as there:
        ear, second = Ear(), Ear()
        line = line_to(there.url, ear)
        await ear.until(lambda: ear.told == ["up"])
        other = line_to(form.format(there.port), second)
        await second.until(lambda: second.told)
        assert "is used by another device of this node" in second.told[0]
        await line.stop()
        await other.stop()


async def test_a_name_that_leads_to_another_device_is_followed(tmp_path: Path) -> None:
    first, ear = PtyLine(tmp_path / "tty"), Ear()
    line = line_to(str(first.link), ear)
    await ear.until(lambda: ear.told == ["up"])
    second = PtyLine(first.link)
    await ear.until(lambda: len(ear.told) > 1)
    assert "leads to another device" in ear.told[1]
    await ear.until(lambda: ear.told[-1] == "up")
    assert line.write(encode(HaltPacket(3, 1)))
    await second.until(lambda packets: packets == [HaltPacket(3, 1)])
    await line.stop()
    second.unplug()
    asyncio.get_running_loop().remove_reader(first.master)
    os.close(first.master)


async def test_a_loop_opens_as_any_other() -> None:
    ear = Ear()
    line = line_to("loop://", ear)
    await ear.until(lambda: ear.told == ["up"])
    line.write(b"abc")
    await met(lambda: line.received == 3)
    await line.stop()


def failure(url: str, **lines: bool) -> str:
    with pytest.raises(Exception) as raised:  # noqa: PT011 - whatever pyserial lets through
        SerialPort(url, 9600, **lines).open()
    assert isinstance(raised.value, Exception)
    return plain(raised.value)


def test_what_is_wrong_with_a_port_is_said_in_plain_words() -> None:
    with peer() as there:
        for url, words in (
            ("socket://no-such-host.invalid:1", "names an unknown host"),
            ("rfc2217://no-such-host.invalid:1", "names an unknown host"),
            (f"rfc2217://127.0.0.1:{there.port}?timeout=0.1", "does not speak RFC 2217"),
            ("hwgrep://no such device", "is not there; is it plugged in?"),
            ("socket://mast", "fails: it names no host and port; write socket://host:7002, for example"),
        ):
            assert words in failure(url)
    for error, words in (
        (TimeoutError("timed out"), "took nothing for 1 s"),
        (serial.SerialTimeoutException("Write timeout"), "took nothing for 1 s"),
        (serial.SerialException("Could not open port socket://x:1: timed out"), "did not answer within 2 s"),
        (serial.SerialException("Could not open port x: [Errno 113] No route to host"), "can't be reached"),
        (ConnectionResetError(104, "reset"), "was cut off by the other end"),
        (ValueError("strange"), "fails: strange"),
    ):
        assert words in plain(error)
    assert TIMEOUT == 1
