"""Books a robot for a minute from its next free time on, and takes that up: `python book.py`."""

import asyncio
from datetime import UTC, datetime

import zscout

NEEDS: dict[str, dict[str, float]] = {"robot/scout33": {}}


async def survey() -> None:
    async with zscout.Client.connect() as client:
        bookings = zscout.BookingsClient(client)
        told = await bookings.slots(NEEDS, runtime=60, within=86_400)
        start = datetime.fromtimestamp(told.slots[0].start, UTC)
        booking = await bookings.book(NEEDS, start, 60, name="survey")
        print(f"booked from {start:%Y-%m-%d %H:%M:%S} on")
        async with zscout.hold(client, "survey", **bookings.terms(booking)) as held:  # waits for the date
            done = await held.command("robot/scout33", {"name": "echo", "value": "hello"})
            print(done.result)


asyncio.run(survey())
