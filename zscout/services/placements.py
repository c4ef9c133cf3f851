"""Between the placer's core and messages: specs, what hosts tell, records."""

from __future__ import annotations

from zscout.balancing.model import Requirements
from zscout.messages import ComponentSpec, ComponentView, Placement
from zscout.placing.events import Record, Seen, Spec
from zscout.scheduling.model import SECOND


def spec_of(told: ComponentSpec) -> Spec:
    """A spec as the core has it; `spec_told` is the way back."""
    return Spec(
        kind=told.kind,
        restart=told.restart,
        metric=told.metric,
        policy=told.policy,
        requirements=Requirements(frozenset(told.labels), told.memory),
        hosts=None if told.hosts is None else frozenset(told.hosts),
        extra={
            "params": told.params,
            "memory_limit": told.memory_limit,
            "cpu_limit": told.cpu_limit,
        },
    )


def spec_told(spec: Spec) -> ComponentSpec:
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


def seen(view: ComponentView) -> Seen:
    """A component as its node told of it."""
    return Seen(
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


def placement_of(record: Record) -> Placement:
    return Placement(
        component=record.component,
        spec=spec_told(record.spec),
        state=record.state,
        incarnation=record.incarnation,
        host=record.host,
        to=record.to,
        reason=record.reason,
        movable=record.movable,
        wanted=record.wanted,
        restarts=record.restarts,
        moves=record.moves,
        dead=None if record.dead is None else record.dead / SECOND,
        tail=record.tail,
    )


def record_of(told: Placement) -> Record:
    return Record(
        component=told.component,
        spec=spec_of(told.spec),
        state=told.state,
        incarnation=told.incarnation,
        host=told.host,
        to=told.to,
        reason=told.reason,
        movable=told.movable,
        wanted=told.wanted,
        restarts=told.restarts,
        moves=told.moves,
        dead=None if told.dead is None else round(told.dead * SECOND),
        tail=told.tail,
    )
