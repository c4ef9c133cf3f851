"""What an installation may lack (requirements/light.txt leaves it out, or an extra brings it), and how to get it."""

from __future__ import annotations

import re
import shlex
import sys
from importlib import metadata
from importlib.util import find_spec
from typing import Final

from zscout.config.strict import Where

MODULES: Final = {"cv2": "opencv-python-headless", "numpy": "numpy", "rerun": "rerun-sdk"}
"""What a light installation leaves out: the package that each module comes with."""
EXTRAS: Final = {"apprise": "apprise", "cryptography": "cryptography", "prometheus_client": "prometheus-client"}
"""The same of what only an extra brings."""


def how_to_get(error: ImportError) -> str:
    """What is missing where this import failed, with the command that brings it, to stand behind the name of what needs
    it; empty if it is none of these."""
    package = (MODULES | EXTRAS).get((error.name or "").partition(".")[0])
    if package is None or not isinstance(error, ModuleNotFoundError):
        return ""
    try:
        required = metadata.requires("zscout") or []
    except metadata.PackageNotFoundError:  # run from its sources
        required = []
    wanted = next((one.partition(";")[0] for one in required if re.split(r"[^\w.-]", one)[0] == package), package)
    command = shlex.join([sys.executable, "-m", "pip", "install", wanted])
    return f"needs {package}, which is not installed here; {command} brings it"


def check_installed(module: str, at: Where) -> None:
    """Refuses what stands `at` a place in a file where the module that it needs is not installed. Raises BadInput."""
    if find_spec(module) is None:
        what, _, remedy = how_to_get(ModuleNotFoundError(name=module)).partition("; ")
        raise at.bad(what, remedy)
