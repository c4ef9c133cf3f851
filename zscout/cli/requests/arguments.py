"""What people write on the command line, read strictly: durations, and needs with their parameters."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from typing import Any, Final

import click
from click.shell_completion import CompletionItem

from zscout import types
from zscout.config.strict import BadInput, quoted
from zscout.keyexpr import BadName, check_name, check_need, is_pattern
from zscout.messages import MAX_NEEDS, MAX_PARAMS
from zscout.scheduling.model import check_patterns

Needs = dict[str, dict[str, Decimal]]

_NUMBER: Final = re.compile(r"[0-9]{1,19}(\.[0-9]{1,18})?|\.[0-9]{1,18}")
_UNITS: Final = {
    "": Decimal(1),
    "s": Decimal(1),
    "ms": Decimal("0.001"),
    "m": Decimal(60),
    "h": Decimal(3600),
}


class Duration(click.ParamType[Decimal]):
    """A duration in seconds from `5`, `1.5`, `300ms`, `2m` or `1h`."""

    name = "duration"

    def __init__(self, *, zero: bool = False) -> None:
        self._zero = zero

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Decimal:
        if isinstance(value, Decimal):
            return value
        what = param.opts[0] if param is not None else "duration"
        return parse_duration(str(value), what, zero=self._zero)


class Need(click.ParamType[tuple[str, dict[str, Decimal]]]):
    """An RC or a pattern, and how it will be used."""

    name = "need"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, dict[str, Decimal]]:
        if isinstance(value, tuple):
            return value
        try:
            return parse_need(str(value))
        except BadInput as error:
            if "/" not in str(value) and ctx is not None and not ctx.meta.get("command"):
                raise BadInput(f"{error}; a command goes after --") from None
            raise


class RcName(click.ParamType[str]):
    """An RC of one kind: `robot/scout33`, or `scout33` alone; with `pattern` also `robot/*`. Tab offers those
    on the mesh."""

    name = "rc"

    def __init__(self, kind: str, *, pattern: bool = False) -> None:
        self._kind, self._pattern = kind, pattern

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        text = str(value)
        rc = text if "/" in text else f"{self._kind}/{text}"
        if rc.partition("/")[0] != self._kind or (is_pattern(rc) and not self._pattern):
            raise BadInput(f"{quoted(text)} is no {self._kind}; name one, as in {self._kind}/NAME")
        try:
            check_need(rc)
        except BadName as error:
            raise BadInput(str(error)) from None
        return rc

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        from zscout.cli.completions import rcs

        return [CompletionItem(rc) for rc in rcs(ctx, self._kind) if rc.startswith(incomplete)]


def parse_duration(text: str, what: str, *, zero: bool = False) -> Decimal:
    """Seconds from `5`, `1.5`, `300ms`, `2m` or `1h`. Raises BadInput."""
    remedy = "write a number of seconds, or with a unit: 1.5, 300ms, 2m, 1h"
    number = text.rstrip("hms")
    unit = text[len(number) :]
    if _NUMBER.fullmatch(number) is None or unit not in _UNITS:
        raise BadInput(f"{what}: {quoted(text)} is not a duration; {remedy}")
    seconds = Decimal(number) * _UNITS[unit]
    if zero and seconds == 0:
        return seconds
    try:
        types.duration(seconds, what)
    except ValueError as error:
        raise BadInput(f"{error}; {remedy}") from None
    return seconds


def parse_need(text: str) -> tuple[str, dict[str, Decimal]]:
    """`robot/scout33`, a pattern such as `framegrabber/*`, or with bandwidth parameters
    `radio/rf0:command_rate=5,other=1`. Raises BadInput."""
    rc, colon, rest = text.partition(":")
    try:
        check_need(rc)
    except BadName as error:
        raise BadInput(f"need {quoted(text)}: {error}") from None
    params: dict[str, Decimal] = {}
    for part in rest.split(",") if colon else []:
        name, equals, number = part.partition("=")
        remedy = f"write parameter=number, as in {rc}:command_rate=5"
        try:
            check_name(name, "parameter")
        except BadName as error:
            raise BadInput(f"need {quoted(text)}: {error}; {remedy}") from None
        if name in params:
            raise BadInput(f"need {quoted(text)}: {name} is given twice; give it once")
        if _NUMBER.fullmatch(number) is None:
            found = f"is {quoted(number)}" if equals else "has no number"
            raise BadInput(f"need {quoted(text)}: {name} {found}; {remedy}")
        params[name] = Decimal(number)
    if len(params) > MAX_PARAMS:
        raise BadInput(f"need {quoted(text)}: {len(params)} parameters; at most {MAX_PARAMS} are allowed")
    try:
        types.exact_amounts(params)
    except ValueError as error:
        raise BadInput(f"need {quoted(text)}: {error}") from None
    return rc, params


def gather_needs(pairs: Sequence[tuple[str, dict[str, Decimal]]]) -> Needs:
    """The needs of one ARC; a pattern that comes again is numbered: `framegrabber/*#2` is the second.

    Raises BadInput where there are too many, one RC is named twice, or patterns contradict each other."""
    if len(pairs) > MAX_NEEDS:
        raise BadInput(f"{len(pairs)} RCs; at most {MAX_NEEDS} are allowed in one request")
    needs: Needs = {}
    # Numbers that are written out are not given to others.
    written = {need for need, _ in pairs}
    for need, params in pairs:
        name = need
        if need in needs:
            if not is_pattern(need):
                raise BadInput(
                    f"{need} is named twice; name each RC once, all its parameters after one colon"
                )
            if "#" in need:
                raise BadInput(f"{need} is named twice; leave the numbers out, and they are given")
            numbered = (f"{need}#{number}" for number in range(2, MAX_NEEDS + 2))
            name = next(one for one in numbered if one not in needs and one not in written)
        needs[name] = params
    try:
        check_patterns({need: types.exact_amounts(params) for need, params in needs.items()})
    except ValueError as error:
        raise BadInput(str(error)) from None
    return needs
