"""Computes the order of strategies for each workload in the given files, as the operator would choose it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from understudy.advice import order_explanation
from understudy.advice.strategy_figures import Figure, Way
from understudy.advice.strategy_order import Order, RatedStrategy
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.requirements_spec import Requirements
from understudy.cli.common.errors import CommandError
from understudy.cli.manifests import object_check
from understudy.cli.manifests.manifest_reader import Manifest
from understudy.controller.desired import strategy_selection
from understudy.controller.observed import pool_reader
from understudy.controller.observed.kube_objects import hint
from understudy.controller.status import policy_status
from understudy.kube.client import Object


@dataclass(frozen=True)
class Recommendation:
    """The order for one workload."""

    workload: Manifest
    policy: Manifest
    auto: bool
    """Whether the policy chooses its strategies automatically, so that this order applies."""
    stated: bool
    """Whether the policy states requirements; otherwise the defaults apply."""
    present: str
    """Summary of the policy's own strategies."""
    order: Order

    def data(self) -> dict[str, Any]:
        """Return the recommendation as JSON data: times in seconds, CPU as a share of a working instance's."""
        order = self.order
        return {
            "workload": self.workload.name,
            "namespace": self.workload.namespace or None,
            "policy": self.policy.name,
            "auto": self.auto,
            "requirements": order.requirements.to_wire(),
            "asked": order_explanation.describe_requirements(order.requirements),
            "present": self.present,
            "order": [_strategy_data(order, one) for one in order.chosen],
            "leftOut": [_strategy_data(order, one) for one in order.left_out],
            "notMet": order_explanation.unmet_requirements(order),
        }


def recommended(
    manifests: Sequence[Manifest],
    name: str | None,
    levels: Mapping[str, str],
    cpu: Mapping[Way, Figure],
    recorded: Mapping[tuple[str, str], Object],
) -> list[Recommendation]:
    """Return the recommendation for each workload, or for the named one.

    ``levels`` override requirements of the policy, ``cpu`` is the measured CPU usage of waiting instances, and ``recorded`` are
    workloads in the cluster by namespace and name. Raises CommandError.
    """
    wrong = [str(found) for one in manifests for found in object_check.check(one) if found.severity == "error"]
    if wrong:
        raise CommandError("the manifests are invalid\n" + "\n".join(wrong))
    workloads = [one for one in manifests if one.kind == "RobotWorkload" and name in (None, one.name)]
    if not workloads:
        known = [one.name for one in manifests if one.kind == "RobotWorkload"]
        if name is not None and known:
            raise CommandError(f"--workload: there is no RobotWorkload {name!r:.80} in the files ({hint(name, known)})")
        raise CommandError(
            "there is no RobotWorkload in the files: give the file of a workload, of its policy and of its pools"
        )
    return [_recommended(one, manifests, levels, cpu, recorded) for one in workloads]


def _recommended(
    workload: Manifest,
    manifests: Sequence[Manifest],
    levels: Mapping[str, str],
    cpu: Mapping[Way, Figure],
    recorded: Mapping[tuple[str, str], Object],
) -> Recommendation:
    near = [one for one in manifests if workload.together(one)]
    wanted = workload.data["spec"]["failurePolicyRef"]["name"]
    policies = {one.name: one for one in near if one.kind == "FailurePolicy"}
    if wanted not in policies:
        suggestion = f" ({hint(wanted, policies)})" if policies else ""
        raise CommandError(
            f"RobotWorkload {workload.name}: its FailurePolicy {wanted} is not in the files{suggestion}; give its file too"
        )
    policy = policies[wanted]
    stated = FailurePolicySpec.model_validate(policy.data["spec"]).requirements
    requirements = Requirements.model_validate({**(stated.to_wire() if stated is not None else {}), **levels})
    offered = {one.name: one.data for one in near if one.kind == "FallbackPool"}
    serving = {name: pool for name, pool in offered.items() if pool_reader.serves(pool, workload.data)}
    robots = [one.data for one in near if one.kind == "RobotWorkload"]
    order = strategy_selection.order(
        policy.data,
        {**workload.data, **_status(workload, recorded)},
        serving,
        requirements=requirements,
        cpu=cpu,
        sharing={name: sum(pool_reader.serves(pool, robot) for robot in robots) for name, pool in serving.items()},
    )
    assert order is not None, "the requirements are valid"
    return Recommendation(
        workload=workload,
        policy=policy,
        auto=strategy_selection.is_auto(policy.data),
        stated=stated is not None,
        present=policy_status.in_short(policy.data, offered),
        order=order,
    )


def _status(workload: Manifest, recorded: Mapping[tuple[str, str], Object]) -> Object:
    """Return a workload's status from the cluster, or else from the file, if kubectl wrote it."""
    found = recorded.get((workload.namespace, workload.name))
    return {"status": found["status"]} if found is not None and "status" in found else {}


def _strategy_data(order: Order, one: RatedStrategy) -> dict[str, Any]:
    return {
        "strategy": "Restart" if one.candidate.way == "Restart" else f"Fallback/{one.candidate.way}",
        "pool": one.candidate.pool or None,
        "seconds": {"value": one.seconds.value, "source": one.seconds.source},
        "cpu": {"value": one.cost, "standbys": one.candidate.standbys, "source": one.cpu.source},
        "why": order_explanation.describe_choice(order, one),
    }
