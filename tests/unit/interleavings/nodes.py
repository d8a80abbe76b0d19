"""What nodes know of the API server: their networks may enforce a gate late or never, and one may live on that the API server has lost."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass
class Nodes:
    """The nodes that are not up to date."""

    lags: dict[str, float] = field(default_factory=dict)
    """By node, how many seconds late its network enforces gates; infinite if it enforces no change."""
    _behind: dict[tuple[str, str], tuple[str, ...]] = field(default_factory=dict)
    """By node and workload, the instances that it lets through although the gate has changed."""
    _put_off: dict[str, list[Callable[[], None]]] = field(default_factory=dict)
    """By node that the API server has lost, what its kubelet does once it is back."""

    def changes(self, workload: str, before: tuple[str, ...]) -> dict[str, float]:
        """A gate has changed. Returns the nodes that enforce it later, and after how many seconds."""
        for node in self.lags:
            self._behind.setdefault((node, workload), before)
        return {node: lag for node, lag in self.lags.items() if lag < math.inf}

    def catch_up(self, node: str, workload: str) -> None:
        """A node enforces a gate as it is now."""
        if self.lags.get(node, 0.0) < math.inf:
            self._behind.pop((node, workload), None)

    def heal(self, node: str) -> None:
        """A node enforces all gates at once again, if the API server has not lost it."""
        if node not in self._put_off:
            self.lags.pop(node, None)
            self._behind = {place: through for place, through in self._behind.items() if place[0] != node}

    def let_through(self, node: str, workload: str, allowed: tuple[str, ...]) -> tuple[str, ...]:
        """The instances that a node lets through, where an up-to-date one lets through those that are allowed."""
        return self._behind.get((node, workload), allowed)

    def is_late(self, node: str) -> bool:
        """Whether a node may enforce an old gate."""
        return node in self.lags or any(place[0] == node for place in self._behind)

    # -- nodes that the API server has lost -------------------------------------------------------------------------

    def forget(self, node: str) -> None:
        """The API server loses a node."""
        self.lags[node] = math.inf
        self._put_off.setdefault(node, [])

    def is_forgotten(self, node: str) -> bool:
        """Whether the API server has lost a node."""
        return node in self._put_off

    def put_off(self, node: str, work: Callable[[], None]) -> bool:
        """Put off what the kubelet of a lost node would do. Returns whether it is lost."""
        if node in self._put_off:
            self._put_off[node].append(work)
        return node in self._put_off

    def recall(self, node: str) -> list[Callable[[], None]]:
        """The API server has a node again. Returns what its kubelet does now."""
        work = self._put_off.pop(node, [])
        self.heal(node)
        return work
