"""What the tests of configuration files share: the rules that bad lines end in, and files to write."""

from __future__ import annotations

import re
from pathlib import Path

NAME_RULE = 'write 1 to 64 letters A to Z, digits, "_", "." or "-"'
RC_RULE = 'write kind/name, as in "robot/scout33", each of 1 to 64 letters A to Z, digits, "_", "." or "-"'
ENDPOINT_RULE = 'write protocol/host:port, as in "tcp/127.0.0.1:7447"; protocols: tcp, tls, udp, quic, ws'
MULTICAST_RULE = 'write ip:port, as in "224.0.0.224:7446"'


def write(name: str, text: str) -> Path:
    path = Path(name)
    path.write_text(text)
    return path


def short(text: str) -> str:
    return re.sub(r"\s+", " ", text)[:50]
