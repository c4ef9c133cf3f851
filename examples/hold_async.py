"""Holds a robot whenever it can be had, until the work is done: `python hold_async.py`."""

import asyncio

import zscout

PICTURES = 3


async def survey() -> None:
    taken = 0
    async with zscout.Client.connect() as client:
        async for attempt in zscout.holds(client, "survey", {"robot/scout33": {}}):
            async with attempt as held:  # cancelled when it is taken away, entered again when granted again
                while taken < PICTURES:
                    done = await held.command("robot/scout33", {"name": "echo", "value": taken})
                    print(done.result)
                    taken += 1


asyncio.run(survey())
