"""docs/tutorial-device.md, followed to the letter: its files, its commands, and what they are said to print."""

from __future__ import annotations

import asyncio
import re
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest
from hatchling.build import build_wheel

from tests.cli import tools
from tests.docs.test_console_blocks import missing, sessions
from tests.hang import HANG
from tests.live.lab import Lab
from tests.live.test_recorder import ended, recording, the_file, until
from tests.ports import free_port
from tests.services.recorder.paper_run import lanes, rows

PAGE = (Path(__file__).parents[2] / "docs" / "tutorial-device.md").read_text()
MOST_LINES = 50


def blocks(kind: str) -> list[str]:
    found = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return [text for of, text in found if of == kind]


def files() -> dict[str, str]:
    """What the page has its reader write, by name: it stands in the first line."""
    found = {}
    for text in (*blocks("toml"), *blocks("python")):
        name, _, rest = text.partition("\n")
        found[name.removeprefix("# ")] = rest
    return found


def with_certificate(lab: Lab) -> None:
    """What the page says of a node file needs on a secured fleet."""
    file = Path("node.toml")
    file.write_text(file.read_text() + lab.security_of("anvil"))


def commands() -> list[str]:
    return [line for block in blocks("") for line in block.splitlines()]


def test_it_takes_at_most_50_lines_of_python() -> None:
    programs = [text for name, text in files().items() if name.endswith(".py") and name != "test_lamp.py"]
    lines = [line for text in programs for line in text.splitlines() if line]
    assert len(lines) <= MOST_LINES


@pytest.mark.live
@pytest.mark.essential
def test_a_device_of_ones_own_is_held_commanded_and_on_the_timeline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in files().items():
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(text)
    install, touch, node, view = commands()
    assert (install, touch, node) == ("pip install ./lamp", "touch brightness", "zscout-node node.toml")
    ((request, reading),) = sessions("docs/tutorial-device.md", "zscout request")
    ((blink, blinking),) = sessions("docs/tutorial-device.md", "blink.py")
    assert blink == "python blink.py"
    assert view.startswith("zscout view")
    # What pip does, into a folder of its own: this environment belongs to others.
    with monkeypatch.context() as patch:
        patch.chdir("lamp")
        wheel = build_wheel(str(tmp_path))
    ZipFile(wheel).extractall("site")
    lamp = tmp_path / "brightness"
    lamp.touch()
    text = files()["node.toml"].replace("[node]\n", '[node]\nfleet = "fleet.toml"\n')
    Path("node.toml").write_text(f"{text}port = {free_port()}\n")

    def on_the_timeline() -> bool:
        try:
            path = the_file(tmp_path / "runs")
            bright = {value for _, _, values in rows(path, "/device/**", "Scalars:scalars") for value in values}
            return {50.0, 200.0, 0.0} <= bright and "blink" in str(lanes(path, "/devices/**"))
        except (ValueError, RuntimeError, OSError, KeyError):  # as it is being written
            return False

    async def story() -> None:
        async with Lab(tmp_path) as lab:
            with_certificate(lab)
            lab.env |= {"PYTHONPATH": ":".join([str(tmp_path / "site"), *sys.path])}
            lab.nodes["anvil"] = lab.spawn([sys.executable, "-m", "zscout.node", "node.toml"], log="anvil.log")
            client = await lab.client("crew")
            await lab.ready(client, "lamp/desk")
            await recording(lab)
            program, _, rest = request.partition(" --name ")
            assert (program, rest.split()[:2]) == ("zscout request lamp/desk", ["reading", "--"])
            script = rest.partition("sh -c ")[2].strip("'")
            ask = ("request", "lamp/desk", "--name", "reading", "--", "sh", "-c", script)
            held = await tools.zscout_soon_until(lambda done: done.returncode != 3, *ask, env=lab.env)
            assert (held.returncode, held.stdout.splitlines()[-1:]) == (0, ["I hold lamp/desk"]), held.stderr
            assert missing(reading, held.stdout + held.stderr) == []

            blink_py = (sys.executable, "blink.py")
            blinked = await asyncio.to_thread(tools.program_until_in_time, *blink_py, env=lab.env)
            assert blinked.returncode == 0, blinked.stderr
            assert blinked.stdout == blinking
            await lab.held_by(client, "lamp/desk")
            await until(lambda: lamp.read_text() == "0\n")
            async with asyncio.timeout(HANG):
                while not on_the_timeline():  # noqa: ASYNC110 - nothing tells of it
                    await asyncio.sleep(1)
            await ended(lab, "anvil")

    asyncio.run(story())
