"""Remedies of errors: an error carries a code, which Python programs and the command line word in their own ways."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from zscout.config.fleet import FLEET_VARIABLE

WAIT_FOR_DEVICE: Final = "wait_for_device"
"""The request may wait for a device that no node has offered, if it says so; a code of the protocol."""
CHECK_FLEET: Final = "check_fleet"
"""A node must be started, or the program uses another fleet file than the nodes."""

IN_PYTHON: Final[Mapping[str, str]] = {
    WAIT_FOR_DEVICE: "to wait anyway, pass wait_for_device=True",
    CHECK_FLEET: (
        f"start zscout-node on a host, or check the fleet file (${FLEET_VARIABLE}): `zscout doctor` finds the cause"
    ),
}


def with_remedy(fault: str, remedy: str, words: Mapping[str, str] = IN_PYTHON) -> str:
    """The fault with the words for its remedy; for an unknown code, or none, the fault alone."""
    if not (hint := words.get(remedy)):
        return fault
    return f"{fault} {hint}" if fault.endswith("?") else f"{fault}; {hint}"
