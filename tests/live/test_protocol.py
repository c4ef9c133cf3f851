"""The pages of `docs/protocol.md` are complete: they name all that crosses the mesh, the code takes their examples,
and a client written from them alone survives everything that may happen to a client."""

from __future__ import annotations

import asyncio
import inspect
import json
import re
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

import zscout
from tests.hang import HANG
from tests.live.lab import Lab
from tests.protocol_pages import read_page
from zscout import messages
from zscout.behaviors.client.arc import hold
from zscout.keyexpr import Keys, Role, Sender
from zscout.messages import RcmState
from zscout.types import SECOND

STRUCTS: dict[str, Any] = {
    name: kind
    for name, kind in inspect.getmembers(messages, inspect.isclass)
    if issubclass(kind, messages.Message) and kind is not messages.Message
}
EXAMPLES = [
    example
    for page in ("example", "example-failover")
    for example in re.findall(r"`zscout\.(\w+)\.v1`[^\n]*\n\n```json\n(.*?)\n```", read_page(page), re.DOTALL)
]


@pytest.mark.parametrize("name", STRUCTS)
def test_the_document_names_every_message_and_field(name: str) -> None:
    section = re.search(rf"^### {name}\b.*?(?=^##|\Z)", read_page("messages"), re.DOTALL | re.MULTILINE)
    assert section is not None, f"docs/protocol/messages.md has no section on {name}"
    told = set(re.findall(r"^\| `(\w+)` \|", section.group(), re.MULTILINE))
    tag = STRUCTS[name].__struct_config__.tag_field
    fields = {field.encode_name for field in msgspec.structs.fields(STRUCTS[name])} | ({tag} if tag else set())
    assert told == fields


def test_the_document_names_every_error_code_and_outcome() -> None:
    sources = [path.read_text() for path in Path(zscout.__file__).parent.rglob("*.py")]
    raised = r"(?:Refused|Refusal|Problem)\(\s*\"(\w+)\""
    codes = {code for source in sources for code in re.findall(raised, source)} - {"unknown"}
    assert len(codes) > 15
    table = set(re.findall(r"^\| `(\w+)` \|", read_page("errors"), re.MULTILINE))
    assert codes <= table, f"not in docs/protocol/errors.md: {sorted(codes - table)}"


def test_the_document_names_every_key_and_role() -> None:
    keys, sender = Keys("fleet"), Sender("H", "C")
    both = keys, Keys("fleet", closed=True)
    page = read_page("keys")
    built = [
        keys.schedule(sender),
        keys.grants,
        keys.rcm_state,
        keys.rank,
        *(keys.component("H", sender) for keys in both),
        *(keys.placer(sender) for keys in both),
        keys.placements,
        keys.vote("K/N"),
        keys.command("K/N", sender),
    ]
    built += [keys.rc_state("K/N"), keys.frame("K/N"), keys.load("H"), keys.notice(sender), keys.requests(sender)]
    words = {"fleet": "<fleet>", "H": "<host>", "C": "<client>", "K": "<kind>", "N": "<name>"}
    for key in built:
        told = "/".join(words.get(chunk, chunk) for chunk in key.split("/"))
        assert f"| `{told}` |" in page
    roles = {value for name, value in vars(Role).items() if name.isupper()}
    tokens = page[page.index("## Tokens") :]
    assert roles == set(re.findall(r"^\| `(\w+)` \|", tokens, re.MULTILINE)) - {"role"}


@pytest.mark.parametrize(("name", "text"), EXAMPLES, ids=[name for name, _ in EXAMPLES])
def test_every_example_is_what_the_code_takes_and_sends(name: str, text: str) -> None:
    kind = STRUCTS[name]
    message = messages.decode(text.encode(), kind)
    known = {field.encode_name for field in msgspec.structs.fields(kind)} | {"op"}
    assert json.loads(text).keys() <= known
    assert messages.decode(messages.encode(message), kind) == message


def test_there_are_examples_of_a_whole_life() -> None:
    whole = "Ask Proposal Ballot Grants Notice Command Done Problem Release RcAsk RcState ClientRequests"
    assert set(whole.split()) <= {name for name, _ in EXAMPLES}


class PlainProcess:
    """The plain client as a process: orders in, events out."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.told: list[dict[str, Any]] = []

    @classmethod
    async def start(cls, lab: Lab, name: str) -> PlainProcess:
        mesh = lab.fleet.mesh
        program = str(Path(__file__).with_name("plain_client.py"))
        hold_lease = lab.fleet.timing.hold_lease / SECOND
        arguments = [lab.fleet.name, "elsewhere", name, mesh.multicast_address, str(mesh.lease), str(hold_lease)]
        keys = lab.fleet_of("elsewhere").security
        env = lab.env if keys is None else lab.env | {"KEYS": str(keys)}
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, program, *arguments),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            env=env,
        )
        return cls(process)

    async def order(self, do: str, **details: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": do, **details}).encode() + b"\n")
        await self.process.stdin.drain()

    async def told_of(self, what: str, *, since: int | None = None, **like: Any) -> dict[str, Any]:
        """The next event `what` whose fields are as given, or one `since` so many were told; others are passed over."""
        event: dict[str, Any]
        for event in self.told[len(self.told) if since is None else since :]:
            if event["what"] == what and like.items() <= event.items():
                return event
        assert self.process.stdout is not None
        try:
            async with asyncio.timeout(HANG):
                while line := await self.process.stdout.readline():
                    event = json.loads(line)
                    self.told.append(event)
                    if event["what"] == what and like.items() <= event.items():
                        return event
        except TimeoutError:
            pass
        raise AssertionError(f"no {what} with {like}; was told {self.told}")

    async def command(self, request_id: str, rc: str, action: dict[str, Any], **more: Any) -> dict[str, Any]:
        await self.order("command", id=request_id, rc=rc, action=action, **more)
        answer: dict[str, Any] = (await self.told_of("done"))["answer"]
        return answer

    async def end(self) -> int:
        assert self.process.stdin is not None
        self.process.stdin.close()
        async with asyncio.timeout(HANG):
            return await self.process.wait()

    def kill(self) -> None:
        if self.process.returncode is None:
            self.process.kill()


def holds(request_id: str, grant: Any = None) -> Callable[[RcmState], bool]:
    """Whether the RCM's state shows a hold of this id, under this grant if one is given."""
    wanted = None if grant is None else json.dumps(grant)
    return lambda state: any(view.id == request_id and wanted in (None, json.dumps(view.grant)) for view in state.holds)


@pytest.mark.essential
@pytest.mark.live
async def test_a_client_written_from_the_document_lives_a_whole_life(tmp_path: Path) -> None:
    async def live(lab: Lab, plain: PlainProcess) -> None:
        client = lab.clients[0]
        assert (await plain.told_of("ready"))["imported"] == []
        needs = {"robot/r": {}, "radio/f": {"rate": 4}}

        # It waits behind a program of the same priority, then has its turn.
        async with hold(client, "first", {"robot/r": {}}, priority=1, min_runtime=60):
            await plain.order("ask", id="q1", arc="plain", needs=needs, priority=1, min_runtime=600)
            queued = await plain.told_of("notice", id="q1", state="queued")
            assert queued["ahead"] == 0
            assert "robot/r" in queued["reason"]
        entered = await plain.told_of("entered", id="q1")
        assert await plain.command("q1", "robot/r", {"name": "echo", "value": 42}) == {"result": 42}
        assert (await plain.command("q1", "robot/r", {"name": "fly"}))["code"] == "unknown_command"

        # It is preempted, waits at its old place, and is back; what it held is closed to it meanwhile.
        async with hold(client, "operator", {"robot/r": {}}, priority=10, min_runtime=60):
            preempted = await plain.told_of("notice", id="q1", state="queued", outcome="preempted")
            assert preempted["by"].startswith("test/rival/")
            refused = await plain.command("q1", "robot/r", {"name": "echo"}, grant=entered["grant"])
            assert refused["code"] == "ended"
        again = await plain.told_of("entered", id="q1")
        assert again["grant"] > entered["grant"]

        # It waits with a second request while the leader is killed: it keeps its hold and its place.
        await plain.order("ask", id="q2", arc="next", needs={"robot/r": {}}, priority=0, min_runtime=600)
        waiting = await plain.told_of("notice", id="q2", state="queued")
        before = await lab.state(client, holds("q1", again["grant"]))
        lab.nodes[before.host].send_signal(signal.SIGKILL)
        asked = await plain.told_of("asked_by_rcm")
        assert asked["promise"] > list(before.term)
        assert {told["id"] for told in asked["answer"]["requests"]} == {"q1", "q2"}
        after = await lab.state(client, lambda state: state.term > before.term and holds("q1")(state))
        assert after.host != before.host
        assert holds("q1", again["grant"])(after)
        assert [json.loads(json.dumps(view.place)) for view in after.queue] == [waiting["place"]]
        assert await plain.command("q1", "robot/r", {"name": "echo", "value": 1}) == {"result": 1}

        # It gives back, which gives the second its turn, and cancels that. Ending twice is no error.
        told = len(plain.told)
        await plain.order("release", id="q1")
        assert (await plain.told_of("given_up"))["answer"]["outcome"] == "released"
        await plain.told_of("entered", since=told, id="q2")
        await plain.order("cancel", id="q2")
        assert (await plain.told_of("given_up"))["answer"]["outcome"] == "cancelled"
        await plain.order("release", id="q2")
        assert (await plain.told_of("given_up"))["answer"]["state"] == "ended"

        # Asked again under an id that is over, the RCM says so and starts nothing.
        await plain.order("ask", id="q2", arc="next", needs={"robot/r": {}}, priority=0, min_runtime=600)
        await plain.told_of("notice", id="q2", state="ended", outcome="cancelled")
        await lab.state(client, lambda state: not state.holds and not state.queue)
        await plain.order("ask", id="q3", arc="bad arc", needs={}, priority=0, min_runtime=1)
        assert (await plain.told_of("refused", id="q3"))["code"] == "bad_request"
        assert await plain.end() == 0

    async with Lab(tmp_path, candidates=("a", "b")) as lab:
        lab.node("c", "robot/r", "radio/f:rate=5", extra="candidate = false")
        lab.node("a")
        lab.node("b")
        await lab.begun("rival")
        plain = await PlainProcess.start(lab, "plain")
        try:
            await live(lab, plain)
        finally:
            plain.kill()
