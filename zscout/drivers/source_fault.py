"""Finds out why a video URL can't be opened, since OpenCV gives no reason. Blocking. Reasons contain no part of the URL
that may be secret."""

from __future__ import annotations

import errno
import http.client
import re
import socket
import ssl
import urllib.request
from base64 import b64encode
from collections.abc import Mapping
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, Final
from urllib.error import HTTPError, URLError
from urllib.parse import SplitResult, unquote, urlsplit, urlunsplit

AGENT: Final = "zscout"
DECODABLE: Final = re.compile(
    r"multipart/|image/|video/|application/(octet-stream|vnd\.apple\.mpegurl|x-mpegurl)", re.IGNORECASE
)
UNDECODABLE: Final[Mapping[str, str]] = {"av01": "AV1", "av1": "AV1", "vvc1": "H.266", "h266": "H.266", "evc1": "EVC"}
"""Codecs that OpenCV's wheel names but can't decode."""
REMEDY: Final = "set the camera to H.264, H.265 or MJPEG"
MALFORMED: Final = "the address is malformed"
MAX_REPLY: Final = 65_536

_STATUS: Final = {
    400: "it rejects the address as malformed",
    403: "access is forbidden, perhaps only for this user",
    404: "it has no such page; is the path right?",
    405: "it has no pictures at this path",
    407: "a proxy requires a user and password",
    408: "it waited too long for a request",
    410: "the page no longer exists",
    429: "too many requests",
    453: "it has no bandwidth left for another viewer",
    454: "unknown session",
    461: 'it does not support this transport; set transport = "udp", or "tcp"',
    500: "internal error of the server",
    502: "its gateway failed",
    503: "it is busy, or has no capacity left for another viewer",
    504: "its gateway got no answer",
}
_OS: Final = {
    errno.ECONNREFUSED: "nothing listens there; does its server run, and is the port right?",
    errno.EHOSTUNREACH: "its host is unreachable; is it on, and on this network?",
    errno.ENETUNREACH: "its network is unreachable",
    errno.ECONNRESET: "it hung up without an answer",
    errno.EPIPE: "it hung up without an answer",
}


def why_closed(url: str, timeout: float) -> str | None:
    """The fault as text, found by a request with at most `timeout` seconds for each step; None if none is found."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        return MALFORMED
    if not parts.hostname:
        return MALFORMED
    try:
        if parts.scheme.lower() in ("http", "https"):
            return _http(parts, timeout)
        if parts.scheme.lower() in ("rtsp", "rtsps", "rtspt", "rtspu"):
            return _rtsp(parts, timeout)
        if parts.scheme.lower() in ("tcp", "rtmp") and parts.hostname and port:
            socket.create_connection((parts.hostname, port), timeout).close()
    except HTTPError as error:
        return _of_status(error.code, parts)
    except URLError as error:
        return _of_error(error.reason if isinstance(error.reason, Exception) else error, timeout)
    except (OSError, http.client.HTTPException, ValueError) as error:
        return _of_error(error, timeout)
    return None


def _http(parts: SplitResult, timeout: float) -> str | None:
    bare = urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, parts.query, ""))
    signs_in: list[urllib.request.BaseHandler] = []
    if parts.username is not None:
        passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
        passwords.add_password(None, bare, unquote(parts.username), unquote(parts.password or ""))
        signs_in = [urllib.request.HTTPBasicAuthHandler(passwords), urllib.request.HTTPDigestAuthHandler(passwords)]
    # FFmpeg does not check certificates, so neither does this request.
    opener = urllib.request.build_opener(
        urllib.request.ProxyHandler({}),
        urllib.request.HTTPSHandler(context=ssl._create_unverified_context()),  # noqa: S323
        *signs_in,
    )
    request = urllib.request.Request(bare, headers={"User-Agent": AGENT})  # noqa: S310 - http or https
    try:
        opened = opener.open(request, timeout=timeout)
    except ValueError:  # raised by the handlers for an unknown authentication scheme
        return _of_status(401, parts)
    with opened as reply:
        sent = reply.headers.get("Content-Type", "")
        if reply.status == 204:
            return "its answer is empty"
    kind = sent.partition(";")[0].strip()[:60]
    if kind.lower() in ("text/html", "application/xhtml+xml"):
        return "it sends an HTML page, not pictures; is it a login page?"
    if kind and not DECODABLE.match(kind):
        return f"it sends {kind}, not pictures"
    return None


def _rtsp(parts: SplitResult, timeout: float) -> str | None:
    host, port = parts.hostname or "", parts.port or 554
    bare = urlunsplit(("rtsp", parts.netloc.rpartition("@")[2], parts.path, parts.query, ""))
    ask = f"DESCRIBE {bare} RTSP/1.0\r\nCSeq: 1\r\nAccept: application/sdp\r\nUser-Agent: {AGENT}\r\n"
    reply = _reply(host, port, ask, timeout)
    first = re.match(rb"RTSP/\d\.\d (\d{3})", reply)
    if first is not None and first[1] == b"401" and parts.username is not None:
        reply = _reply(host, port, ask + _signed(reply, bare, parts), timeout)
        first = re.match(rb"RTSP/\d\.\d (\d{3})", reply)
    if first is None:
        return "it hung up without an answer" if not reply else "it does not speak RTSP"
    if (status := int(first[1])) >= 300:
        return _of_status(status, parts)
    body = reply.partition(b"\r\n\r\n")[2].decode(errors="replace")
    if "m=video" not in body:
        return "it sends no video"
    for codec in re.findall(r"^a=rtpmap:\d+ ([\w.-]+)/", body[body.index("m=video") :], re.MULTILINE):
        if codec.lower() in UNDECODABLE:
            return f"it sends {UNDECODABLE[codec.lower()]}, which can't be decoded here; {REMEDY}"
    return None


def _reply(host: str, port: int, ask: str, timeout: float) -> bytes:
    with socket.create_connection((host, port), timeout) as connection:
        connection.sendall(f"{ask}\r\n".encode())
        reply = b""
        while len(reply) < MAX_REPLY and not _whole(reply) and (more := connection.recv(4096)):
            reply += more
    return reply


def _signed(reply: bytes, url: str, parts: SplitResult) -> str:
    user, password = unquote(parts.username or ""), unquote(parts.password or "")
    wanted = re.findall(rb"^WWW-Authenticate: *(\w+) +(.*?)\r?$", reply, re.IGNORECASE | re.MULTILINE)
    for way, challenge in wanted:
        if way.lower() == b"digest":
            passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
            passwords.add_password(None, url, user, password)
            asked: Any = SimpleNamespace(full_url=url, selector=url, data=None, get_method=lambda: "DESCRIBE")
            given = urllib.request.parse_keqv_list(urllib.request.parse_http_list(challenge.decode("latin-1")))
            with suppress(ValueError, URLError):
                signed = urllib.request.AbstractDigestAuthHandler(passwords).get_authorization(asked, given)
                return f"Authorization: Digest {signed}\r\n"
    basic = any(way.lower() == b"basic" for way, _ in wanted)
    return f"Authorization: Basic {b64encode(f'{user}:{password}'.encode()).decode()}\r\n" if basic else ""


def _whole(reply: bytes) -> bool:
    head, end, body = reply.partition(b"\r\n\r\n")
    length = re.search(rb"^content-length: *(\d+)", head, re.IGNORECASE | re.MULTILINE)
    return bool(end) and len(body) >= (int(length[1]) if length else 0)


def _of_status(status: int, parts: SplitResult) -> str:
    if status == 401:
        words = "it refuses this user and password" if parts.username is not None else "it requires a user and password"
    elif 300 <= status < 400:
        words = "it redirects endlessly, or without a target"
    else:
        words = _STATUS.get(status, "it failed" if status >= 500 else "it refuses this")
    return f"{words} ({status})"


def _of_error(error: Exception, timeout: float) -> str:
    if isinstance(error, socket.gaierror):
        again = error.errno == socket.EAI_AGAIN
        return "unknown host" + (", or name lookup does not work at present" if again else "")
    if isinstance(error, TimeoutError):
        return f"it did not answer within {timeout:g} s"
    if isinstance(error, ssl.SSLError):
        return "it does not speak TLS, or no supported version; is it http:// rather than https://?"
    if isinstance(error, http.client.RemoteDisconnected):
        return "it hung up without an answer"
    if isinstance(error, http.client.HTTPException):
        return "it does not speak HTTP"
    if isinstance(error, OSError) and error.errno is not None:
        return _OS.get(error.errno, error.strerror or "it can't be reached")
    return MALFORMED if isinstance(error, ValueError) else "it can't be reached"
