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
    then counts as High. High also requires safe commands (spec.safety)."""
    availability: Level = "Medium"
    """Maximum time from the detection of a failure to the end of the recovery. Low: no limit. Medium: 2 s. High: 500
    ms."""
    resource_usage: Level = "Medium"
    """Limit on the CPU of a workload's standbys, as a share of a working instance's CPU. Low: only strategies whose
    standbys need at most 10%. Medium: the first strategy may need more, if that is necessary to meet safety,
    availability and taskCriticality; each later strategy at most 10%. High: no limit, and the fastest strategy comes
    first."""
    task_criticality: Level = "Low"
    """How much an interruption of the robot's task costs. The shorter time of this field and availability is required.
    Low: no limit. Medium: 2 s. High: 500 ms, and resourceUsage counts as High."""
