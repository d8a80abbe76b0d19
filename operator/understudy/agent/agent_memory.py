"""The state that an agent keeps over a restart of its container: who claimed the pod, and the progress of its instance."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from understudy.api.protocol.agent_messages import GateEpoch
from understudy.clock import CLOCK
from understudy.process.file_replacement import replace_file

_logger = logging.getLogger(__name__)

NAME = "agent.json"


@dataclass
class AgentMemory:
    """Stored in the agent's own emptyDir, which lives as long as the pod.

    Times are of the process's clock; in the file, of the system's.
    """

    workload: str = ""
    """The workload that started the held containers; empty if none has."""
    claim: str = ""
    environment: dict[str, dict[str, str]] = field(default_factory=dict)
    """The environment with which the held containers are started."""
    ros: dict[str, str] = field(default_factory=dict)
    started_at: float | None = None
    process_up_at: float | None = None
    ready_at: float | None = None
    configuration: dict[str, Any] | None = None
    """The monitor's last ``configure`` request."""
    standby: dict[str, Any] | None = None
    """The readiness that the request expects of a waiting instance."""
    brought: str = ""
    """As AgentStatus.initialized."""
    epoch: int = 0
    """The newest epoch of the gate that a monitor of the workload has sent."""
    workload_uid: str = ""
    """UID of the RobotWorkload whose epoch that is."""

    def variables(self, containers: Sequence[str]) -> dict[str, dict[str, str]]:
        """Return the environment of each held container.

        It is that of the robot's graph, overridden by the container's own.
        """
        return {name: {**self.ros, **self.environment.get(name, {})} for name in containers}

    def refuses(self, pod: str, owner: str, workload: str, claim: str) -> str | None:
        """Return why a monitor of a workload, with its claim, may not command this pod; None if it may.

        ``owner`` is the workload for which the pod was created; empty for a pod of a shared pool.
        """
        if owner and workload != owner:
            return f"pod {pod} is an instance of {owner}, not of {workload}"
        if owner or not self.workload:
            return None
        if (workload, claim) != (self.workload, self.claim):
            return f"pod {pod} is claimed by {self.workload} ({self.claim})"
        return None

    def outdated(self, epoch: GateEpoch) -> str | None:
        """Return why a request of this epoch may not be carried out; None if it may."""
        same = epoch.workload_uid == self.workload_uid or not epoch.workload_uid
        if same and epoch.number < self.epoch:
            return (
                f"the request is of epoch {epoch.number} of the gate, and this agent knows epoch {self.epoch}: another "
                "monitor has switched the gate since"
            )
        return None

    def learn(self, epoch: GateEpoch) -> bool:
        """Remember the newest epoch. Returns whether it was not known."""
        if not epoch.workload_uid or (epoch.workload_uid, epoch.number) == (self.workload_uid, self.epoch):
            return False
        self.workload_uid, self.epoch = epoch.workload_uid, epoch.number
        return True

    @classmethod
    def load(cls, directory: Path) -> AgentMemory:
        """Return what was stored; blank if nothing was stored or it cannot be read."""
        path = directory / NAME
        try:
            data = json.loads(path.read_text())
            known = {f.name for f in dataclasses.fields(cls)}
            return cls(**{key: value for key, value in data.items() if key in known})._moved(-CLOCK.step())
        except FileNotFoundError:
            return cls()
        except (OSError, ValueError, TypeError, AttributeError) as error:
            _logger.error("%s cannot be read, continuing without: %s", path, error)
            return cls()

    def save(self, directory: Path) -> None:
        """Store it, readable by the agent only: the environment may contain secrets. Raises OSError."""
        replace_file(directory / NAME, json.dumps(dataclasses.asdict(self._moved(CLOCK.step()))), mode=0o600)

    def _moved(self, seconds: float) -> AgentMemory:
        def moved(moment: float | None) -> float | None:
            return moment + seconds if moment is not None else None

        return dataclasses.replace(
            self,
            started_at=moved(self.started_at),
            process_up_at=moved(self.process_up_at),
            ready_at=moved(self.ready_at),
        )
