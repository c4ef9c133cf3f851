"""Health and figures of devices in `zscout status` and `zscout why`, in the RCs' own words."""

from __future__ import annotations

import asyncio
import json
import subprocess
from collections.abc import Callable

import pytest

from tests.cli.cli_fleet import in_lab
from tests.cli.fleet.test_status import section
from tests.cli.tools import COMMAND, zscout_soon_until
from tests.hang import HANG
from tests.live.bench import Bench, Stand, until
from tests.live.lab import Lab
from zscout.cli.fleet.status import figures_text
from zscout.cli.fleet.watching import without_volatile
from zscout.messages import Figures


class Gauge(Bench):
    """A device with figures."""

    def __init__(self) -> None:
        super().__init__()
        self.told: Figures = {"frames_per_second": 9.8, "dropped": 0, "opened": 3}

    def figures(self) -> Figures:
        return dict(self.told)


@pytest.mark.slow
@pytest.mark.live
@in_lab()
async def test_health_and_figures_of_devices(lab: Lab) -> None:
    lab.node("anvil", "robot/a")
    async with Stand(lab) as stand:
        well = Gauge()
        ill = await stand.rc("framegrabber/ill", Gauge())
        await stand.rc("framegrabber/well", well)
        client = await lab.client("program")
        await lab.ready(client, "robot/a", "framegrabber/ill", "framegrabber/well")
        watcher = await asyncio.create_subprocess_exec(
            *COMMAND, "status", "--devices", "--watch", env=lab.env, stdout=subprocess.PIPE
        )
        stdout = watcher.stdout
        assert stdout is not None

        async def line_with(words: str) -> None:
            async with asyncio.timeout(HANG):
                while True:
                    line = (await stdout.readline()).decode()
                    assert line
                    if words in line:
                        return

        await line_with("framegrabber/well  ok      frames_per_second=9.8, opened=3")
        well.told = {"frames_per_second": 4.5}
        ill.fail("the lens is dirty")
        waits = await client.request("look", {"framegrabber/ill": {}, "robot/a": {}}, min_runtime=60)
        await until(lambda: waits.state == "queued" and waits.reason != "")
        await line_with("framegrabber/ill   the lens is dirty  frames_per_second=9.8, opened=3")
        watcher.terminate()
        await watcher.wait()

        ill_row = ["framegrabber/ill", "the lens is dirty", "frames_per_second=9.8, opened=3"]

        def plain(text: str) -> bool:
            rows = {row[0]: row[1:] for row in section(text, "Devices")}
            return (
                rows["framegrabber/ill"] == ["exclusive", "lost", "bench"]
                and rows["framegrabber/well"] == ["exclusive", "free", "bench"]
                # Without being asked for, only what is wrong is shown.
                and section(text, "Health") == [ill_row]
            )

        def every(text: str) -> bool:
            return section(text, "Health") == [ill_row, ["framegrabber/well", "ok", "frames_per_second=4.5"]]

        def why(text: str) -> bool:
            told = {"  framegrabber/ill: the lens is dirty", "  robot/a: no other request holds it"}
            return told <= set(text.splitlines())

        def machine(text: str) -> bool:
            rcs = {rc["rc"]: rc for rc in json.loads(text)["rcs"]}
            ill, robot = rcs["framegrabber/ill"], rcs["robot/a"]
            return (
                ill["health"] == "the lens is dirty"
                and ill["figures"] == {"frames_per_second": 9.8, "dropped": 0, "opened": 3}
                and ill["present"] is False
                and (robot["health"], robot["figures"]) == ("ok", {})
            )

        def shows(is_so: Callable[[str], bool]) -> Callable[[subprocess.CompletedProcess[str]], bool]:
            return lambda done: done.returncode == 0 and is_so(done.stdout)

        # Each RC has half a second to tell a newcomer of its device.
        await asyncio.gather(
            zscout_soon_until(shows(plain), "status", env=lab.env),
            zscout_soon_until(shows(every), "status", "--devices", env=lab.env),
            zscout_soon_until(shows(why), "why", "look", env=lab.env),
            zscout_soon_until(shows(machine), "status", "--json", env=lab.env),
        )


def test_figures_alone_make_no_new_block_of_watch() -> None:
    told = {"rcs": [{"rc": "robot/a", "health": "ok", "figures": {"dropped": 3.0}}]}
    assert without_volatile(told) == {"rcs": [{"rc": "robot/a", "health": "ok"}]}


def test_figures_in_words() -> None:
    assert figures_text({}) == ""
    assert figures_text({"a": 0.0, "b": 3.0, "c": 0.123456, "d": -2.5}) == "b=3, c=0.1235, d=-2.5"
    assert figures_text({"a": 1e300, "b": 1e14}) == "a=1e+300, b=100000000000000"
    assert figures_text({f"f{n}": 1.0 for n in range(15)}).endswith("f11=1, 3 more")
