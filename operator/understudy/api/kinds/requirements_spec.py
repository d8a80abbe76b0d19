"""What a workload requires of its protection, in the paper's terms. Strategies of type Auto are ordered by these requirements."""

from __future__ import annotations

from typing import Literal

from understudy.api.base import Model

Level = Literal["Low", "Medium", "High"]


class Requirements(Model):
    """How important each of the paper's factors is (section III, taxonomy). docs/choosing.md explains each level."""

    safety: Level = "Low"
    """What must be known about the instance that takes over. Low: nothing more than the check that ends every recovery.
    Medium: pools with readiness Initialized or Executing are tried first, because their instances already run. High:
    Executing pools are tried first, because their standbys were observed to be healthy while they waited; resourceUsage
    then counts as High."""
    availability: Level = "Medium"
    """Maximum time from the detection of a failure to the end of the recovery. Low: no limit. Medium: 2 s. High: 500
    ms."""
    resource_usage: Level = "Medium"
    """CPU that the standbys of a workload may use. Low: for each strategy, at most one tenth of a working instance's
    CPU. Medium: for the first strategy, as much as it needs to be as fast as required; for each other one, at most one
    tenth. High: no limit, and the fastest strategy comes first."""
    task_criticality: Level = "Low"
    """How much an interruption of the robot's task costs. The shorter time of this field and availability is required.
    Low: no limit. Medium: 2 s. High: 500 ms, and resourceUsage counts as High."""
