"""The Zenoh settings behind a `[mesh]` table, with every trap taken into account."""

from __future__ import annotations

import json
from typing import Any

import zenoh

from zscout.config.fleet import MeshConfig

BLOCK_US = 100_000
"""The longest that a publication waits for a peer that does not read, before that peer is given up."""
CONTROL_BATCHES = 8
"""Control messages under way to one peer: with fewer, an answer waits until the message before it is out."""
SCOUTING_DELAY_MS = 200


def zenoh_config(config: MeshConfig) -> zenoh.Config:
    """The Zenoh settings behind a `[mesh]` table."""
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": config.multicast,
        "scouting/multicast/address": config.multicast_address,
        "scouting/multicast/interface": config.interface,
        "scouting/delay": SCOUTING_DELAY_MS,
        "transport/link/tx/lease": round(config.lease * 1000),
        "transport/link/tx/queue/congestion_control/block/wait_before_close": BLOCK_US,
        "transport/link/tx/queue/size": {"interactive_high": CONTROL_BATCHES},
        "transport/shared_memory/enabled": False,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 1.5},
    }
    if config.listen:
        settings["listen/endpoints"] = list(config.listen)
    if config.connect:
        settings["connect/endpoints"] = list(config.connect)
    result = zenoh.Config()
    for key, value in settings.items():
        result.insert_json5(key, json.dumps(value))
    return result
