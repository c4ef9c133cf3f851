"""A small RTSP server of JPEG over RTP (RFC 2326, 2435), by TCP and UDP, that can be told to fail."""

from __future__ import annotations

import hashlib
import re
import socket
import struct
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

QUALITY: Final = 80
CHUNK: Final = 1_200


def scan_of(picture: NDArray[np.uint8]) -> bytes:
    """A colour picture as JPEG without its headers: RTP has tables of its own for each quality."""
    _, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    data = coded.tobytes()
    start = data.index(b"\xff\xda")
    return data[start + 2 + int.from_bytes(data[start + 2 : start + 4], "big") :]


def interleaved(client: socket.socket, packet: bytes) -> None:
    client.sendall(b"$\0" + struct.pack(">H", len(packet)) + packet)


class RtspServer:
    """Serves `picture(number)`, 20 a second, to whoever asks; a context manager. `status` other than 200 answers each
    DESCRIBE so, to user `a` alone where there is a `password`; `codec` is what the description names. `transports` are
    those that were asked for, `tcp` or `udp`."""

    def __init__(
        self, picture: Callable[[int], NDArray[np.uint8]], *, status: int = 200, codec: str = "JPEG", password: str = ""
    ) -> None:
        self.picture, self.status, self.codec, self.password = picture, status, codec, password
        self.transports: list[str] = []
        self._closing = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"rtsp://127.0.0.1:{self._listener.getsockname()[1]}/live"
        threading.Thread(target=self._accept, daemon=True).start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        send: Callable[[bytes], object] | None = None
        gone = threading.Event()
        with client, suppress(OSError):
            buffer = b""
            while more := client.recv(4096):
                buffer += more
                while b"\r\n\r\n" in buffer:
                    head, _, buffer = buffer.partition(b"\r\n\r\n")
                    if head[:1] == b"$":  # RTCP
                        continue
                    text = head[head.rfind(b"$") + 1 :].decode("latin-1")
                    number = re.search(r"CSeq: *(\d+)", text, re.IGNORECASE)
                    more_heads, body, status = "", "", 200
                    if "DESCRIBE " in text:
                        status = self.status if self._lets_in(text) else 401
                        kind = 26 if self.codec == "JPEG" else 96
                        body = (
                            "v=0\r\no=- 1 1 IN IP4 127.0.0.1\r\ns=x\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\n"
                            f"m=video 0 RTP/AVP {kind}\r\na=rtpmap:{kind} {self.codec}/90000\r\na=control:track1\r\n"
                        )
                        more_heads = "Content-Type: application/sdp\r\n"
                        more_heads += 'WWW-Authenticate: Digest realm="cam", nonce="n1"\r\n' * (status == 401)
                    elif "SETUP " in text:
                        asked = re.search(r"Transport: *(.*)", text, re.IGNORECASE)
                        asks = asked[1].strip() if asked else ""
                        ports = re.search(r"client_port=(\d+)", asks)
                        self.transports.append("udp" if ports else "tcp")
                        if ports:
                            to = ("127.0.0.1", int(ports[1]))
                            out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                            out.bind(("127.0.0.1", 0))
                            asks += f";server_port={out.getsockname()[1]}-{out.getsockname()[1] + 1}"
                            out.connect(to)
                            send = out.send
                        else:
                            send = partial(interleaved, client)
                        more_heads = f"Transport: {asks}\r\nSession: 1\r\n"
                    reply = f"RTSP/1.0 {status} x\r\nCSeq: {number[1] if number else 0}\r\n{more_heads}"
                    client.sendall(f"{reply}Content-Length: {len(body)}\r\n\r\n{body}".encode())
                    if "PLAY " in text and send is not None:
                        threading.Thread(target=self._stream, args=(send, gone), daemon=True).start()
        gone.set()

    def _lets_in(self, text: str) -> bool:
        given = re.search(r'uri="([^"]*)".*response="(\w+)"', text)

        def md5(words: str) -> str:
            return hashlib.md5(words.encode()).hexdigest()  # noqa: S324 - as RFC 2617 has it

        return not self.password or (
            given is not None and given[2] == md5(f"{md5(f'a:cam:{self.password}')}:n1:{md5(f'DESCRIBE:{given[1]}')}")
        )

    def _stream(self, send: Callable[[bytes], object], gone: threading.Event) -> None:
        sequence = number = 0
        with suppress(OSError):
            while not gone.is_set() and not self._closing.wait(0.05):
                number += 1
                picture = self.picture(number)
                height, width = picture.shape[:2]
                scan = scan_of(picture)
                for start in range(0, len(scan), CHUNK):
                    part = scan[start : start + CHUNK]
                    last = start + CHUNK >= len(scan)
                    head = struct.pack(">BBHII", 0x80, 26 | last << 7, sequence & 0xFFFF, number * 4500, 7)
                    jpeg = start.to_bytes(4, "big") + bytes((1, QUALITY, width // 8, height // 8))
                    send(head + jpeg + part)
                    sequence += 1
