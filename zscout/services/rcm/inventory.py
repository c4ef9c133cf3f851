"""Each candidate's knowledge of the devices of its fleet, for the time when it leads.

It follows tokens and states of RCs, asks the leader for the devices seen before it joined, and stores them in a file
of the node's state folder."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Final

import msgspec
from msgspec import structs

from zscout.config.fleet import Fleet
from zscout.config.state_folder import write_durably
from zscout.config.strict import BadInput, read_bytes
from zscout.keyexpr import Role, Token
from zscout.mesh import Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import MAX_STATE, Malformed, RcmState, RcState, StateAsk, decode_received, encode
from zscout.rcm.devices import ExpectedDevices, SeenHome, homes_in
from zscout.types import SECOND, Ns

log = logging.getLogger(__name__)

FILE: Final = "devices.json"
ASK_TIMEOUT_S: Final = 2.0
TRIES: Final = 3
SAVE_DELAY_S: Final = 5.0
"""Seconds for which changes are gathered before they are written."""
SAVE_PERIOD_S: Final = 300.0
"""Seconds between writes without changes: the file's date is when present devices were last seen."""


class _DeviceFile(msgspec.Struct):
    """The file. `written` is in seconds since 1970, as a host's monotonic clock ends when it restarts."""

    written: Annotated[float, msgspec.Meta(ge=0, le=1e11)]
    homes: list[SeenHome] = []


class Inventory:
    """Follows devices during a candidacy, and keeps them for the next."""

    def __init__(self, mesh: Mesh, fleet: Fleet, folder: Path | None = None) -> None:
        """`folder`: for its file; None: nothing is stored."""
        self.mesh = mesh
        self.devices = ExpectedDevices(fleet.devices)
        self._file = None if folder is None else folder / FILE
        self._declarations = ExitStack()
        self._load()

    def start(self, supervisor: Supervisor) -> None:
        keys, mesh = self.mesh.keys, self.mesh
        self._supervisor = supervisor
        # Existing tokens are reported again.
        self.devices.forget_tokens(mesh.now())
        for declared in (
            mesh.subscribe(keys.rc_state_any, RcState, supervisor.guard(self._on_state)),
            mesh.watch(keys.alive_any(Role.RC), supervisor.guard(self._on_token)),
            mesh.watch(keys.alive_any(Role.RCM), supervisor.guard(self._on_leader)),
        ):
            self._declarations.callback(declared.close)
        if self._file is not None:
            supervisor.spawn(self._keep_saving(self._file))

    def stop(self) -> None:
        self._declarations.close()

    def _on_token(self, token: Token, alive: bool) -> None:
        if alive:
            self.devices.token_came(token)
        else:
            self.devices.token_went(token, self.mesh.now())

    def _on_state(self, key: str, state: RcState) -> None:
        if self.mesh.keys.rc_of(key) != state.rc:
            return
        if state.leaving:
            self.devices.stopped(state.rc, state.host)
        elif not state.duplicate_of:
            self.devices.report(state)

    def _on_leader(self, token: Token, alive: bool) -> None:
        """Ask another leader for the devices that were seen before this host joined."""
        if alive and token.host != self.mesh.me.host:
            self._supervisor.spawn(self._catch_up())

    async def _catch_up(self) -> None:
        for _ in range(TRIES):
            key, ask = self.mesh.keys.rcm_state, StateAsk(devices_only=True)
            reply = await self.mesh.ask_one(key, ask, RcmState, timeout=ASK_TIMEOUT_S)
            if reply is not None and reply.message is not None:
                self.devices.remember(homes_in(reply.message.rcs), self.mesh.now())
                return
            await asyncio.sleep(ASK_TIMEOUT_S)
        log.info("the leader did not list its devices in %d tries", TRIES)

    def _load(self) -> None:
        if self._file is None or not self._file.exists():
            return
        try:
            kept: _DeviceFile = decode_received(read_bytes(self._file, max_bytes=MAX_STATE), _DeviceFile)
        except (BadInput, Malformed) as error:
            log.warning("%s can't be read, and is not used: %s", self._file, error)
            return
        # If the clock was set back, no age decreases.
        since = max(0.0, time.time() - kept.written)
        homes = (structs.replace(home, ago=home.ago + since) for home in kept.homes)
        self.devices.remember(homes, self.mesh.now())

    async def _keep_saving(self, file: Path) -> None:
        saved: tuple[int, Ns] | None = None
        while True:
            await asyncio.sleep(SAVE_DELAY_S)
            now = self.mesh.now()
            self.devices.forget_old(now)
            version = self.devices.version
            if saved is None or saved[0] != version or now - saved[1] > SAVE_PERIOD_S * SECOND:
                saved = version, now
                try:
                    await asyncio.to_thread(write_durably, file, self._contents(now))
                except OSError as error:
                    log.warning("%s can't be written: %s", file, error)

    def _contents(self, now: Ns) -> bytes:
        return encode(_DeviceFile(time.time(), self.devices.homes(now)))
