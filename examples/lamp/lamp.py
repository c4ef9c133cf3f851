import asyncio
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

from zscout.drivers.driver import Driver, Parameter, Refused


class Lamp(Driver):
    @dataclass(frozen=True)
    class Options:  # what the node file may say of it; all else is refused before the node begins
        path: str
        most: int = 255

    def parameters(self):  # what a request may book of it; another one, or more, is refused at once
        return [Parameter("level", "steps", bound=Decimal(self.options.most))]

    async def open(self, rc):  # a device that is not there is no error: it counts as lost until it is
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

    async def command(self, holder, do):  # only ever under a hold in force
        match do:
            case {"name": "set", "level": int(level)} if 0 <= level <= self.options.most:
                self.set(level)
                return {"level": level}
        raise Refused("bad_command", f'write {{"name": "set", "level": 0 to {self.options.most}}}')

    async def safe(self):  # nobody holds it any more
        if self.path.exists():
            self.set(0)

    def figures(self):  # for `zscout status`, and as curves on the timeline
        return {"level": self.level}

    def set(self, level):
        self.path.write_text(f"{level}\n")
        self.level = level
