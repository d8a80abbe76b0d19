"""Robots that only a mux commands, and instances that send to it and to monitors, each over a link that can be cut."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from tests.unit.interleavings.mux_processes import Mux
from tests.unit.interleavings.pods import Running
from tests.unit.interleavings.robots import Robots


class Listener(Protocol):
    """What a monitor receives directly from instances."""

    @property
    def listens(self) -> bool:
        """Whether its monitor lives."""

    def flow(self, found: Running) -> None:
        """What an instance sends to it may be something else now."""


@dataclass
class MuxRobots(Robots):
    """Robots with muxes."""

    muxes: dict[str, Mux] = field(default_factory=dict)
    """By workload."""
    cut: set[str] = field(default_factory=set)
    """UIDs of instances that do not reach the mux."""
    unheard: set[str] = field(default_factory=set)
    """UIDs of instances that no monitor hears."""
    joined_at: float = -1.0
    """When monitors that had not heard a pod, or no pod at all, last heard it again (Unix seconds)."""
    listeners: dict[str, list[Listener]] = field(default_factory=dict)
    """The monitors', by workload."""
    _emitting: set[str] = field(default_factory=set)

    def listen(self, robot: str, listener: Listener) -> None:
        """A monitor begins to listen."""
        self.listeners[robot] = [one for one in self.listeners.get(robot, []) if one.listens] + [listener]
        self.route(robot)

    def _selected(self, found: Running, robot: str, allowed: tuple[str, ...]) -> bool:
        mux = self.muxes.get(robot)
        return mux is not None and found.uid not in self.cut and mux.forwards(found)

    def _let_flow(self, robot: str) -> None:
        super()._let_flow(robot)
        for found in self.running.values():
            if found.robot != robot:
                continue
            for listener in self.listeners.get(robot, ()):
                listener.flow(found)
            if found.sends and found.uid not in self._emitting:
                self._emitting.add(found.uid)
                self.later(found.next_sample(self.now) - self.now, self._emit, found.uid)

    def _emit(self, uid: str) -> None:
        """An instance sends a sample."""
        found = self.running[uid]
        if not found.sends or found.ended:
            self._emitting.discard(uid)
            return
        mux = self.muxes.get(found.robot)
        if mux is not None and uid not in self.cut:
            mux.arrive(found)
        self.later(max(0.001, found.next_sample(self.now + 0.001) - self.now), self._emit, uid)

    def set_cut(self, uid: str, of: set[str], so: bool) -> None:
        """Cut an instance off from its mux or from all monitors, or join it again."""
        (of.add if so else of.discard)(uid)
        if of is self.unheard:
            self.joined_at = self.now
        if (found := self.running.get(uid)) is not None:
            self.route(found.robot)
