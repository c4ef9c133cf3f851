"""A service that is notified: HTTP on loopback, which keeps what it is sent."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self

from tests.hang import HANG


class Receiver:
    """Its URL has a secret, as most services' have. The first `refuses` messages are refused."""

    SECRET = "s3cr3t-token"  # noqa: S105 - shown to be a secret by the tests

    def __init__(self, refuses: int = 0) -> None:
        self._left, self._news = refuses, threading.Condition()
        self.heard: list[dict[str, Any]] = []
        self.asked = 0
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                self.send_response(200 if receiver._take(self._read()) else 500)
                self.end_headers()

            def _read(self) -> dict[str, Any]:
                body: dict[str, Any] = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                return body

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"json://user:{self.SECRET}@127.0.0.1:{self._server.server_address[1]}/{self.SECRET}"

    def _take(self, message: dict[str, Any]) -> bool:
        with self._news:
            self.asked += 1
            taken = self._left == 0
            self._left -= not taken
            if taken:
                self.heard.append(message)
            self._news.notify_all()
            return taken

    def until(self, condition: Callable[[], bool]) -> None:
        """Waits until this is true, looking at each message; in a thread."""
        with self._news:
            assert self._news.wait_for(condition, HANG), self.heard

    @property
    def titles(self) -> list[str]:
        return [message["title"] for message in self.heard]

    def __enter__(self) -> Self:
        threading.Thread(target=self._server.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._server.shutdown()
        self._server.server_close()
