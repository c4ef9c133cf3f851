"""The components of one host, and their operations (`host/<host>/component`)."""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable
from typing import Final

import msgspec

from zscout import messages
from zscout.behaviors.components.component import installed_kinds
from zscout.config.fleet import Fleet, beside
from zscout.config.node import MAX_KINDS, ComponentsConfig
from zscout.config.strict import quoted
from zscout.keyexpr import BadName, check_name
from zscout.mesh import IncomingQuery, Mesh, Refused, Supervisor
from zscout.mesh.supervision import done_within
from zscout.rcm.authority import Authority
from zscout.services.node.component_process import ComponentProcess
from zscout.services.node.limits import ControlGroups
from zscout.services.node.process_use import RunningComponent

log = logging.getLogger("zscout.components")

MAX_ENDED: Final = 64  # ended components still listed
MAX_UNDERWAY: Final = 512  # operations at one time
MAKE_WAY: Final = 5.0  # seconds for a leaving incarnation to end before its successor is refused
GRACE: Final = 2.0  # seconds for components to end when their node stops


class ComponentHost:
    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        rules: ComponentsConfig,
        on_failure: Callable[[Exception], object],
        limits: ControlGroups | None = None,
        *,
        authority: Authority | None = None,
        kinds: Callable[[], dict[str, str]] = installed_kinds,
        process: type[ComponentProcess] = ComponentProcess,
    ) -> None:
        self.mesh, self._rules, self._kinds, self._process = mesh, rules, kinds, process
        self._fleet = msgspec.structs.replace(fleet, mesh=beside(fleet.mesh))
        self._authority = authority or Authority(fleet)
        self._limits = limits or ControlGroups()
        self._living: dict[str, ComponentProcess] = {}
        self._ended: OrderedDict[str, ComponentProcess] = OrderedDict()
        self._known: OrderedDict[str, int] = OrderedDict()  # the highest incarnation of each component started here
        self.supervisor = Supervisor("the component host", on_failure)
        self._looking: asyncio.Future[dict[str, str]] | None = None
        self._stopping = False

    async def start(self) -> None:
        await asyncio.to_thread(self._limits.sweep)
        self._served = [
            self.mesh.serve(
                key, messages.ComponentOperation, self._on_request, limit=messages.MAX_MOVE, unanswered=MAX_UNDERWAY
            )
            for key in self.mesh.keys.served_component(self.mesh.me.host)
        ]

    async def stop(self) -> None:
        """End all components in parallel, each within GRACE seconds."""
        self._stopping = True
        await asyncio.gather(*(process.stop(GRACE) for process in list(self._living.values())))
        for served in self._served:
            served.close()
        await self.supervisor.close()

    def take(self, rules: ComponentsConfig) -> None:
        """For later starts; running components continue."""
        self._rules = rules

    def running(self) -> list[RunningComponent]:
        """For the load report; callable from any thread."""
        return [
            RunningComponent(process.start.component, process.start.spec.kind, process.start.incarnation, pid)
            for process in list(self._living.values())
            if (pid := process.pid) is not None
        ]

    def _on_request(self, request: IncomingQuery[messages.ComponentOperation]) -> None:
        if self.mesh.keys.closed:
            self._authority.check_component(self.mesh.keys.sender_of(request.key), request.message)
        self.supervisor.spawn(self._answer(request))

    async def _answer(self, request: IncomingQuery[messages.ComponentOperation]) -> None:
        try:
            request.answer(await self._do(request.message))
        except Refused as refused:
            request.refuse(refused.problem)
        except BadName as error:
            request.refuse(messages.Problem("bad_request", str(error)))
        except Exception:
            log.exception("an operation on a component failed")
            request.refuse(messages.Problem("internal", "the request failed here; see this node's log"))

    async def _do(self, operation: messages.ComponentOperation) -> msgspec.Struct:
        match operation:
            case messages.StartComponent():
                return await self._start(operation)
            case messages.StopComponent():
                process = self._find(operation.component, operation.incarnation, old="unknown_component")
                return await process.stop(operation.grace)
            case messages.CheckpointComponent():
                return await self._find(operation.component).checkpoint()
            case messages.ListComponents():
                return await self._list(operation.component)
            case messages.ReadOutput():
                process = self._find(operation.component)
                begin, end, text = process.output.read(operation.start)
                own, over = process.start.incarnation, process.output.over
                return messages.Output(operation.component, own, begin, end, text, over)
            case messages.MoveComponent():
                check_name(operation.to, "host")
                if operation.to == self.mesh.me.host or operation.to_incarnation <= operation.incarnation:
                    raise Refused("bad_request", "it is moving to another host, and gets a higher incarnation there")
                return await self._find(operation.component, operation.incarnation).move(operation)
            case messages.RestoreComponent():
                return await self._find(operation.component, operation.incarnation).restore(operation)
            case messages.ActivateComponent():
                return await self._find(operation.component, operation.incarnation).activate(operation)

    async def _start(self, start: messages.StartComponent) -> msgspec.Struct:
        before = self._living.get(start.component)
        if before is not None and before.leaving and start.incarnation > before.start.incarnation:
            # It moved away, failed or stops: its successor may be started before its end.
            await done_within(MAKE_WAY, before.over.wait())
        process = self._same(start) or await self._launch(start)
        await process.settled.wait()
        return process.view()

    async def _launch(self, start: messages.StartComponent) -> ComponentProcess:
        self._check(start)
        kinds = await self._installed()
        # Another start may have arrived meanwhile.
        if process := self._same(start):
            return process
        where = kinds.get(start.spec.kind)
        if where is None:
            there = ", ".join(self._startable(kinds)) or "none"
            message = f"unknown kind {quoted(start.spec.kind)}; installed here: {there}"
            raise Refused("unknown_kind", message[: messages.MAX_ERROR])
        if len(self._living) >= self._rules.max:
            raise Refused("too_many", f"{len(self._living)} components run here, the most that [components] max allows")
        if self._stopping:
            raise Refused("not_allowed", "this node is stopping")
        name = start.component
        self._known[name] = start.incarnation
        self._known.move_to_end(name)
        while len(self._known) > messages.MAX_PLACED:
            self._known.popitem(last=False)
        self._ended.pop(name, None)
        process = self._process(
            self.mesh.me.host, self._fleet, self.mesh.now, self._limits, start, where, self._on_over
        )
        self._living[name] = process
        process.begin(self.supervisor)
        log.info("starting %s.%d (%s)", name, start.incarnation, start.spec.kind)
        return process

    def _same(self, start: messages.StartComponent) -> ComponentProcess | None:
        """The process of an equal earlier start. Raises Refused if another is in the way."""
        name = start.component
        process = self._living.get(name) or self._ended.get(name)
        if process is not None and process.start.incarnation == start.incarnation:
            return process
        known = self._known.get(name, 0)
        if start.incarnation <= known:
            raise Refused("old_incarnation", f"{name} was already started here as incarnation {known}")
        if name in self._living:
            raise Refused("runs_already", f"incarnation {known} of {name} runs here; stop it first")
        return None

    def _check(self, start: messages.StartComponent) -> None:
        check_name(start.component, "component")
        kinds = self._rules.kinds
        if not self._rules.allow:
            raise Refused("not_allowed", "this host starts no components: its node file has [components] allow = false")
        if kinds is not None and start.spec.kind not in kinds:
            allowed = ", ".join(kinds) or "none"
            message = f"this host does not start kind {quoted(start.spec.kind)}; [components] kinds allows {allowed}"
            raise Refused("not_allowed", message[: messages.MAX_ERROR])
        size = len(msgspec.json.encode(start.spec.params))
        if size > messages.MAX_PARAMS_SIZE:
            raise Refused("too_large", f"params are {size} bytes as JSON; write at most {messages.MAX_PARAMS_SIZE}")

    async def _list(self, component: str | None) -> messages.ComponentList:
        kinds = await self._installed()
        found = {**self._ended, **self._living}
        views = [found[name].view() for name in sorted(found) if component in (None, name)]
        return messages.ComponentList(self.mesh.me.host, views, self._startable(kinds)[:MAX_KINDS])

    async def _installed(self) -> dict[str, str]:
        """Concurrent callers share one search."""
        if self._looking is None or self._looking.done():
            self._looking = asyncio.ensure_future(asyncio.to_thread(self._kinds))
        return await asyncio.shield(self._looking)

    def _startable(self, kinds: dict[str, str]) -> list[str]:
        if not self._rules.allow:
            return []
        allowed = self._rules.kinds
        return sorted(kind for kind in kinds if allowed is None or kind in allowed)

    def _find(self, name: str, incarnation: int | None = None, *, old: str = "old_incarnation") -> ComponentProcess:
        """`old`: the refusal code if a higher incarnation was started here, so that the requested one has ended."""
        process = self._living.get(name) or self._ended.get(name)
        if process is None:
            raise Refused("unknown_component", f"there is no component {quoted(name[:80])} on this host")
        own = process.start.incarnation
        if incarnation is not None and incarnation != own:
            code = old if incarnation < own else "unknown_component"
            raise Refused(code, f"{name} has incarnation {own} on this host, not {incarnation}")
        return process

    def _on_over(self, process: ComponentProcess) -> None:
        name = process.start.component
        del self._living[name]
        self._ended[name] = process
        while len(self._ended) > MAX_ENDED:
            self._ended.popitem(last=False)
