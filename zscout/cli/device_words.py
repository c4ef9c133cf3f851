"""Remarks on a device or a certificate, in words."""

from __future__ import annotations

from collections.abc import Iterator

from zscout.messages import RcState, RcView
from zscout.terminal import clock, span


def ending(name: str, left: float) -> str:
    """A warning that the certificate of this machine or person ends in `left` seconds."""
    return f"the certificate of {name} " + (f"expires in {span(left)}" if left > 0 else f"expired {span(-left)} ago")


def absence(view: RcView) -> str:
    """Return the reason that the device is absent; empty: present, or unknown."""
    if view.present or not view.reason:
        return ""
    return view.reason if view.gone is None else f"{view.reason} since {clock(-view.gone)}"


def unwell(device: RcState | None) -> str:
    """Return the reason that a device does not work at present though it is not lost; empty: it works."""
    if device is None or device.unwell is None or device.health != "ok":
        return ""
    report = device.unwell
    return f"unwell since {clock(-report.since)}: {report.why}; lost in {span(max(1, report.left))} unless it recovers"


def remarks(view: RcView) -> Iterator[str]:
    if words := absence(view):
        yield words
    for host in view.duplicates:
        yield f"at {host}: duplicate of {view.rc} at {view.host}"
    for host, ago in view.unseen.items():
        yield f"its other host {host} was last seen at {clock(-ago)}"
