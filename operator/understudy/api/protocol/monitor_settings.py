"""What the operator tells a workload's monitor, as ``settings.json`` in a ConfigMap that the monitor mounts.

It holds what the monitor can't read from the three kinds: resolved addresses, gate ports, the process environment for a claim.
"""

from __future__ import annotations

from pydantic import Field

from understudy.api.base import Model
from understudy.api.kinds.failure_policy import Strategy
from understudy.api.kinds.fallback_pool import Readiness
from understudy.api.kinds.procedure_spec import Check, Procedure
from understudy.api.kinds.switchover_spec import Drain


class PoolChoice(Model):
    """A pool that a strategy of the policy names and that serves this workload."""

    name: str = Field(description="FallbackPool.")
    readiness: Readiness = Field(description="Its readiness.")
    template_hash: str = Field(default="", description="Hash of the template whose pods may be claimed; empty: of any.")
    reserved: int = Field(default=0, description="The last ready pods of it that this workload may not take.")
    initialization: Procedure | None = Field(default=None, description="What brings its standbys to its readiness.")
    readiness_check: Check | None = Field(default=None, description="What must hold of its standbys.")
    keep_up: str | None = Field(
        default=None, description="Time between two hand-overs of the kept state to its standbys; absent for none."
    )


class Upstream(Model):
    """A workload that this one depends on, directly or through others."""

    name: str = Field(description="RobotWorkload.")
    depends_on: list[str] = Field(default_factory=list, description="Those that it depends on in turn.")


class WorkloadSettings(Model):
    """The settings of one workload's monitor."""

    workload: str = Field(description="RobotWorkload.")
    namespace: str = Field(description="Its namespace.")
    uid: str = Field(description="Its UID.")
    source_kind: str = Field(description="ReplicaSet (template), Deployment or StatefulSet (workloadRef).")
    source_name: str = Field(description="Name of the controller that replaces deleted pods.")
    source_selector: dict[str, str] = Field(
        default_factory=dict,
        description="For a workloadRef: matchLabels of its selector, so that the monitor sees new pods before they are labelled.",
    )
    ros_environment: dict[str, str] = Field(default_factory=dict, description="ROS environment of this robot's graph.")
    container_environment: dict[str, dict[str, str]] = Field(
        default_factory=dict,
        description="Per container of the template: the literal environment that a claimed pod is started with.",
    )
    instance_profiles: str = Field(
        default="", description="The profiles that a claimed pod is started with; empty where it needs none."
    )
    tasks_problem: str = Field(
        default="",
        description="Why the tasks, or some of them, have no proxy or one that can't do all; empty if it can.",
    )
    pools: list[PoolChoice] = Field(
        default_factory=list, description="Pools named by the policy that serve this workload."
    )
    drain: Drain | None = Field(
        default=None, description="Where the instance in control runs on a node that is to be emptied."
    )
    strategies: list[Strategy] | None = Field(
        default=None,
        description="The strategies in force, in order, where its policy has Auto or situations.",
    )
    situation: str | None = Field(
        default=None, description="The situation of the policy whose strategies these are; absent for none."
    )
    upstream: list[Upstream] = Field(
        default_factory=list,
        description="All that it depends on, each after those that it depends on in turn; none while that is a circle.",
    )
