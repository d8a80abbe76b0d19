"""Workloads whose policy leaves the strategies to the operator, for tests."""

from __future__ import annotations

from typing import Any

from tests.unit.controller.world import (
    World,
    applied,
    created,
    custom,
    gate,
    held_pod,
    hot,
    policy,
    source_pod,
    spare,
    workload,
)
from understudy.api import names
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.controller.plan import Plan
from understudy.kube.client import Object

UP: Object = {"yaml": {"set_lifecycle": {"node": "/nav", "state": "inactive"}}}


def auto(verify_within: str = "10s", **requirements: str) -> Object:
    """A policy that leaves its strategies to be chosen."""
    made = policy("Restart")
    made["spec"]["strategies"] = [{"type": "Auto", "verifyWithin": verify_within}]
    made["spec"]["requirements"] = requirements
    return made


def warm(name: str = "warm", **spec: Any) -> Object:
    selector = {"matchLabels": {"task": "critical"}}
    more = {"readiness": "Initialized", "perWorkload": 1, "initialization": UP, "workloadSelector": selector}
    return custom("FallbackPool", name, more | spec)


def settings_of(plan: Plan) -> WorkloadSettings:
    return WorkloadSettings.model_validate_json(
        applied(plan, "configmaps")[names.settings("w")]["data"]["settings.json"]
    )


def order(plan: Plan) -> list[str]:
    """The chosen strategies: the pools, and Restart."""
    found = settings_of(plan).strategies
    assert found is not None
    return [one.pool_ref.name if one.pool_ref is not None else one.type for one in found]


def pools_of(plan: Plan) -> set[str]:
    """The pools of the standbys that are made."""
    return {pod["metadata"]["labels"][names.POOL] for pod in created(plan, "pods")}


def world(asked: Object | None = None, *more: Object, status: Object | None = None) -> World:
    made = World(workload(status=status), asked or auto(), *(more or (hot(), warm(), spare())))
    active = source_pod("w-a")
    made.pods = [active]
    made.own(gate(made.workload, active=active, epoch=3))
    made.unclaimed = {"spare": [held_pod("s-1", of=spare())]}
    return made
