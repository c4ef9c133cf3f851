"""Devices of a fleet with their holders, as text and as tables in a notebook. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape

from zscout.messages import HoldView, RcmState, RcView
from zscout.scheduling.reason import kept, named, starting
from zscout.types import clean

Row = tuple[str, ...]


@dataclass(frozen=True)
class LabStatus:
    """The devices of a fleet with their holders, and the waiting requests, at the time of the query.

    It prints as text, and shows as tables in a notebook. `state` has the same for programs: `state.rcs`, `state.holds`
    and `state.queue`, in the messages of the protocol."""

    fleet: str
    state: RcmState

    def __str__(self) -> str:
        return "\n".join(
            [self._title, *(line for head, rows in self._tables() for line in ("", *_aligned(head, rows)))]
        )

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"<p>{escape(self._title)}</p>" + "".join(_html(head, rows) for head, rows in self._tables())

    @property
    def _title(self) -> str:
        return f"{self.fleet}, led by {clean(self.state.host)}"

    def _tables(self) -> Iterator[tuple[Row, list[Row]]]:
        holds: dict[str, list[HoldView]] = {}
        for hold in self.state.holds:
            for rc in hold.needs:
                holds.setdefault(rc, []).append(hold)
        devices: list[Row] = [
            (clean(view.rc), clean(view.host), _availability(view, holds.get(view.rc, []))) for view in self.state.rcs
        ]
        yield ("DEVICE", "HOST", "HELD BY"), devices
        if self.state.queue:
            waiting: list[Row] = [(named(arc.who, arc.client, arc.arc), clean(arc.reason)) for arc in self.state.queue]
            yield ("WAITS", "WHY"), waiting


def _availability(view: RcView, holds: Iterable[HoldView]) -> str:
    if not view.present:
        return f"absent: {clean(view.reason)}" if view.reason else "absent"
    return "; ".join(map(_holder, holds)) or "free"


def _holder(hold: HoldView) -> str:
    who = named(hold.who, hold.client, hold.arc)
    if hold.waits is not None:
        return f"{who}, {starting(hold.waits)}"
    return f"{who}, {hold.remaining:.0f} s left" if hold.remaining > 0 else f"{who}, {kept(hold.priority)}"


def _aligned(head: Row, rows: Sequence[Row]) -> Iterator[str]:
    table = [head, *rows]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for row in table:
        yield "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()


def _html(head: Row, rows: Iterable[Row]) -> str:
    def line(tag: str, row: Row) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape(text)}</{tag}>" for text in row) + "</tr>"

    return f"<table><thead>{line('th', head)}</thead><tbody>{''.join(line('td', row) for row in rows)}</tbody></table>"
