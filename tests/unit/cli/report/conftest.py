"""The stand-in for kubectl, and the clock, of the console's tests."""

from __future__ import annotations

from tests.unit.cli.console.conftest import in_the_present, stand

__all__ = ["in_the_present", "stand"]
