"""`zscout request`: wait for devices, and hold them for a time or for a command."""

from __future__ import annotations

import asyncio
import signal
import sys
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import ExitStack, asynccontextmanager, closing, contextmanager, nullcontext, suppress
from functools import partial
from typing import IO, Any, Final

import click
from click.core import ParameterSource
from msgspec.structs import replace

from zscout.behaviors.client.arc import Held
from zscout.behaviors.client.client import QUERY_TIMEOUT, Client, CommandRefused
from zscout.behaviors.client.direct import DEFAULT_SETTLE, DirectHold
from zscout.behaviors.client.hold_notices import HoldNotice
from zscout.behaviors.client.request import HoldEnd, OpenArc
from zscout.cli import common, completion
from zscout.cli.booked import BOOKING, look, next_dates
from zscout.cli.common import Failed
from zscout.cli.device_words import unwell
from zscout.cli.ownership import User, yes_option
from zscout.cli.requests.options import (
    CommandAfterDashes,
    EventFile,
    HoldOptions,
    gather,
    grace_within,
    hold_options,
    priority_option,
    tolerate_option,
)
from zscout.cli.requests.run_command import RunningCommand, environment
from zscout.cli.requests.taking_up import check_options, taking_up
from zscout.cli.requests.waiting import NeedContention, contention_of, hold_text, reason_text, request_words
from zscout.config.strict import BadInput
from zscout.mesh.supervision import done_within
from zscout.messages import Foresight, RcmState, RcState, StateAsk, version_words
from zscout.rcm.authority import Authority
from zscout.scheduling.reason import ReasonCode, kept, starting, waits
from zscout.terminal import LiveLine, clean, clock, print_json, print_line, span
from zscout.types import SECOND, VERSION, Ns

TAKEN_AWAY: Final = 75
"""EX_TEMPFAIL: the grant was taken from the command; another try may succeed."""
TIME_OVER: Final = 124
"""As of `timeout`: the command was ended because its time was over (for a kept hold: and another request waited)."""
ANSWER_TIMEOUT_S: Final = 5.0
"""With --timeout 0: time for an answer of the leader, or of the next leader."""
UNDECIDED: Final = (ReasonCode.VOTING, ReasonCode.SEARCHING)
"""Reasons of a request whose decision is still pending."""
MAX_DATES_SHOWN: Final = 8
LAST_NOTICE_TIMEOUT_S: Final = 0.5
"""Time for the RCM's notice of a hold whose time is over."""
REFRESH_INTERVAL_S: Final = 1.0
"""Shortest time between two queries of the state, and between two drawings at a terminal."""


@click.command(cls=CommandAfterDashes)
@priority_option
@click.option("--keep", is_flag=True, hidden=True, help="Has no effect: it is the default.")
@click.option("--booking", type=BOOKING, shell_complete=completion.bookings, help="Use this booking: its name or id.")
@tolerate_option
@yes_option
@click.option("--dry-run", is_flag=True, help="Only print the estimated start, and the requests to preempt.")
@partial(hold_options, needs_required=False)
@common.runs
async def request(
    needs: Any, priority: int, keep: bool, name: str | None, dry_run: bool, booking: str | None, yes: bool, **rest: Any
) -> int:
    """Wait until all of the devices are granted at once, then hold them.

    A DEVICE is kind/name; for a sharable device add its use: radio/rf0:command_rate=5,other=1. A * stands
    for any name: 'framegrabber/*' is any one framegrabber, 'robot/scout$*' any one robot whose name begins with
    scout. Write a pattern twice to get two devices, and quote it for the shell.

    Your hold is protected for the minimum runtime: until then only a request of higher priority takes the devices.
    After that you keep them until a request of equal or higher priority waits for one of them. --release-after
    releases them even if no request waits.

    With --booking the request uses a booking, with its devices, priority and time, and waits for its next date.
    Before it uses another user's booking it asks; if stdin is not a terminal, add --yes.

    With a COMMAND the devices are held while it runs, and released when none of its processes is left. When its
    time is over or the grant is taken away, the command and its processes get SIGTERM, and SIGKILL after the grace;
    also if zscout dies or hangs. The next holder waits until no process is left. --again then repeats
    request and command. Without a COMMAND the devices are held until Ctrl-C or until the time is over.

    \b
    Environment of the command:
      ZSCOUT_ARC, ZSCOUT_ARC_ID  name and id of the request
      ZSCOUT_RCS                 the devices, with spaces between
      ZSCOUT_BOUND               the device for each pattern, as JSON:
                                 {"framegrabber/*": "framegrabber/fgrab1"}
      ZSCOUT_GRANT               the grant as JSON, to send with each command
      ZSCOUT_CLIENT              the holder: <host>/<client>
      ZSCOUT_REMAINING           seconds until the minimum runtime is over
      ZSCOUT_FLEET_NAME          the fleet; ZSCOUT_FLEET its file, if there is one

    \b
    Exit code: the command's own (128 + n: ended by signal n), or
      75   the grant was taken away before its time
      124  its time was over: another request waited after the minimum runtime, or --release-after
      126  the command can't be executed  127  there is no such command
      1    not granted; without a command also: taken away    3  no leader
      2    can never be granted: an unknown device or parameter, or more than a device has
    With --infra-exit N it is N instead of 1, 2, 3, 75 and 124: all other codes are the command's own.

    With a COMMAND zscout prints to stderr only. --json-file also writes its events as JSON lines.

    \b
    Examples:
      zscout request robot/scout33 --min-runtime 2h -- sleep 7200
      zscout request robot/scout33 --release-after 5m
      zscout request robot/scout33 radio/rf0:command_rate=5 -- sh -c 'echo I hold $ZSCOUT_RCS; sleep 50'
      zscout request framegrabber/fgrab1 --timeout 30 --again -- sleep 60
      zscout request dut/board --timeout 0 --infra-exit 75 --json-file events.json -- ./test.sh
      zscout request 'framegrabber/*' 'framegrabber/*' robot/scout33 -- python3 -i
      zscout request robot/scout33 --json | jq .event
      zscout request robot/scout33 --priority 5 --dry-run
      zscout request --booking survey -- sleep 7200
      zscout request dut/board --tolerate 2m -- ./reboot-test.sh
    """
    if keep and rest["release_after"] is not None:
        raise BadInput("--keep and --release-after exclude each other; use only one of them")
    if booking is not None:
        check_options(dry_run=dry_run, **rest)
    wanted = gather(needs, name, priority=priority, keep=True, booking=booking or "", **rest)
    async with common.connected("request") as client:
        if booking is not None:
            given = click.get_current_context().get_parameter_source("priority") is not ParameterSource.DEFAULT
            wanted = await taking_up(client, wanted, name=name, priority=priority if given else None, yes=yes)
        return await (_dry_run(client, wanted) if dry_run else carry_out(client, wanted))


async def carry_out(client: Client, wanted: HoldOptions) -> int:
    """Wait, hold, run the command, release. Return the exit code. Raises Failed, RequestRefused."""
    stream = sys.stderr if wanted.command else sys.stdout
    client.who = wanted.asked_by(client.who)
    with Report(wanted.name, client, as_json=wanted.as_json, stream=stream, events=wanted.events) as report:
        client.internals.watch(report.news)
        arc: OpenArc | None = None
        while True:
            try:
                arc = await wait_for_grant(client, wanted, report, arc if arc is not None and arc.open else None)
                code = await _use(client, wanted, report, arc)
            except CommandRefused as refused:
                # A device does not know the grant; the client has released it.
                if not wanted.again:
                    lost = TAKEN_AWAY if wanted.command else 1
                    raise Failed(f"{wanted.name}: {refused}; try again", lost) from None
                report.event("lost", f"{wanted.name}: {refused}; asking again", reason=str(refused))
                arc = None
                continue
            if code is not None:
                return code


async def wait_for_grant(client: Client, wanted: HoldOptions, report: Report, arc: OpenArc | None) -> OpenArc:
    """Raises Failed if the request is not granted."""
    try:
        once = wanted.timeout == 0
        async with (
            report.following(report.follow_wait(quiet=once)),
            asyncio.timeout(ANSWER_TIMEOUT_S if once else wanted.timeout) as limit,
        ):
            if arc is None:
                arc = await client.request(
                    wanted.name,
                    wanted.needs,
                    **wanted.terms(),
                    comment=wanted.comment,
                    estimate=True,
                    direct=wanted.direct or bool(wanted.command),
                    booking=wanted.booking,
                    until_done=bool(wanted.command),
                )
            async with common.beside(_give_up_once_queued(client, arc, limit)) if once else nullcontext():
                grant = await client.granted(arc, confirmed=True)
    except (TimeoutError, asyncio.CancelledError) as error:
        reason, why = ("", "") if arc is None else (arc.reason, _reason_words(arc, client))
        if arc is not None:
            await client.end(arc)
        if isinstance(error, asyncio.CancelledError):
            report.event("ended", f"{wanted.name} is cancelled", outcome="cancelled")
            raise
        report.event("ended", "", outcome="timeout", reason=reason)
        if once and arc is None:
            raise common.NobodyThere(f"the leader of fleet {client.fleet.name} did not answer; try again") from None
        within = "at once" if once else f"within {span(wanted.timeout or 0)}"
        line = f"{wanted.name} was not granted {within}, and is cancelled"
        raise Failed(f"{line}: {why}" if why else line) from None
    if grant is None:
        report.event("ended", "", outcome=arc.outcome, reason=arc.reason)
        raise Failed(f"{wanted.name} was not granted: {arc.reason or arc.outcome}")
    return arc


async def _give_up_once_queued(client: Client, arc: OpenArc, limit: asyncio.Timeout) -> None:
    """Let `limit` pass as soon as the leader has decided that `arc` waits."""
    loop = asyncio.get_running_loop()
    while arc.state != "queued" or _undecided(arc):
        limit.reschedule(None if arc.state == "running" else loop.time() + ANSWER_TIMEOUT_S)
        await client.changed(arc)
    limit.reschedule(loop.time())


async def _use(client: Client, wanted: HoldOptions, report: Report, arc: OpenArc) -> int | None:
    """Use the grant. Return the exit code; None: it was taken away, and must be waited for again."""
    grant = arc.grant
    if grant is None:  # taken away since the RCs confirmed it
        return await _after_loss(client, wanted, report, arc)
    held = Held(client, arc, grant)
    rcs, left, longest = held_text(held), held.remaining, client.fleet.scheduling.max_runtime
    details = {"id": arc.id, "rcs": held.rcs, "bound": held.bound, "keep": arc.keep}
    details |= {"grant": grant, "remaining": round(left, 3)}
    yours = _yours(arc, left, longest, cut=_is_cut(client, arc, left))
    report.event("granted", f"{arc.name} holds {rcs}: {yours}", **details)
    try:
        code = None
        if wanted.tolerate is not None:
            await tolerate(wanted.tolerate, report, held)
        with reporting_unwell(report, held, client):
            if wanted.command:
                code = await _run(wanted, report, held, client)
            else:
                with _never_suspended(report):
                    noticing = report_notices(report, held, client)
                    async with report.following(report.follow_hold(arc)), common.beside(noticing):
                        await held.over()
    except BaseException:
        await client.end(arc)
        report.event("ended", f"{arc.name} gave back {rcs}", outcome="released")
        raise
    if code is not None:
        await client.end(arc)
        report.event("ended", f"{arc.name} gave back {rcs}", outcome="released", code=code)
        return code
    if held.active:
        # By this host's clock its time is over; wait for the RCM's notice.
        await common.until(lambda: not held.active, report.changed, LAST_NOTICE_TIMEOUT_S)
    ending = ending_of(arc)
    if held.active or ending.outcome == "completed":
        why = ending.reason if arc.keep else "its time is over"
        ended_by_hand = arc.why is not None and arc.why.code == "released"
        again = wanted.again and arc.keep and not ended_by_hand
        line = f"the time of {arc.name} is over" + (f": {why}" if arc.keep else "")
        details = {"outcome": "completed", "reason": why, "by": ending.by, "again": again}
        arc._finish("completed", why, client.mesh.now())
        report.event("ended", f"{line}; asking again" if again else line, **details)
        if again:
            return None
        return wanted.own_code(TIME_OVER) if wanted.command else 0
    return await _after_loss(client, wanted, report, arc)


async def tolerate(seconds: float, report: Report, held: Held) -> None:
    tolerated = await held.expect_outage(seconds, each=True)
    if less := {rc: most for rc, most in tolerated.items() if most < seconds}:
        words = ", ".join(f"{rc} tolerates {span(most) if most else 'no outage'}" for rc, most in less.items())
        report.event("tolerate", f"--tolerate {span(seconds)} is more than the devices allow: {words}", tolerated=less)


@contextmanager
def reporting_unwell(report: Report, held: Held, client: Client) -> Iterator[None]:
    """Report when a held device stops working, and when it works again."""
    keys, sick = client.mesh.keys, set[str]()

    def published(key: str, state: RcState) -> None:
        ours = keys.rc_of(key) == state.rc and any(holder.grant == held.grant for holder in state.holders)
        if not ours or state.health != "ok" or (state.unwell is not None) is (state.rc in sick):
            return
        sick.symmetric_difference_update({state.rc})
        if state.unwell is not None:
            details = {"reason": state.unwell.why, "left": round(state.unwell.left, 3)}
            report.event("unwell", clean(f"{state.rc} is {unwell(state)}"), rc=state.rc, **details)
        else:
            report.event("well", f"{state.rc} is well again", rc=state.rc)

    with ExitStack() as stack:
        for rc in held.rcs:
            stack.enter_context(closing(client.mesh.subscribe(keys.rc_state(rc), RcState, published)))
        yield


async def _report_dates(report: Report, held: Held, client: Client) -> None:
    dates = next_dates(await look(client), held.rcs, f"{client.mesh.me}/{held.arc.id}")
    if dates:
        lines = "\n  ".join(map(str, dates[:MAX_DATES_SHOWN]))
        report.event("dates", f"{held.arc.name}: {lines}", dates=[date._asdict() for date in dates])


async def report_notices(
    report: Report, held: Held, client: Client, noticed: Callable[[HoldNotice, str], object] = lambda *_: None
) -> None:
    """Report the next booking of each device, and notices until the hold is over; `noticed` gets each in words too."""
    async with common.beside(_report_dates(report, held, client)):
        await _report_each(report, held, User.of(client), noticed)


async def _report_each(report: Report, held: Held, me: User, noticed: Callable[[HoldNotice, str], object]) -> None:
    while (notice := await held.noticed()) is not None:
        now, by = held.now(), notice.by
        words = request_words(by.arc, by.who, by.client, me=me if notice.code == "waits" else None)
        details: dict[str, Any] = {"code": notice.code, "withdrawn": notice.withdrawn, "by": by}
        details |= {"rcs": notice.rcs, "safe": round(max(0, notice.safe_until - now) / SECOND, 3)}
        if notice.begins is not None:
            details["begins_in"] = round((notice.begins - now) / SECOND, 3)
        text = f"{held.arc.name}: {clean(notice.text(now, clock, words))}"
        report.event("notice", text, **details)
        noticed(notice, text)


@contextmanager
def _never_suspended(report: Report) -> Iterator[None]:
    """Ignore Ctrl-Z: a suspended client can't confirm its holds, and loses them."""
    loop, text = asyncio.get_running_loop(), "not suspended: it would lose what it holds"
    loop.add_signal_handler(signal.SIGTSTP, report.event, "not_suspended", text)
    try:
        yield
    finally:
        loop.remove_signal_handler(signal.SIGTSTP)


async def _run(wanted: HoldOptions, report: Report, held: Held, client: Client) -> int | None:
    """Return its exit code; None: the hold is over, and the command was ended."""
    direct, program = client.internals.direct_hold(held.grant), wanted.command[0]
    until = direct.sure_until if direct is not None else None
    command = RunningCommand(wanted.command, environment(held, client), _grace(wanted, report, direct), until)

    def follow(hold: DirectHold) -> None:
        command.hold_until(hold.sure_until)
        if hold.ended_at is not None:
            command.terminate(hold.ended_at)

    try:
        noticing = report_notices(report, held, client, partial(_signal, command, wanted.notify_signal))
        async with command, common.beside(_warn_not_settling(report, held, client, direct)), common.beside(noticing):
            if direct is not None:
                direct.watch(follow)
                follow(direct)
            _, ended = await common.first_of(held.over(), command.wait())
            if ended and command.why_ended not in ("client", "deadline"):
                if held.active:
                    await client.end(held.arc)
                return await command.wait()
            why = "its time is over" if held.active else ending_of(held.arc).reason or "the grant is gone"
            report.event("stopping", f"{program} is stopped: {why}", reason=why)
    finally:
        if direct is not None and command.gone:
            direct.returned()
    if command.why_ended == "deadline" and held.active and not held.completed:
        # This process was stalled at the deadline, and has not checked its hold since.
        await common.until(lambda: not held.active, report.changed, LAST_NOTICE_TIMEOUT_S)
        if held.active:
            await client.end(held.arc)
    return None


def _signal(command: RunningCommand, number: int | None, notice: HoldNotice, _text: str) -> None:
    if number is not None and not notice.withdrawn:
        command.signal(number)


async def _warn_not_settling(report: Report, held: Held, client: Client, direct: DirectHold | None) -> None:
    """Warn of an old leader or old devices, which don't let the next holder wait until the command has ended."""
    key, asked = client.mesh.keys.ask_state(client.mesh.me), StateAsk(holds_only=True)
    reply = await client.mesh.ask_one(key, asked, RcmState, timeout=QUERY_TIMEOUT)
    state, who = reply.message if reply is not None else None, [] if direct is None else direct.never_settle
    if state is not None and any(hold.grant == held.grant and not hold.direct for hold in state.holds):
        who = [f"the leader at {state.host} ({version_words(state.version)}, this is {VERSION})", *who]
    if who:
        text = f"the next holder may begin before the command is gone: {', '.join(who)} can't make it wait; upgrade"
        report.event("not_settling", text, who=who)


def _grace(wanted: HoldOptions, report: Report, direct: DirectHold | None) -> float:
    """Return the seconds from SIGTERM to SIGKILL, at most those for which the RCs settle."""
    most = float((direct.grace if direct is not None else DEFAULT_SETTLE) / SECOND)
    grace, text = grace_within(wanted.grace, most)
    if text:
        report.event("grace", text, asked=float(wanted.grace or 0), grace=grace)
    return grace


async def _after_loss(client: Client, wanted: HoldOptions, report: Report, arc: OpenArc) -> int | None:
    """Return the exit code, or None to wait again. Raises Failed with neither a command nor --again."""
    ending = ending_of(arc)
    # A hold that lost an RC after its minimum runtime is not queued again.
    again = wanted.again and (arc.open or ending.outcome == "lost")
    line = f"{arc.name} lost its grant: {ending.reason or ending.outcome}"
    details = {"outcome": ending.outcome, "reason": ending.reason, "by": ending.by, "again": again}
    if again:
        report.event("taken", f"{line}; waiting again", **details)
        return None
    report.event("taken", line if wanted.command else "", **details)
    if arc.open:
        await client.end(arc)
    if wanted.command:
        return wanted.own_code(TAKEN_AWAY)
    raise Failed(f"{line}; ask again{', or with a higher priority' if ending.outcome == 'preempted' else ''}")


def _is_cut(client: Client, arc: OpenArc, left: float) -> bool:
    """Return True if a hold for a command is protected for less time than usual: its devices are needed then."""
    usual = Authority(client.fleet).until_done(client.mesh.me.host, round(arc.min_runtime * SECOND))
    return arc.until_done and left + 1 < usual / SECOND


def _yours(arc: OpenArc, left: float, longest: Ns | None, *, cut: bool = False) -> str:
    """Words for how long a hold lasts: protected for `left` seconds, at most `longest` in all (the fleet's limit)."""
    continues = arc.keep and (longest is None or max(float(arc.min_runtime), round(left)) * SECOND < longest)
    then = _kept(longest, arc.priority) if continues else "given back"
    cause = ", when it is booked or reserved" if cut else ""
    return f"yours for {span(left)} (until {clock(left)}{cause}), then {then}"


def _kept(longest: Ns | None, priority: int) -> str:
    return kept(priority) if longest is None else f"{kept(priority)}, {span(longest / SECOND)} in all at most"


def ending_of(arc: OpenArc) -> HoldEnd:
    return arc._ending or HoldEnd("lost", "")


async def _dry_run(client: Client, wanted: HoldOptions) -> int:
    """Print the estimated start, and the requests that it would preempt now. Return 1 if no start can be estimated.
    Raises RequestRefused, NobodyThere."""
    predicted = await client.foresee(wanted.name, wanted.needs, **wanted.terms())
    if predicted is None:
        raise common.NobodyThere(f"the leader of fleet {client.fleet.name} did not answer; try again")
    dates = next_dates(await look(client), wanted.needs)
    if wanted.as_json:
        found = {
            name: getattr(predicted, name)
            for name in ("starts_in", "begin_within", "preempts", "victims", "reason", "why")
        }
        print_json({"arc": wanted.name, **found, "dates": [date._asdict() for date in dates]})
    else:
        for line in (*_words(predicted, User.of(client)), *map(str, dates[:MAX_DATES_SHOWN])):
            print_line(clean(line))
    return 0 if predicted.starts_in is not None else wanted.own_code(1)


def _words(predicted: Foresight, me: User) -> Iterator[str]:
    reason, start = reason_text(predicted.reason, predicted.why, me=me), predicted.starts_in
    if start is None:
        yield f"{predicted.arc} would wait, and no start can be estimated: {reason}"
    elif reason:
        yield f"{predicted.arc} would start at {clock(start)} (in {span(start)}), if nothing else comes"
        yield f"until then: {reason}"
    else:
        yield f"{predicted.arc} would start at once"
    if start is not None and predicted.begin_within:
        yield f"then it is {starting(predicted.begin_within)}"
    if predicted.preempts:
        victims = [request_words(victim.arc, victim.who, victim.client, me=me) for victim in predicted.victims]
        yield f"it would preempt {', '.join(victims or predicted.preempts)}"


class Report(LiveLine):
    """Reports one request of a client on `stream`: a live line at a terminal, plain lines in a pipe, or JSON lines."""

    def __init__(
        self, name: str, client: Client, *, as_json: bool, stream: IO[str], events: EventFile | None = None
    ) -> None:
        super().__init__(stream, shown=not as_json)
        self._name, self._client, self._as_json, self._events = name, client, as_json, events
        self._mesh = client.mesh
        self._arc: OpenArc | None = None
        self.changed = asyncio.Event()
        self._printed: tuple[str, str, int | None] | None = None
        """State, reason and place in the queue by the last line that stays."""
        self._settling: object = None
        """The grant whose start was reported."""
        self._state: RcmState | None = None
        """The state at `_fetched_at`, when `_fetched_for` was the newest notice."""
        self._fetched_at: Ns | None = None
        self._fetched_for: object = None

    def event(self, kind: str, text: str, /, **details: Any) -> None:
        """Report an event: `text` for people (empty: no line), the rest for programs."""
        event = {"event": kind, "arc": self._name, "client": str(self._mesh.me)} | details
        if self._events is not None:
            self._events.write(event)
        # A closed stderr must not change the command or its exit code.
        with suppress(OSError) if self._stream is sys.stderr else nullcontext():
            if self._as_json:
                print_json(event, self._stream)
            elif text:
                self.print(text)

    def news(self, arc: OpenArc) -> None:
        self._arc = arc
        self.changed.set()

    @asynccontextmanager
    async def following(self, follow: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
        """Run `follow_wait` or `follow_hold` while the context is open."""
        try:
            async with common.beside(follow):
                yield
        finally:
            self.hide()

    async def follow_wait(self, *, quiet: bool = False) -> None:
        """`quiet`: as events only, since an error will name the reason."""
        self._printed = None
        while True:
            if self._fetched_at is not None and self._arc is not None and self._arc.state == "queued":
                # One query per interval: many notices may come at once.
                await asyncio.sleep(REFRESH_INTERVAL_S - (self._mesh.now() - self._fetched_at) / SECOND)
            self.changed.clear()
            arc = self._arc
            if arc is None:
                self.draw(f"{self._name}: asking the leader")
            elif arc.state == "running" and (arc._settling == arc.grant or arc.ready is not None):
                self._show_settling(arc)
            elif arc.state in ("asking", "queued") and arc.reason:
                if not self.watched and _undecided(arc) and await done_within(REFRESH_INTERVAL_S, self.changed.wait()):
                    continue  # a decision came within the interval
                news = arc._last != self._fetched_for if self.watched else _how(arc) != self._printed
                if arc.state == "queued" and news:
                    self._fetched_at, self._fetched_for = self._mesh.now(), arc._last
                    self._state = await self._client.state()
                if arc.state in ("asking", "queued"):
                    self._show_wait(arc, quiet=quiet)
            await done_within(REFRESH_INTERVAL_S if self.watched else None, self.changed.wait())

    async def follow_hold(self, arc: OpenArc) -> None:
        """Show the rest of a hold without a command, until cancelled."""
        longest = self._client.fleet.scheduling.max_runtime
        while True:
            self.changed.clear()
            now = self._mesh.now()
            left = (arc.end - now) / SECOND
            protected = left > 0 or not arc.keep
            rest = (
                _yours(arc, left, longest)
                if protected
                else f"for {span(self._since(arc))}, {_kept(longest, arc.priority)}"
            )
            rest = rest if arc.ready is None else starting((arc.ready - now) / SECOND)
            self.draw(f"{arc.name} holds {held_text(arc)}: {rest}\n  Ctrl-C gives back")
            await done_within(REFRESH_INTERVAL_S if self.watched else None, self.changed.wait())

    def _show_wait(self, arc: OpenArc, *, quiet: bool) -> None:
        now, start, starts_in, me = self._mesh.now(), "", None, User.of(self._client)
        needs: list[NeedContention] = []
        if arc.start is not None:
            starts_in = round(max(0, arc.start - now) / SECOND, 3)
        if arc.state == "queued":
            start = "no start can be estimated"
            if starts_in is not None:
                start = f"starts at {clock(starts_in)} (in {span(starts_in)})"
            if self._state is not None and self._fetched_at is not None:
                # The state now, if nothing has happened since it was fetched.
                past = (now - self._fetched_at) / SECOND
                holds = [
                    replace(hold, held=hold.held + past, remaining=hold.remaining - past) for hold in self._state.holds
                ]
                needs = contention_of(replace(self._state, holds=holds), arc.needs, f"{self._mesh.me}/{arc.id}")
        # Holders of a sharable RC are not in the way unless the reason names the RC. An RC that meets two patterns is
        # listed once.
        met = {rc.rc: rc for need in needs if need.rc or not need.met for rc in need.rcs if rc.holds}
        in_way = [rc for rc in met.values() if not rc.sharable or (arc.why and rc.rc in arc.why.rcs)]
        holders = [f"{rc.rc}: {'; '.join(hold_text(hold, arc.priority, me) for hold in rc.holds)}" for rc in in_way]
        holders += [f"{rc.rc}: {rc.lost}" for need in needs if need.rc for rc in need.rcs if rc.lost]
        words = f"{arc.name} {waits(_reason_words(arc, self._client), arc.why)}"
        ahead = f"{arc.ahead} ahead" if arc.ahead else ""
        waited = self._since(arc)
        since = ", ".join(filter(None, (f"waits since {clock(-waited)} ({span(waited)})", ahead, start)))
        self.draw("\n  ".join([words, since, *holders]))
        # The estimate is no reason for a new line: it changes all the time.
        if self.watched or self._printed == _how(arc):
            return
        before, self._printed = self._printed, _how(arc)
        if before is not None and before[:2] == self._printed[:2]:  # one line for each reason
            words, ahead = f"{arc.name} waits: {ahead or 'nobody ahead'}", ""
        text = "" if quiet else "; ".join(filter(None, (words, ahead, start)))
        contention = [need.as_json() for need in needs]
        self.event(
            "waits",
            text,
            id=arc.id,
            reason=arc.reason,
            why=arc.why,
            ahead=arc.ahead,
            starts_in=starts_in,
            needs=contention,
        )

    def _show_settling(self, arc: OpenArc) -> None:
        ready_in = None if arc.ready is None else round(max(0, arc.ready - self._mesh.now()) / SECOND, 3)
        why = arc.reason if ready_in is None else starting(ready_in)
        self.draw(f"{arc.name} is granted {held_text(arc)}, and waits {span(self._since(arc))}: {why}")
        if self._settling != arc.grant:
            self._settling, self._printed = arc.grant, None
            text = "" if self.watched else f"{arc.name} is granted {held_text(arc)}, and waits: {why}"
            details = {"grant": arc.grant, "reason": why, "ready_in": ready_in}
            self.event("settling", text, id=arc.id, rcs=arc.rcs, **details)

    def _since(self, arc: OpenArc) -> float:
        return (self._mesh.now() - arc.since) / SECOND


def _how(arc: OpenArc) -> tuple[str, str, int | None]:
    return arc.state, arc.reason, arc.ahead


def _reason_words(arc: OpenArc, client: Client) -> str:
    return reason_text(arc.reason, arc.why, (client.mesh.now() - arc._notified_at) / SECOND, User.of(client))


def _undecided(arc: OpenArc) -> bool:
    return arc.why is not None and arc.why.code in UNDECIDED


def held_text(held: OpenArc | Held) -> str:
    """Held devices with the patterns that they meet: `framegrabber/fgrab1 for framegrabber/*, robot/a`."""
    met = {rc: need for need, rc in held.bound.items()}
    return ", ".join(f"{rc} for {met[rc]}" if rc in met else rc for rc in sorted(held.rcs))
