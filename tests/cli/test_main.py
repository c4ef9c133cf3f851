"""The `zscout` group: lazy, quick, one line for each error, exit codes."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from decimal import Decimal
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from tests.cli import tools
from tests.hang import HANG
from tests.live.lab import Lab
from zscout.behaviors.client.client import NoRcm, RequestRefused
from zscout.behaviors.client.remedies import CHECK_FLEET, IN_PYTHON, with_remedy
from zscout.cli.common import REMEDIES
from zscout.cli.groups import LazyGroup, booking, component, instead
from zscout.cli.main import HABITS, HEADINGS, INSTEAD, OLD, explain, main
from zscout.cli.requests.options import gather_needs, parse_duration, parse_need
from zscout.config.strict import BadInput
from zscout.messages import Problem
from zscout.terminal import Table, span

HEAVY = ("zenoh", "rich", "rerun", "msgspec", "numpy", "cv2")


def zscout(*args: str, **env: str) -> subprocess.CompletedProcess[str]:
    return tools.zscout(*args, env=os.environ | env)


@pytest.mark.live
def test_help_loads_nothing_heavy_and_lists_all() -> None:
    script = (
        "import sys; from zscout.cli.main import main\n"
        "try: main(['--help'])\n"
        f"finally: sys.stderr.write(' '.join(name for name in {HEAVY} if name in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=HANG)
    assert (done.returncode, done.stderr) == (0, "")
    shown = [line for line in done.stdout.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert shown == ["Options:", *(f"{heading}:" for heading in HEADINGS)]
    assert all(f"\n  {name} " in done.stdout for name in main.table)
    assert not any(f"\n  {name} " in done.stdout for name in OLD)


@pytest.mark.parametrize("group", [main, component, booking])
def test_every_command_is_there_and_its_help_has_examples(group: LazyGroup) -> None:
    for name in group.list_commands(click.Context(group)):
        command = group.get_command(click.Context(group), name)
        assert command is not None
        assert command.hidden is (name in group.old)
        assert command.help is not None
        assert "Example" in command.help, name


@pytest.mark.parametrize(("old", "new"), [(old, new) for old, new in INSTEAD.items() if old.split()[0] in OLD])
def test_an_old_spelling_has_the_meaning_and_options_of_the_new(old: str, new: str) -> None:
    def found(words: str) -> click.Command:
        command: click.Command = main
        for word in words.split():
            if word.startswith("-"):
                assert word in {name for param in command.params for name in param.opts}
            else:
                assert isinstance(command, click.Group)
                below = command.get_command(click.Context(command), word)
                assert below is not None
                command = below
        return command

    before, now = found(old), found(new)
    if old in ("keys", "components --kinds"):
        assert {name for param in now.params for name in param.opts} >= {"--json"}
        return
    assert before.callback is now.callback
    assert before.params == now.params


@pytest.mark.parametrize(
    ("call", "words"),
    [
        ("bookings --mine", "zscout bookings is now called zscout booking list"),
        ("unbook survey", "zscout unbook is now called zscout booking cancel"),
        ("calendar import lab.ics", "zscout calendar is now called zscout booking import"),
        *(
            (f"{name} survey", f"zscout {name} is now called zscout component {name}")
            for name in ("start", "stop", "logs", "migrate")
        ),
        ("keys --json", "zscout keys is now called zscout doctor --keys"),
        ("watch --source none.avi", "zscout watch is now called zscout motion"),
        ("components --json", "zscout components is now called zscout component list"),
        ("components --kinds a", "zscout components is now called zscout component kinds"),
        ("calendar export --folder a --out b", "zscout calendar is now called zscout booking export"),
    ],
)
def test_an_old_spelling_names_the_new_at_a_terminal_alone(
    call: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lines(*, terminal: bool) -> list[str]:
        monkeypatch.setattr("zscout.cli.groups.at_terminal", lambda: terminal)
        return CliRunner().invoke(main, ["--fleet", "nowhere.toml", *call.split()]).stderr.splitlines()

    assert lines(terminal=True) == [words, *lines(terminal=False)]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("requst", "; did you mean request?"),
        ("migrat", "; did you mean component migrate?"),
        ("ps", "; use zscout status"),
        ("lock", "; use zscout request"),
        ("KILL", "; use zscout cancel"),
        ("disable", "; use zscout maintain"),
        ("when", "; use zscout slots"),
        ("xyzzy", ""),
    ],
)
def test_an_unknown_command_is_one_line_with_a_hint(name: str, words: str) -> None:
    done = CliRunner().invoke(main, [name, "--whatever"])
    assert done.exit_code == 2
    assert done.stderr == f'zscout: there is no command "{name}"{words} (see zscout --help)\n'


def test_a_habit_leads_to_a_command_that_is_there() -> None:
    for name, words in instead(HABITS).items():
        assert words.split()[0] in main.table or words.startswith("--"), name
        assert name not in {*main.table, *OLD}


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["request"], "DEVICE... is missing"),
        (["request", "robot/a", "--"], "no command follows the --"),
        (["request", "robot/a", "--priority", "high"], '--priority: "high" is not a whole number (see'),
        (["request", "robot"], 'zscout: device "robot" is not valid; write kind/name'),
        (["request", "robot/a", "robot/a"], "robot/a is named twice"),
        (["request", "robot/a", "--again"], "--again repeats a command"),
        (["request", "robot/a", "--min-runtime", "0"], "--min-runtime must be positive"),
        (["request", "robot/a", "sleep", "5"], "a command goes after --"),
        (["request", "robot/a:rate"], "rate has no number; write parameter=number"),
        (["cancel"], "REQUEST is missing"),
        (["cancel", ""], '"" can\'t be the name of a request; see zscout status'),
    ],
)
def test_bad_input_is_one_line_and_2(args: list[str], words: str) -> None:
    done = CliRunner().invoke(main, args)
    assert (done.exit_code, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("zscout")
    assert words in done.stderr


@pytest.mark.live
def test_a_fleet_file_that_is_not_there_is_named() -> None:
    done = zscout("--fleet", "nowhere.toml", "cancel", "x")
    assert done.returncode == 2
    assert done.stderr == "zscout: nowhere.toml: there is no such file; check the path\n"
    named = zscout("cancel", "x", ZSCOUT_FLEET="nowhere.toml")
    assert named.returncode == 2
    assert "named by $ZSCOUT_FLEET" in named.stderr


@pytest.mark.live
def test_a_mesh_without_an_rcm_is_3(tmp_path: Path) -> None:
    lab = Lab(tmp_path)
    done = zscout("--fleet", str(lab.fleet_file), "request", "robot/a")
    assert done.returncode == 3
    who = "(no other program either); start zscout-node"
    assert done.stderr.startswith(f"zscout: no leader is on the mesh of fleet {lab.fleet.name} {who}")
    assert "check the fleet file (--fleet, $ZSCOUT_FLEET)" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.live
def test_a_closed_pipe_is_quiet() -> None:
    read, write = os.pipe()
    os.close(read)
    process = subprocess.Popen([*tools.COMMAND, "completion", "fish"], stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    _, errors = process.communicate(timeout=HANG)
    assert (process.returncode, errors) == (1, "")


@pytest.mark.live
@pytest.mark.parametrize(("command", "code"), [("completion fish", 1), ("completion no-such-shell", 2), ("--help", 1)])
def test_a_terminal_that_is_gone_is_quiet(command: str, code: int) -> None:
    """As where a terminal window is closed and SIGHUP is ignored: all that is written to it fails with EIO."""
    ours, theirs = os.openpty()
    os.close(ours)
    for stderr in (subprocess.PIPE, theirs):
        process = subprocess.Popen([*tools.COMMAND, *command.split()], stdout=theirs, stderr=stderr, text=True)
        _, errors = process.communicate(timeout=HANG)
        assert process.returncode == code
        assert "Traceback" not in (errors or "")
        assert "Exception ignored" not in (errors or "")
    os.close(theirs)


@pytest.mark.live
@pytest.mark.parametrize(("command", "code"), [("--help", 0), ("replay nowhere.toml", 2)])
@pytest.mark.parametrize("closed", [">&-", "2>&-"])
def test_a_closed_stream_is_no_error(command: str, code: int, closed: str) -> None:
    script = f"exec {shlex.join(tools.COMMAND)} {command} {closed}"
    done = subprocess.run(["sh", "-c", script], capture_output=True, text=True, timeout=HANG)
    assert (done.returncode, "Traceback" in done.stdout + done.stderr) == (code, False), done.stderr


@pytest.mark.live
def test_a_full_disk_is_told_in_one_line() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*tools.COMMAND, "completion", "fish"], stdout=full, stderr=subprocess.PIPE, text=True, timeout=HANG
        )
    assert (done.returncode, done.stderr) == (1, "zscout: No space left on device; free some\n")


@pytest.mark.live
def test_completion_knows_the_commands_without_loading_them() -> None:
    script = zscout("completion", "bash")
    assert script.returncode == 0
    assert "_ZSCOUT_COMPLETE=bash_complete" in script.stdout
    asked = zscout(_ZSCOUT_COMPLETE="bash_complete", COMP_WORDS="zscout re", COMP_CWORD="1")
    assert asked.stdout.split() == ["plain,request", "plain,renew", "plain,release", "plain,replay"]
    below = zscout(_ZSCOUT_COMPLETE="bash_complete", COMP_WORDS="zscout component s", COMP_CWORD="2")
    assert below.stdout.split() == ["plain,start", "plain,stop"]
    options = zscout(_ZSCOUT_COMPLETE="bash_complete", COMP_WORDS="zscout request --min", COMP_CWORD="2")
    assert options.stdout.split() == ["plain,--min-runtime"]
    script = zscout("completion", "bash", "--program", "zscout-node")
    assert "_ZSCOUT_NODE_COMPLETE=bash_complete" in script.stdout
    variables = {"_ZSCOUT_NODE_COMPLETE": "bash_complete", "COMP_WORDS": "zscout-node --log", "COMP_CWORD": "1"}
    command = [sys.executable, "-c", "import sys; from zscout.node import main; main(prog_name='zscout-node')"]
    node = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, timeout=HANG)
    assert (node.stdout.split(), node.stderr) == (["plain,--log-level"], "")
    unknown = zscout("completion", SHELL="/bin/tcsh")
    assert unknown.returncode == 2
    assert "write one of bash, zsh, fish" in unknown.stderr


@pytest.mark.live
def test_bash_completes_at_tab(tmp_path: Path) -> None:
    """A real bash at a terminal, with `zscout` on its path and the script read."""
    here = tmp_path / "zscout"
    here.write_text(f'#!/bin/sh\nexec {shlex.join(tools.COMMAND)} "$@"\n')
    here.chmod(0o755)
    (tmp_path / "table.rrd").touch()
    env = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "PS1": "ready> "}
    with tools.Terminal(command=("bash", "--norc", "--noprofile", "-i"), env=env) as terminal:
        terminal.until("ready> ")
        terminal.press(f"cd {tmp_path} && zscout completion bash > script && . ./script && echo re''ad\n")
        terminal.until("\nread\nready> ")
        for typed, offered in (
            ("zscout stat", "zscout status "),
            ("zscout status --w", "zscout status --watch "),
            ("zscout replay --strategy pri", "zscout replay --strategy priority "),
            ("zscout view ta", "zscout view table.rrd "),
        ):
            # Ctrl-U empties the line.
            terminal.press("\x15" + typed + "\t")
            terminal.until(offered)
        # An interactive shell does not heed SIGTERM.
        terminal.press("\x15exit\n")
        assert terminal.code() == 0


@pytest.mark.parametrize("text", ["", "5x", "-1", "1e3", "nan", "1_0", "٣", "5  s", "mm", "0", "1ss", "99999999h"])
def test_what_is_no_duration_is_refused(text: str) -> None:
    with pytest.raises(BadInput, match="--timeout"):
        parse_duration(text, "--timeout")


def test_needs() -> None:
    assert parse_need("robot/scout33") == ("robot/scout33", {})
    rc, params = parse_need("radio/rf0:command_rate=0.1,other=2")
    assert (rc, params) == ("radio/rf0", {"command_rate": Decimal("0.1"), "other": Decimal(2)})
    assert gather_needs([(rc, params), ("robot/a", {})]) == {"radio/rf0": params, "robot/a": {}}


def test_a_pattern_that_comes_again_is_numbered() -> None:
    def needs(*texts: str) -> list[str]:
        return list(gather_needs([parse_need(text) for text in texts]))

    assert needs("fg/*", "robot/a", "fg/*", "fg/*") == ["fg/*", "robot/a", "fg/*#2", "fg/*#3"]
    assert needs("fg/a$*", "fg/*", "fg/a$*", "*/x") == ["fg/a$*", "fg/*", "fg/a$*#2", "*/x"]
    # What is written out stays as it is.
    assert needs("fg/*", "fg/*", "fg/*#2", "fg/*#7") == ["fg/*", "fg/*#3", "fg/*#2", "fg/*#7"]
    assert len(needs(*["fg/*"] * 64)) == 64
    same = {"rate": Decimal(2)}
    assert gather_needs([parse_need("radio/*:rate=2")] * 2) == {"radio/*": same, "radio/*#2": same}


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["robot/a", "fg/*", "robot/a"], "robot/a is named twice; name each device once"),
        (["fg/*#2", "fg/*#2"], "fg/*#2 is named twice; leave the numbers out: zscout numbers them"),
        (["radio/*:rate=2", "radio/*:rate=3"], "different parameters; give them all the same"),
        (["radio/*:rate=2", "*/x"], "name a kind"),
        (["fg/*"] * 65, "65 devices; at most 64 are allowed"),
    ],
)
def test_needs_that_do_not_go_together(texts: list[str], message: str) -> None:
    with pytest.raises(BadInput, match=re.escape(message)):
        gather_needs([parse_need(text) for text in texts])


@pytest.mark.parametrize(
    "text",
    ["", "robot", "robot/", "/a", "a/b/c", "a/b:", "a/b:rate", "a/b:rate=", "a/b:rate=-1", "a/b:rate=nan",
     "a/b:rate=1,rate=2", "a/b:rate=1,", "a/b:=1", "a/b:rate=1e999", "a/b:ra te=1", "a/b\n",
     "*", "a/**", "a/b*", "a/*/*", "a/*#", "a/*#0", "a/*#2#3", "a/*#100", "a/b#2", "a/*:rate", "a/* "],
)  # fmt: skip
def test_what_is_no_need_is_refused(text: str) -> None:
    with pytest.raises(BadInput):
        parse_need(text)


def test_spans_of_time_as_people_read_them() -> None:
    spans = [0.0, 0.44, 9.96, 59.4, 59.996, 185, 7440, 93_600, -1]
    said = ["0.0 s", "0.4 s", "10 s", "59 s", "1 min", "3 min 5 s", "2 h 4 min", "1 d 2 h", "0.0 s"]
    assert [span(seconds) for seconds in spans] == said


def test_plain_tables_align() -> None:
    assert Table("", ["RC", "holder"], [["robot/a", "x"], ["b/c", ""]]).lines() == [
        "RC       holder",
        "robot/a  x",
        "b/c",
    ]


@pytest.mark.parametrize("fault", ["unknown device robot/a;", "unknown device robot/a; did you mean robot/b?"])
def test_a_remedy_is_an_option_here_and_an_argument_in_a_program(fault: str) -> None:
    refused = RequestRefused(Problem("unknown_device", fault.removesuffix(";"), remedy="wait_for_device"))
    assert str(refused) == f"{fault} to wait anyway, pass wait_for_device=True"
    assert explain(refused) == (2, f"zscout: {fault} to wait anyway, add --wait-for-device")


def test_every_remedy_has_words_in_python_and_here() -> None:
    assert REMEDIES.keys() == IN_PYTHON.keys()
    assert not any("--" in words for words in IN_PYTHON.values())
    unknown = Problem("unknown_device", "unknown device robot/a", remedy="of_a_newer_leader")
    assert explain(RequestRefused(unknown)) == (2, "zscout: unknown device robot/a")
    no_leader = NoRcm("no leader is on the mesh", CHECK_FLEET)
    assert "($ZSCOUT_FLEET)" in str(no_leader)
    assert "(--fleet, $ZSCOUT_FLEET)" in with_remedy(no_leader.fault, no_leader.remedy, REMEDIES)
