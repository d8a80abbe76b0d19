"""What a workload requires of its protection, in the paper's terms. Strategies of type Auto are ordered by these requirements."""

from __future__ import annotations

from typing import Literal

from understudy.api.base import Model

Level = Literal["Low", "Medium", "High"]


class Requirements(Model):
    """How important each of the paper's factors is (section III, taxonomy). docs/choosing.md explains each level."""

    safety: Level = "Low"
    """What must be known about the instance that takes over. Low: only what is checked before every recovery counts as
    complete. Medium: instances that are already running are tried first (Initialized, Executing). High: an instance
    that was observed to be healthy while it waited is tried first (Executing), at any cost."""
    availability: Level = "Medium"
    """How soon after its detection a failure must be recovered from. Low: no limit. Medium: within 2 s. High: within
    500 ms."""
    resource_usage: Level = "Medium"
    """How many resources the standbys may use. Low: almost none (one tenth of the CPU of a working instance). Medium:
    what is needed to recover in time. High: everything that the pools offer."""
    task_criticality: Level = "Low"
    """How much an interruption of the robot's work costs. Low: no more than availability states. Medium: at least as
    much as with availability Medium. High: as much as with availability High, and resources do not matter."""
