"""What a fleet decides about placing: how hard it tries, and whether it moves what pays."""

from __future__ import annotations

from typing import Annotated, Final

from msgspec import Struct

from zscout.config.strict import key, seconds
from zscout.types import SECOND, Ns


class PlacementPolicy(Struct, frozen=True, forbid_unknown_fields=True):
    """The table [placement]. Durations in ns."""

    start_timeout: Annotated[
        Ns, seconds("0.05", "600", "A start without an answer for this long has failed.")
    ] = 15 * SECOND
    restarts: Annotated[int, key("Starts in a row that fail soon until it is given up.", 0, 1_000)] = 5
    back_off: Annotated[
        Ns, seconds("0.05", "3600", "Before the first restart after a failure; doubled each time.")
    ] = SECOND // 2
    longest_back_off: Annotated[Ns, seconds("0.05", "86400", "Up to this.")] = 30 * SECOND
    settled: Annotated[
        Ns, seconds("0.05", "86400", "After running this long its failures are counted anew.")
    ] = 30 * SECOND
    rebalance: Annotated[bool, key("Whether running components are moved when that pays.")] = False
    gain: Annotated[
        float, key("How much better it must run elsewhere, as a share of now, to be moved.", 0.05, 100)
    ] = 0.3
    steady: Annotated[Ns, seconds("0.05", "3600", "For how long that must be so.")] = 10 * SECOND
    rest: Annotated[
        Ns, seconds("0.05", "86400", "A component that was placed or moved stays for this long.")
    ] = 60 * SECOND


DEFAULT_PLACEMENT: Final = PlacementPolicy()
