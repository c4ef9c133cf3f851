"""What really happened, as a behaviour of the model: from the lines of `zscout.trace` to actions of `ownership.tla`.

Only exclusive RCs are followed; of a gang the rest is left out. One instance of an RC is one RC of the model: one that
starts anew has forgotten what its predecessor heard. A client of the model is an ARC."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import msgspec

from formal.tlc import CORES, Outcome, run

Term: TypeAlias = tuple[int, str]
Grant: TypeAlias = tuple[Term, int]
Action: TypeAlias = tuple[str, ...]
"""The text of an action in TLA+, and what it is about, for people."""


@dataclass(slots=True)
class _Reign:
    """What a leader has published, in steps of the model."""

    steps: int = 0
    table: dict[str, Grant | None] = field(default_factory=dict)
    """Of each instance that it has taken in."""
    tables: list[dict[str, Grant | None]] = field(default_factory=list)
    named: list[set[str]] = field(default_factory=list)
    published: dict[int, int] = field(default_factory=dict)
    """By seq: the step that it was."""


@dataclass(slots=True)
class _Rc:
    holds: Grant | None = None
    heard: tuple[Term, int] = ((0, ""), 0)
    """Term and step."""
    ended: set[Grant] = field(default_factory=set)
    answers: set[tuple[Term, Grant | None]] = field(default_factory=set)
    obeyed: Grant | None = None


class Behaviour:
    """The actions of one run."""

    def __init__(self, lines: Iterable[str | Mapping[str, Any]]) -> None:
        """Lines, or what they say, in the order in which it came about."""
        events = [msgspec.json.decode(line) if isinstance(line, str) else line for line in lines]
        self.actions: list[str] = []
        self.notes: dict[int, str] = {}
        """What is wrong with an action that is none, by its number."""
        sharable = {event["instance"] for event in events if event.get("sharable")}
        self._events = [event for event in events if event.get("instance") not in sharable]
        self._sharable = {event["rc"] for event in events if event.get("sharable")}
        terms = {_term(event["term"]) for event in self._events}
        terms |= {_term(grant[0]) for event in self._events for grant in _grants_in(event)}
        self._terms = {term: number for number, term in enumerate(sorted(terms - {(0, "")}), 1)}
        self._reigns: defaultdict[Term, _Reign] = defaultdict(_Reign)
        self._rcs: defaultdict[str, _Rc] = defaultdict(_Rc)
        self._names: dict[str, int] = {}
        self._arcs: dict[str, int] = {}
        self._of: dict[Grant, tuple[int, int, int, frozenset[str]]] = {}
        """Of each grant: term, step, client and gang in the model."""
        self._arc_of: dict[Grant, tuple[str, Any]] = {}
        """Its ARC, and the place of that."""
        for event in self._events:
            getattr(self, f"_{event['do']}")(event)

    @property
    def terms(self) -> int:
        return len(self._terms)

    @property
    def rcs(self) -> int:
        return len(self._names)

    # RCs

    def _promise(self, event: Mapping[str, Any]) -> None:
        term, (name, rc) = _term(event["term"]), self._rc(event)
        answer = (term, rc.holds)
        if event["instance"] in self._reigns[term].table:
            # Its leader asks it again: it had lost sight of it.
            self._lose(term, event["instance"])
        if answer not in rc.answers or rc.heard[0] != term:
            self._add(f"Promise({name}, {self._terms[term]})")
        rc.answers.add(answer)
        if rc.heard[0] != term:
            rc.heard = (term, 0)

    def _hear(self, event: Mapping[str, Any]) -> None:
        term, (name, rc), holds = _term(event["term"]), self._rc(event), _held(event)
        reign = self._reigns[term]
        step = reign.published.get(event["seq"])
        if step is None:
            return
        told = event["instance"] in reign.named[step - 1]
        becomes = reign.tables[step - 1].get(event["instance"]) if told else rc.holds
        if becomes in rc.ended:
            becomes = None
        if rc.heard != (term, step) or becomes != rc.holds:
            self._add(f"Hear({name}, {self._terms[term]}, {step}) /\\ {self._holds(name, becomes)}")
        self._takes(rc, becomes, (term, step))
        self._ends(event, name, rc, holds)

    def _read(self, event: Mapping[str, Any]) -> None:
        term, (name, rc), holds = _term(event["term"]), self._rc(event), _held(event)
        reign = self._reigns[term]
        step = reign.published.get(event["seq"])
        if step is None:
            return
        becomes = rc.holds
        if becomes is None and (added := reign.tables[step - 1].get(event["instance"])) not in rc.ended:
            becomes = added
        if rc.heard != (term, step) or becomes != rc.holds:
            self._add(f"Read({name}, {self._terms[term]}, {step}) /\\ {self._holds(name, becomes)}")
        self._takes(rc, becomes, (term, step))
        self._ends(event, name, rc, holds)

    def _end(self, event: Mapping[str, Any]) -> None:
        name, rc = self._rc(event)
        self._ends(event, name, rc, _held(event))

    def _command(self, event: Mapping[str, Any]) -> None:
        name, rc = self._rc(event)
        if rc.obeyed != (grant := _grant(event["grant"])):
            rc.obeyed = grant
            self._add(f"Command({name}) /\\ {self._is('obeyed', name, grant)}")

    def _ends(self, event: Mapping[str, Any], name: int, rc: _Rc, holds: Grant | None) -> None:
        """What an RC ends by itself. What it holds and should not is left for TLC to refuse."""
        if rc.holds is not None and holds is None:
            self._add(f"Expire({name})")
            self._takes(rc, None, rc.heard)
        elif rc.holds != holds:
            self.notes[len(self.actions) + 1] = f"RC {name} holds {holds}, and should hold {rc.holds}"
            self._add("FALSE")

    def _takes(self, rc: _Rc, holds: Grant | None, heard: tuple[Term, int]) -> None:
        if rc.holds is not None and holds != rc.holds:
            rc.ended.add(rc.holds)
        rc.holds, rc.heard = holds, heard

    # Leaders

    def _over(self, event: Mapping[str, Any]) -> None:
        """Grants are what the model has; that an ARC is over shows in that none follows."""

    def _publish(self, event: Mapping[str, Any]) -> None:
        term = _term(event["term"])
        reign, number = self._reigns[term], self._terms[term]
        instances: dict[str, str] = event["instances"]
        wanted: dict[str, Grant | None] = {}
        for rc, holders in event["rcs"].items():
            if rc in self._sharable or rc not in instances or not self._promised(term, instances[rc]):
                continue
            wanted[instances[rc]] = None
            for grant, arc, place, gang in holders[:1]:
                given = _grant(grant)
                wanted[instances[rc]] = given
                self._arc_of[given] = arc, place
                if given not in self._of and given[0] == term:
                    rcs = frozenset(instances[one] for one in gang if one in instances and one not in self._sharable)
                    self._of[given] = (number, 0, self._arcs.setdefault(arc, len(self._arcs) + 1), rcs)
        self._take_in(term, reign, wanted)
        for held in sorted({held for instance in wanted if (held := reign.table[instance]) is not None}):
            if any(wanted.get(instance) != held for instance in wanted if reign.table[instance] == held):
                self._revoke(term, reign, held, wanted)
        for held in sorted({held for held in wanted.values() if held is not None and held[0] == term}):
            if any(reign.table[instance] != held for instance in wanted if wanted[instance] == held):
                _, _, client, gang = self._of[held]
                self._of[held] = (number, reign.steps + 1, client, gang)
                self._add(f"Grant({number}, {client}, {self._set(gang)})")
                self._step(reign, dict.fromkeys(gang, held), gang)
        if not reign.named or not wanted.keys() <= reign.named[-1]:
            self._add(f"Again({number}, {self._set(wanted)})")
            self._step(reign, {}, wanted)
        reign.published[event["seq"]] = reign.steps

    def _promised(self, term: Term, instance: str) -> bool:
        """One that was only named, by its token, is not taken in yet."""
        return instance in self._reigns[term].table or any(one == term for one, _ in self._rcs[instance].answers)

    def _take_in(self, term: Term, reign: _Reign, wanted: Mapping[str, Grant | None]) -> None:
        number = self._terms[term]
        back = {
            instance
            for instance, held in wanted.items()
            if (held is not None and held[0] != term and reign.table.get(instance) not in (None, held))
            or (held is not None and held[0] != term and instance in reign.table and reign.table[instance] != held)
        }
        for instance in sorted(back):
            self._lose(term, instance)
        fresh = [instance for instance in wanted if instance not in reign.table]
        if not fresh and reign.steps:
            return
        goes_on = {one: held for one in fresh if (held := wanted[one]) is not None and held[0] != term}
        table = " /\\ ".join(self._row(number, reign.steps + 1, one, goes_on.get(one)) for one in fresh)
        self._add(
            f"Join({number}) /\\ joined'[{number}] = joined[{number}] \\cup {self._set(fresh)} /\\ {table or 'TRUE'}"
        )
        self._step(reign, {one: goes_on.get(one) for one in fresh}, fresh)

    def _lose(self, term: Term, instance: str) -> None:
        reign = self._reigns[term]
        lost = reign.table.pop(instance)
        gone = {one for one, held in reign.table.items() if held == lost is not None}
        self._add(f"Lose({self._terms[term]}, {self._name(instance)})")
        self._step(reign, dict.fromkeys(gone), gone)

    def _revoke(self, term: Term, reign: _Reign, held: Grant, wanted: Mapping[str, Grant | None]) -> None:
        number, rcs = self._terms[term], {one for one, grant in reign.table.items() if grant == held}
        client = self._of[held][2]
        arc, place = self._arc_of[held]
        nexts = {wanted.get(one) for one in rcs}
        after = nexts.pop() if len(nexts) == 1 else None
        if after is not None and self._arc_of[after][1] == place and self._arc_of[after][0] != arc:
            _, _, other, gang = self._of[after]
            self._of[after] = (number, reign.steps + 1, other, gang)
            self._add(f"HandOver({number}, {client}, {other})")
            self._step(reign, dict.fromkeys(rcs, after), rcs)
            return
        self._add(f"Revoke({number}, {client})")
        self._step(reign, dict.fromkeys(rcs), rcs)

    def _step(self, reign: _Reign, changed: Mapping[str, Grant | None], named: Iterable[str]) -> None:
        reign.steps += 1
        reign.table |= changed
        reign.tables.append(dict(reign.table))
        reign.named.append(set(named))

    # As TLA+

    def _rc(self, event: Mapping[str, Any]) -> tuple[int, _Rc]:
        return self._name(event["instance"]), self._rcs[event["instance"]]

    def _name(self, instance: str) -> int:
        return self._names.setdefault(instance, len(self._names) + 1)

    def _set(self, instances: Iterable[str]) -> str:
        return "{" + ", ".join(str(number) for number in sorted(map(self._name, instances))) + "}"

    def _holds(self, name: int, grant: Grant | None) -> str:
        return self._is("hold", name, grant)

    def _is(self, variable: str, name: int, grant: Grant | None) -> str:
        return f"{variable}'[{name}] = {self._value(grant)}"

    def _row(self, number: int, step: int, instance: str, grant: Grant | None) -> str:
        return f"history'[{number}][{step}].table[{self._name(instance)}] = {self._value(grant)}"

    def _value(self, grant: Grant | None) -> str:
        if grant is None:
            return "None"
        term, step, client, gang = self._of.get(grant, (0, 0, 0, frozenset()))
        return f"G({term}, {step}, {client}, {self._set(gang)})"

    def _add(self, action: str) -> None:
        self.actions.append(action)


def accept(behaviours: Sequence[Behaviour], *, workers: int = CORES) -> tuple[Outcome, str]:
    """Whether the model has all of these behaviours: what TLC says, and where one is none: which, and at which action.

    Raises NoTlc, RuntimeError."""
    steps = []
    for number, behaviour in enumerate(behaviours, 1):
        cases = "\n".join(f"    [] i = {at} -> {action}" for at, action in enumerate(behaviour.actions, 1))
        steps.append(f"Step{number} == CASE i = 0 -> FALSE\n{cases}\n    [] OTHER -> FALSE\n")
    lengths = ", ".join(str(len(behaviour.actions)) for behaviour in behaviours)
    choice = "\n    ".join(f"[] n = {number} -> Step{number}" for number in range(1, len(behaviours) + 1))
    module = (
        "EXTENDS ownership\n"
        "VARIABLES n, i\n"
        "G(t, s, c, rcs) == [term |-> t, seq |-> s, client |-> c, rcs |-> rcs]\n"
        "\\* A leader says again what it has said.\n"
        "Again(t, named) ==\n"
        "    /\\ history' = [history EXCEPT ![t] = Append(@, [table |-> Table(t), named |-> named])]\n"
        "    /\\ UNCHANGED <<answers, joined, heard, hold, ended, obeyed>>\n"
        + "".join(steps)
        + f"Lengths == <<{lengths}>>\n"
        f"Start == Init /\\ n \\in 1 .. {len(behaviours)} /\\ i = 1\n"
        f"Do == CASE n = 0 -> FALSE\n    {choice}\n"
        "Follow == IF i > Lengths[n] THEN UNCHANGED <<vars, n, i>> ELSE Do /\\ i' = i + 1 /\\ UNCHANGED n\n"
    )
    most = max(len(behaviour.actions) for behaviour in behaviours) + 1
    config = [
        "CONSTANTS",
        "  None = None",
        "  Clients = {}",
        f"  RCs = {{{', '.join(map(str, range(1, max(one.rcs for one in behaviours) + 1)))}}}",
        "  Needs = {}",
        f"  MaxTerm = {max(one.terms for one in behaviours)}",
        f"  MaxSeq = {most}",
        f"  MaxJoin = {most}",
        "  Losses = TRUE",
        '  GUARDS = {"fence", "above", "older", "ended", "grant", "whole", "over", "known"}',
        "INIT Start",
        "NEXT Follow",
    ]
    outcome = run(module, config, workers=workers)
    if outcome.violated is None:
        return outcome, ""
    which, at = (int(outcome.text.rpartition(f"/\\ {name} = ")[2].split()[0]) for name in ("n", "i"))
    refused = behaviours[which - 1]
    return outcome, f"behaviour {which}, action {at}: {refused.notes.get(at, refused.actions[at - 1])}"


def _term(value: Sequence[Any]) -> Term:
    return int(value[0]), str(value[1])


def _grant(value: Sequence[Any]) -> Grant:
    return _term(value[0]), int(value[1])


def _held(event: Mapping[str, Any]) -> Grant | None:
    return _grant(event["holds"][0]) if event["holds"] else None


def _grants_in(event: Mapping[str, Any]) -> list[Any]:
    published = [held[0] for holders in event.get("rcs", {}).values() for held in holders]
    return [*published, *event.get("holds", [])]
