"""Runs Apprise in a short-lived process: its services take 28 MB, and its log may show URLs, which are secret; the log
of this process is dropped. URLs are passed through standard input."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from typing import Any, Final

PROCESS: Final = (sys.executable, "-P", "-m", "zscout.config.apprise_process")
TIMEOUT: Final = 60.0
"""Seconds. By default Apprise takes at most 4 s to connect and 4 s for each answer; a URL can set others (`cto`,
`rto`)."""


class NoAnswer(Exception):
    """The process gave no result. The message has the reason, without a URL."""


def usable(urls: Sequence[str]) -> list[bool]:
    """For each URL, True if Apprise can use it. Raises NoAnswer."""
    return _ask({"urls": urls})


def send(url: str, title: str, body: str) -> bool:
    """Send a text. Returns True if the service at `url` accepted it. Raises NoAnswer."""
    return _ask({"urls": [url], "title": title, "body": body}) == [True]


def _ask(question: Mapping[str, object]) -> list[bool]:
    text = json.dumps(question).encode()
    try:
        done = subprocess.run(  # noqa: S603 - a program of ours
            PROCESS, input=text, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=TIMEOUT, check=True
        )
        answer: list[bool] = json.loads(done.stdout)
    except subprocess.TimeoutExpired:
        raise NoAnswer(f"Apprise did not end within {TIMEOUT:g} s") from None
    except (OSError, subprocess.CalledProcessError, ValueError) as error:
        raise NoAnswer(f"Apprise failed: {type(error).__name__}") from None
    return answer


def _answer(question: Mapping[str, Any]) -> list[bool]:
    from apprise import Apprise, AppriseAsset

    if "title" not in question:
        return [Apprise.instantiate(url) is not None for url in question["urls"]]
    sender = Apprise(asset=AppriseAsset(async_mode=False))
    sender.add(question["urls"])
    return [bool(sender.notify(body=question["body"], title=question["title"], body_format="text"))]


if __name__ == "__main__":
    os.nice(10)  # not urgent
    with redirect_stdout(sys.stderr):
        answer = _answer(json.load(sys.stdin))
    json.dump(answer, sys.stdout)
