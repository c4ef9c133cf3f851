"""A workload (RCs and the ARCs that request them), and its file for `zscout replay`.

    [[rc]]
    name = "radio/rf0"
    sharable = true                      # several holders at once; exclusive without it
    capacity = { command_rate = 10.0 }   # vetoes holders whose sum is greater

    [[arc]]
    name = "arc0"
    at = 0.0                             # seconds
    priority = 1                         # the larger wins
    min_runtime = 5.0                    # seconds, more than 0
    [arc.needs]
    "radio/rf0" = { command_rate = 5.0 } # a parameter left out counts 0

Names are free texts, since nothing goes onto a mesh. An ARC that needs an RC missing from the file stays unserved.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from fractions import Fraction
from typing import Annotated, Final

from msgspec import Meta, Struct

from zscout.config.strict import Where, amounts, check_unique, parse_toml, quoted, seconds_to_ns
from zscout.keyexpr import is_pattern
from zscout.scheduling.model import ArcRequest
from zscout.types import Ns, Params, RcName


@dataclass(frozen=True, slots=True)
class WorkloadRc:
    """A sharable RC vetoes holders that exceed its capacity; no capacity means no bound."""

    name: RcName
    sharable: bool = False
    capacity: Mapping[str, Fraction] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Arrival:
    at: Ns
    request: ArcRequest


@dataclass(frozen=True, slots=True)
class Workload:
    """Arrivals of one instant are requested in the order given."""

    rcs: tuple[WorkloadRc, ...]
    arrivals: tuple[Arrival, ...]


MAX_BYTES: Final = 64_000_000  # of a workload file
MAX_ARCS: Final = 100_000
MAX_RCS: Final = 10_000
MAX_NEEDS: Final = 1_000  # RCs per ARC
MAX_PARAMETERS: Final = 64  # per RC: capacities, and bandwidth parameters of an ARC
MAX_PRIORITY: Final = 1_000_000_000
_MAX_NAME: Final = 130

_Amounts = Annotated[dict[str, Decimal], Meta(max_length=MAX_PARAMETERS)]


class _Rc(Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    sharable: bool = False
    capacity: _Amounts | None = None


class _Arc(Struct, frozen=True, forbid_unknown_fields=True):
    name: str
    at: Decimal
    priority: Annotated[int, Meta(ge=0, le=MAX_PRIORITY)]
    min_runtime: Decimal
    needs: Annotated[dict[str, _Amounts], Meta(max_length=MAX_NEEDS)]


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    rc: Annotated[list[_Rc], Meta(max_length=MAX_RCS)] = []
    arc: Annotated[list[_Arc], Meta(max_length=MAX_ARCS)] = []


def parse_workload(text: str, source: str) -> Workload:
    """Parse `text`, keeping the file's order. `source` names the file in errors. Raises BadInput."""
    file = parse_toml(text, source, _File)
    top = Where(source)
    check_unique((rc.name for rc in file.rc), top / "rc", "name")
    check_unique((arc.name for arc in file.arc), top / "arc", "name")
    rcs = tuple(_rc(rc, (top / "rc").item(number, rc.name)) for number, rc in enumerate(file.rc))
    arrivals = tuple(_arrival(arc, (top / "arc").item(number, arc.name)) for number, arc in enumerate(file.arc))
    return Workload(rcs, arrivals)


def _rc(rc: _Rc, where: Where) -> WorkloadRc:
    _check_texts(where / "name", rc.name)
    if is_pattern(rc.name):
        raise (where / "name").bad(f"{quoted(rc.name)} is a pattern", "leave out the *; only needs may have one")
    if rc.capacity is None:
        return WorkloadRc(rc.name, rc.sharable)
    if not rc.sharable:
        raise (where / "capacity").bad("an exclusive device has no capacity", "add sharable = true, or remove it")
    _check_texts(where / "capacity", *rc.capacity)
    return WorkloadRc(rc.name, rc.sharable, amounts(rc.capacity, where / "capacity"))


def _arrival(arc: _Arc, where: Where) -> Arrival:
    _check_texts(where / "name", arc.name)
    at = seconds_to_ns(arc.at, where / "at")
    min_runtime = seconds_to_ns(arc.min_runtime, where / "min_runtime", low=Decimal("0.000000001"))
    if not arc.needs:
        raise (where / "needs").bad("a request needs at least one device", "name one, with {} for no parameters")
    needs: dict[RcName, Params] = {}
    for rc, parameters in arc.needs.items():
        _check_texts(where / "needs", rc)
        _check_texts(where / "needs" / rc, *parameters)
        needs[rc] = amounts(parameters, where / "needs" / rc)
    try:
        return Arrival(at, ArcRequest(arc.name, arc.name, needs, arc.priority, min_runtime))
    except ValueError as error:
        raise (where / "needs").bad(str(error), "see zscout request --help") from None


def _check_texts(where: Where, *names: str) -> None:
    for name in names:
        if not (0 < len(name) <= _MAX_NAME and name.isprintable()):
            raise where.bad(f"{quoted(name)} is not a name", f"write 1 to {_MAX_NAME} printable characters")
