"""What an agent keeps over a restart of its container: who claimed the pod, and the progress of its instance."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from understudy.agent.held_containers import write_atomically

_logger = logging.getLogger(__name__)

NAME = "agent.json"


@dataclass
class AgentMemory:
    """Kept in the emptyDir, which lives as long as the pod. Times are Unix seconds."""

    workload: str = ""
    """Who started the held containers; empty while nobody did."""
    claim: str = ""
    environment: dict[str, dict[str, str]] = field(default_factory=dict)
    """What the held containers are started with."""
    ros: dict[str, str] = field(default_factory=dict)
    started_at: float | None = None
    process_up_at: float | None = None
    ready_at: float | None = None
    configuration: dict[str, Any] | None = None
    """The monitor's last ``configure``."""
    standby: dict[str, Any] | None = None
    """What that said of an instance that waits."""
    brought: str = ""
    """What the instance was brought to by a procedure, as the monitor called it."""

    def variables(self, containers: Sequence[str]) -> dict[str, dict[str, str]]:
        """The environment of each held container: the robot's graph, and the container's own over it."""
        return {name: {**self.ros, **self.environment.get(name, {})} for name in containers}

    @classmethod
    def load(cls, directory: Path) -> AgentMemory:
        """What was kept; blank if nothing was or it cannot be read."""
        path = directory / NAME
        try:
            data = json.loads(path.read_text())
            known = {f.name for f in dataclasses.fields(cls)}
            return cls(**{key: value for key, value in data.items() if key in known})
        except FileNotFoundError:
            return cls()
        except (OSError, ValueError, TypeError, AttributeError) as error:
            _logger.error("%s cannot be read, continuing without: %s", path, error)
            return cls()

    def save(self, directory: Path) -> None:
        """Keep it. For the agent's eyes only: the environment may hold secrets. Raises OSError."""
        write_atomically(directory / NAME, json.dumps(dataclasses.asdict(self)), 0o600)
