"""Radio packets: through noise and back."""

from __future__ import annotations

import binascii

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zscout.drivers.packets import (
    MAX_LASTS,
    MAX_PACKET,
    OVERHEAD,
    SYNC,
    TICKS,
    CameraPacket,
    DrivePacket,
    HaltPacket,
    Packet,
    PacketDecoder,
    StopPacket,
    encode,
)
from zscout.types import MAX_CHANNEL, MAX_ROBOT

ids = st.integers(0, MAX_ROBOT)
numbers = st.integers(0, 255)
wheels = st.integers(-127, 127).map(lambda step: step / 127)
lasts = st.integers(1, 255).map(lambda ticks: ticks / TICKS)
packets: st.SearchStrategy[Packet] = st.one_of(
    st.builds(DrivePacket, ids, numbers, wheels, wheels, lasts),
    st.builds(StopPacket, ids, numbers),
    st.builds(CameraPacket, ids, numbers, st.integers(0, MAX_CHANNEL)),
    st.builds(HaltPacket, ids, numbers),
)
noise = st.binary(max_size=20)


def test_the_bytes_are_those_of_the_description() -> None:
    packet = encode(DrivePacket(33, 7, 1, -1, 0.5))
    assert packet[:-2] == bytes((0x5A, 6, 33, 7, 1, 127, 129, 25))
    assert packet[-2:] == binascii.crc_hqx(packet[1:-2], 0xFFFF).to_bytes(2, "big")
    assert len(packet) == MAX_PACKET
    assert [len(encode(kind(1, 2))) for kind in (StopPacket, HaltPacket)] == [OVERHEAD, OVERHEAD]
    assert encode(CameraPacket(1, 2, 3))[:-2] == bytes((0x5A, 4, 1, 2, 3, 3))
    # The check value of CRC-16/CCITT-FALSE.
    assert binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1


@given(st.lists(packets, max_size=6), st.lists(st.integers(1, 9), max_size=20))
def test_packets_survive_being_cut_anywhere(sent: list[Packet], cuts: list[int]) -> None:
    data, decoder, got = b"".join(map(encode, sent)), PacketDecoder(), []
    for cut in cuts:
        got += decoder.feed(data[:cut])
        data = data[cut:]
    got += decoder.feed(data)
    assert (got, decoder.spoiled) == (sent, 0)


@given(packets, noise, noise)
def test_a_packet_is_found_in_noise(packet: Packet, before: bytes, after: bytes) -> None:
    # Noise may begin what looks like a packet; what follows it long enough ends that.
    before, after = before.replace(bytes((SYNC,)), b""), after.replace(bytes((SYNC,)), b"")
    assert PacketDecoder().feed(before + encode(packet) + after) == [packet]


@given(packets, packets, st.data())
def test_one_spoiled_bit_loses_one_packet_and_no_more(one: Packet, other: Packet, data: st.DataObject) -> None:
    raw = bytearray(encode(one))
    bit = data.draw(st.integers(0, len(raw) * 8 - 1))
    raw[bit // 8] ^= 1 << bit % 8
    # Enough behind it to end whatever the spoiled length promised.
    got = PacketDecoder().feed(bytes(raw) + encode(other) + bytes(MAX_PACKET))
    assert got[-1:] == [other]
    assert one not in got[:-1]


@given(st.lists(noise, max_size=8))
def test_any_bytes_are_taken_and_little_is_kept(pieces: list[bytes]) -> None:
    decoder = PacketDecoder()
    for piece in pieces:
        decoder.feed(piece)
    # Whatever came before, a packet gets through once what may be half a one is over.
    assert decoder.feed(bytes(MAX_PACKET) + encode(HaltPacket(1, 2)))[-1:] == [HaltPacket(1, 2)]


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        *((StopPacket, said) for said in ((-1, 0), (MAX_ROBOT + 1, 0), (1, 256))),
        *((CameraPacket, (1, 0, channel)) for channel in (-1, MAX_CHANNEL + 1)),
        *((DrivePacket, (1, 0, *said)) for said in ((1.01, 0, 1), (0, float("nan"), 1), (0, 0, 0))),
        (DrivePacket, (1, 0, 0, 0, MAX_LASTS + 0.01)),
    ],
)
def test_what_no_packet_can_say_is_refused(kind: type[Packet], arguments: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=r"is not|are not|must be"):
        kind(*arguments)  # type: ignore[arg-type]


def test_a_packet_with_a_true_checksum_and_nonsense_in_it_is_none() -> None:
    def framed(*body: int) -> bytes:
        data = bytes((len(body), *body))
        return bytes((SYNC,)) + data + binascii.crc_hqx(data, 0xFFFF).to_bytes(2, "big")

    for body in ((1, 2, 9), (255, 2, 2), (1, 2, 2, 0), (1, 2, 3), (1, 2, 3, 16), (1, 2, 1, 128, 0, 9)):
        assert PacketDecoder().feed(framed(*body)) == []
    assert PacketDecoder().feed(framed(1, 2, 1, 127, 0, 0)) == []
