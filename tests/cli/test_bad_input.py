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
NEEDS_ARGUMENTS: Final = {
    "DEVICE...": ("request", "take", "acquire --for 1h", "book --at 9:00 --for 1h"),
    "TOKEN": ("run", "renew --for 1h"),
    "REQUEST": ("release", "cancel", "why"),
    "ROBOT": ("drive",),
    "HOST": ("drain", "uncordon"),
    "KIND": ("component start", "start"),
    "NAME...": ("component stop", "stop"),
    "NAME": ("component logs", "logs", "component migrate", "migrate"),
    "NAME|ID": ("booking show", "booking cancel", "unbook"),
    "FILE": ("replay",),
    "--at": ("book robot/a", "maintain robot/a --for 1h"),
    "--for": ("slots robot/a", "acquire robot/a"),
    "--source": ("motion", "watch"),
}
"""What is missing, and where."""
BAD: Final = """
nonsense | there is no command "nonsense" (see zscout --help)
requst | there is no command "requst"; did you mean request?
--fleet none.toml status | none.toml: there is no such file; check the path
--fleet bad.toml status | bad.toml: fleet.nam: unknown key; did you mean name?
request robot/a -- | no command follows the --; write a command, or leave the -- out
request robot/a sleep 5 | device "sleep" is not valid; write kind/name, as in robot/scout33; a command goes after --
request robot/a --priority high | --priority: "high" is not a whole number
request robot/a --priority 1.5 | --priority: "1.5" is not a whole number
request robot/a --again | --again repeats a command; add one after --
request robot/a --notify-signal USR1 | --notify-signal is for a command; add one after --
request robot/a --notify-signal KILL -- true | --notify-signal: "KILL" is not a signal that a command can catch
request robot/a --min-runtime never | --min-runtime: "never" is not a duration
request robot/a --min-runtime 0 | --min-runtime must be positive, but is 0; write more than 0, at most 3660 d
request robot/a --for 1h | there is no option --for; did you mean --min-runtime or --release-after? (see zscout request
usage --user ada | there is no option --user (see zscout usage --help)
maintain robot/a --reason stuck | there is no option --reason; did you mean --comment?
history --device robot/a | there is no option --device; did you mean --rc?
request robot/a --timeout -1 | --timeout: "-1" is not a duration
request robot/a --name a/b | --name "a/b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -, as in a-b
request robot/a --name test_gpu[0] | use 1 to 64 of A-Z a-z 0-9 _ . -, as in test_gpu-0
request robot/a --name 'ci job 7/9' | use 1 to 64 of A-Z a-z 0-9 _ . -, as in ci-job-7-9
request robot/a --name '///' | --name "///" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
request robot | device "robot" is not valid; write kind/name, as in robot/scout33; a command goes after --
request robot/a robot/a | robot/a is named twice; name each device once, with all its parameters after one colon
request robot/a:rate | rate has no number; write parameter=number, as in robot/a:command_rate=5
request robot/a:rate=x | rate is "x"; write parameter=number, as in robot/a:command_rate=5
request robot/a:rate=1,rate=2 | rate is given twice; give it once
request true -- true | device "true" is not valid; write kind/name, as in robot/scout33
request framegrabber/** | pattern "framegrabber/**" is not valid; write kind/name with * for a whole name or $* for a
request framegrabber/f* | pattern "framegrabber/f*" is not valid; write kind/name with * for a whole name or $* for a
request radio/*:rate=1 radio/*:rate=2 | patterns of the kind radio have different parameters; give them all the same
request */x radio/*:rate=2 | a pattern for devices of any kind can't be combined with parameters; name a kind
request fg/*#2 fg/*#2 | fg/*#2 is named twice; leave the numbers out: zscout numbers them
request --booking x --min-runtime 5 | --min-runtime can't be used with --booking; leave it out
request --booking x --release-after 5 | --release-after can't be used with --booking; leave it out
request --booking x --dry-run | --dry-run can't be used with --booking; leave it out
take framegrabber/*#0 | pattern "framegrabber/*#0" is not valid; write kind/name with * for a whole name or $* for a
take robot/a:= | parameter "" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -; write parameter=number, as in
take robot/a --min-runtime 0 | --min-runtime must be positive, but is 0
request robot/a --infra-exit 256 | --infra-exit: 256 is out of range; write 1 to 255
request robot/a --json-file /none/events | --json-file "/none/events" can't be written (No such file or directory)
acquire robot/a --for 1h -- true | acquire runs no command; write zscout run TOKEN -- COMMAND after it
acquire robot --for 1h | device "robot" is not valid; write kind/name, as in robot/scout33
acquire robot/a --for 0 | --for must be positive, but is 0; write more than 0, at most 3660 d
run survey-000000000000 | -- COMMAND is missing (see zscout run --help)
run survey-000000000000 -- true | unknown token "survey-000000000000"
run robot/a -- true | unknown token "robot/a"; robot/a is a device: zscout request robot/a -- COMMAND
renew survey --for 1h | unknown token "survey"
drive radio/rf0 | "radio/rf0" is not a robot; name one, as in robot/NAME
drive robot/a --framegrabber radio/* | --framegrabber: "radio/*" is needed already, as the radio; name another
drive robot/a | standard input is not a terminal, and zscout drive reads keys; run it at a terminal
drive robot/a --speed 9 | --speed: 9.0 is out of range; write 0.1 to 1.0
motion --source none.avi | "none.avi" can't be read (No such file or directory); name a video file, a URL or a device
motion --source none.avi --limit 0 | --limit must be positive, but is 0
cancel '' | "" can't be the name of a request; see zscout status
cancel \\a | "\\x07" can't be the name of a request; see zscout status
why '' | "" can't be the name of a request; see zscout status
status --once | there is no option --once
book robot/a --for 1h --at tue | --at: "tue" has no time; write "tue 14:00"
book robot/a --for soon --at 9:00 | --for: "soon" is not a duration
book robot/a --for 1h --at '9999-12-31 23:59' | --at: "9999-12-31 23:59" is more than a year ahead; write an earlier
book robot/a --for 1h --at 0001-01-01 | --at: "0001-01-01" is long past; write a later date
book robot --for 1h --at 9:00 | device "robot" is not valid; write kind/name, as in robot/scout33
book robot/a --for 1h --at 9:00 --until 2026-12-24 | --until ends a repeated booking; add --every, or leave --until
book robot/a --for 1h --at 9:00 --every month | --every: "month" is not 1 to 366 days; write day, week, "2 weeks" or
book robot/a --for 1h --at 9:00 --patience 2h | --patience is longer than the booking; write at most 1 h
book robot/a --for 1h --at 9:00 --zone Berlin | --zone: "Berlin" is not a time zone of the IANA database; did you mean
book robot/a robot/a --for 1h --at 9:00 | robot/a is named twice; name each device once, with all its parameters after
book robot/a --for 1h --at 9:00 --name 'a b' | --name "a b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
maintain robot/a --broken x --well | zscout: --broken and --well exclude each other; use only one of them
maintain robot/a --broken x --for 1h | zscout: --for can't be used with --broken, which has no date; leave it out
maintain anvil --broken x | zscout: anvil is not a device; name devices, or use zscout drain anvil
maintain robot/a --broken '' | zscout: --broken: the reason is empty; write what is wrong
maintain 'robot/a b' --for 1h --at 9:00 | device name "a b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
maintain 'a b' --for 1h --at 9:00 | host "a b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
maintain anvil anvil --for 1h --at 9:00 | zscout: anvil is named twice; name each device and host once
maintain robot/a robot/a --for 1h --at 9:00 | zscout: robot/a is named twice; name each device and host once
slots robot/a --for 1h --within 500d | --within: 500 d is out of range; write 1.0 s to 366 d
slots robot/a --for 1h --limit 0 | --limit: 0 is out of range; write 1 to 50
bookings --date nosuch | --date: "nosuch" is not a date;
booking cancel x --date someday | --date: "someday" is not a date; write "now", "tue 14:00", "tomorrow 9:00", "14:30"
history --since soon | --since: "soon" is not a time
history --since 2999-01-01 | --since: "2999-01-01" is in the future; write an earlier date
history --since 0101-01-01 | --since: "0101-01-01" is too far back; write a later date
history --since 1h --until 2h | --since is not before --until; write an earlier --since
history robot/a --rc robot/b | DEVICE and --rc are the same; use only one of them
history robot | device "robot" is not valid; write kind/name, as in robot/scout33
history --rc robot | device "robot" is not valid; write kind/name, as in robot/scout33
history --user '' | --user: "" is not a name; write 1 to 64 characters
history --group arms | --group: the fleet file has no group "arms" with members; there are none
history --limit 0 | --limit: 0 is out of range; write 1 to 100000
history --json --csv | --json and --csv exclude each other; use only one of them
usage --by weekday | --by: "weekday" is unknown; write one of "user", "group", "rc"
usage --by group | --by group: the fleet file has no [groups]; name some there, or write --by user
usage --until 30d | --since is not before --until; write an earlier --since
component start a/b | kind "a/b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
component start counter --name 'a b' | --name "a b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
component start counter --name '' | --name "" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
component start counter --set x | --set: "x" has no value; write KEY=VALUE
component start counter --host a* | --host "a*" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
component start counter --label a/b | --label "a/b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
component start counter --memory much | --memory: "much" is not a size; write bytes, or with a unit: 500M, 1.5G
component start counter --memory-limit -5 | --memory-limit: "-5" is not a size; write bytes, or with a unit: 500M
component start counter --cpu-limit nan | --cpu-limit: "nan" is not a number of cores; write one, as in 0.5 or 2
component start counter --cpu-limit 0 | --cpu-limit: "0" is not a number of cores; write one, as in 0.5 or 2
component start counter --restart maybe | --restart: "maybe" is unknown; write one of "never", "on-failure", "always"
component start counter --timeout soon | --timeout: "soon" is not a duration
component stop a/b | component "a/b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -; see zscout component list
component logs * | component "*" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -; see zscout component list
component logs counter --lines -1 | --lines: -1 is out of range; write 0 to 100000
component migrate counter --to a/b | --to "a/b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
drain * | host "*" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
uncordon '' | host "" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
components --kinds --watch | --kinds takes no NAME and no --watch; leave them out
component list 'a b' | component "a b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -; see zscout component list
doctor --keys --all --json | there is no option --all (see zscout doctor --help)
cert ca --days 0 | --days: "0" is not a time up to 36,525 days; write it as in 90, 12h, 90s
cert issue anvil | zscout-ca/ca-key.pem: there is no such file; make a CA with `zscout cert ca`, or name its folder by
cert issue a/b | name "a/b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -
cert show | no folder is given; name a folder, or set $ZSCOUT_KEYS
view none.rrd | none.rrd: there is no such file; recordings of nodes and of zscout view are in runs/
view not.rrd | not.rrd: not a Rerun recording; name a .rrd file
view --bind somewhere | --bind: "somewhere" is not an IP address; write one, as in 127.0.0.1
view --port 0 | --port: 0 is out of range; write 1 to 65535
replay none.toml | none.toml: there is no such file; check the path
replay bad.toml | bad.toml: fleet: unknown key; known here: arc, rc
replay none.toml --strategy best | --strategy: "best" is unknown; write one of "priority", "optimal", "adaptive"
replay work.toml --rrd picture.png | --rrd picture.png: not the name of a recording; end it in .rrd
replay work.toml --rrd no/such/folder/x.rrd | zscout: can't write the recording no/such/folder/x.rrd (No such file
replay torn.toml | torn.toml: line 1, column 5, the end: Expected ']]' at the end of an array declaration; fix the
replay early.toml | early.toml: arc[0].at (a): is -1 s; write 0 to 1000000000 seconds
replay nan.toml | nan.toml: arc[0].at (a): is not a finite number; write a number
replay needless.toml | needless.toml: arc[0].needs (a): a request needs at least one device; name one, with {} for no
simulate | no building is given; name one of living_room, office, random:SEED, or a file
simulate castle | unknown building "castle"; name one of living_room, office, random:SEED, or a file
simulate castle.toml | castle.toml: there is no such file; check the path
simulate random:x | "random:x": write random: and a number from 0 to 4294967295
simulate living_room --http nowhere | --http: "nowhere" is not an address; write HOST:PORT, as in 127.0.0.1:8080
simulate living_room --http 127.0.0.1:99999 | --http: "127.0.0.1:99999" is not an address; write HOST:PORT, as in
simulate living_room --radio /dev/null | /dev/null: already exists; give another name for the radio's link
simulate living_room --node /no/such/folder/lab.toml | /no/such/folder/lab.toml: can't be written (No such file or
simulate office --speed 0 | --speed: 0.0 is out of range; write 0 to 100
demo nothing | there is no command "nothing" (see zscout demo --help)
demo table1 --out picture.png | --out picture.png: not the name of a recording; end it in .rrd
demo placement --policy best | --policy: "best" is unknown; write one of "least_loaded", "randomized", "two_choices"
demo robots --building nowhere | unknown building "nowhere"; name one of living_room, office, random:SEED, or a file
completion tcsh | SHELL: "tcsh" is unknown; write one of "bash", "zsh", "fish"
bookings x | too many arguments: "x" (see zscout bookings --help)
calendar export a b | too many arguments: "a b"
calendar import none.ics | none.ics: there is no such file; check the path
keys --json x | too many arguments: "x" (see zscout keys --help)
components 'a b' | component "a b" is not valid; use 1 to 64 of A-Z a-z 0-9 _ . -; see zscout component list
component starp counter | there is no command "starp"; did you mean start?
component ps | there is no command "ps"; use zscout component list
component kinds x | too many arguments: "x" (see zscout component kinds --help)
booking ls | there is no command "ls"; use zscout booking list
booking import none.ics | none.ics: there is no such file; check the path
node --nope | there is no option --nope (see zscout node --help)
--fleet none.toml node lab.toml | --fleet is for other commands; write fleet = "FILE" under [node] in the node file
"""
LONG: Final = {
    f"component start {'k' * 49}": "has more than 48 characters; give a shorter --name",
    "component start counter"
    + "".join(f" --label=l{number}" for number in range(33)): "33 labels are too many; give --label at most 32 times",
    "component start counter"
    + "".join(
        f" --host=h{number}" for number in range(257)
    ): "257 hosts are too many; give --host at most 256 times, or use --label",
    f"booking cancel {'x' * 65}": """x..." can't be the name of a booking; see zscout booking list""",
    f"why {'x' * 300}": """x..." can't be the name of a request; see zscout status""",
}


def test_what_a_command_can_not_use_is_one_line_and_code_2(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TZ", "Europe/Berlin")
    for name in ("ZSCOUT_FLEET", "ZSCOUT_KEYS", "ZSCOUT_CA"):
        monkeypatch.delenv(name, raising=False)
    for name, text in FILES.items():
        Path(name).write_text(text)
    rows = dict(line.split(" | ") for line in BAD.strip().splitlines()) | LONG
    for missing, calls in NEEDS_ARGUMENTS.items():
        rows |= {
            call: f"zscout: {missing} is missing (see zscout {call.split(' --')[0].removesuffix(' robot/a')} --help)"
            for call in calls
        }
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
