"""Apprise, in a process of its own that ends with its work: it loads all the services that it knows, which takes 28 MB,
and what it logs may show a URL, which nobody hears there. URLs go in by its standard input."""

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
"""Seconds from its start to its end. Apprise takes 4 s to connect and 4 s for each answer at most, where the URL does
not say otherwise (`cto`, `rto`)."""


class NoAnswer(Exception):
    """The process told nothing; the message says why, without a URL."""


def usable(urls: Sequence[str]) -> list[bool]:
    """Which of these URLs Apprise can use. Raises NoAnswer."""
    return _asked({"urls": urls})


def sent(url: str, title: str, body: str) -> bool:
    """Whether the service behind it has taken this text. Raises NoAnswer."""
    return _asked({"urls": [url], "title": title, "body": body}) == [True]


def _asked(question: Mapping[str, object]) -> list[bool]:
    text = json.dumps(question).encode()
    try:
        done = subprocess.run(  # noqa: S603 - a program of ours
            PROCESS, input=text, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=TIMEOUT, check=True
        )
        answer: list[bool] = json.loads(done.stdout)
    except subprocess.TimeoutExpired:
        raise NoAnswer(f"Apprise has not ended within {TIMEOUT:g} s") from None
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
    os.nice(10)  # there is no hurry
    with redirect_stdout(sys.stderr):
        answer = _answer(json.load(sys.stdin))
    json.dump(answer, sys.stdout)
