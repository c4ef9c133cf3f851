"""Packages that an installation may lack (not in requirements/light.txt, or of an extra), and how to get them."""

from __future__ import annotations

import re
import shlex
import sys
from importlib import metadata
from importlib.util import find_spec
from typing import Final

from zscout.config.strict import Where

MODULES: Final = {"cv2": "opencv-python-headless", "numpy": "numpy", "rerun": "rerun-sdk"}
"""Modules that a light installation omits, each with its package."""
EXTRAS: Final = {"apprise": "apprise", "cryptography": "cryptography", "prometheus_client": "prometheus-client"}
"""Modules that only an extra adds, each with its package."""


def how_to_get(error: ImportError) -> str:
    """The missing package of this error and the command that installs it, as `needs numpy, ...`, to follow the name of
    a feature. "" for any other module."""
    package = (MODULES | EXTRAS).get((error.name or "").partition(".")[0])
    if package is None or not isinstance(error, ModuleNotFoundError):
        return ""
    try:
        required = metadata.requires("zscout") or []
    except metadata.PackageNotFoundError:  # run from its sources
        required = []
    wanted = next((line.partition(";")[0] for line in required if re.split(r"[^\w.-]", line)[0] == package), package)
    command = shlex.join([sys.executable, "-m", "pip", "install", wanted])
    return f"needs {package}, which is not installed here; install it with {command}"


def check_installed(module: str, at: Where) -> None:
    """Raises BadInput about this place in a file if the module that it needs is not installed."""
    if find_spec(module) is None:
        what, _, remedy = how_to_get(ModuleNotFoundError(name=module)).partition("; ")
        raise at.bad(what, remedy)
