"""Words that a command can't use: one line on stderr that names what is wrong, exit code 2, and nobody is asked."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Final

import pytest
from click.testing import CliRunner

from zscout.cli.main import main

ARC: Final = '[[arc]]\nname = "a"\nat = {}\npriority = 1\nmin_runtime = 1\n[arc.needs]\n{}'
NEEDS: Final = '"robot/a" = {}'
FILES: Final = {
    "work.toml": f'[[rc]]\nname = "robot/a"\n{ARC.format(0, NEEDS)}',
    "torn.toml": "[[rc",
    "early.toml": ARC.format(-1, NEEDS),
    "nan.toml": ARC.format("nan", NEEDS),
    "needless.toml": ARC.format(0, ""),
    "bad.toml": "[fleet]\nnam = 1\n",
    "node.toml": '[[rc]]\nname = "robot/a"\ndriver = "robot"\n',
    "not.rrd": "no recording",
}
NEEDS_ARGUMENTS: Final = (
    "request", "take", "book robot/a", "book --at 9:00 --for 1h", "drive", "watch", "release", "cancel", "why", "start",
    "stop", "logs", "migrate", "drain", "uncordon", "replay", "unbook", "slots robot/a", "maintain robot/a --for 1h",
)  # fmt: skip
BAD: Final = """
nonsense | there is no command 'nonsense'; known: request
requst | there is no command 'requst'; did you mean request? (see zscout --help)
--fleet none.toml status | none.toml: there is no such file; check the path
--fleet bad.toml status | bad.toml: fleet.nam: unknown key; did you mean name?
request robot/a -- | no command follows the --
request robot/a sleep 5 | a command goes after --
request robot/a --priority high | 'high' is not a whole number
request robot/a --priority 1.5 | '1.5' is not a whole number
request robot/a --again | --again runs a command again
request robot/a --min-runtime never | --min-runtime: "never" is not a duration
request robot/a --min-runtime 0 | --min-runtime must be positive
request robot/a --timeout -1 | --timeout: "-1" is not a duration
request robot/a --name a/b | --name 'a/b' is not valid
request robot | need "robot": RC 'robot' is not valid: write kind/name
request robot/a robot/a | robot/a is named twice
request robot/a:rate | rate has no number; write parameter=number
request robot/a:rate=x | rate is "x"; write parameter=number
request robot/a:rate=1,rate=2 | rate is given twice
request true -- true | need "true": RC 'true' is not valid
request framegrabber/** | need "framegrabber/**": need 'framegrabber/**' is not valid: write
request framegrabber/f* | write kind/name with * for a whole name or $* for a part of one
request radio/*:rate=1 radio/*:rate=2 | have different parameters; give all the same
request */x radio/*:rate=2 | can't stand beside parameters; name its kind
request fg/*#2 fg/*#2 | fg/*#2 is named twice; leave the numbers out, and they are given
request --booking x --min-runtime 5 | --min-runtime is not for --booking
request --booking x --release-after 5 | --release-after is not for --booking
request --booking x --dry-run | --dry-run is not for --booking
take framegrabber/*#0 | #2, #3 and so on behind it for a second and third
take robot/a:= | parameter '' is not valid
take robot/a --min-runtime 0 | --min-runtime must be positive
drive radio/rf0 | "radio/rf0" is no robot
drive robot/a | zscout drive reads keys: run it at a terminal
drive robot/a --speed 9 | 9.0 is not in the range
watch --source none.avi | "none.avi" can't be read
watch --source none.avi --limit 0 | --limit must be positive
cancel '' | "" names no ARC; zscout status lists them
cancel \\a | names no ARC
why '' | names no ARC; zscout status lists them
status --once | No such option '--once'
book robot/a --for 1h --at tue | --at: "tue" has no time of day; write "tue 14:00"
book robot/a --for soon --at 9:00 | --for: "soon" is not a duration
book robot/a --for 1h --at '9999-12-31 23:59' | is more than a year ahead; write an earlier
book robot/a --for 1h --at 0001-01-01 | is long past; write a later one
book robot --for 1h --at 9:00 | need "robot":
book robot/a --for 1h --at 9:00 --until 2026-12-24 | --until is the end of what is repeated
book robot/a --for 1h --at 9:00 --every month | --every: "month" is not from 1 to 366 days
book robot/a --for 1h --at 9:00 --patience 2h | --patience: it is over after 1 h
book robot/a --for 1h --at 9:00 --zone Berlin | did you mean Europe/Berlin?
book robot/a robot/a --for 1h --at 9:00 | robot/a is named twice
book robot/a --for 1h --at 9:00 --name 'a b' | --name
maintain robot/* --for 1h --at 9:00 | robot/* may be any one RC; name those
maintain robot/a robot/a --for 1h --at 9:00 | an RC is named twice
slots robot/a --for 1h --within 500d | --within: 500 d is not from 1.0 s to 366 d; write
slots robot/a --for 1h --limit 0 | --limit
unbook x --date someday | --date:
history --since soon | --since: "soon" is no time; write a number of seconds
history --since 2999-01-01 | is in the future
history --since 1h --until 2h | --since: it is not before --until
history --rc robot | write kind/name, like robot/scout33
history --user '' | is no name
history --group arms | --group: "arms" is no group of the fleet file that has members; it has none
history --limit 0 | 0 is not in the range
history --json --csv | --json and --csv: write one of them
usage --by weekday | 'weekday' is not one of
usage --by group | the fleet file has no [groups]
usage --until 30d | --since: it is not before --until
start a/b | kind 'a/b' is not valid
start counter --name 'a b' | --name 'a b' is not valid
start counter --name '' | --name '' is not valid
start counter --set x | --set "x" sets nothing; write KEY=VALUE
start counter --host a* | --host 'a*' is not valid
start counter --label a/b | --label 'a/b' is not valid
start counter --memory much | --memory: "much" is no size
start counter --memory-limit -5 | --memory-limit: "-5" is no size
start counter --cpu-limit nan | --cpu-limit: "nan" is no number of cores
start counter --cpu-limit 0 | --cpu-limit: "0" is no number of cores
start counter --restart maybe | 'maybe' is not one of
start counter --timeout soon | --timeout: "soon" is not a duration
stop a/b | component 'a/b' is not valid
logs * | zscout components lists them
logs counter --lines -1 | -1 is not in the range
migrate counter --to a/b | --to 'a/b' is not valid
drain * | host '*' is not valid
uncordon '' | host '' is not valid
components --kinds --watch | leave NAME and --watch out
components 'a b' | component 'a b' is not valid
keys --all --json | No such option '--all'
cert ca --days 0 | --days: "0" is no time up to 36,525 days
cert issue anvil | zscout-ca/ca-key.pem: there is no such file; make a CA with `zscout cert ca`
cert issue a/b | name 'a/b' is not valid
cert show | name a folder; $ZSCOUT_KEYS names none
view none.rrd | none.rrd: there is no such file
view not.rrd | not.rrd: is not a Rerun recording; name a .rrd file
view --bind somewhere | --bind: "somewhere" is not an IP address
view --port 0 | 0 is not in the range
replay none.toml | none.toml: there is no such file
replay bad.toml | bad.toml: fleet: unknown key; known here: arc, rc
replay none.toml --strategy best | 'best' is not one of 'priority'
replay work.toml --rrd picture.png | end it in .rrd
replay work.toml --rrd no/such/folder/x.rrd | can't write the recording
replay torn.toml | torn.toml: line 1
replay early.toml | early.toml: arc[0].at
replay nan.toml | nan.toml: arc[0].at
replay needless.toml | needless.toml: arc[0].needs (a): an ARC needs at least one RC
simulate | which building? name one of living_room, office, random:SEED, or a file
simulate castle | there is no building "castle"; name one of living_room, office
simulate castle.toml | castle.toml
simulate random:x | write random: and a number
simulate living_room --http nowhere | write HOST:PORT, as in
simulate living_room --http 127.0.0.1:99999 | write HOST:PORT, as in
simulate living_room --radio /dev/null | /dev/null: is there already; give another name
simulate living_room --node /no/such/folder/lab.toml | can't be written
simulate office --speed 0 | 0.0 is not in the range
demo nothing | No such command 'nothing'
demo table1 --out picture.png | let it end in .rrd
demo placement --policy best | 'best' is not one of 'least_loaded'
demo robots --building nowhere | there is no building "nowhere"; name one of living_room
completion tcsh | 'tcsh' is not one of 'bash', 'zsh', 'fish'
"""
LONG: Final = {
    f"start {'k' * 49}": "has more than 48 characters; give a shorter --name",
    "start counter" + "".join(f" --label=l{number}" for number in range(33)): "33 labels; at most 32",
    "start counter" + "".join(f" --host=h{number}" for number in range(257)): "257 hosts; name at most 256",
    f"unbook {'x' * 65}": "names no booking",
    f"why {'x' * 300}": "names no ARC",
}


def test_what_a_command_can_not_use_is_one_line_and_code_2(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TZ", "Europe/Berlin")
    for name in ("ZSCOUT_FLEET", "ZSCOUT_KEYS", "ZSCOUT_CA"):
        monkeypatch.delenv(name, raising=False)
    for name, text in FILES.items():
        Path(name).write_text(text)
    rows = dict(line.split(" | ") for line in BAD.strip().splitlines()) | LONG
    rows |= dict.fromkeys(NEEDS_ARGUMENTS, "Missing ")
    wrong = []
    for words, said in rows.items():
        done = CliRunner().invoke(main, shlex.split(words.replace("\\a", "\a")))
        one_line = (done.exit_code, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        # Where no command is taken, none is proposed.
        proposed = "after --" in done.stderr and not words.startswith(("request", "take"))
        if not one_line or said not in done.stderr or proposed:
            wrong.append(f"{words}: {done.exit_code} {done.stdout}{done.stderr}")
    assert not wrong, "\n".join(wrong)


def test_the_version_is_a_line_and_without_words_there_is_help() -> None:
    assert CliRunner().invoke(main, ["--version"]).stdout.startswith("zscout ")
    nothing = CliRunner().invoke(main, [])
    assert (nothing.exit_code, nothing.stdout) == (2, "")
    assert nothing.stderr.startswith("Usage: zscout")
