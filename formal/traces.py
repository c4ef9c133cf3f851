"""What really happened, as a behaviour of the model: from the lines of `zscout.trace` to actions of `ownership.tla`.

Only exclusive RCs are followed; of a gang the rest is left out. One instance of an RC is one RC of the model: one that
starts anew has forgotten what its predecessor heard. A client of the model is an ARC.

A long run is cut into pieces. The state that a piece begins with is worked out here, and TLC finds at the end of the
piece before that this is what its actions led to: all pieces together are the run. What is left out of it can only make
less possible (`LeadsTo` in MODULE)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

import msgspec

from formal.tlc import CORES, GUARDS, run

Term: TypeAlias = tuple[int, str]
Grant: TypeAlias = tuple[Term, int]
PIECE: Final = 400
"""A piece is cut after so many actions: the work for each grows with them."""
BATCH: Final = 16_000
"""About so many actions go to one TLC."""


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
    answers: defaultdict[Term, list[Grant | None]] = field(default_factory=lambda: defaultdict(list))
    obeyed: Grant | None = None


@dataclass(slots=True)
class Piece:
    """Some actions of a run, one after the other."""

    begins: str
    """The state before them, in TLA+; empty for that of the model's beginning."""
    ends: str = ""
    """The state that the next piece begins with."""
    actions: list[str] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    """Of each action: the line of the trace that says so."""
    rcs: set[int] = field(default_factory=set)
    terms: set[int] = field(default_factory=set)


class Behaviour:
    """The actions of one run, in pieces."""

    def __init__(self, lines: Iterable[str | Mapping[str, Any]], *, piece: int = PIECE) -> None:
        """Lines, or what they say, in the order in which it came about."""
        events = [msgspec.json.decode(line) if isinstance(line, str) else line for line in lines]
        self.pieces = [Piece("")]
        sharable = {event["instance"] for event in events if event.get("sharable")}
        self._events = {
            number: event for number, event in enumerate(events, 1) if event.get("instance") not in sharable
        }
        self._sharable = {event["rc"] for event in events if event.get("sharable")}
        terms = {_term(event["term"]) for event in self._events.values()}
        terms |= {_term(grant[0]) for event in self._events.values() for grant in _grants_in(event)}
        self._terms = {term: number for number, term in enumerate(sorted(terms | {(0, "")}))}
        self._line = 0
        self._last: dict[Any, int] = {}
        """Of each instance, term and publication: the last line that speaks of it."""
        for number, event in self._events.items():
            self._last |= dict.fromkeys((*_instances_in(event), _term(event["term"])), number)
            if event["do"] in ("hear", "read"):
                self._last[_term(event["term"]), event["seq"]] = number
        self._reigns: defaultdict[Term, _Reign] = defaultdict(_Reign)
        self._rcs: defaultdict[str, _Rc] = defaultdict(_Rc)
        self._names: dict[str, int] = {}
        self._arcs: dict[str, int] = {}
        self._of: dict[Grant, tuple[int, int, int, frozenset[str]]] = {}
        """Of each grant: term, step, client and gang in the model."""
        self._arc_of: dict[Grant, tuple[str, Any]] = {}
        """Its ARC, and the place of that."""
        for number, event in self._events.items():
            self._line = number
            if len(self.pieces[-1].actions) >= piece:
                self._cut()
            getattr(self, f"_{event['do']}")(event)
            self.pieces[-1].rcs |= {self._name(one) for one in _instances_in(event)}
            self.pieces[-1].terms.add(self._terms[_term(event["term"])])

    @property
    def actions(self) -> int:
        return sum(len(one.actions) for one in self.pieces)

    def _cut(self) -> None:
        """Begins a new piece, with what is spoken of from here on."""
        later = {key for key, line in self._last.items() if line >= self._line}
        reigns = {term: reign for term, reign in self._reigns.items() if term in later}
        in_tables = {one for reign in reigns.values() for one, held in reign.table.items() if held is not None}
        rcs = {one: self._rcs[one] for one in sorted((self._rcs.keys() & later) | in_tables, key=self._name)}
        rows = {
            term: {step for seq, step in reign.published.items() if (term, seq) in later} | {reign.steps} - {0}
            for term, reign in reigns.items()
        }
        said = {rc.holds for rc in rcs.values()}
        said |= {held for rc in rcs.values() for term in reigns for held in rc.answers.get(term, ())}
        before = -1
        while before != (before := sum(map(len, rows.values()))):
            said |= {reigns[term].tables[step - 1].get(one) for term in rows for step in rows[term] for one in rcs}
            for term, reign in reigns.items():
                # What it ended it does not take up again.
                over = (self._had(reign, held, rcs) for held in said if held is not None and held[0] < term)
                rows[term] |= set(over) - {0}

        def of_rcs(value: Callable[[str, _Rc], str]) -> str:
            return _function({self._name(one): value(one, rc) for one, rc in rcs.items()})

        def of_reigns(value: Callable[[Term, _Reign], str]) -> str:
            return _function({self._terms[term]: value(term, reign) for term, reign in reigns.items()})

        def said_in(reign: _Reign, step: int) -> str:
            table = of_rcs(lambda one, _: self._value(reign.tables[step - 1].get(one)))
            return f"[seq |-> {step}, table |-> {table}, named |-> {self._set(reign.named[step - 1] & rcs.keys())}]"

        def answers(term: Term, _: _Reign) -> str:
            return of_rcs(lambda _, rc: self._values(set(rc.answers.get(term, ()))))

        state = {
            "hold": of_rcs(lambda _, rc: self._value(rc.holds)),
            "heard": of_rcs(lambda _, rc: f"<<{self._terms[rc.heard[0]]}, {rc.heard[1]}>>"),
            "obeyed": of_rcs(lambda _, rc: self._value(rc.obeyed)),
            "ended": of_rcs(lambda _, rc: self._values(rc.ended & said)),
            "joined": of_reigns(lambda _, reign: self._set(reign.table.keys() & rcs.keys())),
            "answers": of_reigns(answers),
            "history": of_reigns(
                lambda term, reign: "<<" + ", ".join(said_in(reign, step) for step in sorted(rows[term])) + ">>"
            ),
        }
        ends = "[" + ",\n    ".join(f"{name} |-> {value}" for name, value in state.items()) + "]"
        self.pieces[-1].ends = ends
        self.pieces.append(Piece(ends))
        for piece in self.pieces[-2:]:
            piece.rcs |= set(map(self._name, rcs))
            piece.terms |= {self._terms[term] for term in reigns}

    @staticmethod
    def _had(reign: _Reign, held: Grant, rcs: Iterable[str]) -> int:
        """The last step in which this reign had a hold in its table that is there no longer; 0: there is none."""
        gone = [one for one in rcs if reign.table.get(one) != held]
        steps = (step for step, table in enumerate(reign.tables, 1) if any(table.get(one) == held for one in gone))
        return max(steps, default=0)

    # RCs

    def _promise(self, event: Mapping[str, Any]) -> None:
        term, (name, rc) = _term(event["term"]), self._rc(event)
        table = self._reigns[term].table
        if table.get(event["instance"]) is not None:
            # Its leader, which was away, asks it again, and lets its hold go on.
            return
        if event["instance"] in table:
            # Its leader asks it again: it had lost sight of it.
            self._lose(term, event["instance"])
        if rc.holds not in rc.answers[term] or rc.heard[0] != term:
            self._add(f"Promise({name}, {self._terms[term]})")
        rc.answers[term].append(rc.holds)
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
        if holds == rc.holds != becomes:
            # Not the publication: a heartbeat after it.
            becomes = holds
            if rc.heard != (term, step):
                self._add(f"Beats({name}, {self._terms[term]}, {step})")
        elif rc.heard != (term, step) or becomes != rc.holds:
            self._add(f"Hears({name}, {self._terms[term]}, {step}) /\\ {self._holds(name, becomes)}")
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
            self._add(f"Reads({name}, {self._terms[term]}, {step}) /\\ {self._holds(name, becomes)}")
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
            self._add(f"FALSE (* RC {name} holds {holds}, and should hold {rc.holds} *)")

    def _takes(self, rc: _Rc, holds: Grant | None, heard: tuple[Term, int]) -> None:
        if rc.holds is not None and holds != rc.holds:
            rc.ended.add(rc.holds)
        rc.holds, rc.heard = holds, heard

    # Leaders

    def _reopened(self, event: Mapping[str, Any]) -> None:
        """That it is not over after all shows in a grant that follows."""

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
            for grant, arc, place, gang, *_ in holders[:1]:
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
        return instance in self._reigns[term].table or term in self._rcs[instance].answers

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
        told = {one: goes_on.get(one) or self._rcs[one].answers[term][-1] for one in fresh}
        lost = {held for held in told.values() if held is not None} - set(goes_on.values())
        said = _function({self._name(one): self._value(held) for one, held in told.items()})
        table = [f"Table({number})'[{self._name(one)}] = {self._value(goes_on.get(one))}" for one in fresh]
        self._add(" /\\ ".join((f"TakeIn({number}, {self._set(fresh)}, {said}, {self._values(lost)})", *table)))
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

    def _value(self, grant: Grant | None) -> str:
        if grant is None:
            return "None"
        term, step, client, gang = self._of.get(grant, (0, 0, 0, frozenset()))
        return f"G({term}, {step}, {client}, {self._set(gang)})"

    def _values(self, grants: Iterable[Grant | None]) -> str:
        return "{" + ", ".join(map(self._value, grants)) + "}"

    def _add(self, action: str) -> None:
        self.pieces[-1].actions.append(action)
        self.pieces[-1].lines.append(self._line)


MODULE: Final = r"""
EXTENDS ownership, TLC
VARIABLES n, i
G(t, s, c, rcs) == [term |-> t, seq |-> s, client |-> c, rcs |-> rcs]

\* By its number: what a leader said. None of those that may come is left out.
Hears(r, t, s) == \E m \in DOMAIN history[t] : history[t][m].seq = s /\ Hear(r, t, history[t][m])
Reads(r, t, s) == \E m \in DOMAIN history[t] : history[t][m].seq = s /\ Read(r, t, history[t][m])
Beats(r, t, s) == \E m \in DOMAIN history[t] : history[t][m].seq = s /\ Beat(r, t, history[t][m])

\* A leader says again what it has said.
Again(t, named) == Says(t, Table(t), named) /\ UNCHANGED <<answers, joined, heard, hold, ended, obeyed>>

Or(f, x, else) == IF x \in DOMAIN f THEN f[x] ELSE else

\* A piece begins in the state S. Of an RC or a reign that S does not speak of there was nothing.
Begins(S) ==
    /\ hold = [r \in RCs |-> Or(S.hold, r, None)]
    /\ heard = [r \in RCs |-> Or(S.heard, r, <<0, 0>>)]
    /\ obeyed = [r \in RCs |-> Or(S.obeyed, r, None)]
    /\ ended = [r \in RCs |-> Or(S.ended, r, {})]
    /\ joined = [t \in Terms |-> Or(S.joined, t, {})]
    /\ answers = [t \in Terms |-> [r \in RCs |-> Or(Or(S.answers, t, <<>>), r, {})]]
    /\ history = [t \in Terms |-> [m \in DOMAIN Or(S.history, t, <<>>) |->
        [S.history[t][m] EXCEPT !.table = [r \in RCs |-> Or(@, r, None)]]]]

\* The state is S, but for what only makes less possible when it is left out: messages and answers, which are lost then,
\* RCs that no reign has in its table, reigns of which nothing more is heard; and for ended grants of which nothing in S
\* speaks: nothing can bring them back.
LeadsTo(S) ==
    LET rcs == DOMAIN S.hold
        rows(t) == {S.history[t][m] : m \in DOMAIN S.history[t]}
        spoken_of == ({S.hold[r] : r \in rcs}
            \cup UNION {UNION {S.answers[t][r] : r \in rcs} : t \in DOMAIN S.answers}
            \cup UNION {UNION {{row.table[r] : r \in rcs} : row \in rows(t)} : t \in DOMAIN S.history}) \ {None}
    IN /\ \A r \in rcs :
           /\ hold[r] = S.hold[r] /\ heard[r] = S.heard[r] /\ obeyed[r] = S.obeyed[r]
           /\ ended[r] \cap spoken_of = S.ended[r]
       /\ \A t \in DOMAIN S.history :
           /\ joined[t] \cap rcs = S.joined[t]
           /\ \A r \in rcs : S.answers[t][r] \subseteq answers[t][r]
           /\ \A row \in rows(t) : \E m \in DOMAIN history[t] : LET had == history[t][m] IN
               /\ had.seq = row.seq /\ had.named \cap rcs = row.named
               /\ \A r \in rcs : had.table[r] = row.table[r]
           /\ Leads(t) =>
               /\ S.history[t] # <<>> /\ S.history[t][Len(S.history[t])].seq = Now(t)
               /\ \A r \in RCs \ rcs : Table(t)[r] = None
               /\ \A g \in spoken_of : g.term < t /\ Ended(t, g) =>
                   \E row \in rows(t) : \E r \in rcs : row.table[r] = g /\ Table(t)[r] # g
    /\ UNCHANGED vars
"""


@dataclass(slots=True)
class Verdict:
    """What TLC says of some behaviours."""

    refused: dict[int, str] = field(default_factory=dict)
    """Where it is none: by the number of the behaviour, from 0."""
    states: int = 0
    took: float = 0.0
    """Seconds, of TLC."""


def accept(behaviours: Sequence[Behaviour], *, workers: int = CORES) -> Verdict:
    """Which of these behaviours the model has. Raises NoTlc, RuntimeError."""
    verdict = Verdict()
    left = [(number, at) for number, behaviour in enumerate(behaviours) for at in range(len(behaviour.pieces))]
    while left:
        batch: list[tuple[int, int]] = []
        while left and sum(len(behaviours[one].pieces[at].actions) for one, at in batch) < BATCH:
            batch.append(left.pop(0))
        refused = _follow([behaviours[number].pieces[at] for number, at in batch], verdict, workers)
        if refused is not None:
            (which, at), (action, why) = batch[refused[0]], refused[1:]
            line = behaviours[which].pieces[at].lines[min(action, len(behaviours[which].pieces[at].lines)) - 1]
            verdict.refused[which] = f"line {line}, piece {at + 1}, action {action}: {why}"
            # TLC stops there: the others are still to be judged.
            left = [one for one in (*batch, *left) if one[0] != which]
    return verdict


def _follow(pieces: Sequence[Piece], verdict: Verdict, workers: int) -> tuple[int, int, str] | None:
    """The piece, from 0, and the action, from 1, at which one is refused, and what that is."""
    text = [MODULE]
    actions = [[*one.actions, *([f"LeadsTo(End{number})"] if one.ends else [])] for number, one in enumerate(pieces, 1)]
    for number, (one, does) in enumerate(zip(pieces, actions, strict=True), 1):
        begins = "Init" if not one.begins else f"Begins(Begin{number})"
        cases = "\n".join(f"    [] i = {at} -> {action}" for at, action in enumerate(does, 1))
        text += [f"Begin{number} == {one.begins}\n"] if one.begins else []
        text += [f"End{number} == {one.ends}\n"] if one.ends else []
        text.append(f"Start{number} == {begins}\nStep{number} == CASE i = 0 -> FALSE\n{cases}\n    [] OTHER -> FALSE\n")
    numbers = range(1, len(pieces) + 1)
    choice = "\n    ".join(f"[] n = {number} -> Step{number}" for number in numbers)
    start = "\n    ".join(f"\\/ n = {number} /\\ Start{number}" for number in numbers)
    text += [
        f"Lengths == <<{', '.join(str(len(does)) for does in actions)}>>\n",
        f"RCsHere == {_numbers(set[int]().union(*(one.rcs for one in pieces)))}\n",
        f"TermsHere == {_numbers(set[int]().union(*(one.terms for one in pieces)))}\n",
        f"Start == i = 1 /\\ (\n    {start})\n",
        f"Do == CASE n = 0 -> FALSE\n    {choice}\n",
        "Follow == IF i > Lengths[n] THEN UNCHANGED <<vars, n, i>> ELSE Do /\\ i' = i + 1 /\\ UNCHANGED n\n",
    ]
    config = [
        "CONSTANTS",
        "  None = None",
        "  Clients = {}",
        "  RCs <- RCsHere",
        "  Terms <- TermsHere",
        "  Needs = {}",
        "  MaxTerm = 0",
        "  MaxSeq = 1000000000",
        "  MaxJoin = 1000000000",
        "  Losses = TRUE",
        "  GUARDS = {" + ", ".join(f'"{guard}"' for guard in GUARDS) + "}",
        "INIT Start",
        "NEXT Follow",
    ]
    outcome = run("".join(text), config, workers=workers)
    verdict.states += outcome.states
    verdict.took += outcome.took
    if outcome.violated is None:
        return None
    which, at = (int(outcome.text.rpartition(f"/\\ {name} = ")[2].split()[0]) for name in ("n", "i"))
    one = pieces[which - 1]
    if at > len(one.actions):
        return which - 1, at, "it does not lead to what the next piece begins with"
    return which - 1, at, one.actions[at - 1]


def _function(values: Mapping[int, str]) -> str:
    return "(" + " @@ ".join(f"{key} :> {value}" for key, value in values.items()) + ")" if values else "<<>>"


def _numbers(numbers: Iterable[int]) -> str:
    return "{" + ", ".join(map(str, sorted(numbers))) + "}"


def _term(value: Sequence[Any]) -> Term:
    return int(value[0]), str(value[1])


def _grant(value: Sequence[Any]) -> Grant:
    return _term(value[0]), int(value[1])


def _held(event: Mapping[str, Any]) -> Grant | None:
    return _grant(event["holds"][0]) if event["holds"] else None


def _grants_in(event: Mapping[str, Any]) -> list[Any]:
    published = [held[0] for holders in event.get("rcs", {}).values() for held in holders]
    return [*published, *event.get("holds", [])]


def _instances_in(event: Mapping[str, Any]) -> list[str]:
    return [event["instance"]] if "instance" in event else list(event.get("instances", {}).values())
