"""What all messages have in common: their base, bounds, and the way to JSON and back.

Numbers from outside are bounded and made exact here before anything is computed with them."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from decimal import Decimal
from fractions import Fraction
from functools import cache
from operator import attrgetter
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

import msgspec
from msgspec import inspect

from zscout.types import NO_TERM, SECOND, Ns, Params, Term

MAX_PAYLOAD = 65_536
"""Bytes of one query."""
MAX_STATE = 16_000_000
"""Bytes of one answer or publication, which may be about a whole fleet."""
MAX_LISTED = 400_000
"""Bytes of a client's answer on what it asks for: decoding it takes below 20 ms."""
MAX_HELD = 1_000_000
"""Bytes of an RC's state, with all its holders."""
MAX_NEEDS = 64
MAX_PARAMS = 16
MAX_COUNTER = 2**52 - 1
"""A term whose counter is above this is rejected."""
MAX_INCARNATION = MAX_COUNTER * 1000
"""Of a component: the placer of a term counts from a thousand times its counter on."""
MAX_JUMP = 1_000_000
"""A term whose counter is this far above all that were received is an error, not an election."""
LAST_TERMS = MAX_COUNTER - 2**20
"""Above this counter terms come one by one: nobody can use up at once those that are left."""
MAX_ERROR = 400
"""Characters in the text of an error: it may quote what was sent."""
MAX_DIGITS = 25
MAX_EXPONENT = 18
MAX_SECONDS = Decimal(10 * 366 * 86_400)
"""Ten years."""

Amounts: TypeAlias = dict[str, Decimal]
State: TypeAlias = Literal["queued", "running", "ended"]
Finite: TypeAlias = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Metres: TypeAlias = Finite
Radians: TypeAlias = Finite
Seconds: TypeAlias = Finite
"""A duration that is computed with: bounded, so that it is still finite in nanoseconds."""
Elapsed: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
"""Likewise, of the past."""
WallTime: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1e11)]
"""Seconds since 1970, UTC."""
ShortText: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=130)]
"""A name, or `kind/name`."""
VersionText: TypeAlias = Annotated[str, msgspec.Meta(max_length=64)]
"""What `zscout --version` prints where it is from; empty: it is older than versions that tell theirs."""
FIRST_TOLD = "0.2.0"
"""The first version that tells itself."""
RcSeconds: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1e15)]
Figure: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Bytes: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=1 << 60)]


class Message(msgspec.Struct, frozen=True, omit_defaults=True):
    """Base of all messages."""


class Problem(Message, frozen=True):
    """Why something was refused. `term` is the term that the replier has promised, where that is why; `left` the
    seconds for which an RC that answers `settling` may go on to do so."""

    code: str
    message: str
    term: Term | None = None
    left: Seconds | None = None
    version: VersionText = ""
    """Of who did not understand what was asked."""


class Refused(Exception):
    """Raised by a handler to answer a query with an error."""

    def __init__(self, code: str, message: str, term: Term | None = None) -> None:
        super().__init__(message)
        self.problem = Problem(code, message, term)

    @classmethod
    def by(cls, problem: Problem) -> Refused:
        refused = cls(problem.code, problem.message)
        refused.problem = problem
        return refused


T = TypeVar("T")
M = TypeVar("M", bound=Message)
_ENCODER = msgspec.json.Encoder(decimal_format="number")
_decoder: Callable[[Any], msgspec.json.Decoder[Any]] = cache(msgspec.json.Decoder)
NAMES_ONCE: set[Any] = set()
"""Kinds in which a name that stands twice in one object is refused. The decoder alone takes the last, which
in a request would silently drop a need; elsewhere the 6 us are not worth it."""

LIMITS: dict[Any, int] = {}
"""Bytes of one message of that kind, where they are fewer than of others."""


NEWEST_COUNTS: set[Any] = set()
"""Kinds of publications of which the newest on a key tells all: of many that wait some are left out."""


class Malformed(ValueError):
    """A payload that is not the message it should be; the text names what and where."""


def absurd(term: Term, known: Term, *, heard: bool = True) -> bool:
    """Whether `term` is too far above `known`, the newest received, to be accepted. Where no RCM that is believed is
    `heard`, as before the first one (`NO_TERM`), any up to LAST_TERMS is accepted: a fleet may be old. Of those above
    it only the next is, and who does not know it asks others (`zscout.mesh.terms`)."""
    bound = known.counter + MAX_JUMP if heard and known != NO_TERM else MAX_COUNTER
    return term.counter > min(bound, max(LAST_TERMS, known.counter + 1), MAX_COUNTER)


def of_the_last(term: Term, known: Term) -> bool:
    """Whether `term` is absurd only because `known` is too old to judge it."""
    return max(LAST_TERMS, known.counter + 1) < term.counter <= MAX_COUNTER


def disbelieved(term: Term, known: Term) -> bool:
    """Whether who refused `term` for a lower one, `known`, hears an RCM that it obeys, and goes on to do so."""
    return absurd(term, known) and not of_the_last(term, known)


def version_words(version: str) -> str:
    """What others told as their `version`, for people."""
    return f"version {version}" if version else f"older than {FIRST_TOLD}"


def encode(message: msgspec.Struct) -> bytes:
    return _ENCODER.encode(message)


def decode(payload: bytes, kind: type[T] | Any, limit: int = MAX_PAYLOAD) -> T:
    """`payload` as a message of `kind` (a struct, or a union of tagged ones). Raises Malformed."""
    if len(payload) > limit:
        raise Malformed(f"{len(payload)} bytes are too many; at most {limit} are taken")
    try:
        message: T = _decoder(kind).decode(payload)
        # What is as this encodes it has no name twice.
        if kind in NAMES_ONCE and _ENCODER.encode(message) != payload:
            _ONCE.decode(payload.decode())
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        name = getattr(kind, "__name__", "operation")
        raise Malformed(f"not a valid {name}: {str(error)[:MAX_ERROR]}") from None
    return message


def largest(kind: Any, limit: int = MAX_STATE) -> int:
    """Bytes of one message of that kind at most."""
    return min(limit, LIMITS.get(kind, limit))


def decode_told(payload: bytes, kind: type[T] | Any, limit: int = MAX_STATE) -> T:
    """The same of what is published or answered, and may be passed on: it holds no decimal that is no number, or of
    implausible size, which others could not read again. (An operation is refused for one in words of its own.)"""
    message: T = decode(payload, kind, largest(kind, limit))
    check: Callable[[Any], bool] = _plausible(kind)
    if not check(message):
        raise Malformed(f"not a valid {kind.__name__}: a decimal in it is no number, or beyond 1e{MAX_EXPONENT}")
    return message


def _check_of(kind: inspect.Type) -> Callable[[Any], bool] | None:
    """None: there are no decimals in it."""
    match kind:
        case inspect.DecimalType():
            return lambda value: value.is_finite() and (not value or abs(value.adjusted()) <= MAX_EXPONENT)
        case inspect.Metadata(type=of):
            return _check_of(of)
        case inspect.StructType(fields=fields):
            checks = [(attrgetter(one.name), check) for one in fields if (check := _check_of(one.type)) is not None]
            if len(checks) == 1:
                ((get, only),) = checks
                return lambda value: only(get(value))
            return (lambda value: all(check(get(value)) for get, check in checks)) if checks else None
        case inspect.ListType(item_type=of) | inspect.VarTupleType(item_type=of):
            return _check_of_each(of, iter)
        case inspect.DictType(value_type=of):
            return _check_of_each(of, dict.values)
        case inspect.UnionType(types=types):  # of messages that are told only X | None
            item = next(filter(None, map(_check_of, types)), None)
            return (lambda value: value is None or item(value)) if item is not None else None
    return None


def _check_of_each(kind: inspect.Type, values: Callable[[Any], Iterable[Any]]) -> Callable[[Any], bool] | None:
    if (found := _check_of(kind)) is None:
        return None
    check = found
    return lambda value: not value or all(map(check, values(value)))


# A check of all decimals in a message of that kind.
_plausible: Callable[[Any], Callable[[Any], bool]] = cache(
    lambda kind: _check_of(inspect.type_info(kind)) or (lambda _: True)
)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        twice, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f'"{twice[:80]}" is given more than once; give it once')
    return found


_ONCE = json.JSONDecoder(object_pairs_hook=_unique, parse_int=str, parse_float=str)


def carried(message: Message, kind: type[M], **own: Any) -> M:
    """A message of `kind` with the fields that `message` has as well, and its `own`."""
    return kind(**{name: getattr(message, name) for name in _shared_fields(type(message), kind)} | own)


@cache
def _shared_fields(one: type[Message], other: type[Message]) -> list[str]:
    names = {*one.__struct_fields__}
    return [name for name in other.__struct_fields__ if name in names]


def schema(kind: type) -> str:
    """The name under which a message travels in the encoding."""
    return f"zscout.{kind.__name__}.v1"


def exact(value: Decimal, what: str) -> Fraction:
    """A number that is not negative, exactly. Raises ValueError for NaN, infinity, and implausible sizes."""
    check_amount(value, what)
    return Fraction(value)


def check_amount(value: Decimal, what: str) -> None:
    """Raises ValueError for what `exact` does not take."""
    if not value.is_finite():
        raise ValueError(f"{what} must be a number, not {str(value)[:40]}")
    if value < 0:
        raise ValueError(f"{what} must not be negative, and is {str(value)[:40]}")
    # A Fraction of 1e999999 would take all memory: look at the exponent before converting.
    if value and not -MAX_EXPONENT <= value.adjusted() <= MAX_EXPONENT:
        raise ValueError(f"{what} must lie between 1e-{MAX_EXPONENT} and 1e{MAX_EXPONENT}, and is {str(value)[:40]}")
    if len(value.as_tuple().digits) > MAX_DIGITS:
        raise ValueError(f"{what} has more than {MAX_DIGITS} digits")


def exact_amounts(params: Mapping[str, Decimal]) -> dict[str, Fraction]:
    """Bandwidth parameters, exactly. Raises ValueError."""
    return {name: exact(value, name) for name, value in params.items()}


def duration(value: Decimal, what: str) -> Ns:
    """A positive duration in seconds as whole ns, half to even. Raises ValueError."""
    check_amount(value, what)
    if value > MAX_SECONDS:
        raise ValueError(f"{what} must be at most {MAX_SECONDS} s (ten years), and is {value}")
    nanoseconds = round(value * SECOND)
    if nanoseconds <= 0:
        raise ValueError(f"{what} must be positive, and is {value}")
    return nanoseconds


def decimals(params: Params) -> Amounts:
    """Bandwidth parameters as they are sent."""
    return {name: Decimal(value.numerator) / Decimal(value.denominator) for name, value in params.items()}


def decimal_seconds(time: Ns) -> Decimal:
    return Decimal(time).scaleb(-9)
