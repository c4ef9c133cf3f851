"""A subcommand's view of its fleet: tokens, loads of hosts, states of the RCM and the RCs."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, Self

from zscout.behaviors.client.placer_client import PlacerClient
from zscout.behaviors.client.request import RequestRefused
from zscout.cli import common
from zscout.keyexpr import BadName, Role, Sender, Token
from zscout.mesh.supervision import done_within
from zscout.messages import MAX_RANKED, HostRanking, LoadReport, RankAsk, RcAsk, RcmState, RcState
from zscout.types import SECOND, Ns

if TYPE_CHECKING:
    from zscout.behaviors.client.client import Client
    from zscout.mesh import Reply

PLACER_TIMEOUT_S: Final = 1.0
BALANCER_TIMEOUT_S: Final = 1.0
RC_TIMEOUT_S: Final = 0.5
ALL_RCS_TIMEOUT_S: Final = 5.0
"""For all answers if each RC is asked on its own key: a node answers for a thousand RCs in 2 s."""
CONCURRENT_QUERIES: Final = 32
"""RCs asked on their own keys at once."""
FIND_LOADS_S: Final = 1.2
"""Wait this long for hosts known to be up, and for load reports missing at the balancer: they come once a second."""
QUIET_S: Final = 0.3
"""Without a new host for this long, all hosts have been seen."""
STALE_NS: Final = 3 * SECOND
"""Age from which a load report is outdated."""
FORGET_AFTER_NS: Final = 60 * SECOND
"""A host that disappeared is kept for this long."""


@dataclass(slots=True)
class Host:
    """A host as the mesh shows it. `load`: the last load report, None before the first; `reported`: its time."""

    tokens: set[Token] = field(default_factory=set)
    load: LoadReport | None = None
    reported: Ns = 0
    gone: Ns | None = None
    """Time at which its last token disappeared."""

    def has(self, role: str) -> bool:
        return any(token.role == role for token in self.tokens)

    @property
    def components(self) -> list[str]:
        return sorted({token.name for token in self.tokens if token.role == Role.COMPONENT})


class FleetView:
    """Tokens and loads, followed while the context is open, and the RCM's state on request."""

    def __init__(self, client: Client) -> None:
        self.client, self.mesh = client, client.mesh
        self.hosts: dict[str, Host] = {}
        self.changed = asyncio.Event()
        # No component has this name, so answers are short: only the cordoned hosts are needed.
        self.placer = PlacerClient(client.mesh, {"*"})
        self._settled = False
        self._reported: dict[str, tuple[Ns, LoadReport]] | None = None
        """The reports of the balancer; None: it did not answer."""
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        keys = self.mesh.keys
        self._stack.enter_context(self.placer)
        self._stack.callback(self.mesh.watch(keys.alive_any(), self._on_token).close)
        self._stack.callback(self.mesh.subscribe(keys.load_any, LoadReport, self._on_load).close)
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def _on_token(self, token: Token, alive: bool) -> None:
        if Sender(token.host, token.name) == self.mesh.me:
            return
        host = self.hosts.setdefault(token.host, Host())
        if alive and host.load is None and token.host in (self._reported or {}):
            host.reported, host.load = (self._reported or {})[token.host]
        (host.tokens.add if alive else host.tokens.discard)(token)
        host.gone = None if host.tokens else self.mesh.now()
        self.changed.set()

    def _on_load(self, key: str, load: LoadReport) -> None:
        host = self.hosts.get(self.mesh.keys.host_of(key))
        if host is not None:
            host.load, host.reported = load, self.mesh.now()
            self.changed.set()

    def forget_gone(self) -> None:
        now = self.mesh.now()
        self.hosts = {
            name: host for name, host in self.hosts.items() if host.gone is None or now - host.gone < FORGET_AFTER_NS
        }

    def all_hosts(self) -> dict[str, Host]:
        """With the fleet's missing candidates."""
        missing = {name: Host() for name in self.client.fleet.candidates if name not in self.hosts}
        return dict(sorted((missing | self.hosts).items()))

    def tokens(self, role: str) -> list[Token]:
        return sorted(token for host in self.hosts.values() for token in host.tokens if token.role == role)

    def stale(self, host: Host) -> bool:
        """Return True if a host that should report its load has not done so recently."""
        if not host.has(Role.LOAD) or (host.load is None and not self._settled):
            return False
        return host.load is None or self.mesh.now() - host.reported > STALE_NS

    def ending(self) -> dict[str, float]:
        """Return the certificates that expire soon or have expired, this command's and hosts': seconds left by name."""
        own, now = self.mesh.validity, datetime.now(UTC)
        found = {own.name: own.ends_in(now)} if own is not None and own.soon(now) else {}
        loads = {name: host.load for name, host in self.hosts.items() if host.load is not None and host.load.renew}
        return {name: load.certificate_ends_in or 0.0 for name, load in sorted(loads.items())} | found

    def rights(self) -> dict[str, list[str]]:
        pairs = sorted(
            (host.load.rights, name) for name, host in self.hosts.items() if host.load and host.has(Role.LOAD)
        )
        return {rights: [name for its, name in pairs if its == rights] for rights, _ in pairs if rights}

    def faults(self) -> dict[str, str]:
        """Return, by host, the reason that its node uses older settings than its files have."""
        loads = {name: host.load for name, host in sorted(self.hosts.items()) if host.has(Role.LOAD)}
        return {name: load.fault for name, load in loads.items() if load is not None and load.fault}

    def unrecorded(self) -> dict[str, str]:
        """Return, by host, the reason that its node's recorder writes nothing."""
        loads = {name: host.load for name, host in sorted(self.hosts.items()) if host.has(Role.LOAD)}
        return {name: load.recorder for name, load in loads.items() if load is not None and load.recorder}

    async def quiet(self) -> None:
        """Return when no new host was seen for QUIET_S: links are made one after another."""
        deadline = self.mesh.now() + round(FIND_LOADS_S * SECOND)
        known = -1
        while known < len(self.hosts) and self.mesh.now() < deadline:
            known = len(self.hosts)
            await common.until(lambda: len(self.hosts) > known, self.changed, QUIET_S)  # noqa: B023 - awaited

    async def settled(self, *, loads: bool = True) -> RcmState:
        """The RCM's state once its RCs are seen, and with `loads` the hosts and their loads. Raises NobodyThere."""
        await common.see_rcm(self.client)
        if not loads:
            state = await common.state_of(self.client)
            await common.until(lambda: self._sees_all_of(state), self.changed, FIND_LOADS_S)
            return state
        state, _, _ = await asyncio.gather(
            common.state_of(self.client, forecast=True), self.ask_loads(), self._ask_cordons()
        )
        complete = self._complete(state)
        if not complete:
            await common.until(lambda: self._complete(state), self.changed, FIND_LOADS_S)
        # The token of a candidate that the balancer does not know may only be late.
        if self._reported is not None and not all(host.tokens for host in self.all_hosts().values()):
            complete = False
            seen = lambda: all(host.tokens for host in self.all_hosts().values())  # noqa: E731
            await common.until(seen, self.changed, QUIET_S)
        self._settled = True
        return state if complete else await self.client.state(forecast=True) or state

    def _sees_all_of(self, state: RcmState) -> bool:
        """Return True if all RCs and holders in the RCM's state are seen."""
        rcs = {view.rc for view in state.rcs if view.present}
        clients = {hold.client for hold in state.holds}
        seen = {f"{token.host}/{token.name}" for token in self.tokens(Role.CLIENT)}
        return clients <= seen and rcs <= {token.name for token in self.tokens(Role.RC)}

    def _complete(self, state: RcmState) -> bool:
        """Return True if also all hosts are seen, with their loads."""
        if not self._sees_all_of(state):
            return False
        if self._reported is None:
            # Wait for all candidates: one whose token is late must not be shown as missing.
            hosts, there = self.all_hosts(), True
        else:
            hosts, there = self.hosts, self._reported.keys() <= self.hosts.keys()
        return there and all(host.tokens and (host.load or not host.has(Role.LOAD)) for host in hosts.values())

    async def ask_loads(self) -> None:
        """Take the load reports of all hosts from the balancer; a balancer of an older version sends none."""
        key, asked = self.mesh.keys.ask_rank(self.mesh.me), RankAsk(at_most=MAX_RANKED, reports=True)
        reply = await self.mesh.ask_one(key, asked, HostRanking, timeout=BALANCER_TIMEOUT_S)
        if reply is None or reply.message is None or reply.message.reports is None:
            return
        now = self.mesh.now()
        reports = {
            aged_report.report.host: (now - round(aged_report.age * SECOND), aged_report.report)
            for aged_report in reply.message.reports
        }
        self._reported = reports
        for name, host in self.hosts.items():
            if host.load is None and name in reports:
                host.reported, host.load = reports[name]
        self.changed.set()

    async def _ask_cordons(self) -> None:
        # Without an answer the known cordons stay.
        with suppress(TimeoutError, RequestRefused):
            async with asyncio.timeout(PLACER_TIMEOUT_S):
                await self.placer.try_refresh()


async def see_hosts(client: Client) -> None:
    with FleetView(client) as seen:
        await seen.quiet()


class Devices:
    """The newest state of each RC with a token: queried once, then received as it is published."""

    def __init__(self, fleet_view: FleetView) -> None:
        self._fleet_view = fleet_view
        self._mesh = fleet_view.mesh
        self._states: dict[str, RcState] = {}
        # Needed, and so open, as long as the mesh.
        self._mesh.subscribe(self._mesh.keys.rc_state_any, RcState, self._on_state)

    async def ask(self) -> None:
        """Ask the RCs whose state is unknown; wait at most RC_TIMEOUT_S for their answers."""
        self._states = self.known()

        def unknown() -> set[str]:
            return {token.name for token in self._fleet_view.tokens(Role.RC)} - self.known().keys()

        def all_known(reply: Reply[RcState] | None = None) -> bool:
            if reply is not None and reply.message is not None:
                self._on_state(reply.key, reply.message)
            return not unknown()

        mesh, keys = self._mesh, self._mesh.keys
        if keys.closed:
            # A secured fleet lets no RC answer on the shared key.
            left = sorted(unknown())
            await done_within(
                ALL_RCS_TIMEOUT_S, asyncio.gather(*(self._ask_each(left) for _ in range(CONCURRENT_QUERIES)))
            )
        elif unknown():
            await mesh.ask(keys.rc_state_any, RcAsk(), RcState, timeout=RC_TIMEOUT_S, enough=all_known)

    async def _ask_each(self, left: list[str]) -> None:
        while left:
            await self._ask(left.pop())

    async def _ask(self, rc: str) -> None:
        key = self._mesh.keys.ask_rc_state(rc, self._mesh.me)
        reply = await self._mesh.ask_one(key, RcAsk(), RcState, timeout=RC_TIMEOUT_S)
        if reply is not None and reply.message is not None and reply.message.rc == rc:
            self._on_state(self._mesh.keys.rc_state(rc), reply.message)

    def known(self) -> dict[str, RcState]:
        """Return the last state of each RC, ordered by name, of RCs whose instance has a token."""
        living = {(token.name, token.instance) for token in self._fleet_view.tokens(Role.RC)}
        return {rc: state for rc, state in sorted(self._states.items()) if (rc, state.instance) in living}

    def _on_state(self, key: str, state: RcState) -> None:
        with suppress(BadName):
            named = any(token.name == state.rc for token in self._fleet_view.tokens(Role.RC))
            # A duplicate reports nothing about the device.
            if named and not state.duplicate_of and key == self._mesh.keys.rc_state(state.rc):
                self._states[state.rc] = state
