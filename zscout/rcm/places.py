"""Whose a place in the queue is: it can't be claimed under another name.

A leader knows to whom it gave a place. One of an earlier term is known by its seal, where managers share a key; without
one it is that of who listed it when the leader took over, or was the first to show it."""

from __future__ import annotations

import heapq
import hmac
from collections.abc import Collection

from zscout.types import ArcId, ClientId, Ns, Place, Term

MAX_KEPT = 20_000
"""Places of ARCs that are over, but might be asked for again."""


def arc_id(client: str, request_id: str) -> ArcId:
    """The core's name of a request: unique on the mesh, as a client's own id is not."""
    return f"{client}/{request_id}"


def request_id(arc: ArcId) -> str:
    """The client's own id in an ArcId."""
    return arc.rpartition("/")[2]


def client_id(arc: ArcId) -> ClientId:
    return arc.rpartition("/")[0]


class Places:
    """The places of one fleet, as the leader of `term` knows them; `key` is the one that managers share."""

    def __init__(self, fleet: str, key: bytes | None, term: Term) -> None:
        self._fleet, self._key, self.term = fleet, key, term
        self._places: dict[ArcId, Place] = {}
        """Of open ARCs."""
        self._owners: dict[Place, dict[ClientId, int]] = {}
        """By place: its clients, each with how many open ARCs there."""
        self._over: list[tuple[Ns, Place]] = []
        """A heap of dates up to which places without an open ARC are kept."""
        self._until: dict[Place, Ns] = {}
        """By place: the latest of its dates in that heap, which counts."""

    def seal(self, place: Place, arc: ArcId) -> str | None:
        """What proves to every leader that this place is this ARC's; None: there is no key."""
        if self._key is None:
            return None
        (counter, rcm), arrival = place
        said = "\n".join((self._fleet, str(counter), rcm, str(arrival), arc))
        return hmac.digest(self._key, said.encode(), "sha256").hex()[:32]

    def may_claim(self, place: Place, client: ClientId, id_: str, seal: str | None, *, seen: bool) -> bool:
        """Whether this is a place of `client`, for its ARC of this id. One of an earlier term that nobody has shown yet
        is its own where no seal can tell, if its token is `seen`."""
        owners = self._owners.get(place)
        if owners is not None and client in owners:
            return True
        if place.term == self.term:
            return False
        if self._key is not None:
            return self.proves(place, client, id_, seal)
        return owners is None and seen

    def proves(self, place: Place, client: ClientId, id_: str, seal: str | None) -> bool:
        """Return True if a leader of this fleet sealed that place for this request."""
        expected = self.seal(place, arc_id(client, id_))
        return None not in (expected, seal) and hmac.compare_digest(f"{expected}".encode(), f"{seal}".encode())

    def takes_the_word_for(self, place: Place) -> bool:
        """Whether whoever shows this place first has it: nothing here tells whose it is."""
        return self._key is None and place not in self._owners

    def may_recover(self, place: Place, client: ClientId, id_: str, seal: str | None) -> bool:
        """Whether that place is to be recovered for who lists it as its own."""
        return self._key is None or self.may_claim(place, client, id_, seal, seen=True)

    def bind(self, place: Place, arc: ArcId, now: Ns) -> None:
        """An open ARC has this place from now on."""
        if self._places.get(arc) == place:
            return
        self.end(arc, now)
        self._places[arc] = place
        owners, client = self._owners.setdefault(place, {}), client_id(arc)
        owners[client] = owners.get(client, 0) + 1

    def admit(self, arc: ArcId, clients: Collection[ClientId]) -> None:
        """These expect to be handed an open ARC: their word is believed where no seal can tell."""
        if self._key is None:
            for client in clients:
                self._owners[self._places[arc]].setdefault(client, 0)

    def end(self, arc: ArcId, now: Ns, keep: Ns = 0) -> None:
        """An ARC is over. For `keep` its client may ask for its place again."""
        if (place := self._places.pop(arc, None)) is None:
            return
        owners = self._owners[place]
        owners[client_id(arc)] -= 1
        if not any(owners.values()) and now + keep > self._until.get(place, -1):
            self._until[place] = now + keep
            heapq.heappush(self._over, (now + keep, place))
        while self._over and (self._over[0][0] <= now or len(self._over) > MAX_KEPT):
            date, place = heapq.heappop(self._over)
            if self._until[place] != date:
                continue
            del self._until[place]
            if not any(self._owners[place].values()):
                del self._owners[place]
