"""The Rerun viewer without its calls home: its page as zscout serves it, and the settings of its process.

Rerun's page loads a font from the internet, and its program reports usage and asks GitHub for newer versions. Here the
page may connect to the recording alone, and the process has analytics switched off and an HTTPS proxy that leads
nowhere."""

from __future__ import annotations

import asyncio
import http.client
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from zscout.services.plain_http import Page, PlainHttpServer

FILES: Final = frozenset(
    {"/", "/re_viewer.js", "/re_viewer_bg.wasm", "/favicon.ico", "/apple-touch-icon.png", "/sw.js"}
)
NOWHERE: Final = "http://127.0.0.1:9"
"""A proxy that nothing serves: only root may listen there."""
_REMOTE_LINKS: Final = re.compile(rb"<link\b[^>]*\bhttps?://[^>]*>")
_POLICY: Final = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'; connect-src 'self' {stream}"
)


def silent(folder: Path) -> Mapping[str, str]:
    """Return the environment of a viewer without usage reports; write its configuration into `folder`."""
    config = folder / "rerun" / "analytics.json"
    config.parent.mkdir()
    # Rerun replaces a file that lacks a field by its own.
    paths = {"config_file_path": str(config), "data_dir_path": str(folder / "analytics")}
    config.write_text(json.dumps({"analytics_enabled": False, "analytics_id": "", "metadata": {}} | paths))
    return {"XDG_CONFIG_HOME": str(folder), "HTTPS_PROXY": NOWHERE, "https_proxy": NOWHERE}


class ViewerPage(PlainHttpServer):
    """Serves the page of the viewer at `source` with a policy that lets it connect to `stream` alone."""

    where = "the viewer is at /"
    timeout = 120.0

    def __init__(self, source: tuple[str, int], stream: str, bind: str, port: int) -> None:
        super().__init__("the viewer", bind, port)
        self._source = source
        # A policy can't name an IPv6 address: then any host, without TLS.
        policy = _POLICY.format(stream="http:" if "[" in stream else stream)
        self._headers = f"Content-Security-Policy: {policy}\r\nReferrer-Policy: no-referrer\r\n"

    async def page(self, path: str) -> Page | None:
        return await asyncio.to_thread(self._fetch, path) if path in FILES else None

    def _fetch(self, path: str) -> Page:
        connection = http.client.HTTPConnection(*self._source, timeout=self.timeout)
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            text = answer.read()
            status = f"{answer.status} {answer.reason}"
            size = answer.getheader("rerun-final-length", str(len(text)))
            kind = answer.getheader("Content-Type", "text/plain")
        finally:
            connection.close()
        if path == "/":
            text = _REMOTE_LINKS.sub(b"", text)
        return Page(text, kind, status, f"{self._headers}rerun-final-length: {size}\r\n")
