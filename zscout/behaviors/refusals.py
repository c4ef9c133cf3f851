"""What a program is told when it is not to have its way."""

from __future__ import annotations

from zscout.messages import Problem


class RequestRefused(Exception):
    """The RCM will not take this request as it is; the message says why, `code` is the protocol's."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.message)
        self.code = problem.code


class CommandRefused(Exception):
    """An RC did not obey; `code` is the protocol's, or `unknown` where no answer came."""

    def __init__(self, rc: str, problem: Problem) -> None:
        super().__init__(f"{rc}: {problem.message}")
        self.code = problem.code
