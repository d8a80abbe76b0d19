"""What must hold of the state that monitors keep of applications."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests.unit.interleavings.pods import Running
from understudy.api.base import seconds
from understudy.api.kinds.state_spec import KeptTopic, State
from understudy.api.protocol.kept_state import KeptState
from understudy.monitor.act.instances.state_manager import LEAST_READ_PERIOD, PERSIST
from understudy.monitor.loop import SLOW

KEPT = State(keep=[KeptTopic(topic="/progress", type="std_msgs/msg/String", restore_to="/resume")])
"""An application publishes its progress with each of its samples: the time at which it was sent."""

INTERVAL = seconds(KEPT.margin) + seconds(KEPT.period) + LEAST_READ_PERIOD + PERSIST + SLOW
"""Maximum age in seconds of restored state, compared with the newest that was kept. Newer state may be wrong already, and is not on the
disk yet if the monitor was replaced."""


class KeptStates:
    """What a recovery restores is never older than what its monitor had kept, beyond the interval of keeping."""

    def __init__(self, broken: Callable[[str], None]) -> None:
        self._broken = broken
        self._kept: dict[Path, dict[float, float]] = {}
        """By a monitor's folder: when (Unix seconds) the states were sent that were kept there, and from when on each is on the disk."""
        self._last_seen: dict[Path, float] = {}
        """By a monitor's folder, when its monitor was last seen to work."""
        self._expected: dict[str, float] = {}
        """By workload, when the newest state was sent that its monitor could select last. None may have been kept for a while before."""
        self.restored = 0

    def began(self, folder: Path) -> None:
        """A monitor begins with what its predecessor has stored in its folder. What that one kept at last was not on the disk yet."""
        ended = self._last_seen.get(folder, 0.0)
        self._kept[folder] = {sent: stored for sent, stored in self._kept.get(folder, {}).items() if stored <= ended}

    def kept(self, folder: Path, sent: float, now: float) -> None:
        """A monitor has kept state that an application sent at a time."""
        self._last_seen[folder] = now
        known = self._kept.setdefault(folder, {})
        if sent > max(known, default=0.0):
            known[sent] = now + PERSIST + SLOW

    def selected(self, workload: str, folder: Path, state: KeptState, onset: float, now: float) -> None:
        """A monitor has selected state to restore after a failure that began at a time (Unix seconds)."""
        self._last_seen[folder] = now
        safe, known = onset - seconds(KEPT.margin), self._kept.get(folder, {})
        known |= {float(sample.data): now for sample in state.samples}  # it is stored before it is given to an instance
        self._expected[workload] = max((sent for sent in known if sent <= safe), default=0.0)
        age = onset - self._expected[workload]
        if not state.samples and INTERVAL < age < seconds(KEPT.keep[0].max_age):
            self._broken(f"no state of {workload} is restored, and some was kept {age:.1f} s before the failure")

    def given(self, found: Running, state: KeptState) -> None:
        """An instance is given state."""
        newest = self._expected[found.robot]
        for sample in state.samples:
            self.restored += 1
            if (older := newest - float(sample.data)) > INTERVAL:
                self._broken(
                    f"{found.name} is given state that is {older:.1f} s older than what was kept of {found.robot}"
                )
