"""Headless Chromium with software rendering, driven through its pipe: a page, and pictures of it."""

from __future__ import annotations

import base64
import io
import itertools
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from PIL import Image

FLAGS = (
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)
ANSWER = 240.0
"""Seconds until an answer: a page that is busy gives no picture."""


def find() -> str | None:
    """The program, if it is installed: `apt-get install chromium fonts-dejavu-core`."""
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Chromium:
    """One page. Use as a context manager."""

    def __init__(self, program: str, width: int = 1600, height: int = 900) -> None:
        self._profile = tempfile.TemporaryDirectory(prefix="zscout-chromium-")
        ours_in, theirs_out = os.pipe()
        theirs_in, ours_out = os.pipe()

        def pipes() -> None:
            # It reads orders from descriptor 3, and answers on 4.
            reader, writer = os.dup(theirs_in), os.dup(theirs_out)
            os.dup2(reader, 3)
            os.dup2(writer, 4)

        size = f"--window-size={width},{height}"
        self._process = subprocess.Popen(
            [program, *FLAGS, size, f"--user-data-dir={self._profile.name}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(3, 4),
            preexec_fn=pipes,
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._in, self._out = ours_in, ours_out
        self._read = b""
        self._numbers = itertools.count(1)
        self._session: str | None = None
        targets = self.ask("Target.getTargets")["targetInfos"]
        page = next(target["targetId"] for target in targets if target["type"] == "page")
        self._session = self.ask("Target.attachToTarget", targetId=page, flatten=True)["sessionId"]
        self.ask("Page.enable")

    def ask(self, method: str, **params: Any) -> Any:
        """The result of one order."""
        number = next(self._numbers)
        order = {"id": number, "method": method, "params": params}
        if self._session is not None:
            order["sessionId"] = self._session
        os.write(self._out, json.dumps(order).encode() + b"\0")
        deadline = time.monotonic() + ANSWER
        while True:
            while b"\0" not in self._read:
                if not select.select([self._in], [], [], max(0, deadline - time.monotonic()))[0]:
                    raise TimeoutError(f"chromium did not answer {method} within {ANSWER:g} s")
                got = os.read(self._in, 1 << 20)
                if not got:
                    raise RuntimeError(f"chromium ended with code {self._process.wait()}")
                self._read += got
            message, _, self._read = self._read.partition(b"\0")
            answer = json.loads(message)
            if answer.get("id") == number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]

    def picture(self) -> Image.Image:
        deadline = time.monotonic() + ANSWER
        while True:
            try:
                data = self.ask("Page.captureScreenshot", format="png", optimizeForSpeed=True)["data"]
                break
            except RuntimeError as error:
                # A page that was just navigated to may be in another process, which has not answered yet.
                if "active page" not in str(error) or time.monotonic() >= deadline:
                    raise
                time.sleep(0.1)
        return Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")

    def close(self) -> None:
        os.close(self._in)
        os.close(self._out)
        self._process.kill()
        self._process.wait()
        shutil.rmtree(Path(self._profile.name), ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
