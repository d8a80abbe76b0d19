"""FallbackPool: warm instances that wait at a readiness."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from understudy.api.base import LocalReference, Model, rules
from understudy.api.conditions import Condition

Readiness = Literal["Uninitialized", "Initialized", "Executing"]


class LabelSelectorRequirement(Model):
    """One expression of a label selector."""

    key: str = Field(description="Label key.")
    operator: Literal["In", "NotIn", "Exists", "DoesNotExist"] = Field(description="How the values are compared.")
    values: list[str] | None = Field(default=None, description="Values for In and NotIn.")


class LabelSelector(Model):
    """A label selector as in the rest of Kubernetes; an empty one selects everything."""

    match_labels: dict[str, str] | None = Field(default=None, description="Labels that must all be there.")
    match_expressions: list[LabelSelectorRequirement] | None = Field(
        default=None, description="Expressions that must all hold."
    )


class TemplateSource(Model):
    """Where the pool's pod template is taken from."""

    workload: str = Field(min_length=1, max_length=253, description="RobotWorkload whose template is used.")


class FallbackPoolSpec(Model):
    """A warm pool."""

    model_config = Model.model_config | {
        "json_schema_extra": rules(
            (
                "self.readiness == 'Uninitialized' ? has(self.replicas) && !has(self.perWorkload) "
                ": has(self.perWorkload) && !has(self.replicas)",
                "an Uninitialized pool has replicas (it is shared); an Initialized or Executing one has perWorkload "
                "(such a standby lives in one robot's ROS graph)",
            ),
            (
                "self.readiness == 'Uninitialized' ? has(self.template) != has(self.templateFrom) "
                ": !has(self.template) && !has(self.templateFrom)",
                "an Uninitialized pool has exactly one of template and templateFrom; an Initialized or Executing one has "
                "neither (it uses each workload's own)",
            ),
            ("self.readiness == oldSelf.readiness", "readiness is immutable: create another pool"),
        )
    }

    readiness: Readiness = Field(
        description="Uninitialized: pods run, processes wait for a robot. Initialized: up and configured. Executing: run in full, gated."
    )
    replicas: int | None = Field(default=None, ge=0, le=1000, description="Unclaimed pods to keep (Uninitialized).")
    per_workload: int | None = Field(
        default=None, ge=0, le=8, description="Standbys for each workload (Initialized, Executing)."
    )
    workload_selector: LabelSelector = Field(
        description="Labels of the RobotWorkloads it serves, in the same namespace."
    )
    template: dict[str, Any] | None = Field(
        default=None,
        description="Pod template of an Uninitialized pool. Containers need a command, since it is held until the claim.",
        json_schema_extra={"x-kubernetes-preserve-unknown-fields": True},
    )
    template_from: TemplateSource | None = Field(
        default=None, description="Take the template from a RobotWorkload instead."
    )
    warm_paths: list[str] = Field(
        default_factory=list,
        max_length=16,
        description="Files and folders in the containers to read once while they are held, so that they are in the page cache.",
    )


class FallbackPoolStatus(Model):
    """What is so."""

    observed_generation: int | None = Field(
        default=None, description="Generation of the spec that was reconciled last."
    )
    replicas: int | None = Field(default=None, description="Unclaimed pods that exist.")
    desired: int | None = Field(default=None, description="Pods that should exist.")
    ready: int | None = Field(default=None, description="Pods that could take over now.")
    claimed: int | None = Field(default=None, description="Pods of this pool that drive a robot.")
    selector: str | None = Field(
        default=None, description="Label selector of the pool's pods, for the scale subresource."
    )
    conditions: list[Condition] | None = Field(
        default=None,
        description="Accepted, Ready.",
        json_schema_extra={"x-kubernetes-list-type": "map", "x-kubernetes-list-map-keys": ["type"]},
    )
