"""FallbackPool: warm instances that wait at a readiness."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from understudy.api.base import Duration, Model, ObjectName, Percentage, matching, rules
from understudy.api.conditions import Condition, Time
from understudy.api.kinds.procedure_spec import Check, Procedure
from understudy.api.schema.pod_template import pod_template

Readiness = Literal["Uninitialized", "Initialized", "Executing"]

WARM_PATH_PATTERN = r"^/[^\x00-\x1f]+$"

WarmPath = Annotated[
    str,
    Field(
        pattern=WARM_PATH_PATTERN,
        max_length=1024,
        json_schema_extra=matching(WARM_PATH_PATTERN, "write an absolute path of a file or folder, such as /opt/app"),
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
                "values are required for the operators In and NotIn, and only for them",
                ".values",
            ),
        )
    }

    key: str = Field(min_length=1, max_length=317, description="Label key.")
    operator: Literal["In", "NotIn", "Exists", "DoesNotExist"] = Field(description="In, NotIn, Exists or DoesNotExist.")
    values: list[Annotated[str, Field(max_length=63)]] | None = Field(
        default=None, max_length=64, description="Values for In and NotIn."
    )


class LabelSelector(Model):
    """A label selector as in the rest of Kubernetes; an empty one selects everything."""

    match_labels: dict[str, str] | None = Field(default=None, description="Labels that must all be there.")
    match_expressions: list[LabelSelectorRequirement] | None = Field(
        default=None, max_length=16, description="Expressions that must all hold."
    )


class TemplateSource(Model):
    """Where the pool's pod template is taken from."""

    workload: ObjectName = Field(description="RobotWorkload whose template is used.")


class KeepUp(Model):
    """How a waiting standby keeps up with the instance in control."""

    period: Duration = Field(default="5s", description="Time between two hand-overs of the kept state.")


class Reserve(Model):
    """The last pods of a shared pool, which not every workload may take."""

    pods: int = Field(default=1, ge=1, le=1000, description="How many of the pods that are ready.")
    pool_priority: int = Field(
        ge=-999, le=1000, description="The least spec.poolPriority of a RobotWorkload that may take them."
    )


class Sizing(Model):
    """How a shared pool's size follows the failures of its robots, as `understudy size` reckons."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(("self.min <= self.max", "min must not be above max", ".min"))
    }

    risk: Percentage = Field(description="The risk that the pool's size is to keep, such as 1%.")
    risk_of: Literal["Loss", "Waiting"] = Field(
        default="Loss",
        description="What it is a risk of. Loss: a failure finds no pod, and its policy's next strategy is taken. Waiting: it has to wait "
        "for one, for policies with waitFor.",
    )
    failures_per_robot_hour: float = Field(
        default=1.0,
        ge=0.0001,
        le=3600,
        description="What is assumed while nothing was seen: how often a robot asks for a pod. It counts as one failure.",
    )
    refill: Duration = Field(
        default="30s",
        description="From a failure until another pod is ready in place of the one that it took: about what a pod takes to start.",
    )
    history: Duration = Field(default="24h", description="How far back failures count.")
    min: int = Field(default=1, ge=0, le=1000, description="It never has fewer pods.")
    max: int = Field(ge=0, le=1000, description="It never has more pods, whatever the risk.")


class UpdateStrategy(Model):
    """What becomes of a shared pool's waiting pods when its template changes. Claimed ones stay as they are."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "self.type == 'Recreate' || !has(self.minReady)",
                "minReady is only for type Recreate: with OnReplenish no pod is taken away",
                ".minReady",
            )
        )
    }

    type: Literal["Recreate", "OnReplenish"] = Field(
        default="Recreate",
        description="Recreate: new ones are made beside them, and they go. OnReplenish: they wait on until they are claimed, and the ones "
        "that are made in their place are of the new template.",
    )
    min_ready: int | None = Field(
        default=None,
        ge=0,
        le=1000,
        description="Ready pods that could be claimed and that are left while new ones start (Recreate); the others of the old template "
        "go at once and make room. Absent: none goes before there is a ready one in its place.",
    )


class FallbackPoolSpec(Model):
    """A warm pool."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "self.readiness == 'Uninitialized' ? (has(self.replicas) || has(self.sizing)) && !has(self.perWorkload) "
                ": has(self.perWorkload) && !has(self.replicas) && !has(self.sizing)",
                "an Uninitialized pool has replicas or sizing (it is shared); an Initialized or Executing one has perWorkload "
                "(such a standby lives in one robot's ROS graph)",
            ),
            (
                "!has(self.replicas) || !has(self.sizing)",
                "replicas and sizing exclude each other: with sizing the size follows the failures, between its min and max; remove "
                "sizing to set replicas by hand",
                ".replicas",
            ),
            (
                "self.readiness == 'Uninitialized' ? has(self.template) != has(self.templateFrom) "
                ": !has(self.template) && !has(self.templateFrom)",
                "an Uninitialized pool has exactly one of template and templateFrom; an Initialized or Executing one has "
                "neither (it uses each workload's own)",
            ),
            *(
                (
                    f"self.readiness != 'Uninitialized' || !has(self.{field})",
                    f"{field} is only for pools with readiness Initialized or Executing",
                    f".{field}",
                )
                for field in ("initialization", "readinessCheck", "keepUp")
            ),
            (
                "self.readiness == 'Uninitialized' || !has(self.reserve)",
                "reserve is only for pools with readiness Uninitialized: a standby is of one workload anyway",
                ".reserve",
            ),
            (
                "self.readiness == 'Uninitialized' || !has(self.updateStrategy)",
                "updateStrategy is only for pools with readiness Uninitialized: standbys are of their workload's template, and the old one "
                "stays until the new one is ready",
                ".updateStrategy",
            ),
            (
                "self.readiness != 'Initialized' || has(self.initialization)",
                "an Initialized pool needs an initialization, which says how far its standbys are brought",
                ".initialization",
            ),
            ("self.readiness == oldSelf.readiness", "readiness is immutable: create another pool", ".readiness"),
        )
    }

    readiness: Readiness = Field(
        description="Uninitialized: pods run, processes wait for a robot. Initialized: up and configured. Executing: run in full, gated."
    )
    replicas: int | None = Field(
        default=None, ge=0, le=1000, description="Unclaimed pods to keep (Uninitialized); else sizing says how many."
    )
    sizing: Sizing | None = Field(
        default=None,
        description="Have the number of unclaimed pods follow the failures of the workloads that take from it (Uninitialized), instead "
        "of replicas. See docs/sizing.md.",
    )
    per_workload: int | None = Field(
        default=None, ge=0, le=8, description="Standbys for each workload (Initialized, Executing)."
    )
    workload_selector: LabelSelector = Field(
        description="Labels of the RobotWorkloads it serves, in the same namespace."
    )
    template: dict[str, Any] | None = Field(
        default=None,
        description="Pod template of an Uninitialized pool. Containers need a command, since it is held until the claim.",
        json_schema_extra=pod_template(
            (
                "has(self.command) && size(self.command) > 0",
                "command is required in a pool's template: the container is held until the claim and then runs it",
                ".command",
            )
        ),
    )
    template_from: TemplateSource | None = Field(
        default=None, description="Take the template from a RobotWorkload instead."
    )
    initialization: Procedure | None = Field(
        default=None,
        description="What brings a started standby to the pool's readiness, such as lifecycle transitions (Initialized, Executing). "
        "Absent: the workload's bringUp for Executing; an Initialized pool needs one.",
    )
    readiness_check: Check | None = Field(
        default=None,
        description="What must hold of a standby, in the ROS graph, before it counts as ready (Initialized, Executing). Absent: for "
        "Executing the policy's health tree, for Initialized that the initialization has succeeded.",
    )
    keep_up: KeepUp | None = Field(
        default=None,
        description="Give standbys fresh state while they wait (Initialized), so that the hand-over needs little.",
    )
    reserve: Reserve | None = Field(
        default=None,
        description="Keep the last ready pods for critical workloads (Uninitialized). Absent: whoever fails first has the last one. See "
        "docs/waiting.md.",
    )
    update_strategy: UpdateStrategy | None = Field(
        default=None,
        description="What becomes of waiting pods when the pool's template changes (Uninitialized). Absent: Recreate.",
    )
    warm_paths: list[WarmPath] = Field(
        default_factory=list,
        max_length=16,
        description="Files and folders in the containers to read once while they are held, so that they are in the page cache.",
    )

    def kept_from(self, priority: int) -> int:
        """How many of the ready pods a workload of a poolPriority may not take."""
        return self.reserve.pods if self.reserve is not None and priority < self.reserve.pool_priority else 0


class SizingStatus(Model):
    """The size that the failures ask for, and how that came about. Figures have two digits."""

    size: int = Field(description="Unclaimed pods to keep now.")
    last_change: Time = Field(description="When the size last changed, RFC 3339.")
    needed: int = Field(description="Enough for the risk at the expected rate, without regard to min and max.")
    robots: int = Field(description="Workloads that would take a pod of it.")
    failures: int = Field(description="How often they asked for one, in the time that counts.")
    robot_hours: float = Field(description="For how long they were observed, all together.")
    failures_per_robot_hour: float = Field(description="The expected rate.")
    low: float = Field(description="It is above this, for 95 %.")
    high: float = Field(description="It is below this, for 95 %.")


class FallbackPoolStatus(Model):
    """What is so."""

    observed_generation: int | None = Field(
        default=None, description="Generation of the spec that was reconciled last."
    )
    replicas: int | None = Field(default=None, description="Unclaimed pods that exist.")
    desired: int | None = Field(default=None, description="Pods that should exist.")
    ready: int | None = Field(default=None, description="Pods that could take over now.")
    claimed: int | None = Field(default=None, description="Pods of this pool that drive a robot.")
    updated: int | None = Field(
        default=None, description="Unclaimed pods of the present template; see the condition Updated (Uninitialized)."
    )
    waiting: int | None = Field(
        default=None, description="Workloads that wait for a pod of it; see the condition Available (Uninitialized)."
    )
    sizing: SizingStatus | None = Field(default=None, description="What came of spec.sizing.")
    selector: str | None = Field(
        default=None, description="Label selector of the pool's pods, for the scale subresource."
    )
    conditions: list[Condition] | None = Field(
        default=None,
        description="Accepted: it can be filled. Ready: every pod that should be there could take over now. Available: a pod could be "
        "claimed now (Uninitialized); while it is Dry, it says who waits, in order. Sized, with spec.sizing: how many there are to be "
        "and why; False where max is not enough for the risk. Updated: every unclaimed pod is of the present "
        "template, or may be of an earlier one (Uninitialized). Moving, while it is so: pods are replaced elsewhere, since their node "
        "is to be emptied or was lost.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["type"]},
    )
