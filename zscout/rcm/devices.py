"""The devices that a fleet expects: devices in its fleet file, and devices seen within the last day. Pure.

An RC has a *home* at each host that offers or offered it. When an RC disappears, its home keeps the time and reason."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, KeysView, Mapping
from dataclasses import dataclass, field
from typing import Final

import msgspec

from zscout.keyexpr import BadName, Token, check_name, check_rc
from zscout.messages import Elapsed, Parameters, RcState, RcView
from zscout.types import SECOND, HostName, Ns, RcName

REMEMBERED: Final[Ns] = 24 * 3600 * SECOND
MAX_HOMES: Final = 20_000


class SeenHome(msgspec.Struct, frozen=True, omit_defaults=True):
    """An RC was seen at a host `ago` seconds before this record was written. `why` it disappeared, if known."""

    rc: str
    host: str
    ago: Elapsed = 0.0
    why: str = ""
    stopped: bool = False
    sharable: bool = False
    parameters: Parameters | None = None


def homes_in(views: Iterable[RcView]) -> Iterator[SeenHome]:
    """The homes in a leader's list of devices."""
    for view in views:
        seen = dict.fromkeys(view.duplicates, 0.0) | view.unseen
        if view.host and (view.present or view.gone is not None):
            seen[view.host] = view.gone or 0.0
        for host, ago in seen.items():
            why = view.reason if host == view.host and not view.present else ""
            yield SeenHome(view.rc, host, ago, why, sharable=view.sharable, parameters=view.parameters)


@dataclass(slots=True)
class Home:
    """A host at which an RC is, was, or should be."""

    declared: bool = False
    instances: set[str] = field(default_factory=set)
    """Instances whose tokens are seen."""
    seen: Ns | None = None
    """When the last instance disappeared; None: there was none yet, or one is seen."""
    why: str = ""
    """The reported reason that it disappeared, if any."""
    stopped: bool = False
    """The RC was shut down in order."""


@dataclass(slots=True)
class _Device:
    homes: dict[HostName, Home] = field(default_factory=dict)
    sharable: bool = False
    parameters: Parameters | None = None
    """The parameters in its last report."""


class ExpectedDevices:
    """One host's knowledge of its fleet's devices. Times are by its own monotonic clock."""

    def __init__(self, declared: Mapping[HostName, Collection[RcName]]) -> None:
        self._devices: dict[RcName, _Device] = {}
        self._living: dict[HostName, set[Token]] = {}
        self._count = 0
        """The number of homes of all devices."""
        self.version = 0
        """Grows with each change that should be stored."""
        self.declare(declared)

    def declare(self, declared: Mapping[HostName, Collection[RcName]]) -> None:
        """Expect the devices of this fleet file instead of the last file's."""
        for device in self._devices.values():
            for home in device.homes.values():
                home.declared = False
        for host, rcs in declared.items():
            for rc in rcs:
                if (expected := self._home(rc, host)) is not None:
                    expected.declared = True
        self.version += 1

    def token_came(self, token: Token) -> None:
        home = self._home(token.name, token.host)
        if home is not None:
            home.instances.add(token.instance)
            home.seen, home.why, home.stopped = None, "", False
            self._living.setdefault(token.host, set()).add(token)
            self.version += 1

    def token_went(self, token: Token, now: Ns) -> None:
        if living := self._living.get(token.host):
            living.discard(token)
            if not living:
                del self._living[token.host]
        device = self._devices.get(token.name)
        if device is not None and (home := device.homes.get(token.host)) is not None:
            home.instances.discard(token.instance)
            if not home.instances:
                home.seen = now
                self.version += 1

    def report(self, state: RcState) -> None:
        if _is_name(state.rc, state.host) and self._home(state.rc, state.host) is not None:
            device = self._devices[state.rc]
            device.sharable, device.parameters = state.sharable, state.parameters

    def stopped(self, rc: RcName, host: HostName) -> None:
        if _is_name(rc, host) and (home := self._home(rc, host)) is not None:
            home.why, home.stopped = f"it is stopped at {host}", True
            self.version += 1

    def forget_tokens(self, now: Ns) -> None:
        """No instance counts as seen any longer."""
        for device in self._devices.values():
            for home in device.homes.values():
                if home.instances:
                    home.instances.clear()
                    home.seen = now
        self._living.clear()

    def remember(self, homes: Iterable[SeenHome], now: Ns) -> None:
        """Add homes that another host knows, or that were stored before a restart; what was seen here later stays."""
        for stored in homes:
            seen = now - round(stored.ago * SECOND)
            if now - seen > REMEMBERED or not _is_name(stored.rc, stored.host):
                continue
            home = self._home(stored.rc, stored.host)
            if home is None or home.instances or (home.seen is not None and home.seen >= seen):
                continue
            home.seen, home.why, home.stopped = seen, stored.why, stored.stopped
            self.version += 1
            device = self._devices[stored.rc]
            if device.parameters is None:
                device.sharable, device.parameters = stored.sharable, stored.parameters

    def _home(self, rc: RcName, host: HostName) -> Home | None:
        """Added if new; None: there are MAX_HOMES already."""
        device = self._devices.get(rc)
        home = device.homes.get(host) if device is not None else None
        if home is None and self._count < MAX_HOMES:
            home = Home()
            self._count += 1
            self._devices.setdefault(rc, _Device()).homes[host] = home
        return home

    def forget_old(self, now: Ns) -> None:
        """Remove homes not in the fleet file that are unseen for a day, or shut down while the RC is seen elsewhere."""
        for rc, device in list(self._devices.items()):
            for host, home in list(device.homes.items()):
                old = home.seen is None or now - home.seen > REMEMBERED
                moved = home.stopped and any(other.instances for other in device.homes.values())
                if not home.instances and not home.declared and (old or moved):
                    del device.homes[host]
                    self._count -= 1
            if not device.homes:
                del self._devices[rc]

    def homes(self, now: Ns) -> list[SeenHome]:
        return [
            SeenHome(rc, host, _ago(home, now), home.why, home.stopped, device.sharable, device.parameters)
            for rc, device in sorted(self._devices.items())
            for host, home in sorted(device.homes.items())
            if home.instances or home.seen is not None
        ]

    @property
    def names(self) -> KeysView[RcName]:
        return self._devices.keys()

    def latest_home(self, rc: RcName) -> HostName | None:
        """The host where `rc` was seen last; else a host where the fleet file has it."""
        homes = self._devices[rc].homes if rc in self._devices else {}
        return min(homes, key=lambda host: (homes[host].seen is None, -(homes[host].seen or 0), host), default=None)

    def home_of(self, rc: RcName) -> HostName | None:
        """The host at which the fleet file has it."""
        device = self._devices.get(rc)
        declared = (host for host, home in device.homes.items() if home.declared) if device is not None else ()
        return next(iter(declared), None)

    def parameters(self, rc: RcName) -> Parameters | None:
        device = self._devices.get(rc)
        return device.parameters if device is not None else None

    def why_gone(self, rc: RcName, host: HostName) -> str:
        home = self._devices[rc].homes.get(host) if rc in self._devices else None
        if home is not None and home.why:
            return home.why
        if home is not None and home.seen is None:
            return f"it has not been seen at {host} yet"
        return f"it is gone from {host}" if host in self._living else f"the node of {host} is gone"

    def view(self, known: RcView, now: Ns, named: HostName | None) -> RcView:
        """For `status` and the web page. `known`: by scheduler and RC; `named`: its named instance's host."""
        device = self._devices.get(known.rc, _Device())
        living = sorted(host for host, home in device.homes.items() if home.instances)
        gone = {host: home for host, home in device.homes.items() if not home.instances}
        if named in living:
            host = named
        elif living:
            host = living[0]
        else:
            host = self.latest_home(known.rc) or ""
        reason, since = known.reason, None
        if host in gone and not known.present:
            reason, since = self.why_gone(known.rc, host), None if gone[host].seen is None else _ago(gone[host], now)
        unseen = {
            other: _ago(home, now)
            for other, home in sorted(gone.items())
            if other != host and home.seen is not None and not home.stopped
        }
        return RcView(
            known.rc,
            known.present,
            known.sharable if known.present or known.parameters is not None else device.sharable,
            known.holders,
            host=host,
            reason="" if known.present else reason,
            gone=since,
            duplicates=[other for other in living if other != host],
            unseen=unseen,
            parameters=known.parameters if known.parameters is not None else device.parameters,
        )


def _ago(home: Home, now: Ns) -> float:
    """Seconds since an instance was seen there."""
    return 0.0 if home.instances or home.seen is None else max(0, now - home.seen) / SECOND


def _is_name(rc: str, host: str) -> bool:
    try:
        check_rc(rc)
        check_name(host, "host")
    except BadName:
        return False
    return True
