"""The order that requirements come to for each workload of some files, as the operator would choose it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from understudy.advice import order_explanation
from understudy.advice.strategy_figures import Figure, Way
from understudy.advice.strategy_order import Judged, Order
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
    """Whether the policy leaves its strategies to be chosen, so that this order is in force."""
    stated: bool
    """Whether the policy says what is required; else the defaults count."""
    present: str
    """The policy's own strategies, in short."""
    order: Order

    def data(self) -> dict[str, Any]:
        """As JSON takes it: seconds, and shares of a working instance's CPU."""
        order = self.order
        return {
            "workload": self.workload.name,
            "namespace": self.workload.namespace or None,
            "policy": self.policy.name,
            "auto": self.auto,
            "requirements": order.requirements.to_wire(),
            "asked": order_explanation.asked(order.requirements),
            "present": self.present,
            "order": [_told(order, one) for one in order.chosen],
            "leftOut": [_told(order, one) for one in order.left_out],
            "notMet": order_explanation.unmet(order),
        }


def recommended(
    manifests: Sequence[Manifest],
    name: str | None,
    levels: Mapping[str, str],
    cpu: Mapping[Way, Figure],
    recorded: Mapping[tuple[str, str], Object],
) -> list[Recommendation]:
    """The recommendation for each workload, or for the one of a name.

    ``levels`` are requirements that count instead of the policy's, ``cpu`` is what waiting instances were measured to use, and
    ``recorded`` are workloads as they are in a cluster, by namespace and name. Raises CommandError.
    """
    wrong = [str(found) for one in manifests for found in object_check.check(one) if found.severity == "error"]
    if wrong:
        raise CommandError("the manifests can't be followed\n" + "\n".join(wrong))
    workloads = [one for one in manifests if one.kind == "RobotWorkload" and name in (None, one.name)]
    if not workloads:
        known = [one.name for one in manifests if one.kind == "RobotWorkload"]
        if name is not None and known:
            raise CommandError(f"--workload: there is no RobotWorkload {name!r:.80} in the files ({hint(name, known)})")
        raise CommandError(
            "there is no RobotWorkload in the files: give the file of one, with those of its policy and its pools"
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
    given = {one.name: one for one in near if one.kind == "FailurePolicy"}
    if wanted not in given:
        told = f" ({hint(wanted, given)})" if given else ""
        raise CommandError(
            f"RobotWorkload {workload.name}: its FailurePolicy {wanted} isn't in the files{told}; give its file too"
        )
    policy = given[wanted]
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
    assert order is not None, "the requirements are understood"
    return Recommendation(
        workload=workload,
        policy=policy,
        auto=strategy_selection.is_auto(policy.data),
        stated=stated is not None,
        present=policy_status.in_short(policy.data, offered),
        order=order,
    )


def _status(workload: Manifest, recorded: Mapping[tuple[str, str], Object]) -> Object:
    """A workload's status: as the cluster has it, and else as the file does, where kubectl wrote it."""
    found = recorded.get((workload.namespace, workload.name))
    return {"status": found["status"]} if found is not None and "status" in found else {}


def _told(order: Order, one: Judged) -> dict[str, Any]:
    return {
        "strategy": "Restart" if one.candidate.way == "Restart" else f"Fallback/{one.candidate.way}",
        "pool": one.candidate.pool or None,
        "seconds": {"value": one.seconds.value, "source": one.seconds.source},
        "cpu": {"value": one.cost, "standbys": one.candidate.standbys, "source": one.cpu.source},
        "why": order_explanation.why(order, one),
    }
