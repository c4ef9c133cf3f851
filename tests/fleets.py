"""On which fleets a live test runs, as a pytest plugin: on a plain and on a secured one, unless a table says otherwise.

A secured one has certificates, roles, a group, `[access]` and quotas (`tests/live/rights.py`). Its runs are `slow`, but
for those of `QUICK`. docs/suite.md counts them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from tests.live.rights import PERSON, Present

TESTS: Final = Path(__file__).parent
QUICK: Final = ("live/test_smoke.py", "live/test_patterns.py")
"""Modules whose quick tests are quick on a secured fleet, too."""
SECURED: Final = frozenset(
    f"live/test_{name}.py"
    for name in (
        "admission",
        "closed_doors",
        "closed_fleet",
        "commands_by_role",
        "doctor",
        "doors",
        "floods",
        "interfaces",
        "liars",
        "sites",
    )
)
"""Modules about rights: they say themselves who has which, and where they need a plain fleet."""
_NO_FLEET: Final = "starts no node, or one alone"
_OWN: Final = "starts a fleet of its own, without a fleet file"
_FORGES: Final = "sends under other names, which certificates forbid: see test_closed_doors, test_liars, test_floods"
_RIGHTLESS: Final = "rights play no part: pictures, drivers, load, signals in the program itself"
PLAIN_ONLY: Final[dict[str, str]] = {
    "behaviors/test_guardian.py": _NO_FLEET,
    "cli/fleet/test_calls_home.py": _NO_FLEET,
    "cli/fleet/test_cert.py": _NO_FLEET,
    "cli/operator/test_watch.py": _NO_FLEET,
    "cli/simulation/test_replay.py": _NO_FLEET,
    "config/test_certificates.py": _NO_FLEET,
    "config/test_devices.py": _NO_FLEET,
    "config/test_node_file.py": _NO_FLEET,
    "deploy/test_files.py": _NO_FLEET,
    "deploy/test_install_host.py": _NO_FLEET,
    "drivers/test_capture.py": _NO_FLEET,
    "drivers/test_command_driver.py": _NO_FLEET,
    "drivers/test_lock.py": _NO_FLEET,
    "drivers/test_registry.py": _NO_FLEET,
    "services/bookings/test_khal.py": _NO_FLEET,
    "test_streams.py": _NO_FLEET,
    "services/node/test_component_process.py": _NO_FLEET,
    "services/node/test_limits.py": _NO_FLEET,
    "services/node/test_load_reporter.py": _NO_FLEET,
    "services/notify/test_notifier.py": _NO_FLEET,
    "services/recorder/test_finish.py": _NO_FLEET,
    "services/recorder/test_placement_pictures.py": _NO_FLEET,
    "services/recorder/test_robot_pictures.py": _NO_FLEET,
    "services/recorder/test_timeline.py": _NO_FLEET,
    "services/recorder/test_viewer_picture.py": _NO_FLEET,
    "studies/faults/test_simulation.py": _NO_FLEET,
    "studies/test_process_pool.py": _NO_FLEET,
    "studies/test_study.py": _NO_FLEET,
    "studies/test_study_placement.py": _NO_FLEET,
    "cli/test_main.py": _NO_FLEET,
    "test_model.py": _NO_FLEET,
    "test_node.py": _NO_FLEET,
    "live/test_demo.py": _OWN,
    "live/test_demo_robots.py": _OWN,
    "studies/chaos/test_smoke.py": _OWN,
    "surface/test_live.py": _OWN,
    "cli/simulation/test_simulate.py": _RIGHTLESS,
    "drivers/test_radio.py": _RIGHTLESS,
    "drivers/test_robot.py": _RIGHTLESS,
    "live/robots/test_blindness.py": _RIGHTLESS,
    "live/robots/test_loss_of_hold.py": _RIGHTLESS,
    "live/robots/test_net_at_work.py": _RIGHTLESS,
    "live/robots/test_warming_up.py": _RIGHTLESS,
    "live/test_blocking.py": _RIGHTLESS,
    "services/node/test_tree_load.py": _RIGHTLESS,
    "live/test_crowd.py": "the benchmark's empty queryable is on a plain session",
    "live/test_moving.py": "kills processes around a move for two minutes; test_component_moves has moves with rights",
    "fuzz/test_live.py": _FORGES,
    "services/recorder/test_robots_heard.py": _FORGES,
    "live/test_bad_input.py": _FORGES,
    "live/test_forgeries.py": _FORGES,
    "live/test_plain_doors.py": _FORGES,
    "deploy/test_units.py": "runs systemd's units as shipped; test_install_host covers a secured host",
    "docs/test_coming_from_labgrid.py": "a user releases another user's board; with rights only operators may",
    "live/test_versions.py": "version 0.1.0 has no [security]",
}
"""Modules, and why they have no secured fleet."""


def fleets(path: str) -> list[object]:
    """Of the tests of this module."""
    return ["plain", "secured" if path in QUICK else pytest.param("secured", marks=pytest.mark.slow)]


def pytest_configure(config: pytest.Config) -> None:
    os.environ["LOGNAME"] = PERSON  # a person is who the certificate says, and on a plain fleet the user
    config.addinivalue_line("markers", "plain_only(reason): a live test that can't run on a secured fleet")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    test = metafunc.definition
    path = test.path.relative_to(TESTS).as_posix()
    if test.get_closest_marker("live") is None or path in SECURED or path in PLAIN_ONLY:
        return
    if test.get_closest_marker("plain_only") is None and "stranger" not in metafunc.fixturenames:
        metafunc.parametrize("fleet_kind", fleets(path), indirect=True, scope="module")


@pytest.fixture(scope="module", autouse=True)
def fleet_kind(request: pytest.FixtureRequest) -> Iterator[str]:
    """The kind of fleet that a `Lab` is. A fixture of a module that makes one asks for this one."""
    kind = getattr(request, "param", "plain")
    Present.secured = kind == "secured"
    yield kind
    Present.secured = False
