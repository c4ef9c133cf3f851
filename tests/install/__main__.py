"""`python -m tests.install`: the wheel of this tree in clean environments, with pip, pipx and uv, and the light
installation of it. Each has to run a node and a request; prints how long it took and what it takes on disk. `host`: by
`deploy/install-host`, on a machine with a systemd of its own.

Packages come from the index that pip is configured with. Where pipx and uv can't be had they are skipped."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from tests.cli.tools import program_until_in_time
from tests.deploy.machine import Machine, missing
from tests.docs.test_tutorial_device import files
from tests.hang import HANG
from tests.ports import free_port
from zscout.config.certificate_authority import CertificateAuthority
from zscout.keyexpr import new_instance

ROOT: Final = Path(__file__).parents[2]
REQUIREMENTS: Final = ROOT / "requirements"
LIGHT_MB: Final = 150
LEFT_OUT: Final = ("numpy", "cv2", "rerun")
INSTALL: Final = 1_200.0
"""Seconds for one installation."""
CLEAN: Final = {
    name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV", "ZSCOUT"))
}


class CheckFailed(Exception):
    """An installation does not do what it should."""


def run(
    *command: object, cwd: Path, env: Mapping[str, str] = CLEAN, timeout: float = HANG, check: bool = True
) -> subprocess.CompletedProcess[str]:
    """Runs a program to its end. Raises CheckFailed, with its output, where it fails."""
    words = [str(word) for word in command]
    try:
        done = subprocess.run(words, cwd=cwd, env=env, capture_output=True, text=True, timeout=timeout, check=False)
    except subprocess.TimeoutExpired:
        raise CheckFailed(f"{' '.join(words)} did not end within {timeout:g} s") from None
    if check and done.returncode:
        raise CheckFailed(f"{' '.join(words)} ended with {done.returncode}:\n{done.stdout}{done.stderr}")
    return done


def expect(found: bool, what: str) -> None:
    if not found:
        raise CheckFailed(what)


def megabytes(folder: Path) -> float:
    """What it takes on disk, in 10^6 bytes."""
    return sum(path.lstat().st_blocks for path in folder.rglob("*")) * 512 / 1e6


def make_environment(folder: Path) -> None:
    run(sys.executable, "-m", "venv", folder, cwd=folder.parent, timeout=INSTALL)


# Ways to install; each returns the folder that has the programs


def by_pip(wheel: Path, folder: Path) -> Path:
    make_environment(folder)
    run(folder / "bin/python", "-m", "pip", "install", "--quiet", wheel, cwd=folder, timeout=INSTALL)
    return folder / "bin"


def by_pipx(tools: Path, wheel: Path, folder: Path) -> Path:
    homes = {"PIPX_HOME": str(folder), "PIPX_BIN_DIR": str(folder / "bin"), "PIPX_MAN_DIR": str(folder / "man")}
    folder.mkdir()
    run(tools / "pipx", "install", "--python", sys.executable, wheel, cwd=folder, env=CLEAN | homes, timeout=INSTALL)
    return folder / "bin"


def by_uv(tools: Path, wheel: Path, folder: Path) -> Path:
    homes = {"UV_TOOL_DIR": str(folder), "UV_TOOL_BIN_DIR": str(folder / "bin"), "UV_LINK_MODE": "copy"}
    # uv does not read what pip is told, by whichever of its files or by the environment, which comes first.
    for line in run(sys.executable, "-m", "pip", "config", "list", cwd=folder.parent).stdout.splitlines():
        name, _, value = line.partition("=")
        if name.endswith(".index-url") and "UV_DEFAULT_INDEX" not in CLEAN:
            homes.setdefault("UV_DEFAULT_INDEX", value.strip("'"))
    folder.mkdir()
    command = (tools / "uv", "tool", "install", "--quiet", "--python", sys.executable, wheel)
    run(*command, cwd=folder, env=CLEAN | homes, timeout=INSTALL)
    return folder / "bin"


def light(wheel: Path, folder: Path) -> Path:
    make_environment(folder)
    pip = (folder / "bin/python", "-m", "pip", "install", "--quiet")
    run(*pip, "--require-hashes", "-r", REQUIREMENTS / "light.txt", cwd=folder, timeout=INSTALL)
    run(*pip, "--no-deps", wheel, cwd=folder, timeout=INSTALL)
    return folder / "bin"


# What each has to do


class Fleet:
    """A fleet of one node, apart from every other on this machine."""

    def __init__(self, programs: Path, folder: Path) -> None:
        self.programs, self.folder = programs, folder
        folder.mkdir()
        # Leases that outlast a process that stands still for a second or two, and votes that come within that.
        (folder / "fleet.toml").write_text(
            f'[fleet]\nname = "install-{new_instance()}"\n'
            f'[mesh]\nmulticast_address = "224.0.0.224:{free_port()}"\ninterface = "lo"\nlease = 10.0\n'
            "[timing]\nhold_lease = 30.0\nrebuild = 2.0\nvote_timeout = 2.0\n"
        )

    def file(self, rcs: str) -> Path:
        path = self.folder / "node.toml"
        path.write_text(f'[node]\nhost = "small"\nfleet = "fleet.toml"\n{rcs}')
        return path

    def zscout(self, *args: object, check: bool = True) -> subprocess.CompletedProcess[str]:
        env = CLEAN | {"ZSCOUT_FLEET": str(self.folder / "fleet.toml")}
        return run(self.programs / "zscout", *args, cwd=self.folder, env=env, check=check)

    def refused(self, rcs: str) -> str:
        """What a node says that does not begin."""
        done = run(self.programs / "zscout-node", self.file(rcs), cwd=self.folder, check=False)
        expect(done.returncode == 2, f"zscout-node ended with {done.returncode}: {done.stderr}")
        return done.stderr

    @contextmanager
    def node(self, rcs: str) -> Iterator[None]:
        """A node in peace: it ends with 0."""
        log = self.folder / "node.log"
        with log.open("wb") as out:
            command = [str(self.programs / "zscout-node"), str(self.file(rcs))]
            node = subprocess.Popen(command, cwd=self.folder, env=CLEAN, stdout=out, stderr=out)
        try:
            yield
            node.terminate()
            expect(node.wait(HANG) == 0, f"the node ended with {node.returncode}:\n{log.read_text()}")
        finally:
            node.kill()
            node.wait()

    def until(self, *args: str, said: str = "") -> subprocess.CompletedProcess[str]:
        """Runs a command until the node is there and serves it, and it says that."""
        deadline = time.monotonic() + HANG
        while (done := self.zscout(*args, check=False)).returncode or said not in done.stdout:
            log = (self.folder / "node.log").read_text()
            expect(time.monotonic() < deadline, f"{args}: {done.returncode} {done.stdout}{done.stderr}\n{log}")
        return done

    def request(self, *args: str) -> subprocess.CompletedProcess[str]:
        return self.until("request", *args)


@contextmanager
def serial_line() -> Iterator[str]:
    """A port whose other end takes what is written."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)

    def take() -> None:
        while True:
            try:
                os.read(ours, 4_096)
            except OSError:
                return

    threading.Thread(target=take, daemon=True).start()
    yield os.ttyname(theirs)
    os.close(theirs)


def check_whole(programs: Path, folder: Path) -> None:
    fleet = Fleet(programs, folder)
    expect("zscout" in fleet.zscout("--version").stdout, "zscout --version says nothing")
    # The environment that the program is of, where that is a link.
    python = (programs / "zscout").resolve().parent / "python"
    run(python, "-c", f"import {', '.join(LEFT_OUT)}", cwd=folder)
    with fleet.node('[[rc]]\nname = "robot/a"\ndriver = "exclusive"\n'):
        fleet.request("robot/a", "--", "true")
    fleet.zscout("replay", ROOT / "examples/workload.toml", "--json")


def check_light(programs: Path, folder: Path) -> None:
    fleet = Fleet(programs, folder)
    # A driver as the tutorial has it.
    for name, text in files().items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    run(programs / "python", "-m", "pip", "install", "--quiet", "./lamp", cwd=folder, timeout=INSTALL)
    # The tutorial's own test, by what the wheel brings for authors.
    test = "from pathlib import Path; from test_lamp import test_the_lamp_is_set_and_goes_out as test; test(Path())"
    run(programs / "python", "-c", test, cwd=folder)
    (folder / "brightness").touch()
    for module in LEFT_OUT:
        found = run(programs / "python", "-c", f"import {module}", cwd=folder, check=False)
        expect(found.returncode != 0, f"{module} is there")
    tell = '["sh", "-c", "echo $ZSCOUT_DO >> told"]'
    with (
        serial_line() as port,
        fleet.node(
            f'[[rc]]\nname = "psu/bench"\ndriver = "command"\nstart = {tell}\nstop = {tell}\nsafe = {tell}\n'
            f'[[rc]]\nname = "radio/rf0"\ndriver = "radio"\nport = "{port}"\n'
            '[[rc]]\nname = "link/a"\ndriver = "capacity"\ncapacity = { rate = 10 }\n'
            '[[rc]]\nname = "robot/a"\ndriver = "exclusive"\n'
            '[[rc]]\nname = "lamp/desk"\ndriver = "lamp"\npath = "brightness"\n'
        ),
    ):
        rcs = ("lamp/desk:level=200", "psu/bench", "radio/rf0:command_rate=5", "link/a:rate=2", "robot/a")
        held = fleet.request(*rcs, "--", "sh", "-c", "echo I hold $ZSCOUT_RCS")
        expect("psu/bench" in held.stdout, f"the command did not run: {held.stdout}")
        client = (
            "import zscout\n"
            "with zscout.connect() as lab, lab.hold('py', {'robot/a': {}}, min_runtime=60) as held:\n"
            "    print(held.command('robot/a', {'name': 'echo', 'value': 'hello'}))\n"
        )
        env = CLEAN | {"ZSCOUT_FLEET": str(folder / "fleet.toml")}
        said = program_until_in_time(str(programs / "python"), "-c", client, env=env, cwd=folder)
        expect(said.stdout == "hello\n", f"the client got {said.stdout!r}{said.stderr}")
        fleet.until("status", said="psu/bench")
    told = (folder / "told").read_text().split()
    expect(told[:4] == ["safe", "start", "stop", "safe"], f"the commands were run as {told}")
    # What is missing is named, with the command that brings it.
    line = fleet.refused('[[rc]]\nname = "framegrabber/f"\ndriver = "framegrabber"\nsource = "/dev/video0"\n')
    expect(len(line.splitlines()) == 1 and "pip install" in line, f"a framegrabber is refused with {line}")
    for args, package in (
        (("motion", "--source", "a.avi"), "opencv-python-headless"),
        (("view", "--web"), "rerun-sdk"),
    ):
        done = fleet.zscout(*args, check=False)
        last = (done.stderr.splitlines() or [""])[-1]
        expect(done.returncode != 0 and package in last and "pip install" in last, f"{args}: {done.stderr}")


def check_host(wheel: Path, folder: Path) -> None:
    """`deploy/install-host`, in a secured fleet: its node runs under its unit, and once more it changes nothing."""
    folder.mkdir(mode=0o755)
    with Machine(folder, installed=False) as host:
        host.path("/srv/new").mkdir()
        host.path(f"/srv/new/{wheel.name}").write_bytes(wheel.read_bytes())
        fleet = f'[fleet]\nname = "{new_instance()}"\n[mesh]\ninterface = "lo"\n[roles]\nmanager = ["anvil"]\n'
        host.write("/srv/new/fleet.toml", f'{fleet}[security]\nfolder = "/etc/zscout/keys"\n')
        now, keys = datetime.now(UTC), host.path("/srv/new/anvil")
        CertificateAuthority.make(folder / "ca", timedelta(days=2), now)
        CertificateAuthority.read(folder / "ca", now).issue("anvil", keys, timedelta(days=1), now)
        host.write("/srv/new/anvil.toml", '[node]\nhost = "anvil"\nfleet = "fleet.toml"\n[components]\nmax = 0\n')
        words = ["/opt/zscout/project/deploy/install-host", "--python", "/opt/zscout/python/bin/python3"]
        words += ["--wheel", f"/srv/new/{wheel.name}"]
        words += ["--fleet", "/srv/new/fleet.toml", "--node", "/srv/new/anvil.toml"]
        refused = host.fails(*words, timeout=INSTALL)
        expect("components.max: is 0" in refused, f"a bad node file is taken: {refused}")
        expect(not host.path("/etc/zscout").exists(), "a bad node file leaves something in /etc")
        host.write("/srv/new/anvil.toml", '[node]\nhost = "anvil"\nfleet = "fleet.toml"\n')
        ended = host.fails(*words, timeout=INSTALL)
        expect("zscout-node does not run: /etc/zscout/keys: has no certificate" in ended, f"no keys: {ended}")
        host.run("rm", "-r", "/etc/zscout", "/etc/systemd/system/zscout-node.service")
        words += ["--keys", "/srv/new/anvil"]
        said = host.run(*words, timeout=INSTALL)
        expect("/etc/zscout/node.toml" in said and "/etc/systemd/system/zscout-node.service" in said, said)
        host.until("zscout-node", ActiveState="active", SubState="running", UnitFileState="enabled")
        host.until("zscout-cert-renew.timer", ActiveState="active", UnitFileState="enabled")
        host.until_says("anvil", "zscout", "status")
        files = ("/etc/zscout", "/etc/zscout/keys", "/etc/zscout/renew-certificate", "/etc/zscout/keys/key.pem")
        modes = host.run("stat", "-c", "%a %U:%G", *files).splitlines()
        expect(modes == ["755 root:root", "750 root:zscout", "755 root:root", "640 root:zscout"], f"modes are {modes}")
        before = host.show("zscout-node", "MainPID")
        again = host.run(*words, timeout=INSTALL)
        expect("new or changed" not in again, f"the second time it says {again}")
        expect(host.show("zscout-node", "MainPID") == before, "the second time it restarts the node")


def main() -> int:
    failed = 0
    rows: list[tuple[str, str, str]] = []
    with tempfile.TemporaryDirectory(prefix="zscout-install-") as name:
        folder = Path(name)
        build = (sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation")
        run(*build, "--wheel-dir", folder, ROOT, cwd=folder, timeout=INSTALL)
        (wheel,) = folder.glob("zscout-*.whl")
        tools = folder / "tools"
        ways: dict[str, Callable[[Path, Path], Path]] = {
            "light": light,
            "pip": by_pip,
            "pipx": lambda wheel, home: by_pipx(tools / "bin", wheel, home),
            "uv": lambda wheel, home: by_uv(tools / "bin", wheel, home),
        }
        wanted = [way for way in sys.argv[1:] if way in (*ways, "host")] or [*ways, "host"]
        if "host" in wanted and (why := missing()):
            print(f"host is skipped: {why}", flush=True)
            wanted.remove("host")
        if {"pipx", "uv"} & set(wanted):
            try:
                make_environment(tools)
                pip = (tools / "bin/python", "-m", "pip", "install", "--quiet", "--require-hashes")
                run(*pip, "-r", REQUIREMENTS / "installers.txt", cwd=folder, timeout=INSTALL)
            except CheckFailed as error:
                print(f"pipx and uv are skipped, they can't be had here: {error}", flush=True)
                wanted = [way for way in wanted if way not in ("pipx", "uv")]
        for way in wanted:
            print(f"{way} ...", flush=True)
            try:
                if way == "host":
                    check_host(wheel, folder / way)
                    continue
                began = time.monotonic()
                programs = ways[way](wheel, folder / way)
                seconds, size = time.monotonic() - began, megabytes(folder / way)
                rows.append((way, f"{seconds:.0f}", f"{size:.0f}"))
                if way == "light":
                    expect(size < LIGHT_MB, f"it takes {size:.0f} MB, more than {LIGHT_MB}")
                (check_light if way == "light" else check_whole)(programs, folder / f"{way}-fleet")
            except (CheckFailed, AssertionError, OSError, subprocess.TimeoutExpired) as error:
                failed += 1
                print(f"{way} FAILED: {error}", flush=True)
    _print_table([("installed", "seconds", "MB"), *rows])
    return 1 if failed else 0


def _print_table(rows: Sequence[tuple[str, str, str]]) -> None:
    for way, seconds, size in rows:
        print(f"{way:<10} {seconds:>8} {size:>8}")


if __name__ == "__main__":
    sys.exit(main())
