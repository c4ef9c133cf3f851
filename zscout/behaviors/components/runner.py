"""The process of one component: `python -m zscout.behaviors.components.runner FD`, started by a node.

FD is its end of a socket pair to the node. When the other end closes, for any reason, this process and all that it
started are killed at once: a component can't outlive its node.
"""

from __future__ import annotations

import asyncio
import ctypes
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import BinaryIO, Final

import uvloop

from zscout.behaviors.components import channel
from zscout.behaviors.components.channel import BadFrame, ComponentJob, ComponentReport, EndReport, Order
from zscout.behaviors.components.component import BAD_PARAMS
from zscout.behaviors.components.lifecycle import ComponentLifecycle
from zscout.behaviors.components.processes import kill_family
from zscout.logs import log_to_stderr
from zscout.mesh.supervision import done_within

_PR_SET_PDEATHSIG: Final = 1
REPORT_LAST: Final = 2.0
"""Seconds for the last report to the node."""


def main() -> None:
    """Exit with 0, with 1 if the component failed, or with BAD_PARAMS if its parameters are invalid."""
    if len(sys.argv) != 2 or not sys.argv[1].isdecimal() or os.getpgrp() != os.getpid():
        sys.exit("zscout: this program is started by a node; `zscout component start` starts a component")
    log_to_stderr("WARNING", "%(levelname)s %(message)s")
    # A stopped process notices no end of file: SIGCONT at its parent's death makes it run again.
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGCONT, 0, 0, 0)
    connection = socket.socket(fileno=int(sys.argv[1]))
    connection.set_inheritable(False)
    orders = connection.makefile("rb")
    try:
        job: ComponentJob | None = channel.receive(orders, ComponentJob)
    except BadFrame as error:
        sys.exit(f"zscout.behaviors.components.runner: {error}")
    if job is None:
        return
    ends = uvloop.run(_live(job, connection, orders))
    if ends.bad_params:
        sys.exit(BAD_PARAMS)
    sys.exit(1 if ends.how == "failed" else 0)


async def _live(job: ComponentJob, connection: socket.socket, orders: BinaryIO) -> EndReport:
    loop = asyncio.get_running_loop()
    # Sent by a thread, so that a stalled node doesn't delay the component; by only one, so that frames stay whole.
    sender = ThreadPoolExecutor(1)

    def send(report: ComponentReport) -> asyncio.Future[None]:
        return loop.run_in_executor(sender, _send, connection, channel.pack(report))

    life = ComponentLifecycle(job, send)
    listening = orders, job.tag, lambda order: loop.call_soon_threadsafe(life.order, order)
    threading.Thread(target=_receive_orders, args=listening, daemon=True).start()
    loop.add_signal_handler(signal.SIGTERM, life.end, EndReport("failed", "ended by SIGTERM"))
    ends = await life.run()
    await done_within(REPORT_LAST, send(ends))
    if ends.how in ("moved", "superseded"):
        # Skip all cleanup: it would give back holds that another incarnation has now.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return ends


def _send(connection: socket.socket, frame: bytes) -> None:
    with suppress(OSError):  # the node is gone; the receiving thread sees that too
        connection.sendall(frame)


def _receive_orders(orders: BinaryIO, tag: str, deliver: Callable[[Order], object]) -> None:
    """Deliver orders until the node closes, then kill all processes of this component, this one last. In a thread,
    since the component may block the event loop."""
    try:
        with suppress(BadFrame, RuntimeError):  # RuntimeError: the loop is closed
            while (order := channel.receive(orders, Order)) is not None:
                deliver(order)
    finally:
        try:
            kill_family(tag, spare=os.getpid())
        finally:
            os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    main()
