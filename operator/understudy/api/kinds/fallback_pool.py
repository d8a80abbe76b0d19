"""FallbackPool: instances that wait at a given readiness."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from understudy.api.base import Duration, Model, ObjectName, Percentage, matching, rules
from understudy.api.conditions import Condition, Time
from understudy.api.kinds.pod_template import pod_template
from understudy.api.kinds.procedure_spec import Check, Procedure

Readiness = Literal["Uninitialized", "Initialized", "Executing"]

WARM_PATH_PATTERN = r"^/[^\x00-\x1f]+$"

WarmPath = Annotated[
    str,
    Field(
        pattern=WARM_PATH_PATTERN,
        max_length=1024,
        json_schema_extra=matching(WARM_PATH_PATTERN, "write the absolute path of a file or folder, such as /opt/app"),
    ),
]
"""A file or folder in the containers."""


class LabelSelectorRequirement(Model):
    """One expression of a label selector."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "self.operator in ['In', 'NotIn'] ? has(self.values) && size(self.values) > 0 "
                ": !has(self.values) || size(self.values) == 0",
                "values are required for the operators In and NotIn, and not allowed for others",
                ".values",
            ),
        )
    }

    key: str = Field(min_length=1, max_length=317, description="Label key.")
    operator: Literal["In", "NotIn", "Exists", "DoesNotExist"] = Field(description="In, NotIn, Exists or DoesNotExist.")
    values: list[Annotated[str, Field(max_length=63)]] | None = Field(
        default=None, max_length=64, description="Values. Only for the operators In and NotIn."
    )


class LabelSelector(Model):
    """A label selector, as elsewhere in Kubernetes. An empty selector selects everything."""

    match_labels: dict[str, str] | None = Field(default=None, description="Labels that must all be present.")
    match_expressions: list[LabelSelectorRequirement] | None = Field(
        default=None, max_length=16, description="Expressions that must all be true."
    )


class TemplateSource(Model):
    """Source of the pool's pod template."""

    workload: ObjectName = Field(description="Name of the RobotWorkload whose template is used.")


class KeepUp(Model):
    """How a waiting standby receives the state of the active instance."""

    period: Duration = Field(default="5s", description="Time between two transfers of the kept state.")


class Reserve(Model):
    """Pods of a shared pool that are reserved for critical workloads."""

    pods: int = Field(default=1, ge=1, le=1000, description="How many ready pods are reserved.")
    pool_priority: int = Field(
        ge=-999, le=1000, description="Minimum spec.poolPriority of a RobotWorkload that may claim reserved pods."
    )


class Sizing(Model):
    """How to compute the size of a shared pool from its workloads' failures. The command `understudy size` uses the same calculation."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(("self.min <= self.max", "min must not be greater than max", ".min"))
    }

    risk: Percentage = Field(
        description="The accepted risk, such as 1%. The pool is made large enough to stay below it."
    )
    risk_of: Literal["Loss", "Waiting"] = Field(
        default="Loss",
        description="What the risk refers to. Loss: a failure finds no ready pod, and the policy's next strategy is used. "
        "Waiting: a failure must wait for a pod; for policies with waitFor.",
    )
    failures_per_robot_hour: float = Field(
        default=1.0,
        ge=0.0001,
        le=3600,
        description="Assumed number of failures per robot and hour while none have been observed. It has the weight of one "
        "observed failure.",
    )
    refill: Duration = Field(
        default="30s",
        description="Time from a claim until a replacement pod is ready. Usually the start-up time of a pod.",
    )
    history: Duration = Field(default="24h", description="Length of the time window in which failures count.")
    min: int = Field(default=1, ge=0, le=1000, description="Minimum number of pods.")
    max: int = Field(ge=0, le=1000, description="Maximum number of pods, even if the risk is then exceeded.")


class UpdateStrategy(Model):
    """What happens to the waiting pods of a shared pool when its template changes. Claimed pods never change."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "self.type == 'Recreate' || !has(self.minReady)",
                "minReady is allowed only for type Recreate, because OnReplenish does not remove pods",
                ".minReady",
            )
        )
    }

    type: Literal["Recreate", "OnReplenish"] = Field(
        default="Recreate",
        description="Recreate: new pods are created and replace the waiting ones. OnReplenish: waiting pods stay until they "
        "are claimed, and their replacements use the new template.",
    )
    min_ready: int | None = Field(
        default=None,
        ge=0,
        le=1000,
        description="For type Recreate: minimum number of ready pods during the update. Old pods above this number are "
        "deleted immediately to make room. Absent: an old pod is deleted only when a new ready pod replaces it.",
    )


class FallbackPoolSpec(Model):
    """A pool of warm instances."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "self.readiness == 'Uninitialized' ? (has(self.replicas) || has(self.sizing)) && !has(self.perWorkload) "
                ": has(self.perWorkload) && !has(self.replicas) && !has(self.sizing)",
                "an Uninitialized pool is shared and needs replicas or sizing; an Initialized or Executing pool "
                "needs perWorkload, because its standbys belong to one robot's ROS graph",
            ),
            (
                "!has(self.replicas) || !has(self.sizing)",
                "replicas and sizing exclude each other: sizing computes the size from failures, between its "
                "min and max. Remove sizing to set replicas",
                ".replicas",
            ),
            (
                "self.readiness == 'Uninitialized' ? has(self.template) != has(self.templateFrom) "
                ": !has(self.template) && !has(self.templateFrom)",
                "an Uninitialized pool needs exactly one of template and templateFrom; an Initialized or "
                "Executing pool has neither, because it uses the template of each workload",
            ),
            *(
                (
                    f"self.readiness != 'Uninitialized' || !has(self.{field})",
                    f"{field} is allowed only for pools with readiness Initialized or Executing",
                    f".{field}",
                )
                for field in ("initialization", "readinessCheck", "keepUp")
            ),
            (
                "self.readiness == 'Uninitialized' || !has(self.reserve)",
                "reserve is allowed only for pools with readiness Uninitialized, because other standbys belong "
                "to one workload",
                ".reserve",
            ),
            (
                "self.readiness == 'Uninitialized' || !has(self.updateStrategy)",
                "updateStrategy is allowed only for pools with readiness Uninitialized: other standbys use "
                "their workload's template, and an old one stays until the new one is ready",
                ".updateStrategy",
            ),
            (
                "self.readiness != 'Initialized' || has(self.initialization)",
                "an Initialized pool needs an initialization, which brings its standbys to the readiness",
                ".initialization",
            ),
            ("self.readiness == oldSelf.readiness", "readiness is immutable: create another pool", ".readiness"),
        )
    }

    readiness: Readiness = Field(
        description="How far the pool's instances are prepared. Uninitialized: pods run, and their processes wait until a "
        "robot is assigned. Initialized: the application is running and configured. Executing: the application "
        "runs completely, and the gate blocks its outputs."
    )
    replicas: int | None = Field(
        default=None,
        ge=0,
        le=1000,
        description="Number of unclaimed pods to keep (Uninitialized). Set either this field or sizing.",
    )
    sizing: Sizing | None = Field(
        default=None,
        description="Compute the number of unclaimed pods from the failures of the workloads that use the pool "
        "(Uninitialized). Set either this field or replicas. See docs/sizing.md.",
    )
    per_workload: int | None = Field(
        default=None, ge=0, le=8, description="Number of standbys for each workload (Initialized, Executing)."
    )
    workload_selector: LabelSelector = Field(
        description="Selects the RobotWorkloads that this pool serves by their labels, in the same namespace."
    )
    template: dict[str, Any] | None = Field(
        default=None,
        description="Pod template of an Uninitialized pool. Every container needs a command, because it is held until the "
        "pod is claimed.",
        json_schema_extra=pod_template(
            (
                "has(self.command) && size(self.command) > 0",
                "command is required in a pool's template: the container is held until the pod is claimed, and "
                "then runs the command",
                ".command",
            )
        ),
    )
    template_from: TemplateSource | None = Field(
        default=None, description="Use the template of a RobotWorkload instead of template."
    )
    initialization: Procedure | None = Field(
        default=None,
        description="Procedure that brings a started standby to the pool's readiness, such as lifecycle transitions "
        "(Initialized, Executing). Required for Initialized. Absent for Executing: the workload's bringUp is "
        "used.",
    )
    readiness_check: Check | None = Field(
        default=None,
        description="Condition that a standby must meet before it counts as ready (Initialized, Executing). Absent for "
        "Executing: the policy's health tree is used. Absent for Initialized: the initialization must have "
        "succeeded.",
    )
    keep_up: KeepUp | None = Field(
        default=None,
        description="Transfers current state to waiting standbys (Initialized), so that a failover has less to restore.",
    )
    reserve: Reserve | None = Field(
        default=None,
        description="Keep the last ready pods for critical workloads (Uninitialized). Absent: any workload may claim the "
        "last pod. See docs/waiting.md.",
    )
    update_strategy: UpdateStrategy | None = Field(
        default=None,
        description="What happens to waiting pods when the pool's template changes (Uninitialized). Absent: Recreate.",
    )
    warm_paths: list[WarmPath] = Field(
        default_factory=list,
        max_length=16,
        description="Files and folders in the containers to read once while the containers are held, so that they are in "
        "the page cache.",
    )

    def kept_from(self, priority: int) -> int:
        """Return how many of the ready pods a workload with this poolPriority may not claim."""
        return self.reserve.pods if self.reserve is not None and priority < self.reserve.pool_priority else 0


class SizingStatus(Model):
    """The computed size and the figures behind it. Figures have two significant digits."""

    size: int = Field(description="Number of unclaimed pods to keep now.")
    last_change: Time = Field(description="When the size last changed, RFC 3339.")
    needed: int = Field(description="Size that meets the risk at the expected rate, before min and max are applied.")
    robots: int = Field(description="Number of workloads that can claim a pod of this pool.")
    failures: int = Field(description="Number of claims that the workloads needed within the history.")
    robot_hours: float = Field(description="Total time for which the workloads were observed, in robot hours.")
    failures_per_robot_hour: float = Field(description="Expected number of failures per robot and hour.")
    low: float = Field(description="Lower bound of the 95% interval of the rate.")
    high: float = Field(description="Upper bound of the 95% interval of the rate.")


class FallbackPoolStatus(Model):
    """Observed state."""

    observed_generation: int | None = Field(
        default=None, description="Generation of the spec that was last reconciled."
    )
    replicas: int | None = Field(default=None, description="Number of unclaimed pods that exist.")
    desired: int | None = Field(default=None, description="Number of pods that should exist.")
    ready: int | None = Field(default=None, description="Number of pods that could take over now.")
    claimed: int | None = Field(default=None, description="Number of this pool's pods that control a robot.")
    updated: int | None = Field(
        default=None,
        description="Number of unclaimed pods with the current template; see the condition Updated (Uninitialized).",
    )
    waiting: int | None = Field(
        default=None,
        description="Number of workloads that wait for a pod of this pool; see the condition Available (Uninitialized).",
    )
    sizing: SizingStatus | None = Field(default=None, description="Result of spec.sizing.")
    selector: str | None = Field(
        default=None, description="Label selector of the pool's pods, for the scale subresource."
    )
    conditions: list[Condition] | None = Field(
        default=None,
        description="Accepted: the spec is valid, and pods can be created. Ready: every pod of the desired number could "
        "take over now. Available (Uninitialized): a pod could be claimed now; with the reason Dry, the message "
        "lists the workloads that wait, in order. Sized (if spec.sizing is set): the computed size and the "
        "reason for it; False if max is too small for the risk. Updated (Uninitialized): every unclaimed pod "
        "uses the current template, or the update strategy allows an earlier one. Moving: pods are being "
        "replaced on other nodes, because their node is being drained or was lost.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["type"]},
    )
