"""When a test that waits is taken to hang."""

from __future__ import annotations

from typing import Final

HANG: Final = 120.0
"""Seconds after which a condition that is awaited counts as one that never comes.

No test claims a speed by it: it only ends a run that would not end. How long something may take is measured
against something else in the same run, so that a busy machine changes no result."""
