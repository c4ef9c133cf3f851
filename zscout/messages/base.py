"""The base class of messages, their bounds, and their encoding as JSON.

Numbers received from other processes are checked and made exact here before any computation."""

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
"""Bytes of one answer or publication, which may cover a whole fleet."""
MAX_LISTED = 400_000
"""Bytes of a client's list of requests: decoding it takes less than 20 ms."""
MAX_HELD = 1_000_000
"""Bytes of an RC's state, with all its holders."""
MAX_NEEDS = 64
MAX_PARAMS = 16
MAX_COUNTER = 2**52 - 1
"""A term whose counter is above this is rejected."""
MAX_INCARNATION = MAX_COUNTER * 1000
"""Of a component: a placer starts counting at a thousand times the counter of its term."""
MAX_JUMP = 1_000_000
"""A counter this far above all received terms is an error, not the result of elections."""
LAST_TERMS = MAX_COUNTER - 2**20
"""Above this counter only the next term is accepted, so that a single message can't use up the remaining terms."""
MAX_ERROR = 400
"""Characters in the text of an error, which may quote the rejected input."""
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
"""A duration in seconds, bounded so that it is finite in nanoseconds."""
Elapsed: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
"""A duration in seconds that is not negative."""
WallTime: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1e11)]
"""Seconds since 1970, UTC."""
ShortText: TypeAlias = Annotated[str, msgspec.Meta(min_length=1, max_length=130)]
"""A name, or `kind/name`."""
VersionText: TypeAlias = Annotated[str, msgspec.Meta(max_length=64)]
"""The output of `zscout --version` at the sender; empty if the sender is older than FIRST_WITH_VERSION."""
FIRST_WITH_VERSION = "0.2.0"
"""The first version of zscout that sends its version."""
RcSeconds: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1e15)]
Figure: TypeAlias = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Bytes: TypeAlias = Annotated[int, msgspec.Meta(ge=0, le=1 << 60)]


class Message(msgspec.Struct, frozen=True, omit_defaults=True):
    """Base of all messages."""


class Problem(Message, frozen=True):
    """A refusal. `term` is set if the query's term was too low: the term that the replier has promised. `left` is set
    with code `settling`: seconds for which the RC may continue to give this answer."""

    code: str
    message: str
    term: Term | None = None
    left: Seconds | None = None
    version: VersionText = ""
    """Version of the replier, in refusals that a version difference may explain."""
    remedy: str = ""
    """A code for what the requester may do, if `message` does not say it: `wait_for_device`."""


class Refused(Exception):
    """Raised by a handler to answer a query with an error."""

    def __init__(self, code: str, message: str, term: Term | None = None, remedy: str = "") -> None:
        super().__init__(message)
        self.problem = Problem(code, message, term, remedy=remedy)

    @classmethod
    def by(cls, problem: Problem) -> Refused:
        refused = cls(problem.code, problem.message)
        refused.problem = problem
        return refused


T = TypeVar("T")
M = TypeVar("M", bound=Message)
_ENCODER = msgspec.json.Encoder(decimal_format="number")
_decoder: Callable[[Any], msgspec.json.Decoder[Any]] = cache(msgspec.json.Decoder)
UNIQUE_NAMES: set[Any] = set()
"""Kinds in which a duplicate name in an object is rejected. The decoder alone takes the last value, which in a request
would silently drop a need; elsewhere the check is not worth its 6 us."""

LIMITS: dict[Any, int] = {}
"""Bytes of one message of a kind with a lower limit than others."""


NEWEST_COUNTS: set[Any] = set()
"""Kinds of publications that are complete in themselves: while many on a key wait, only the newest count."""


class Malformed(ValueError):
    """A payload that is no valid message of its kind; the text names the fault and its position."""


def absurd(term: Term, known: Term, *, heard: bool = True) -> bool:
    """Return True if `term` is too far above `known`, the newest received, to be accepted.

    Without a credible RCM (not `heard`, or `known` is NO_TERM) any term up to LAST_TERMS is accepted: a fleet may be
    old. Above LAST_TERMS only the next term is accepted, and a process that does not know the present term queries
    others (`zscout.mesh.terms`)."""
    bound = known.counter + MAX_JUMP if heard and known != NO_TERM else MAX_COUNTER
    return term.counter > min(bound, max(LAST_TERMS, known.counter + 1), MAX_COUNTER)


def of_the_last(term: Term, known: Term) -> bool:
    """Return True if `term` is absurd only because it is above LAST_TERMS: `known` may be outdated."""
    return max(LAST_TERMS, known.counter + 1) < term.counter <= MAX_COUNTER


def disbelieved(term: Term, known: Term) -> bool:
    """Return True if a process that refused `term` obeys an RCM of the lower term `known`, and will continue to."""
    return absurd(term, known) and not of_the_last(term, known)


def version_words(version: str) -> str:
    """The `version` field of another process, for people."""
    return f"version {version}" if version else f"older than {FIRST_WITH_VERSION}"


def encode(message: msgspec.Struct) -> bytes:
    return _ENCODER.encode(message)


def decode(payload: bytes, kind: type[T] | Any, limit: int = MAX_PAYLOAD) -> T:
    """Decode `payload` as a message of `kind` (a struct, or a union of tagged structs). Raises Malformed."""
    if len(payload) > limit:
        raise Malformed(f"{len(payload)} bytes are too many; at most {limit} are accepted")
    try:
        message: T = _decoder(kind).decode(payload)
        # A payload equal to its own encoding has no duplicate names.
        if kind in UNIQUE_NAMES and _ENCODER.encode(message) != payload:
            _UNIQUE.decode(payload.decode())
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        name = getattr(kind, "__name__", "operation")
        raise Malformed(f"not a valid {name}: {str(error)[:MAX_ERROR]}") from None
    return message


def largest(kind: Any, limit: int = MAX_STATE) -> int:
    """The most bytes of one message of a kind."""
    return min(limit, LIMITS.get(kind, limit))


def decode_received(payload: bytes, kind: type[T] | Any, limit: int = MAX_STATE) -> T:
    """Decode a publication or an answer, which may be passed on: reject decimals that are not finite or of implausible
    size, which others could not read again. (Operations are decoded by `decode`, and checked with errors of their own.)
    """
    message: T = decode(payload, kind, largest(kind, limit))
    check: Callable[[Any], bool] = _plausible(kind)
    if not check(message):
        raise Malformed(f"not a valid {kind.__name__}: a decimal in it is not a number, or beyond 1e{MAX_EXPONENT}")
    return message


def _check_of(kind: inspect.Type) -> Callable[[Any], bool] | None:
    """A check of the decimals in values of `kind`; None if there are none."""
    match kind:
        case inspect.DecimalType():
            return lambda value: value.is_finite() and (not value or abs(value.adjusted()) <= MAX_EXPONENT)
        case inspect.Metadata(type=of):
            return _check_of(of)
        case inspect.StructType(fields=fields):
            checks = [(attrgetter(own.name), check) for own in fields if (check := _check_of(own.type)) is not None]
            if len(checks) == 1:
                ((get, only),) = checks
                return lambda value: only(get(value))
            return (lambda value: all(check(get(value)) for get, check in checks)) if checks else None
        case inspect.ListType(item_type=of) | inspect.VarTupleType(item_type=of):
            return _check_of_each(of, iter)
        case inspect.DictType(value_type=of):
            return _check_of_each(of, dict.values)
        case inspect.UnionType(types=types):  # received messages have no other unions than X | None
            item = next(filter(None, map(_check_of, types)), None)
            return (lambda value: value is None or item(value)) if item is not None else None
    return None


def _check_of_each(kind: inspect.Type, values: Callable[[Any], Iterable[Any]]) -> Callable[[Any], bool] | None:
    if (found := _check_of(kind)) is None:
        return None
    check = found
    return lambda value: not value or all(map(check, values(value)))


# Return a check of all decimals in a message of a kind.
_plausible: Callable[[Any], Callable[[Any], bool]] = cache(
    lambda kind: _check_of(inspect.type_info(kind)) or (lambda _: True)
)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        twice, _ = Counter(name for name, _ in pairs).most_common(1)[0]
        raise ValueError(f'"{twice[:80]}" is given more than once; give it once')
    return found


_UNIQUE = json.JSONDecoder(object_pairs_hook=_unique, parse_int=str, parse_float=str)


def carried(message: Message, kind: type[M], **own: Any) -> M:
    """Make a message of `kind` from the fields that it shares with `message`, and its `own` fields."""
    return kind(**{name: getattr(message, name) for name in _shared_fields(type(message), kind)} | own)


@cache
def _shared_fields(source: type[Message], target: type[Message]) -> list[str]:
    names = {*source.__struct_fields__}
    return [name for name in target.__struct_fields__ if name in names]


def schema(kind: type) -> str:
    """The name of a message's kind in the Zenoh encoding."""
    return f"zscout.{kind.__name__}.v1"


def exact(value: Decimal, what: str) -> Fraction:
    """Convert a decimal exactly. Raises ValueError for negative numbers, NaN, infinity, and implausible sizes."""
    check_amount(value, what)
    return Fraction(value)


def check_amount(value: Decimal, what: str) -> None:
    """Raise ValueError for a number that `exact` does not accept."""
    if not value.is_finite():
        raise ValueError(f"{what} must be a number, not {str(value)[:40]}")
    if value < 0:
        raise ValueError(f"{what} must not be negative, but is {str(value)[:40]}")
    # A Fraction of 1e999999 would take all memory: look at the exponent before converting.
    if value and not -MAX_EXPONENT <= value.adjusted() <= MAX_EXPONENT:
        raise ValueError(f"{what} must lie between 1e-{MAX_EXPONENT} and 1e{MAX_EXPONENT}, but is {str(value)[:40]}")
    if len(value.as_tuple().digits) > MAX_DIGITS:
        raise ValueError(f"{what} has more than {MAX_DIGITS} digits")


def exact_amounts(params: Mapping[str, Decimal]) -> dict[str, Fraction]:
    """Bandwidth parameters as exact fractions. Raises ValueError."""
    return {name: exact(value, name) for name, value in params.items()}


def duration(value: Decimal, what: str) -> Ns:
    """Convert a positive duration from seconds to ns, rounded half to even. Raises ValueError."""
    check_amount(value, what)
    if value > MAX_SECONDS:
        raise ValueError(f"{what} must be at most {MAX_SECONDS} s (ten years), but is {value}")
    nanoseconds = round(value * SECOND)
    if nanoseconds <= 0:
        raise ValueError(f"{what} must be positive, but is {value}")
    return nanoseconds


def decimals(params: Params) -> Amounts:
    """Bandwidth parameters as decimals, for a message."""
    return {name: Decimal(value.numerator) / Decimal(value.denominator) for name, value in params.items()}


def decimal_seconds(time: Ns) -> Decimal:
    return Decimal(time).scaleb(-9)
