from __future__ import annotations

from collections.abc import Mapping

from zscout.keyexpr import check_need, is_pattern
from zscout.types import Need, Ns, Params


def check_request(name: str, needs: Mapping[Need, Params], min_runtime: Ns) -> None:
    """Raises ValueError for empty needs, a minimum runtime <= 0 or a negative parameter, and as `check_patterns`."""
    if not needs:
        raise ValueError(f"{name} needs nothing; name at least one device")
    if min_runtime <= 0:
        raise ValueError(f"{name}: the minimum runtime must be positive")
    for params in needs.values():
        if params and any(value.numerator < 0 for value in params.values()):
            raise ValueError(f"{name}: bandwidth parameters must not be negative")
    check_patterns(needs)


def check_patterns(needs: Mapping[Need, Params]) -> None:
    """Raises ValueError for an invalid pattern (BadName), and where parameters would depend on the choice of RCs."""
    by_kind: dict[str, Params] = {}
    for need, params in needs.items():
        if not is_pattern(need):
            continue
        kind = check_need(need).partition("/")[0]
        if by_kind.setdefault(kind, params) != params:
            raise ValueError(f"patterns of the kind {kind} have different parameters; give them all the same")
    if by_kind and any(map(is_pattern, by_kind)) and any(by_kind.values()):
        raise ValueError("a pattern for devices of any kind can't be combined with parameters; name a kind")
