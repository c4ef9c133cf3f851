"""What a program says of itself."""

from __future__ import annotations

import getpass
import os
import sys

import pytest

from zscout.behaviors.client.identity import bounded, checked_comment, this_program
from zscout.messages import MAX_COMMENT, MAX_WHO, Who


@pytest.mark.parametrize(
    ("called", "shown"),
    [
        ("/home/alice/survey.py", "survey.py"),
        ("./survey.py", "survey.py"),
        ("-c", "python"),
        ("", "python"),
        ("/usr/lib/python3/site-packages/lab/__main__.py", "lab"),
        ("./" + "x" * 100 + ".py", "x" * 63 + "…"),
    ],
)
def test_a_program_is_its_user_its_host_and_its_name_without_arguments(
    called: str, shown: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", [called, "--password", "secret"])
    monkeypatch.setattr(getpass, "getuser", lambda: "alice")
    assert this_program("ws1") == Who("alice", "ws1", shown)


def test_a_user_without_a_name_is_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def nameless() -> str:
        raise KeyError("getpwuid(): uid not found")

    monkeypatch.setattr(getpass, "getuser", nameless)
    assert this_program("ws1").user == str(os.getuid())


def test_what_is_sent_is_on_one_line_and_bounded() -> None:
    assert bounded("sh -c 'a\n\tb\x1b[2J'") == "sh -c 'a b [2J'"
    assert (len(bounded("x" * 1000)), checked_comment("  night\nrun ")) == (MAX_WHO, "night run")
    with pytest.raises(ValueError, match=f"the comment has 201 characters; write at most {MAX_COMMENT}"):
        checked_comment("x" * 201)
