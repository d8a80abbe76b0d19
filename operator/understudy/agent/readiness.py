"""The readiness of a standby: the procedure that it must have completed, and a check that must succeed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from understudy.agent.restoration.procedure_runner import InstanceActions, ReadinessCheck, places_of

if TYPE_CHECKING:
    from understudy.trees.core.health_tree import WatchedTopic


@dataclass(frozen=True)
class StandbyExpectation:
    """The monitor's requirements for a ready standby."""

    brought: str = ""
    """The procedure that it must have completed, under the monitor's name for it; empty if no procedure is needed."""
    check: Mapping[str, Any] | None = None
    """A check in the short form, instead of the health tree."""
    period: float = 1.0
    """Seconds between two evaluations of the check."""
    tree: bool = True
    """Whether the health tree must succeed if there is no check."""
    places: Mapping[str, str] = field(default_factory=dict)
    """Positions of the check's nodes in the text, if they were written in another language."""

    @classmethod
    def from_wire(cls, data: object) -> StandbyExpectation | None:
        """Read a ``configure`` request; None for an instance that is judged by its health tree alone.

        Raises ValueError.
        """
        if data is None:
            return None
        if not isinstance(data, Mapping):
            raise ValueError(f"standby is a mapping, not {data!r:.100}")
        check, period = data.get("check"), data.get("period", 1.0)
        if check is not None and not isinstance(check, Mapping):
            raise ValueError(f"standby.check is a mapping, not {check!r:.100}")
        if not isinstance(period, int | float) or isinstance(period, bool) or not 0 < period < 86400:
            raise ValueError(f"standby.period {period!r}: expected a number of seconds")
        places = places_of(data.get("places"))
        return cls(str(data.get("brought") or ""), check, float(period), bool(data.get("tree", True)), places)


class StandbyReadiness:
    """Determines whether a standby is ready."""

    def __init__(
        self,
        actions: Callable[[], InstanceActions],
        watch: Callable[[str, Sequence[WatchedTopic]], None],
        on_change: Callable[[], None],
    ) -> None:
        self._actions, self._watch, self._on_change = actions, watch, on_change
        self._expectation: StandbyExpectation | None = None
        self._checking: ReadinessCheck | None = None
        self._task: asyncio.Task[None] | None = None

    @property
    def reason(self) -> str:
        """Why the check does not succeed; empty if it does or there is none."""
        return self._checking.reason if self._checking is not None else ""

    def expect(self, expectation: StandbyExpectation | None) -> None:
        """Judge by this expectation from now on. Raises ValueError if its check does not load."""
        if expectation == self._expectation:
            return
        checking = None
        if expectation is not None and expectation.check is not None:
            from understudy.trees.languages.short.procedure_loader import load_check

            tree = load_check(expectation.check, path="readinessCheck", places=expectation.places)
            checking = ReadinessCheck(tree, expectation.period, self._actions)
        self._expectation = expectation
        if self._task is not None:
            self._task.cancel()
            self._task = None
        self._checking = checking
        self._watch("check", checking.tree.topics if checking else ())

    def judge(self, ready: bool, reason: str, *, brought: str, busy: str) -> tuple[bool, str]:
        """Return whether the standby is ready, and otherwise why not.

        ``ready`` and ``reason`` are the health tree's. ``busy`` describes the procedure that runs, or how the last one failed.
        """
        expectation = self._expectation
        if expectation is None:
            return ready, reason
        if expectation.brought and brought != expectation.brought:
            return False, f"not initialized{': ' if busy else ' yet'}{busy}"
        if self._checking is not None:
            if self._task is None:
                self._task = asyncio.create_task(self._checking.run(self._on_change), name="check")
            return not self._checking.reason, self._checking.reason
        return (ready, reason) if expectation.tree else (True, "")

    async def end(self) -> None:
        """Stop evaluating."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])
