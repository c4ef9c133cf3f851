"""What may differ from what was recorded: each by its path, as the tests print it, and with its reason.

A path stands for all below it as well, but in `CHANGED`, which also has the value as it is now.
"""

from __future__ import annotations

from typing import Final

_STARTS_IN: Final = "a notice carries its estimate, so that who waits need not ask for the fleet's state"
_CONTEXT: Final = "the field's word for what a component is given; Stage is the same class. It is given by position"
_WHY: Final = "what `reason` says in words, as data: no program need read English"
_UNCONFIRMED: Final = "a grant that its RCs do not confirm is queued again at its place, instead of thrown away"
_REACHABLE: Final = "what was held back is granted as soon as the link to its RC stands again"
_PLACE: Final = "a place is kept though the first question, without it, came late"
_TERM: Final = "a client that promised a higher term tells a leader that has not heard of it"
_TABLE1: Final = (
    "commands > zscout demo table1 > text > It starts three nodes with four devices and five programs on this machine,"
    " apart from every other fleet, for about 25 seconds, and records them. Nothing is left but the recording."
    " Exit code 1: "
)
_FAULTS: Final = "the fault simulator, with `zscout study faults`"
_INSTANCE: Final = (
    "one device, one instance: the RCM names the one that is meant, and others say of which they are a duplicate"
)
_GANG: Final = "the RCs of the grant that a client believes in: a leader that never published it knows what was lost"
_ABOVE: Final = "terms below 2^52, and a candidate that is asked to go above the term that an RC has promised"
_SESSION: Final = "sessions show themselves, so that a link that came back without them is noticed"
_STUDIES: Final = (
    "Examples: zscout study zscout study schedule --family paper --seeds 100 zscout study placement --seeds 20"
    " zscout study robots --starts 40 "
)
_LATE: Final = "on a busy machine cells come late, which is no other order: the demo failed by it"

_INCARNATIONS: Final = (
    "ActivateComponent.v1 > fields > incarnation",
    "Checkpoint.v1 > fields > incarnation",
    "ComponentUse.v1 > fields > incarnation",
    "ComponentView.v1 > fields > incarnation",
    "MoveComponent.v1 > fields > incarnation",
    "MoveComponent.v1 > fields > to_incarnation",
    "Moved.v1 > fields > incarnation",
    "Output.v1 > fields > incarnation",
    "RestoreComponent.v1 > fields > incarnation",
    "StartComponent.v1 > fields > incarnation",
    "StopComponent.v1 > fields > incarnation > anyOf > 0",
)

_TOKENS: Final = (
    "anvil/candidate/node",
    "anvil/load/node",
    "anvil/node/node",
    "anvil/rc/radio/rf#",
    "anvil/rc/robot/a",
    "anvil/rcm/node",
    "anvil/session/node",
    "bellows/load/node",
    "bellows/node/node",
    "bellows/session/node",
    "desk/client/request-#",
    "desk/session/request-#",
)

ADDED: Final[dict[str, str]] = {
    "messages > zscout.Ask.v1 > fields > estimate": _STARTS_IN,
    "messages > zscout.Notice.v1 > fields > starts_in": _STARTS_IN,
    "python > zscout.Component > methods > run > takes > context": _CONTEXT,
    "python > zscout.ComponentContext": _CONTEXT,
    "python > zscout.Client > methods > start": "tests begin a client on a mesh in memory with it",
    "python > zscout.Client > methods > request > takes > estimate": _STARTS_IN,
    "python > what Client.request gives > attributes > estimate": _STARTS_IN,
    "python > what Client.request gives > attributes > start": _STARTS_IN,
    "messages > zscout.Notice.v1 > fields > why": _WHY,
    "messages > zscout.ReasonInfo.v1": _WHY,
    "messages > zscout.ReasonParty.v1": _WHY,
    "messages > zscout.Revocation.v1 > fields > why": _WHY,
    "messages > zscout.WaitView.v1 > fields > why": _WHY,
    "python > what Client.request gives > attributes > why": _WHY,
    "live > status > .queue[].why": _WHY,
    "live > why waiter > .arcs[].why": _WHY,
    "messages > zscout.Ask.v1 > fields > grant": _UNCONFIRMED,
    "messages > zscout.Ask.v1 > fields > reachable": _REACHABLE,
    "messages > zscout.Ask.v1 > fields > unconfirmed": _UNCONFIRMED,
    "messages > zscout.Ask.v1 > fields > term": _TERM,
    "python > what Client.request gives > attributes > unconfirmed": _UNCONFIRMED,
    "python > what Client.request gives > attributes > shown": _PLACE,
    "python > zscout.CommandRefused > attributes > rc": "which RC refused",
    _TABLE1 + "not all came in the order of Table 2; cells that are only late, on a busy machine, are named.": _LATE,
    "commands > zscout study faults": _FAULTS,
    "commands > zscout study > commands > faults": _FAULTS,
    "commands > zscout study > text > "
    + _STUDIES
    + "zscout study faults --runs 1000 zscout study schedule --help": _FAULTS,
    "keys > zscout/FLEET/alive/*/rc/KIND/NAME/*": _INSTANCE,
    "keys > zscout/FLEET/alive/*/session/**": _SESSION,
    "keys > zscout/FLEET/alive/HOST/session/NAME/INSTANCE": _SESSION,
    "keys > zscout/FLEET/alive/HOST/session/CLIENT/*": _SESSION,
    "messages > zscout.ClientRequests.v1 > fields > term": _ABOVE,
    "messages > zscout.Ask.v1 > fields > rcs": _GANG,
    "messages > zscout.OpenRequest.v1 > fields > rcs": _GANG,
    "messages > zscout.Grants.v1 > fields > instances": _INSTANCE,
    "messages > zscout.RcmState.v1 > fields > instances": _INSTANCE,
    "messages > zscout.RcState.v1 > fields > duplicate_of": _INSTANCE,
    "messages > zscout.RcState.v1 > fields > leaving": _INSTANCE,
    "messages > zscout.RcAsk.v1 > fields > above": _ABOVE,
    "messages > zscout.RcAsk.v1 > fields > instance": _INSTANCE,
    "python > zscout.Held > methods > now": "the clock by which the hold ends, for bodies that keep a pace",
}

REMOVED: Final[dict[str, str]] = {
    "python > zscout.Component > methods > run > takes > stage": _CONTEXT,
    _TABLE1 + "a cell differs.": _LATE,
    "commands > zscout study > text > " + _STUDIES + "zscout study schedule --help": _FAULTS,
}

CHANGED: Final[dict[str, tuple[object, str]]] = {
    "live > keys > .alive[].role": (["candidate", "client", "load", "node", "rc", "rcm", "session"], _SESSION),
    "live > keys > .alive[].token": ([f"zscout/surface-#/alive/{token}/#" for token in _TOKENS], _SESSION),
    "python > zscout.Client > methods > connect > gives": (
        "Connecting[Self]",
        "it can be awaited, as before, and entered",
    ),
    **{f"messages > zscout.{field} > maximum": (4503599627370495000, _ABOVE) for field in _INCARNATIONS},
    "messages > zscout.ComponentUse.v1 > fields > processes > maximum": (2**52 - 1, _ABOVE),
}
"""The value now, and the reason."""
