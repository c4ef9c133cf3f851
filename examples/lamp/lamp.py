import asyncio
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

from zscout.drivers.driver import Driver, Parameter, Refused


class Lamp(Driver):
    @dataclass(frozen=True)
    class Options:  # keys of the node file; other keys are refused before the node starts
        path: str
        most: int = 255

    def parameters(self):  # what a request may ask for; other parameters, or more, are refused at once
        return [Parameter("level", "steps", bound=Decimal(self.options.most))]

    async def open(self, rc):  # an unplugged device is no error: it counts as lost until it is back
        self.rc, self.path, self.level = rc, Path(self.options.path), 0
        rc.supervisor.spawn(self.look())
        await self.safe()

    async def look(self):
        while True:
            if not self.path.exists():
                self.rc.fail(f"{self.path} is not there")
            elif self.rc.health != "ok":
                self.rc.recover()
            await asyncio.sleep(1)

    async def command(self, holder, do):  # called only under a hold in force
        match do:
            case {"name": "set", "level": int(level)} if 0 <= level <= self.options.most:
                self.set(level)
                return {"level": level}
        raise Refused("bad_command", f'write {{"name": "set", "level": 0 to {self.options.most}}}')

    async def safe(self):  # the last hold has ended
        if self.path.exists():
            self.set(0)

    def figures(self):  # for `zscout status`, and as curves on the timeline
        return {"level": self.level}

    def set(self, level):
        self.path.write_text(f"{level}\n")
        self.level = level
