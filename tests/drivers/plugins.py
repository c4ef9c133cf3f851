"""Packages with drivers, as pip would have installed them: a folder for `sys.path` or PYTHONPATH."""

from __future__ import annotations

from pathlib import Path


def install(site: Path, package: str, source: str, **drivers: str) -> None:
    """A package of one module, with `name="Class"` as its drivers."""
    info = site / f"{package}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    entries = "".join(f"{name} = {package}:{attribute}\n" for name, attribute in drivers.items())
    (info / "entry_points.txt").write_text(f"[zscout.drivers]\n{entries}")
    (site / f"{package}.py").write_text(source)
