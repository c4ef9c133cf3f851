"""One question to all RCs of a process, and to two processes of one host. Virtual time."""

from __future__ import annotations

import asyncio

from zscout.drivers.confirm_server import CommandQuery, ConfirmServer
from zscout.keyexpr import Sender
from zscout.mesh import Refused
from zscout.messages import Confirm, Confirmed, Done, Problem
from zscout.testing.memory import MemoryNetwork
from zscout.types import Grant, Term

GRANT = Grant(Term(1, "a"), 2)
BUSY = Refused("busy", "ask again")


async def test_each_rc_answers_for_itself_and_nothing_is_said_of_others() -> None:
    network = MemoryNetwork()
    server, other = (ConfirmServer(network.open("f", Sender("bench", name))) for name in ("node", "drivers"))
    client = network.open("f", Sender("desk", "one"))
    asked: list[CommandQuery] = []

    def refuse(_: CommandQuery) -> None:
        raise BUSY

    for rc, take in (("robot/a", asked.append), ("robot/b", asked.append), ("robot/c", refuse)):
        server.serve(rc, take)
    gone = server.serve("robot/gone", asked.append)
    gone.close()
    other.serve("radio/r", lambda query: query.answer(Done(warming=2.0)))
    rcs = ["robot/a", "robot/b", "robot/a", "robot/c", "robot/gone", "robot/foreign", "radio/r"]
    key = client.keys.confirm("bench", client.me)
    asking = asyncio.create_task(client.ask(key, Confirm(GRANT, rcs, ttl=0.5), Confirmed, timeout=1))
    await asyncio.sleep(0.1)
    for query in asked:
        assert (query.message.grant, query.message.do, query.message.ttl) == (GRANT, {"name": "confirm"}, 0.5)
        assert client.keys.sender_of(query.key) == client.me
    first, second = asked
    second.refuse(Problem("settling", "it settles", left=1.0))
    await asyncio.sleep(0.1)
    assert not asking.done()
    first.answer(Done(settle=5.0))
    first.answer(Done(settle=9.0))
    replies = [reply.message for reply in await asking]
    assert Confirmed({"radio/r": Done(warming=2.0)}) in replies
    settles = {"robot/b": Problem("settling", "it settles", left=1.0), "robot/c": BUSY.problem}
    assert Confirmed({"robot/a": Done(settle=5.0)}, settles) in replies
