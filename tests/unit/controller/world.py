"""A small cluster in plain dictionaries: enough for the pure functions, without any API server."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.controller.desired import workload_objects
from understudy.controller.desired.workload_plan import WorkloadPlan, evaluate
from understudy.controller.observed import kube_objects
from understudy.controller.observed.observation import Observed
from understudy.controller.observed.workload_reference import ReferencedObjects
from understudy.controller.plan import Apply, Create, Delete, Images, Patch, Plan, Problem
from understudy.controller.pods import instance_pod, pool_pods
from understudy.controller.status import workload_status
from understudy.kube import apply
from understudy.kube.client import Object
from understudy.kube.gates.cilium import PolicyMapUse

NAMESPACE = "fleet"
NOW = 1_700_000_000.0
IMAGES = Images("registry/monitor:1")
TREE: Object = {"topic": {"name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "gap": "500ms"}}
TEMPLATE: Object = {
    "metadata": {"labels": {"app": "nav"}},
    "spec": {"containers": [{"name": "app", "image": "app:1", "command": ["run"], "args": ["--fast"]}]},
}


class Names:
    """Names and tokens in an order that tests can foresee."""

    def __init__(self) -> None:
        self._count = itertools.count(1)

    def fresh(self) -> pool_pods.UniqueValues:
        return pool_pods.UniqueValues(name=lambda prefix: f"{prefix}-new{next(self._count):02}", token=lambda: "token")


def custom(kind: str, name: str, spec: Object, *, labels: Mapping[str, str] | None = None, **metadata: Any) -> Object:
    return {
        "apiVersion": API_VERSION,
        "kind": kind,
        "metadata": {
            "name": name,
            "namespace": NAMESPACE,
            "uid": f"uid-{name}",
            "generation": 3,
            "resourceVersion": "10",
            "labels": dict(labels or {}),
            **metadata,
        },
        "spec": spec,
    }


def workload(
    name: str = "w", *, labels: Mapping[str, str] | None = None, status: Object | None = None, **spec: Any
) -> Object:
    made: Object = {
        "template": copy.deepcopy(TEMPLATE),
        "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
        "failurePolicyRef": {"name": "policy"},
        **spec,
    }
    if "workloadRef" in made:
        del made["template"]
    found = custom("RobotWorkload", name, made, labels=labels or {"task": "critical"})
    return found | ({"status": status} if status else {})


def policy(*strategies: str, name: str = "policy", tree: Object | None = None) -> Object:
    """A policy; each strategy is a pool's name or ``Restart``."""
    listed = [
        {"type": "Restart"} if s == "Restart" else {"type": "Fallback", "poolRef": {"name": s}} for s in strategies
    ]
    return custom("FailurePolicy", name, {"monitoring": {"yaml": tree or TREE}, "strategies": listed})


def hot(name: str = "hot", per_workload: int = 1, **spec: Any) -> Object:
    selector = {"matchLabels": {"task": "critical"}}
    return custom(
        "FallbackPool",
        name,
        {"readiness": "Executing", "perWorkload": per_workload, "workloadSelector": selector, **spec},
    )


def spare(name: str = "spare", replicas: int = 2, **spec: Any) -> Object:
    return custom(
        "FallbackPool",
        name,
        {
            "readiness": "Uninitialized",
            "replicas": replicas,
            "workloadSelector": {"matchLabels": {"task": "critical"}},
            "template": copy.deepcopy(TEMPLATE),
            **spec,
        },
    )


def pod(
    name: str,
    *,
    ready: bool = True,
    labels: Mapping[str, str] | None = None,
    owner: Object | None = None,
    waiting: str = "",
    phase: str = "Running",
    age: float = 100.0,
    **metadata: Any,
) -> Object:
    status: Object = {"phase": phase, "conditions": [{"type": "Ready", "status": "True" if ready else "False"}]}
    if waiting:
        state = {"waiting": {"reason": waiting, "message": f"{waiting} it is"}}
        status["containerStatuses"] = [{"name": "app", "image": "app:1", "state": state}]
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {
            "name": name,
            "namespace": NAMESPACE,
            "uid": f"uid-{name}",
            "resourceVersion": "7",
            "creationTimestamp": stamp(NOW - age),
            "labels": dict(labels or {}),
            "ownerReferences": [owner] if owner else [],
            **metadata,
        },
        "status": status,
    }


def stamp(moment: float) -> str:
    from datetime import UTC, datetime

    return datetime.fromtimestamp(moment, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def source_pod(name: str, *, of: str = "w", template_hash: str = "", **more: Any) -> Object:
    """A pod of a workload's own ReplicaSet."""
    labels = {
        names.WORKLOAD: of,
        names.COMPONENT: "instance",
        names.SOURCE: "workload",
        names.INSTANCE: name,
        names.TEMPLATE_HASH: template_hash,
    }
    owner = {"apiVersion": "apps/v1", "kind": "ReplicaSet", "name": of, "uid": f"uid-rs-{of}", "controller": True}
    return pod(name, labels=labels, owner=owner, **more)


def standby_pod(name: str, *, of: Object, pool: str = "hot", template_hash: str = "", **more: Any) -> Object:
    labels = {
        names.WORKLOAD: kube_objects.name(of),
        names.COMPONENT: "instance",
        names.POOL: pool,
        names.INSTANCE: name,
        names.TEMPLATE_HASH: template_hash,
    }
    return pod(name, labels=labels, owner=kube_objects.owner("RobotWorkload", of), **more)


def held_pod(name: str, *, of: Object, template_hash: str = "", **more: Any) -> Object:
    labels = {
        names.COMPONENT: "instance",
        names.POOL: kube_objects.name(of),
        names.HELD: "true",
        names.WORKLOAD: names.UNCLAIMED,
        names.CLAIMED_BY: names.UNCLAIMED,
        names.INSTANCE: name,
        names.TEMPLATE_HASH: template_hash,
    }
    return pod(name, labels=labels, owner=kube_objects.owner("FallbackPool", of), **more)


def claimed_pod(name: str, *, of: Object, by: Object, **more: Any) -> Object:
    """A pod of a shared pool after its claim."""
    labels = {
        names.COMPONENT: "instance",
        names.POOL: kube_objects.name(of),
        names.HELD: "true",
        names.WORKLOAD: names.UNCLAIMED,
        names.CLAIMED_BY: kube_objects.name(by),
        names.INSTANCE: name,
    }
    return pod(
        name, labels=labels, owner=kube_objects.owner("RobotWorkload", by), annotations={names.CLAIM: "uid-w/1"}, **more
    )


def gate(of: Object, *, active: Object | None = None, epoch: int = 0) -> Object:
    from understudy.controller.observed import ownership
    from understudy.kube.gates import registry
    from understudy.kube.gates.base import Reach

    made = ownership.ours(
        registry.of(of).closed(kube_objects.name(of), Reach(), epoch=epoch), kube_objects.owner("RobotWorkload", of), of
    )
    made["metadata"] |= {"uid": "uid-gate", "resourceVersion": "20"}
    if active is not None:
        made["metadata"]["annotations"] |= {
            names.ACTIVE: kube_objects.name(active),
            names.ACTIVE_UID: kube_objects.uid(active),
        }
        kind, name = registry.of(of), kube_objects.name(active)
        made["spec"] |= kind.routing(kube_objects.name(of), name)["spec"]
        if selector := made["spec"].get("podSelector"):
            selector.pop("matchLabels")  # None in a merge patch: the field is removed
    return made


def service(of: Object, address: str = "10.96.0.9") -> Object:
    return {
        "apiVersion": "v1",
        "kind": "Service",
        "metadata": {
            "name": names.discovery(kube_objects.name(of)),
            "namespace": NAMESPACE,
            "uid": "uid-service",
            "resourceVersion": "3",
            "ownerReferences": [kube_objects.owner("RobotWorkload", of)],
        },
        "spec": {"clusterIP": address},
    }


class World:
    """What is around one workload; changed by carrying out a plan, as the API server would."""

    def __init__(
        self, item: Object, *others: Object, pods: Sequence[Object] = (), reference: ReferencedObjects | None = None
    ) -> None:
        self.workload = item
        self.others = list(others)
        self.pods = list(pods)
        self.monitors: list[Object] = [pod("w-monitor-1")]
        self.discovery: list[Object] = [pod("w-discovery-1")]
        self.reference = reference
        self.owned: dict[tuple[str, str], Object] = {}
        self.expected: dict[str, int] = {}
        self.unclaimed: dict[str, list[Object]] = {}
        self.held_policies: dict[str, Object] = {}
        self.rivals: list[str] = []
        self.dependencies: dict[str, list[str]] = {}
        self.resized: Object | None = None
        self.cordoned: frozenset[str] = frozenset()
        self.leaving: frozenset[str] = frozenset()
        self.nodes: list[Object] = []
        self.budgets: list[Object] = []
        self.going: frozenset[str] = frozenset()
        self.policy_map: PolicyMapUse | None = None
        self.policy_map_known = True
        self.now = NOW
        self.names = Names()
        self.own(service(item))

    def own(self, item: Object) -> None:
        plurals = {"NetworkPolicy": "networkpolicies"}
        plural = plurals.get(item["kind"], f"{item['kind'].lower()}s")
        self.owned[(plural, kube_objects.name(item))] = item

    def observed(self) -> Observed:
        kinds: dict[str, dict[str, Object]] = {"FailurePolicy": {}, "FallbackPool": {}}
        for item in self.others:
            kinds[item["kind"]][kube_objects.name(item)] = item
        return Observed(
            workload=self.workload,
            now=self.now,
            policies=kinds["FailurePolicy"],
            pools=kinds["FallbackPool"],
            held_policies=self.held_policies,
            owned=self.owned,
            pods=self.pods,
            monitors=self.monitors,
            discovery=self.discovery,
            unclaimed=self.unclaimed,
            reference=self.reference,
            rivals=self.rivals,
            expected=self.expected,
            dependencies=self.dependencies,
            resized=self.resized,
            cordoned=self.cordoned,
            leaving=self.leaving,
            nodes=self.nodes,
            budgets=self.budgets,
            going=self.going,
            policy_map=self.policy_map,
            policy_map_known=self.policy_map_known,
        )

    def understood(self) -> WorkloadPlan:
        return evaluate(self.observed(), IMAGES)

    def plan(self) -> Plan:
        return workload_objects.plan(self.observed(), self.understood(), IMAGES, self.names.fresh())

    def status(self, *problems: Problem) -> Object:
        return workload_status.status(self.observed(), self.understood(), problems)

    def condition(self, type_: str, *problems: Problem) -> Object:
        found: Object = next(c for c in self.status(*problems)["conditions"] if c["type"] == type_)
        return found

    def build(self) -> Plan:
        """Carry out the plan on everything but pods."""
        plan = self.plan()
        for write in plan.writes:
            if isinstance(write, Apply | Create) and write.resource.plural != "pods":
                stamped = apply.stamped(write.body) if isinstance(write, Apply) else write.body
                metadata = {
                    "uid": f"uid-{kube_objects.name(write.body)}",
                    "resourceVersion": "30",
                    **stamped["metadata"],
                }
                key = (write.resource.plural, kube_objects.name(write.body))
                spec = {**self.owned.get(key, {}).get("spec", {}), **stamped.get("spec", {})}
                self.owned[key] = {**stamped, "metadata": metadata, **({"spec": spec} if spec else {})}
        return plan

    @property
    def own_hash(self) -> str:
        """Of the template that the workload's own ReplicaSet makes pods from."""
        return instance_pod.template_hash(self.understood().builts[""])

    @property
    def template_hash(self) -> str:
        """Of the template of the standbys of pool hot."""
        return dict(self.understood().builts)["hot"]["metadata"]["labels"][names.TEMPLATE_HASH]


def applied(plan: Plan, plural: str) -> dict[str, Object]:
    return {
        kube_objects.name(w.body): w.body for w in plan.writes if isinstance(w, Apply) and w.resource.plural == plural
    }


def created(plan: Plan, plural: str) -> list[Object]:
    return [w.body for w in plan.writes if isinstance(w, Create) and w.resource.plural == plural]


def deleted(plan: Plan) -> list[str]:
    return [kube_objects.name(w.item) for w in plan.writes if isinstance(w, Delete)]


def patched(plan: Plan, plural: str) -> dict[str, Object]:
    return {
        kube_objects.name(w.item): w.body for w in plan.writes if isinstance(w, Patch) and w.resource.plural == plural
    }
