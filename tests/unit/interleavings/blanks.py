"""What a monitor records and keeps, where nothing is: for simulations and benches that have no application's data."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from typing import Any

from understudy.api.protocol.kept_state import KeptState


class BlackBox:
    """Nothing is recorded."""

    def begin(self, *_: Any) -> None:
        return

    end = begin


class RobotReaders:
    """Every reader of the robot is behind the gate."""

    ungated = ""


class Keeping:
    """Nothing is kept."""

    source, adopted_nothing = None, True

    def take(self, *_: Any) -> None:
        return

    follow = judge = report_restored = housekeeping = take

    def awaited(self) -> str:
        return ""

    def select(self, onset: float) -> KeptState:
        return KeptState()

    select_for_recovery = select

    @contextlib.asynccontextmanager
    async def recovering(self) -> AsyncIterator[None]:
        yield
