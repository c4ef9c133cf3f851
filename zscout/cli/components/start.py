"""`zscout component start` and `zscout component stop`."""

from __future__ import annotations

import asyncio
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from decimal import Decimal
from typing import Any, Final

import click
import msgspec

from zscout import terminal
from zscout.behaviors.client.placer_client import PlacerClient
from zscout.behaviors.client.request import RequestRefused
from zscout.cli import common, completion
from zscout.cli.components import placing
from zscout.cli.ownership import yes_option
from zscout.cli.requests.options import timeout_option
from zscout.config.strict import BadInput, quoted
from zscout.messages import (
    MAX_COMPONENT_NAME,
    MAX_LABELS,
    MAX_PARAMS_SIZE,
    MAX_RANKED,
    ComponentSpec,
    EndComponent,
    PlaceComponent,
    Placement,
)
from zscout.types import METRICS, POLICIES

MAX_BYTES: Final = 1 << 60
MAX_CORES: Final = 1_000_000
BAD_JSON: Final = (msgspec.MsgspecError, ValueError, RecursionError)

_SIZE: Final = re.compile(r"([0-9]{1,19}(?:\.[0-9]{1,6})?)([KMGT]?)i?B?", re.IGNORECASE)
_POWERS: Final = {"": 0, "K": 10, "M": 20, "G": 30, "T": 40}


def parse_cores(text: str, what: str) -> float:
    """Parse a number of cores: `0.5`, `2`. Raises BadInput."""
    cores = 0.0
    with suppress(ValueError):
        cores = float(text)
    if not 0 < cores <= MAX_CORES:
        raise BadInput(f"{what}: {quoted(text)} is not a number of cores; write one, as in 0.5 or 2")
    return cores


def parse_size(text: str, what: str) -> int:
    """Parse a size in bytes: `500M`, `1.5G`, `1048576`. K, M, G, T are powers of 1024. Raises BadInput."""
    found = _SIZE.fullmatch(text)
    size = int(Decimal(found[1]) * (1 << _POWERS[found[2].upper()])) if found else 0
    if not 0 < size <= MAX_BYTES:
        raise BadInput(f"{what}: {quoted(text)} is not a size; write bytes, or with a unit: 500M, 1.5G")
    return size


SIZE: Final = common.Parsed("size", parse_size)
CORES: Final = common.Parsed("cores", parse_cores)


def gather_params(given: str | None, settings: Sequence[str]) -> dict[str, Any]:
    """A JSON object, overridden by `KEY=VALUE` settings. A VALUE that is not JSON is a text. Raises BadInput."""
    params: dict[str, Any] = {}
    if given is not None:
        try:
            params = msgspec.json.decode(given, type=dict[str, Any])
        except BAD_JSON:
            raise BadInput(f'--params: {quoted(given)} is not a JSON object; write one, as in {{"a": 1}}') from None
    seen: set[str] = set()
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not key or not equals:
            raise BadInput(f"--set: {quoted(setting)} has no value; write KEY=VALUE")
        if key in seen:
            raise BadInput(f"--set: {quoted(key)} is given twice; give it once")
        seen.add(key)
        try:
            params[key] = msgspec.json.decode(value)
        except BAD_JSON:
            params[key] = value
    try:
        size = len(msgspec.json.encode(params))
    except BAD_JSON:
        raise BadInput("the parameters can't be written as JSON; change --set or --params") from None
    if size > MAX_PARAMS_SIZE:
        raise BadInput(f"the parameters have {size} bytes as JSON; at most {MAX_PARAMS_SIZE} are allowed")
    return params


@click.command(context_settings={"show_default": False})
@click.argument("kind", type=common.NAME, shell_complete=completion.kinds)
@click.option("--name", metavar="NAME", type=common.NAME, help="Name of the component. Default: its kind.")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set a parameter; VALUE may be JSON.")
@click.option("--params", metavar="JSON", help="All parameters, as a JSON object.")
@placing.host_option("--host", "Run only on this host; repeat it for several.", multiple=True)
@click.option("--label", metavar="LABEL", type=common.NAME, multiple=True, help="A label that its host must have.")
@click.option("--memory", type=SIZE, default=0, help="Memory that its host must have available, as in 500M.")
@click.option("--metric", type=click.Choice(METRICS), default="composite", help="Compare hosts by this figure.")
@click.option("--policy", type=click.Choice(POLICIES), default="pending", help="Choose the host by this policy.")
@click.option(
    "--restart",
    type=click.Choice(["never", "on-failure", "always"]),
    default="on-failure",
    show_default=True,
    help="When to restart it after it ended.",
)
@click.option("--memory-limit", type=SIZE, default=0, help="Limit its memory, as in 500M.")
@click.option("--cpu-limit", type=CORES, help="Limit the cores it uses, as in 0.5.")
@click.option("--no-wait", is_flag=True, help="Don't wait until it runs.")
@timeout_option("Wait this long until it runs, then exit with 1.")
@common.json_option("Print one JSON object.")
@common.runs
async def start(
    kind: str, name: str | None, no_wait: bool, timeout: float | None, as_json: bool, **wanted: Any
) -> None:
    """Run a component on the best host of the fleet, and keep it running.

    KIND is the name of a kind that is installed on a host: see zscout component kinds. The component stays placed when
    this command ends, also by Ctrl-C or --timeout: it starts as soon as a host can run it, and on another host when its
    host dies, until zscout component stop. Starting it again with the same settings does not start it twice.

    \b
    Exit code: 0 it runs, or has completed; 1 it was refused or given up, or did not run
    in time; 3 no leader. If it is given up, its last output is printed on stderr.

    \b
    Examples:
      zscout component start counter
      zscout component start counter --name blue --set rc=robot/scout33 --set period=0.5
      zscout component start spin --params '{"cpu": 0.5}' --label gpu --memory 2G --cpu-limit 1
      zscout component start counter --host anvil --restart never --timeout 30
    """
    name = kind if name is None else name
    if len(name) > MAX_COMPONENT_NAME:
        raise BadInput(f"the name {quoted(name)} has more than {MAX_COMPONENT_NAME} characters; give a shorter --name")
    spec = gather_spec(kind, **wanted)
    stays = f"{name} stays placed; to end it: zscout component stop {name}"
    async with placing.connected("start", {name}, as_json=as_json) as (_, shown, placer):

        def late() -> str:
            record = placer.placements.get(name)
            now = f" {placing.state_words(record)};" if record is not None else ""
            return f"{name} does not run after {terminal.span(timeout or 0)}:{now} {stays}"

        before = placer.placements.get(name)
        if before is None or before.state in placing.OVER:
            await placing.check_kind(placer.mesh, kind)
            for line in await placing.absent(placer.mesh, spec.hosts or ()):
                terminal.print_line(f"zscout: {line}", sys.stderr)
        placement = await _place(placer, name, spec, before)
        if not no_wait:
            async with shown.within(timeout, late, stays):
                placement = await _until_settled(placer, shown, name, spec)
    if as_json:
        terminal.print_json(placing.placement_object(placement))
    if placement.state == "given_up" or (placement.state == "ended" and not placement.wanted):
        for line in placing.tail_of(placement):
            terminal.print_line(line, sys.stderr)
        raise common.Failed(f"{name} {placing.state_words(placement)}; {placing.remedy(placement)}")
    ran = before is not None and before.state == placement.state == "running"
    shown.finish(f"{name} {'already ' if ran else ''}{placing.state_words(placement)}")


def gather_spec(
    kind: str,
    *,
    settings: Sequence[str],
    params: str | None,
    host: Sequence[str],
    label: Sequence[str],
    restart: str,
    cpu_limit: float | None,
    **same: Any,
) -> ComponentSpec:
    """Check the options of `start`, and return the spec to send. Raises BadInput."""
    # Sorted, as the placer lists them.
    hosts, labels = sorted(set(host)), sorted(set(label))
    if len(hosts) > MAX_RANKED:
        raise BadInput(f"{len(hosts)} hosts are too many; give --host at most {MAX_RANKED} times, or use --label")
    if len(labels) > MAX_LABELS:
        raise BadInput(f"{len(labels)} labels are too many; give --label at most {MAX_LABELS} times")
    given: Any = {"params": gather_params(params, settings), "restart": restart.replace("-", "_")}
    return ComponentSpec(kind=kind, labels=labels, hosts=hosts or None, cpu_limit=cpu_limit or 0.0, **given, **same)


async def _place(placer: PlacerClient, name: str, spec: ComponentSpec, before: Placement | None) -> Placement:
    """Does not wait until it runs. Raises Failed."""
    known = before.incarnation if before is not None else 0

    def done(record: Placement) -> bool:
        return record.spec == spec and (record.state not in placing.OVER or record.incarnation > known)

    try:
        return await placer.request_once(PlaceComponent(name, spec, wait=0.0), done)
    except RequestRefused as refused:
        if refused.code != "exists":
            raise
        raise common.Failed(
            f"{name} already exists with another kind or other settings; give another --name, "
            f"or stop the existing component first: zscout component stop {name}"
        ) from None


async def _until_settled(placer: PlacerClient, shown: placing.Progress, name: str, spec: ComponentSpec) -> Placement:
    """Show the progress until the component runs or is over. Raises Failed."""
    while True:
        placement = placer.placements.get(name)
        if placement is None:
            # A new placer does not know the component yet. Placing it again does not start it twice.
            placement = await _place(placer, name, spec, None)
        if placement.state == "running" or placement.state in placing.OVER:
            return placement
        shown.update(f"{name} {placing.state_words(placement)}")
        await placer.wait_changed()


@click.command()
@click.argument(
    "names", type=placing.COMPONENT, nargs=-1, required=True, metavar="NAME...", shell_complete=completion.components
)
@timeout_option("Wait this long for the end, then exit with 1.")
@yes_option
@common.json_option("Print one JSON object.")
@common.runs
async def stop(names: Sequence[str], timeout: float | None, yes: bool, as_json: bool) -> None:
    """End components for good: ask each to end, and kill it if it does not.

    Returns when all have ended and their devices are released. A component that has already ended is no error. In a
    secured fleet the command asks before it stops another user's component; if stdin is not a terminal, add --yes.

    \b
    Examples:
      zscout component stop counter
      zscout component stop blue green --timeout 10
    """
    names = sorted(set(names))
    stays = f"stopping {', '.join(names)} continues; see zscout component list"
    async with placing.connected("stop", names, as_json=as_json) as (client, shown, placer):
        await placing.ask_for_others(client, placer, names, "stop", yes=yes)
        refused_names = set[str]()

        def lasting() -> str:
            records = (placer.placements.get(name) for name in names if name not in refused_names)
            running = (record for record in records if record and record.state not in placing.OVER)
            return "; ".join(f"{record.component} {placing.state_words(record)}" for record in running)

        def late() -> str:
            return f"after {terminal.span(timeout or 0)} {lasting()}; {stays}"

        async with shown.within(timeout, late, stays):
            ends = await asyncio.gather(*(_end(placer, name) for name in names), return_exceptions=True)
            refused_names |= {name for name, end in zip(names, ends, strict=True) if isinstance(end, BaseException)}
            while words := lasting():
                shown.update(words)
                await placer.wait_changed()
        last = {end.component: end for end in ends if isinstance(end, Placement)}
        last |= {name: record for name, record in placer.placements.items() if name in last}
    if as_json:
        terminal.print_json({"components": [placing.placement_object(record) for record in last.values()]})
    for record in last.values():
        shown.finish(f"{record.component} {placing.state_words(record)}")
    failures = [end for end in ends if isinstance(end, BaseException)]
    # Usually all failures are of one class. Unexpected exceptions come first: they are raised as they are.
    known = (common.Failed, RequestRefused)
    failures.sort(key=lambda failure: isinstance(failure, known))
    if len(failures) > 1 and isinstance(failures[0], known):
        raise common.Failed("; ".join(map(str, failures)))
    if failures:
        raise failures[0]


async def _end(placer: PlacerClient, name: str) -> Placement:
    try:
        return await placer.request_once(EndComponent(name, wait=0.0), lambda record: not record.wanted)
    except RequestRefused as refused:
        if refused.code != "unknown_component":
            raise
    raise await placing.unknown_here(placer, name)
