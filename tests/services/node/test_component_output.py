"""What is kept of a component's output, and how fast it is read."""

from __future__ import annotations

import asyncio
import os

import pytest

from zscout.messages import MAX_TAIL
from zscout.services.node.component_output import BURST, RATE, OutputReader, OutputRing

pytestmark = pytest.mark.real_time


def test_the_last_bytes_are_kept_with_their_places() -> None:
    ring = OutputRing(8)
    assert ring.read(0) == (0, 0, "")
    ring.write(b"abc")
    assert ring.read(0) == (0, 3, "abc")
    assert ring.read(2) == (2, 3, "c")
    assert ring.read(99) == (3, 3, "")
    ring.write(b"defghi")
    assert (ring.start, ring.end) == (1, 9)
    assert ring.read(0) == (1, 9, "bcdefghi")
    ring.write(b"0123456789")
    assert ring.read(0) == (11, 19, "23456789")


@pytest.mark.parametrize("text", ["ä", "€", "\U0001f916"])
def test_a_character_is_told_once_it_is_whole(text: str) -> None:
    ring, raw = OutputRing(), f"x{text}".encode()
    for end in range(2, len(raw)):
        ring = OutputRing()
        ring.write(raw[:end])
        assert ring.read(0) == (0, 1, "x")
        ring.write(raw[end:])
        assert ring.read(1) == (1, len(raw), text)
    ring = OutputRing()
    ring.write(raw[:-1])
    ring.over = True
    first, end, told = ring.read(0)
    assert (first, end, told[0]) == (0, len(raw) - 1, "x")
    assert set(told[1:]) == {"\ufffd"}


@pytest.mark.parametrize("raw", [b"a\xff", b"a\xff\xff\xff\xff", b"a\x80\x80\x80\x80", b"\xf8\x80\x80\x80\x80z"])
def test_what_is_no_utf8_is_replaced_and_holds_nothing_up(raw: bytes) -> None:
    ring = OutputRing()
    ring.write(raw)
    ring.over = True
    first, end, text = ring.read(0)
    assert (first, end) == (0, len(raw))
    assert "\ufffd" in text


def test_a_tail_has_so_many_characters_of_any_width() -> None:
    ring = OutputRing()
    ring.write(("€" * 3 * MAX_TAIL).encode())
    ring.over = True
    assert ring.tail() == "€" * MAX_TAIL


async def test_a_flood_is_read_no_faster_than_allowed_and_what_is_left_at_the_end_is_read() -> None:
    loop = asyncio.get_running_loop()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    ring = OutputRing()
    reader = OutputReader(reading, ring)
    began, written = loop.time(), 0
    while loop.time() - began < 0.5 or ring.end < BURST:
        try:
            written += os.write(writing, b"x" * 65_536)
        except BlockingIOError:
            await asyncio.sleep(0.001)
    assert BURST <= ring.end <= BURST + RATE * (loop.time() - began) + 65_536
    reader.finish()
    assert ring.end == written
    assert ring.over
    os.close(writing)
