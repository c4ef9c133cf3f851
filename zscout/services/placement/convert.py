"""Between the cores of placement and messages: load reports, specs, hosts' lists, statuses."""

from __future__ import annotations

from typing import Any, Final, cast

from zscout.messages import ComponentSpec, ComponentView, LoadReport, Placement
from zscout.placement.events import ComponentState, ComponentStatus, ListedComponent, PlacementSpec
from zscout.placement.model import ComponentUsage, HostReport, Requirements
from zscout.types import SECOND

MIN_CORES: Final = 0.01
MIN_SPEED: Final = 1e-3
"""A host that reports less is slow, and no division by zero."""


def report_of(message: LoadReport) -> HostReport:
    return HostReport(
        host=message.host,
        number=message.number,
        cores=max(MIN_CORES, message.cores),
        load_average=message.load_average,
        cpu=message.cpu / 100,
        memory_available=message.memory_available,
        memory_total=message.memory_total,
        speed=max(MIN_SPEED, message.speed),
        clock=message.clock,
        clock_rated=message.clock_rated,
        temperature=message.temperature,
        labels=frozenset(message.labels),
        uses=tuple(
            ComponentUsage(one.component, one.kind, one.incarnation, one.cpu, one.memory, one.served)
            for one in message.components
        ),
    )


def spec_of(message: ComponentSpec) -> PlacementSpec:
    """A spec as the core has it; `message_of` is the way back."""
    return PlacementSpec(
        kind=message.kind,
        restart=message.restart,
        metric=message.metric,
        policy=message.policy,
        requirements=Requirements(frozenset(message.labels), message.memory),
        hosts=None if message.hosts is None else frozenset(message.hosts),
        extra={
            "params": message.params,
            "memory_limit": message.memory_limit,
            "cpu_limit": message.cpu_limit,
        },
    )


def message_of(spec: PlacementSpec) -> ComponentSpec:
    return ComponentSpec(
        kind=spec.kind,
        restart=spec.restart,
        metric=spec.metric,
        policy=spec.policy,
        labels=sorted(spec.requirements.labels),
        memory=spec.requirements.memory,
        hosts=None if spec.hosts is None else sorted(spec.hosts),
        **spec.extra,
    )


def listed_of(view: ComponentView) -> ListedComponent:
    return ListedComponent(
        component=view.component,
        incarnation=view.incarnation,
        spec=spec_of(view.spec),
        running=view.phase in ("running", "stopping"),
        standby=view.phase == "standby",
        movable=view.movable,
        ended=(view.ended or "lost") if view.phase == "ended" else None,
        reason=view.reason,
        tail=view.tail,
    )


def placement_of(status: ComponentStatus) -> Placement:
    return Placement(
        component=status.component,
        spec=message_of(status.spec),
        state=cast("Any", status.state.value),
        incarnation=status.incarnation,
        host=status.host,
        to=status.to,
        reason=status.reason,
        movable=status.movable,
        wanted=status.wanted,
        restarts=status.restarts,
        moves=status.moves,
        dead=None if status.dead is None else status.dead / SECOND,
        tail=status.tail,
    )


def status_of(placement: Placement) -> ComponentStatus:
    return ComponentStatus(
        component=placement.component,
        spec=spec_of(placement.spec),
        state=ComponentState(placement.state),
        incarnation=placement.incarnation,
        host=placement.host,
        to=placement.to,
        reason=placement.reason,
        movable=placement.movable,
        wanted=placement.wanted,
        restarts=placement.restarts,
        moves=placement.moves,
        dead=None if placement.dead is None else round(placement.dead * SECOND),
        tail=placement.tail,
    )
