"""Settings that the operator gives a workload's monitor, as ``settings.json`` in a ConfigMap that the monitor mounts.

They contain what the monitor cannot read from the three kinds: resolved addresses, gate ports, and the environment for a claim.
"""

from __future__ import annotations

from pydantic import Field

from understudy.api.base import Model
from understudy.api.kinds.failure_policy import Strategy
from understudy.api.kinds.fallback_pool import LEVELS, Readiness, ReadinessLevel
from understudy.api.kinds.procedure_spec import Check, Procedure
from understudy.api.kinds.switchover_spec import Drain


class PoolChoice(Model):
    """A pool that serves this workload and that a strategy of the policy names."""

    name: str
    """FallbackPool."""
    readiness: Readiness
    """Its readiness."""
    template_hash: str = ""
    """Hash of the template whose pods may be claimed. Empty: any."""
    reserved: int = 0
    """How many of the last ready pods this workload may not claim."""
    initialization: Procedure | None = None
    """Procedure that brings the pool's standbys to their readiness."""
    readiness_check: Check | None = None
    """Condition that the pool's standbys must meet."""
    keep_up: str | None = None
    """Time between two transfers of the kept state to the pool's standbys. Absent: none."""

    @property
    def level(self) -> ReadinessLevel:
        """What its readiness means."""
        return LEVELS[self.readiness]


class Upstream(Model):
    """A workload that this one depends on, directly or indirectly."""

    name: str
    """RobotWorkload."""
    depends_on: list[str] = Field(default_factory=list)
    """The workloads that it depends on."""


class WorkloadSettings(Model):
    """Settings of one workload's monitor."""

    workload: str
    """RobotWorkload."""
    namespace: str
    """Namespace of the workload."""
    uid: str
    """Its UID."""
    source_kind: str
    """ReplicaSet (template), Deployment or StatefulSet (workloadRef)."""
    source_name: str
    """Name of the controller that replaces deleted pods."""
    source_selector: dict[str, str] = Field(default_factory=dict)
    """For a workloadRef: matchLabels of its selector, so that the monitor finds new pods before they are labelled."""
    ros_environment: dict[str, str] = Field(default_factory=dict)
    """ROS environment of this robot's graph."""
    container_environment: dict[str, dict[str, str]] = Field(default_factory=dict)
    """For each container of the template: the literal environment with which a claimed pod starts."""
    instance_profiles: str = ""
    """The DDS profiles with which a claimed pod starts. Empty if it needs none."""
    tasks_problem: str = ""
    """Why some or all tasks have no action proxy, or one with limits. Empty if there is no problem."""
    pools: list[PoolChoice] = Field(default_factory=list)
    """Pools that the policy names and that serve this workload."""
    drain: Drain | None = None
    """Set if the active instance runs on a node that is being drained."""
    strategies: list[Strategy] | None = None
    """The strategies in effect, in order, if the policy has Auto or situations."""
    situation: str | None = None
    """The policy's situation that these strategies belong to. Absent: none."""
    upstream: list[Upstream] = Field(default_factory=list)
    """All direct and indirect dependencies, each after its own. Empty if there is a cycle."""
