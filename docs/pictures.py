"""`make pictures`: the pictures of README and docs, made by zscout's own commands on a fleet of their own.

    python docs/pictures.py [NAME...]      timeline, status, why, takeover; all by default

`pictures/made.json` has, for each picture, a digest of the code that it shows; `tests/docs/test_pictures.py` fails when
that code has changed since. The timeline needs a Vulkan driver (`mesa-vulkan-drivers`), and about three minutes.
"""

from __future__ import annotations

import ast
import hashlib
import io
import json
import os
import pty
import re
import select
import subprocess
import sys
import tempfile
import time
import tokenize
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import rerun
from PIL import Image
from rerun.experimental import ViewerClient
from rich.console import Console
from rich.text import Text

from zscout.cli.fleet.viewer_page import silent

ROOT: Final = Path(__file__).parents[1]
FOLDER: Final = ROOT / "docs" / "pictures"
MADE: Final = FOLDER / "made.json"
COLUMNS: Final = 100
LARGEST: Final = 300_000
"""Bytes of one picture."""
SHOWN: Final[Mapping[str, Sequence[str]]] = {
    "timeline.png": ["zscout/services/recorder"],
    "status.svg": ["zscout/cli/fleet/status.py", "zscout/cli/fleet/watching.py", "zscout/terminal.py"],
    "why.svg": ["zscout/cli/requests/why.py", "zscout/cli/requests/waiting.py"],
    "takeover.svg": ["zscout/cli/operator/take.py", "zscout/cli/fleet/status.py", "zscout/cli/fleet/watching.py"],
}
"""By picture: the code that it shows."""
FLEET: Final = """[fleet]
name = "lab"
[mesh]
multicast_address = "224.0.0.224:7448"
interface = "lo"
"""
NODES: Final = {
    "anvil": ("robot/scout33", "robot/scout35", "radio/rf0", "framegrabber/fgrab1", "framegrabber/fgrab2"),
    "bellows": ("arm/left", "arm/right", "scope/s1"),
}
FRAME_S: Final = 3.5
"""Seconds that each frame of the takeover is shown."""
FORMAT: Final = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img">
<style>
.{unique_id}-matrix {{ font-family: ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace;
  font-size: {char_height}px; line-height: {line_height}px; white-space: pre; }}
.{unique_id}-title {{ font-size: 16px; font-family: sans-serif; }}
{styles}
</style>
<defs><clipPath id="{unique_id}-clip-terminal">
<rect x="0" y="0" width="{terminal_width}" height="{terminal_height}" />
</clipPath>{lines}</defs>
{chrome}
<g transform="translate({terminal_x}, {terminal_y})" clip-path="url(#{unique_id}-clip-terminal)">
{backgrounds}<g class="{unique_id}-matrix">{matrix}</g></g>
</svg>
"""
"""Rich's own, but for its fonts, which a page would fetch from another host."""


def digest(paths: Sequence[str]) -> str:
    """Return a digest of the code below `paths`, comments and docstrings left out."""
    total = hashlib.sha256()
    for path in paths:
        place = ROOT / path
        for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            total.update("\n".join(code_of(file.read_text())).encode())
    return total.hexdigest()[:16]


def code_of(text: str) -> Iterator[str]:
    """The lines of Python source that hold code, without comments: the same under each version of Python."""
    lines = text.splitlines()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines[node.lineno - 1 : node.end_lineno] = [""] * (node.end_lineno - node.lineno + 1)  # type: ignore[operator]
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    yield from (line.rstrip() for line in lines if line.strip())


def zscout(*words: str) -> list[str]:
    return [sys.executable, "-m", "zscout.cli.main", *words]


def at_terminal(*words: str, user: str = "ada") -> str:
    """Run a command at a terminal of COLUMNS; return the prompt and all that it printed, escape sequences included."""
    main, other = pty.openpty()
    size = {"TERM": "xterm-256color", "COLUMNS": str(COLUMNS), "LINES": "60"}
    environment = os.environ | size | {"LOGNAME": user, "ZSCOUT_HOST": "desk"}
    with subprocess.Popen(zscout(*words), stdin=other, stdout=other, stderr=other, env=environment) as process:
        os.close(other)
        printed = b""
        while True:
            ready, _, _ = select.select([main], [], [], 60)
            try:
                data = os.read(main, 65_536) if ready else b""
            except OSError:
                data = b""
            if not data:
                break
            printed += data
        process.wait()
    os.close(main)
    return f"\x1b[1;32m$\x1b[0m zscout {' '.join(words)}\n" + printed.decode().replace("\r", "")


@contextmanager
def fleet() -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Two hosts with their devices, and a function that starts a program as a user; all end with the block."""
    with tempfile.TemporaryDirectory() as name:
        folder, processes = Path(name), []
        (folder / "fleet.toml").write_text(FLEET)
        os.environ["ZSCOUT_FLEET"] = str(folder / "fleet.toml")

        def start(*command: str, user: str = "ada") -> subprocess.Popen[bytes]:
            how = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
            environment = os.environ | {"LOGNAME": user, "ZSCOUT_HOST": "desk", "XDG_STATE_HOME": str(folder)}
            process = subprocess.Popen(command, env=environment, **how)  # type: ignore[call-overload]
            processes.append(process)
            return process  # type: ignore[no-any-return]

        try:
            for host, devices in NODES.items():
                tables = [f'[node]\nhost = "{host}"\nfleet = "fleet.toml"\n']
                for device in devices:
                    driver = 'driver = "exclusive"'
                    if device.startswith("radio/"):
                        driver = 'driver = "capacity"\ncapacity = { command_rate = 10.0 }'
                    tables.append(f'[[rc]]\nname = "{device}"\n{driver}\n')
                (folder / f"{host}.toml").write_text("\n".join(tables))
                start(sys.executable, "-m", "zscout.node", str(folder / f"{host}.toml"))
            until(lambda: len(state()["rcs"]) == sum(map(len, NODES.values())))
            yield start
        finally:
            for process in reversed(processes):
                process.terminate()
            for process in processes:
                process.wait()


def state() -> dict[str, list[dict[str, object]]]:
    done = subprocess.run(zscout("status", "--json"), capture_output=True, text=True, check=False)
    found: dict[str, list[dict[str, object]]] = json.loads(done.stdout or '{"rcs": []}')
    return found if found.get("rcs") is not None else {"rcs": []}


def until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + 60
    while not condition():
        if time.monotonic() > end:
            sys.exit("the fleet of the pictures did not come up; is this machine very busy?")
        time.sleep(0.2)


def request(start: Callable[..., subprocess.Popen[bytes]], user: str, name: str, *needs: str) -> None:
    """Start a program that holds `needs`, and wait until the leader knows of it."""
    start(*zscout("request", *needs, "--name", name, "--", "sleep", "600"), user=user)
    until(lambda: name in json.dumps(state()))


def svg(text: str, title: str) -> str:
    console = Console(width=COLUMNS, record=True, file=io.StringIO(), force_terminal=True, color_system="truecolor")
    console.print(Text.from_ansi(text.rstrip()), no_wrap=True, crop=True)
    return console.export_svg(title=title, code_format=FORMAT, unique_id="terminal")


def animated(frames: Sequence[str]) -> str:
    """One SVG that shows each of these in turn, of the size of the largest."""
    size = max((re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', frame) for frame in frames), key=lambda m: float(m[2]))  # type: ignore[index]
    whole, share = FRAME_S * len(frames), 100 / len(frames)
    rules = (
        f"@keyframes frame {{ 0%, {share:.3f}% {{ visibility: visible }}"
        f" {share + 0.001:.3f}%, 100% {{ visibility: hidden }} }}"
        f" .frame {{ visibility: hidden; animation: frame {whole}s step-end infinite }}"
    )
    body = "".join(
        f'<g class="frame" style="animation-delay: {number * FRAME_S}s">'
        f"{frame.replace('terminal-', f'frame{number}-')}</g>"
        for number, frame in enumerate(frames)
    )
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{size[0][9:-1]}"><style>{rules}</style>{body}</svg>'  # type: ignore[index]


def terminals() -> dict[str, str]:
    """The pictures of commands, by file."""
    with fleet() as start:
        request(start, "ada", "survey", "robot/scout33", "radio/rf0:command_rate=5")
        request(start, "bob", "calibrate", "arm/left", "scope/s1")
        request(start, "cleo", "inspect", "robot/scout35", "framegrabber/*", "radio/rf0:command_rate=3")
        request(start, "dan", "night-run", "arm/*", "scope/s1")
        request(start, "eve", "map", "robot/scout33", "framegrabber/*")
        before = at_terminal("status")
        pictures = {
            "status.svg": svg(before, "zscout status"),
            "why.svg": svg(at_terminal("why", "night-run"), "zscout why"),
        }
        with ThreadPoolExecutor(1) as pool:
            words = ("take", "robot/scout33", "--yes", "--name", "takeover", "--", "sleep", "6")
            taking = pool.submit(at_terminal, *words, user="grace")
            until(lambda: any(hold["arc"] == "takeover" for hold in state()["holds"]))
            during = at_terminal("status")
            said = taking.result()
        after = at_terminal("status")
    pictures["takeover.svg"] = animated([svg(text, "zscout") for text in (before, during, said, after)])
    return pictures


def timeline(path: Path) -> None:
    """The recording of `zscout demo`, as the viewer shows it at its end."""

    with tempfile.TemporaryDirectory() as name:
        recording, shot = Path(name) / "demo.rrd", Path(name) / "shot.png"
        subprocess.run(zscout("demo", "robots", "--out", str(recording), "--json"), check=True, capture_output=True)
        viewer = Path(rerun.__file__).parents[1] / "rerun_cli" / "rerun"
        command = [str(viewer), "--headless", "--window-size", "1600x1000", "--bind", "127.0.0.1", "--port", "9899"]
        with subprocess.Popen(
            [*command, str(recording)], env=os.environ | {"HOME": name, "RUST_LOG": "error"} | dict(silent(Path(name)))
        ) as process:
            try:
                client = _ready(process)
                for _ in range(3):  # panes find their sizes over some frames
                    client.save_screenshot(str(shot))
                    time.sleep(2)
            finally:
                process.kill()
        with Image.open(shot) as picture:
            small = picture.convert("RGB").resize((1600, 1000), Image.Resampling.LANCZOS)
            small.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def _ready(process: subprocess.Popen[bytes]) -> ViewerClient:
    end = time.monotonic() + 60
    while time.monotonic() < end and process.poll() is None:
        try:
            client = ViewerClient.connect("rerun+http://127.0.0.1:9899/proxy")
            if len(client.get_state().views) > 3:
                return client
        except (RuntimeError, ConnectionError):
            pass
        time.sleep(0.2)
    sys.exit("the viewer did not open the recording; is a Vulkan driver installed (mesa-vulkan-drivers)?")


def main(names: Sequence[str]) -> None:
    wanted = [f"{name}.png" if name == "timeline" else f"{name}.svg" for name in names] or list(SHOWN)
    made = json.loads(MADE.read_text()) if MADE.exists() else {}
    if any(name.endswith(".svg") for name in wanted):
        for name, text in terminals().items():
            if name in wanted:
                (FOLDER / name).write_text(text)
    if "timeline.png" in wanted:
        timeline(FOLDER / "timeline.png")
    for name in wanted:
        size = (FOLDER / name).stat().st_size
        print(f"docs/pictures/{name}: {size / 1000:.0f} kB")
        if size > LARGEST:
            sys.exit(f"{name} is larger than {LARGEST / 1000:.0f} kB")
        made[name] = digest(SHOWN[name])
    MADE.write_text(json.dumps(made, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
