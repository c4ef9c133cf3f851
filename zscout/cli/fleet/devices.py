"""What RCs report of themselves, for `zscout status`: health in words, and figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

from zscout.cli.fleet.overview import Table
from zscout.keyexpr import BadName, Role
from zscout.messages import RcAsk, RcState

if TYPE_CHECKING:
    from zscout.cli.fleet.fleet_view import FleetView
    from zscout.mesh import Declaration

ASK: Final = 0.5
"""Seconds that an RC has for its answer."""
MAX_FIGURES_SHOWN: Final = 12


class Devices:
    """The newest state of each RC that lives: asked for once, then received as it is published."""

    def __init__(self, fleet_view: FleetView) -> None:
        self._fleet_view = fleet_view
        self._states: dict[str, RcState] = {}
        keys, mesh = fleet_view.client.mesh.keys, fleet_view.client.mesh
        self._subscription: Declaration = mesh.subscribe(keys.rc_state_any, RcState, self._on_state)

    def close(self) -> None:
        self._subscription.close()

    async def ask(self) -> None:
        """Asks the RCs of which no state is known yet; waits ASK for their answers at most."""
        living = self.living()
        self._states = {rc: state for rc, state in self._states.items() if rc in living}
        if all(self.of(rc) is not None for rc in living):
            return
        mesh = self._fleet_view.client.mesh
        await mesh.ask(
            mesh.keys.rc_state_any,
            RcAsk(),
            RcState,
            timeout=ASK,
            enough=lambda reply: reply.message is not None and self._all_known(reply.key, reply.message),
        )

    def of(self, rc: str) -> RcState | None:
        """What this RC reported last, unless it is gone, or another has come in its place."""
        state = self._states.get(rc)
        return state if state is not None and state.instance in self.living().get(rc, ()) else None

    def ill(self, rc: str) -> bool:
        state = self.of(rc)
        return state is not None and state.health != "ok"

    def table(self, *, every: bool) -> Table:
        """Those that are not well; with `every` also those that report figures."""
        rows, styles = [], []
        for rc in sorted(self._states):
            state = self.of(rc)
            if state is None or not (self.ill(rc) or (every and state.figures)):
                continue
            rows.append((rc, state.health, figures_text(state.figures)))
            styles.append("red" if self.ill(rc) else "")
        return Table("Devices", ("RC", "HEALTH", "FIGURES"), rows, styles)

    def as_object(self, rc: str) -> dict[str, Any]:
        """What `--json` prints of an RC; `health` is null where it did not answer."""
        state = self.of(rc)
        if state is None:
            return {"health": None, "figures": {}, "capacity": {}}
        return {"health": state.health, "figures": dict(state.figures), "capacity": dict(state.capacity)}

    def _on_state(self, key: str, state: RcState) -> None:
        try:
            own = key == self._fleet_view.client.mesh.keys.rc_state(state.rc)
        except BadName:
            own = False
        if own and state.rc in self.living():
            self._states[state.rc] = state

    def _all_known(self, key: str, state: RcState) -> bool:
        self._on_state(key, state)
        return all(self.of(rc) is not None for rc in self.living())

    def living(self) -> dict[str, set[str]]:
        """Instances by RC."""
        living: dict[str, set[str]] = {}
        for token in self._fleet_view.tokens(Role.RC):
            living.setdefault(token.name, set()).add(token.instance)
        return living


def figures_text(figures: Mapping[str, float]) -> str:
    """Figures as people read them, without those that are 0: `frames_per_second=9.8, opened=1`."""
    parts = list(_parts(figures))
    rest = len(parts) - MAX_FIGURES_SHOWN
    return ", ".join(parts[:MAX_FIGURES_SHOWN]) + (f", {rest} more" if rest > 0 else "")


def _parts(figures: Mapping[str, float]) -> Iterator[str]:
    for name, value in figures.items():
        if value:
            whole = value == round(value) and abs(value) < 1e15
            yield f"{name}={round(value) if whole else format(value, '.4g')}"
