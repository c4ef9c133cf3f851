"""The study of robots as SVG pictures for a page, drawn without a plotting library."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias
from xml.sax.saxutils import escape

from studies.robots.study import FieldFigures, Quantiles
from zscout.config.strict import BadInput

COLOURS: Final = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000", "#999999")
"""The palette of Okabe and Ito, which people with colour blindness can distinguish."""
WIDTH: Final = 560
HEIGHT: Final = 300
LEFT: Final = 58
RIGHT: Final = 120
TOP: Final = 34
BOTTOM: Final = 46
NEVER: Final = 0.12
"""Part of the plot's height that is reserved at its top for infinite values."""

Lines: TypeAlias = Mapping[str, Sequence[tuple[str, Quantiles]]]
"""Points by the line's name in the legend: the name of a place on the x axis, and the quantiles to draw there."""


@dataclass(frozen=True, slots=True)
class Plot:
    """A picture: lines of medians, with bars from 10 to 90 %."""

    title: str
    across: str
    up: str
    lines: Lines
    top: float | None = None
    """The end of the y axis; None: above all values."""


def plots(grid: Sequence[FieldFigures], radio: Sequence[FieldFigures]) -> dict[str, Plot]:
    """The plots of a study's figures, by file name. Figures that were not measured have no plot."""
    drawn: dict[str, Plot] = {}
    if grid:
        across, named = "robots", lambda figure: str(figure.robots)
        by = _lines(grid, lambda figure: _plural(figure.channels, "channel"), named)
        drawn["robots-placed.svg"] = Plot(
            "Until all are placed", across, "seconds", by(lambda figure: figure.all_placed)
        )
        drawn["robots-noticed.svg"] = Plot(
            "Walks that were noticed", across, "%", by(lambda figure: _percent(figure.noticed_spread)), 100
        )
    if radio:
        by = _lines(radio, lambda figure: f"{figure.command_rate:g} commands/s", lambda figure: str(figure.baud))
        means = f"{_plural(radio[0].robots, 'robot')}, {_plural(radio[0].channels, 'channel')}"
        title = f"Until all are placed: {means}"
        drawn["robots-radio.svg"] = Plot(title, "baud", "seconds", by(lambda figure: figure.all_placed))
    return drawn


def write(folder: Path, grid: Sequence[FieldFigures], radio: Sequence[FieldFigures]) -> None:
    """Write the plots into an existing folder, and replace files of the same names. Raises BadInput."""
    for name, plot in plots(grid, radio).items():
        try:
            (folder / name).write_text(svg(plot), encoding="utf-8")
        except OSError as error:
            raise BadInput(f"--svg {folder}: {name} can't be written ({error.strerror}); give another folder") from None


def svg(plot: Plot) -> str:
    ticks = list(dict.fromkeys(name for line in plot.lines.values() for name, _ in line))
    ticks.sort(key=int)
    finite = [
        value
        for line in plot.lines.values()
        for _, spread in line
        for value in (spread.low, spread.median, spread.high)
        if math.isfinite(value)
    ]
    step, top = _scale(plot.top or max(finite, default=1.0))
    top = plot.top or top
    inner_width, inner_height = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def x(tick: str, shift: float = 0.0) -> float:
        return LEFT + inner_width * (ticks.index(tick) + 0.5) / len(ticks) + shift

    def y(value: float) -> float:
        if value == math.inf:
            return TOP + 4.0
        return TOP + inner_height * (NEVER + (1 - NEVER) * (1 - min(value, top) / top))

    sizes, font = f'width="{WIDTH}" height="{HEIGHT}"', 'font-family="sans-serif" font-size="12"'
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" {sizes} {font}>',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
        _text(LEFT, 20, plot.title, "start", bold=True),
        _text(LEFT + inner_width / 2, HEIGHT - 10, plot.across, "middle"),
        f'<g transform="rotate(-90)">{_text(-(TOP + inner_height / 2), 14, plot.up, "middle")}</g>',
    ]
    for number in range(round(top / step) + 1):
        level = y(number * step)
        out.append(f'<path d="M{LEFT} {level:.1f}H{WIDTH - RIGHT}" stroke="#ddd"/>')
        out.append(_text(LEFT - 6, level + 4, f"{number * step:g}", "end"))
    if any(spread.high == math.inf for line in plot.lines.values() for _, spread in line):
        out.append(_text(LEFT - 6, TOP + 8, "never", "end"))
    out += [_text(x(tick), HEIGHT - BOTTOM + 16, tick, "middle") for tick in ticks]
    for number, (name, line) in enumerate(plot.lines.items()):
        # Side by side, so that bars at the same place don't cover each other.
        shift = (number - (len(plot.lines) - 1) / 2) * 7
        out += _line(number, name, [(x(tick, shift), spread) for tick, spread in line], y)
    return "\n".join([*out, "</svg>", ""])


def _line(number: int, name: str, points: Sequence[tuple[float, Quantiles]], y: Callable[[float], float]) -> list[str]:
    colour = COLOURS[number % len(COLOURS)]
    shown = [(at, spread) for at, spread in points if not math.isnan(spread.median)]
    out = [
        f'<path d="M{at:.1f} {y(spread.low):.1f}V{y(spread.high):.1f}" stroke="{colour}" opacity="0.45" '
        'stroke-width="3"/>'
        for at, spread in shown
    ]
    way = [f"{at:.1f} {y(spread.median):.1f}" for at, spread in shown if spread.median != math.inf]
    if len(way) > 1:
        out.append(f'<path d="M{"L".join(way)}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
    for at, spread in shown:
        never = spread.median == math.inf
        fill = "white" if never else colour
        out.append(f'<circle cx="{at:.1f}" cy="{y(spread.median):.1f}" r="3.5" fill="{fill}" stroke="{colour}"/>')
    level = TOP + 10 + number * 18
    out.append(f'<circle cx="{WIDTH - RIGHT + 14}" cy="{level}" r="3.5" fill="{colour}"/>')
    out.append(_text(WIDTH - RIGHT + 24, level + 4, name, "start"))
    return out


def _lines(
    figures: Sequence[FieldFigures], legend: Callable[[FieldFigures], str], tick: Callable[[FieldFigures], str]
) -> Callable[[Callable[[FieldFigures], Quantiles]], Lines]:
    """Return a function that sorts a value of the figures into lines."""

    def of(value: Callable[[FieldFigures], Quantiles]) -> Lines:
        lines: dict[str, list[tuple[str, Quantiles]]] = {}
        for figure in figures:
            lines.setdefault(legend(figure), []).append((tick(figure), value(figure)))
        return lines

    return of


def _scale(highest: float) -> tuple[float, float]:
    """A round step, and the end of an axis of four to eight steps that reaches `highest`."""
    rough = max(highest, 1e-9) / 5
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 2.5, 5, 10) if power * factor >= rough * 0.999)
    return step, step * math.ceil(highest / step - 1e-9)


def _percent(spread: Quantiles) -> Quantiles:
    return Quantiles(100 * spread.low, 100 * spread.median, 100 * spread.high)


def _plural(number: int, what: str) -> str:
    return f"{number} {what}{'s' * (number != 1)}"


def _text(x: float, y: float, text: str, anchor: str, *, bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{weight} fill="#222">{escape(text)}</text>'
