"""The light installation: what it leaves out, and what is said where that is asked for."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from zscout.config.packages import EXTRAS, MODULES, how_to_get

ROOT = Path(__file__).parents[2]


def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def pins(file: str) -> dict[str, str]:
    """Each package of a requirements file, with its version and hashes, wherever it is needed."""
    text = re.sub(r" ; .*(?= \\\n)", "", (ROOT / "requirements" / file).read_text())
    return {pin.partition("==")[0]: pin.strip() for pin in re.split(r"\n(?=\S)", text)}


def test_it_is_all_that_zscout_requires_but_what_it_names_as_left_out() -> None:
    whole, light = set(project()["project"]["dependencies"]), set(project()["dependency-groups"]["light"])
    assert light < whole
    assert {re.split(r"[^\w.-]", one)[0] for one in whole - light} == set(MODULES.values())


def test_its_versions_are_those_that_are_tested() -> None:
    light, tested = pins("light.txt"), pins("dev.txt")
    assert {"click", "eclipse-zenoh", "msgspec", "psutil", "pyserial", "rich", "uvloop"} <= light.keys()
    assert {name: tested[name] for name in light} == light
    assert not light.keys() & set(MODULES.values())


@pytest.mark.parametrize(
    ("module", "requirement"),
    [
        ("cv2", "'opencv-python-headless>=4.12'"),
        ("numpy.typing", "'numpy>=2'"),
        ("rerun.blueprint", "'rerun-sdk==0.41.*'"),
        ("cryptography.x509", "'cryptography>=46'"),
        ("prometheus_client", "'prometheus-client>=0.26'"),
        ("apprise", "'apprise<3,>=2.3'"),
    ],
)
def test_what_is_missing_is_named_with_the_command_that_brings_it(module: str, requirement: str) -> None:
    package = (MODULES | EXTRAS)[module.partition(".")[0]]
    said = how_to_get(ModuleNotFoundError(f"No module named {module!r}", name=module))
    command = f"{sys.executable} -m pip install {requirement}"
    assert said == f"needs {package}, which is not installed here; install it with {command}"


def test_other_errors_are_left_as_they_are() -> None:
    assert how_to_get(ModuleNotFoundError("No module named 'lab'", name="lab")) == ""
    assert how_to_get(ImportError("libGL.so.1: cannot open shared object file", name="cv2")) == ""
