"""Whose it is: who is asked before another user's is touched, and who is not."""

from __future__ import annotations

from pathlib import Path

from msgspec.structs import replace

from tests.mesh.kit import run
from zscout.behaviors.client.client import Client
from zscout.cli.common import Failed
from zscout.cli.ownership import User, ask_for_others
from zscout.config.access import AccessPolicy, Roles
from zscout.config.fleet import Fleet, default_fleet
from zscout.keyexpr import Sender
from zscout.messages import Who
from zscout.testing.memory import MemoryNetwork

PLAIN = default_fleet()
CLOSED = replace(PLAIN, security=Path("keys"), access=AccessPolicy(Roles(client=("bob",), operator=("ada",))))


def asked(fleet: Fleet, name: str, others: list[str], *, yes: bool = False) -> str:
    """Why it was not done; empty: it goes on."""

    async def story() -> str:
        mesh = MemoryNetwork().open(fleet.name, Sender(name, "cancel-1"))
        try:
            await ask_for_others(Client(mesh, fleet), others, "cancel", yes=yes)
        except Failed as failed:
            return str(failed)
        finally:
            await mesh.close()
        return ""

    return run(story())


def test_without_a_terminal_it_is_refused_with_the_remedy() -> None:
    assert asked(PLAIN, "ws1", ["survey of bob@ws2"]) == (
        "survey of bob@ws2 is not yours; to cancel it all the same, add --yes"
    )
    many = asked(PLAIN, "ws1", [f"a{number}" for number in range(20)])
    assert many.endswith("a7 and 12 more are not yours; to cancel all 20 all the same, add --yes")
    assert asked(PLAIN, "ws1", ["x"], yes=True) == ""
    assert asked(PLAIN, "ws1", []) == ""


def test_in_a_secured_fleet_only_operators_are_asked_and_the_fleet_refuses_others() -> None:
    assert "add --yes" in asked(CLOSED, "ada", ["survey of bob"])
    assert asked(CLOSED, "bob", ["survey of ada"]) == ""


def test_with_certificates_the_name_of_an_account_proves_nothing() -> None:
    ada = User("bob", "ada", proved=True)
    assert ada.owns("ada", Who("ada", "desk"))
    assert not ada.owns("bob", Who("bob", "desk"))
    assert User("bob", "ws1").owns("ws2", Who("bob", "ws2"))
