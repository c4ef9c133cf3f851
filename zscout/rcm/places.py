"""Owners of places in the queue: no other client can claim a place.

A leader knows the owners of the places that it gave. A seal proves the owner of a place of an earlier term, where
managers share a key; without a key the owner is the client that listed the place at the takeover, else the client that
showed it first."""

from __future__ import annotations

import heapq
import hmac
from collections.abc import Collection

from zscout.types import ArcId, ClientId, Ns, Place, Term

MAX_KEPT = 20_000
"""Places of ARCs that have ended, but might be requested again."""


def arc_id(client: str, request_id: str) -> ArcId:
    """The core's name of a request: unique on the mesh, as a client's own id is not."""
    return f"{client}/{request_id}"


def request_id(arc: ArcId) -> str:
    return arc.rpartition("/")[2]


def client_id(arc: ArcId) -> ClientId:
    return arc.rpartition("/")[0]


class Places:
    """The places of a fleet that the leader of `term` knows. `key`: shared by the managers, if any."""

    def __init__(self, fleet: str, key: bytes | None, term: Term) -> None:
        self._fleet, self._key, self.term = fleet, key, term
        self._places: dict[ArcId, Place] = {}
        """The places of open ARCs."""
        self._owners: dict[Place, dict[ClientId, int]] = {}
        """By place: its clients, each with the number of its open ARCs at that place."""
        self._expiries: list[tuple[Ns, Place]] = []
        """A heap of the times until which places without an open ARC are kept."""
        self._until: dict[Place, Ns] = {}
        """By place: its latest time in that heap; earlier ones no longer count."""

    def seal(self, place: Place, arc: ArcId) -> str | None:
        """The seal that proves to every leader that `arc` owns this place; None: there is no key."""
        if self._key is None:
            return None
        (counter, rcm), arrival = place
        sealed = "\n".join((self._fleet, str(counter), rcm, str(arrival), arc))
        return hmac.digest(self._key, sealed.encode(), "sha256").hex()[:32]

    def may_claim(self, place: Place, client: ClientId, id_: str, seal: str | None, *, seen: bool) -> bool:
        """Return True if `client` owns this place for its ARC of this id. Without a key, a client whose token is `seen`
        owns a place of an earlier term that it is the first to show."""
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

    def is_unproven(self, place: Place) -> bool:
        """Return True if nothing here proves the owner of this place: the first client that shows it owns it."""
        return self._key is None and place not in self._owners

    def may_recover(self, place: Place, client: ClientId, id_: str, seal: str | None) -> bool:
        """Return True if a takeover may recover this place for the client that lists it."""
        return self._key is None or self.may_claim(place, client, id_, seal, seen=True)

    def bind(self, place: Place, arc: ArcId, now: Ns) -> None:
        """Give this place to an open ARC, in place of its former one."""
        if self._places.get(arc) == place:
            return
        self.end(arc, now)
        self._places[arc] = place
        owners, client = self._owners.setdefault(place, {}), client_id(arc)
        owners[client] = owners.get(client, 0) + 1

    def allow_claims(self, arc: ArcId, clients: Collection[ClientId]) -> None:
        """Without a key, let the clients that expect a hand-over of this ARC claim its place too."""
        if self._key is None:
            for client in clients:
                self._owners[self._places[arc]].setdefault(client, 0)

    def end(self, arc: ArcId, now: Ns, keep: Ns = 0) -> None:
        """An ARC has ended. Its client may claim its place again within `keep`."""
        if (place := self._places.pop(arc, None)) is None:
            return
        owners = self._owners[place]
        owners[client_id(arc)] -= 1
        if not any(owners.values()) and now + keep > self._until.get(place, -1):
            self._until[place] = now + keep
            heapq.heappush(self._expiries, (now + keep, place))
        while self._expiries and (self._expiries[0][0] <= now or len(self._expiries) > MAX_KEPT):
            date, place = heapq.heappop(self._expiries)
            if self._until[place] != date:
                continue
            del self._until[place]
            if not any(self._owners[place].values()):
                del self._owners[place]
