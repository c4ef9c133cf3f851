"""`zscout request --dry-run`: what would come of a request, without making it."""

from __future__ import annotations

from collections.abc import Iterator

from zscout.cli.common import NobodyThere, connected
from zscout.cli.requests.options import HoldOptions
from zscout.messages import Foresight
from zscout.terminal import clean, print_json, print_line, span


async def foresee(wanted: HoldOptions) -> int:
    """Prints when it would start and whom it would preempt at once. Exit code 1: it would not start.

    Raises RequestRefused, NobodyThere."""
    async with connected("request") as client:
        foretold = await client.foresee(
            wanted.name,
            wanted.needs,
            priority=wanted.priority,
            min_runtime=wanted.min_runtime,
            keep=wanted.keep,
        )
        if foretold is None:
            raise NobodyThere(f"the RCM of fleet {client.fleet.name} did not answer; try again")
    if wanted.as_json:
        print_json(
            {
                "arc": wanted.name,
                "starts_in": foretold.starts_in,
                "preempts": foretold.preempts,
                "reason": foretold.reason,
            }
        )
    else:
        for line in _words(foretold):
            print_line(clean(line))
    return 0 if foretold.starts_in is not None else 1


def _words(foretold: Foresight) -> Iterator[str]:
    if foretold.starts_in is None:
        yield f"{foretold.arc} would wait, and no start can be foretold: {foretold.reason}"
    elif foretold.reason:
        yield f"{foretold.arc} would start in {span(foretold.starts_in)}, if nothing else comes"
        yield f"until then: {foretold.reason}"
    else:
        yield f"{foretold.arc} would start at once"
    if foretold.preempts:
        yield f"it would preempt {', '.join(foretold.preempts)}"
