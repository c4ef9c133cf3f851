"""Finds the driver of an RC in a node file: a driver of zscout, or an installed plugin.

A plugin is an entry point of the group `zscout.drivers`; docs/how-to/write-a-driver.md explains how to write it."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Mapping
from importlib import import_module, metadata
from types import MappingProxyType
from typing import Any, Final

from zscout.config.devices import PluginRc, RcConfig
from zscout.config.packages import how_to_get
from zscout.config.strict import BadInput, Where, convert, quoted
from zscout.drivers.driver import Driver

log = logging.getLogger(__name__)

GROUP: Final = "zscout.drivers"

BUILT_IN: Final[Mapping[str, str]] = MappingProxyType(
    {
        "capacity": "zscout.drivers.generic:CapacityDriver",
        "command": "zscout.drivers.command_driver:CommandDriver",
        "exclusive": "zscout.drivers.generic:ExclusiveDriver",
        "framegrabber": "zscout.drivers.framegrabber:FramegrabberDriver",
        "radio": "zscout.drivers.radio:RadioDriver",
        "robot": "zscout.drivers.robot:RobotDriver",
        "video": "zscout.drivers.generic:VideoDriver",
    }
)
"""Module and class by name. They are imported on demand, with pyserial or OpenCV."""


def driver_for(rc: RcConfig) -> Driver:
    """The driver of an RC, with its options. Raises BadInput, with the package to install or the key to correct."""
    if isinstance(rc, PluginRc):
        return _make(rc, _plugin(rc))
    name = driver_name(rc)
    module, _, attribute = BUILT_IN[name].partition(":")
    try:
        found: type[Driver] = getattr(import_module(module), attribute)
    except ImportError as error:
        if missing := how_to_get(error):
            raise BadInput(f"{rc.name}: its driver {missing}") from error
        raise
    return found.configured(rc)


def driver_name(rc: RcConfig) -> str:
    return rc.driver if isinstance(rc, PluginRc) else str(rc.__struct_config__.tag)


def installed() -> dict[str, list[metadata.EntryPoint]]:
    """Installed plugins by name; several entries if packages conflict."""
    found: dict[str, list[metadata.EntryPoint]] = {}
    for entry in sorted(metadata.entry_points(group=GROUP)):
        places = found.setdefault(entry.name, [])
        if entry.value not in (known.value for known in places):
            places.append(entry)
    return found


def _plugin(rc: PluginRc) -> type[Driver]:
    at, known = rc.at / "driver", installed()
    places = known.get(rc.driver, [])
    if not places:
        names = sorted({*known, *BUILT_IN})
        near = difflib.get_close_matches(rc.driver, names, n=1)
        meant = f"did you mean {quoted(near[0])}? Install" if near else "install"
        there = ", ".join(map(quoted, names))
        raise at.bad(
            f"no driver {quoted(rc.driver)} is installed here",
            f"{meant} its package into this environment, or write one of {there}",
        )
    if len(places) > 1:
        packages = " and ".join(map(_origin, places))
        raise at.bad(f"{quoted(rc.driver)} comes with {packages}", "uninstall one of them")
    (entry,) = places
    try:
        found = entry.load()
    except (Exception, SystemExit) as error:
        raise _unfit(at, f"{_origin(entry)} can't be loaded", error) from error
    if not (isinstance(found, type) and issubclass(found, Driver)):
        raise at.bad(f"{_origin(entry)} is not a driver", "name a subclass of zscout.drivers.driver.Driver there")
    return found


def _make(rc: PluginRc, driver: type[Driver]) -> Driver:
    try:
        options: Any = convert(dict(rc.options), driver.Options, rc.at)
    except TypeError as error:
        what = f"the options of {driver.__module__}.{driver.__qualname__} can't be read: {error}"
        raise (rc.at / "driver").bad(what, "fix its class Options") from error
    try:
        return driver.configured(options)
    except ValueError as error:
        raise rc.at.bad(str(error) or "its driver refuses a value without a reason", "correct it") from error
    except Exception as error:
        raise _unfit(rc.at / "driver", f"{driver.__module__}.{driver.__qualname__} can't be created", error) from error


def _origin(entry: metadata.EntryPoint) -> str:
    package = f" of package {entry.dist.name} {entry.dist.version}" if entry.dist is not None else ""
    return f"{entry.value}{package}"


def _unfit(at: Where, what: str, error: BaseException) -> BadInput:
    log.debug("%s: %s", at.key, what, exc_info=error)
    remedy = f"it {missing}" if isinstance(error, ImportError) and (missing := how_to_get(error)) else ""
    words = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return at.bad(f"{what}: {words}", remedy or "fix that package, or install its needs; --log-level debug shows more")
