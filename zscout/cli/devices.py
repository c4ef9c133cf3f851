"""What RCs tell of themselves, for `zscout status`: health in words, and figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

from zscout.cli.picture import Table
from zscout.keyexpr import BadName, Role
from zscout.messages import RcAsk, RcState

if TYPE_CHECKING:
    from zscout.cli.look import Look
    from zscout.mesh import Declared

ASK: Final = 0.5
"""Seconds that an RC has for its answer."""
MAX_FIGURES_SHOWN: Final = 12


class Devices:
    """The newest word of each RC that lives: asked for once, then heard as it is published."""

    def __init__(self, look: Look) -> None:
        self._look = look
        self._told: dict[str, RcState] = {}
        keys, mesh = look.client.mesh.keys, look.client.mesh
        self._heard: Declared = mesh.subscribe(keys.rc_state_any, RcState, self._on_state)

    def close(self) -> None:
        self._heard.close()

    async def ask(self) -> None:
        """Asks the RCs of which nothing was heard since they came; waits for their answers, ASK at most."""
        living = self.living()
        self._told = {rc: state for rc, state in self._told.items() if rc in living}
        if all(self.of(rc) is not None for rc in living):
            return
        mesh = self._look.client.mesh
        await mesh.ask(
            mesh.keys.rc_state_any,
            RcAsk(),
            RcState,
            timeout=ASK,
            enough=lambda reply: reply.message is not None and self._all_told(reply.key, reply.message),
        )

    def of(self, rc: str) -> RcState | None:
        """What this RC told last, unless it is gone, or another has come in its place."""
        state = self._told.get(rc)
        return state if state is not None and state.instance in self.living().get(rc, ()) else None

    def ill(self, rc: str) -> bool:
        state = self.of(rc)
        return state is not None and state.health != "ok"

    def table(self, *, every: bool) -> Table:
        """Those that are not well; with `every` also those that tell figures."""
        rows, styles = [], []
        for rc in sorted(self._told):
            state = self.of(rc)
            if state is None or not (self.ill(rc) or (every and state.figures)):
                continue
            rows.append((rc, state.health, figures_text(state.figures)))
            styles.append("red" if self.ill(rc) else "")
        return Table("Devices", ("RC", "HEALTH", "FIGURES"), rows, styles)

    def as_object(self, rc: str) -> dict[str, Any]:
        """What `--json` tells of an RC; `health` is null where it did not answer."""
        state = self.of(rc)
        if state is None:
            return {"health": None, "figures": {}, "capacity": {}}
        return {"health": state.health, "figures": dict(state.figures), "capacity": dict(state.capacity)}

    def _on_state(self, key: str, state: RcState) -> None:
        try:
            own = key == self._look.client.mesh.keys.rc_state(state.rc)
        except BadName:
            own = False
        if own and state.rc in self.living():
            self._told[state.rc] = state

    def _all_told(self, key: str, state: RcState) -> bool:
        self._on_state(key, state)
        return all(self.of(rc) is not None for rc in self.living())

    def living(self) -> dict[str, set[str]]:
        """Instances by RC."""
        living: dict[str, set[str]] = {}
        for token in self._look.tokens(Role.RC):
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
