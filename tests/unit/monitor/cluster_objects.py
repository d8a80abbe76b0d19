"""The objects of one workload on an API server in memory, and what a monitor sees and changes there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.support.notices import RecordedNotices
from tests.unit.kube.memory import MemoryClient, merge
from tests.unit.monitor.gates import Packets
from understudy.api import names
from understudy.api.conditions import Condition
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.failover import pinned
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity, Progress
from understudy.kube.client import CONFIG_MAPS, PODS, POLICIES, WORKLOADS, Object
from understudy.kube.gates.base import GateKind, Reach
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.objects.pod_control import EVICTION, PodControl
from understudy.monitor.crash_points import CrashPoints
from understudy.monitor.observe.objects.cluster_view import ClusterView
from understudy.monitor.observe.wakeups import Wakeups

TWIST = "geometry_msgs/msg/Twist"
NAMESPACE = "fleet"
MONITOR = PodIdentity(name="w-monitor-1", uid="uid-m1")
"""The pod of the monitor whose objects these are."""
NOWHERE = Path("/nonexistent")
"""The folder of a monitor that keeps nothing."""


def workload_spec(**more: Any) -> Object:
    """Return the spec of a workload with one gated topic, with these fields besides or instead."""
    return {
        "template": {"spec": {}},
        "outputs": [{"topic": "/cmd_vel", "type": TWIST}],
        "failurePolicyRef": {"name": "policy"},
        **more,
    }


def parsed_spec(**more: Any) -> RobotWorkloadSpec:
    """Return the same as a value."""
    return RobotWorkloadSpec.model_validate(workload_spec(**more))


def policy_of(*strategies: Object, **more: Any) -> FailurePolicySpec:
    """Return a policy that watches /cmd_vel, with these strategies or one restart, and these fields besides or instead."""
    spec = {
        "monitoring": {"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}},
        "strategies": list(strategies) or [{"type": "Restart"}],
        **more,
    }
    return FailurePolicySpec.model_validate(spec)


def settings_of(workload: str = "w", **more: Any) -> WorkloadSettings:
    """Return what the operator resolved for a workload that a ReplicaSet runs, with these fields besides or instead."""
    settings = {
        "workload": workload,
        "namespace": NAMESPACE,
        "uid": f"uid-{workload}",
        "source_kind": "ReplicaSet",
        "source_name": workload,
    }
    return WorkloadSettings.model_validate(settings | more)


def pod_of(instance: Instance, workload: str = "w") -> Object:
    """Return the pod that a monitor sees as this instance (:func:`instance_of`)."""
    labels = {names.WORKLOAD: workload, names.INSTANCE: instance.name}
    labels |= {names.POOL: instance.pool} if instance.pool else {}
    if instance.held:
        labels |= {names.HELD: "true", names.WORKLOAD: names.UNCLAIMED, names.CLAIMED_BY: names.UNCLAIMED}
    labels |= {names.TEMPLATE_HASH: instance.template_hash} if instance.template_hash else {}
    metadata: Object = {"name": instance.name, "uid": instance.uid, "labels": labels}
    metadata |= {"annotations": {names.CLAIM: instance.claim}} if instance.claim else {}
    metadata |= {"creationTimestamp": instance.created} if instance.created else {}
    metadata |= {"deletionTimestamp": "2026-01-01T00:00:30Z"} if instance.terminating else {}
    conditions = [{"type": c.type, "status": c.status, "reason": c.reason} for c in instance.conditions]
    if instance.ready and not conditions:
        conditions.append({"type": "Ready", "status": "True", "reason": ""})
    if instance.evicted:
        conditions.append({"type": "DisruptionTarget", "status": "True", "reason": EVICTION})
    container: Object = {"name": "drive", "restartCount": instance.restarts}
    if instance.crashing:
        container["state"] = {"waiting": {"reason": "CrashLoopBackOff"}}
    knows = [{"name": names.AGENT_PROTOCOL_VARIABLE, "value": str(instance.agent_protocol)}]
    ports = [{"name": names.AGENT_PORT_NAME, "containerPort": instance.agent_port}]
    agent = {"name": names.AGENT_CONTAINER, "ports": ports, "env": knows if instance.agent_protocol > 1 else []}
    containers = [{"name": "drive"}, *([agent] if instance.has_agent else [])]
    return {
        "metadata": metadata,
        "spec": {"nodeName": instance.node, "containers": containers},
        "status": {
            "phase": "Running" if instance.running else "Failed",
            "podIP": instance.ip,
            "conditions": conditions,
            "containerStatuses": [container],
        },
    }


def gate_object(kind: GateKind, workload: str, state: GateState) -> Object:
    """Return a gate object in a state."""
    found = kind.closed(workload, Reach(), epoch=state.epoch)
    merge(found, kind.routing(workload, state.active, state.admitted))
    found["metadata"]["annotations"] = {
        names.EPOCH: str(state.epoch),
        names.ACTIVE: state.active,
        names.ACTIVE_UID: state.active_uid,
        names.RECOVERY: state.recovery.model_dump_json() if state.recovery is not None else "",
        names.ADMITTED: state.admitted,
        names.ADMITTED_UID: state.admitted_uid,
        names.LET_THROUGH: pinned.write(state.pinned),
    }
    return found


class ClusterObjects:
    """The objects of a workload. A test puts them there; the monitor's own parts read and change them."""

    def __init__(
        self,
        folder: Path = NOWHERE,
        *,
        workload: str = "w",
        client: MemoryClient | None = None,
        notices: RecordedNotices | None = None,
    ) -> None:
        self.client = client or MemoryClient()
        self.notices = notices or RecordedNotices()
        self.wakeups, self.crash_points = Wakeups(), CrashPoints(folder)
        self.view = ClusterView(self.client, NAMESPACE, workload, self.wakeups, me=MONITOR)
        self.packets: dict[str, float] = {}
        """When a packet of each pod last got through the gate, by UID."""
        self.pods = PodControl(self.client, self.view, self.crash_points, self.notices)
        self.proof = Packets(self.packets)
        self.gate = GateControl(self.client, self.view, self.pods, self.proof, self.crash_points, self.notices)

    @property
    def cluster(self) -> Cluster:
        """The same as the monitor's value."""
        return Cluster(self.view, self.pods, self.gate)

    def put_workload(
        self,
        *,
        annotations: Mapping[str, str] | None = None,
        status: Object | None = None,
        generation: int = 1,
        deleted: bool = False,
        **spec: Any,
    ) -> None:
        """Have the RobotWorkload, with these fields in its spec (see :func:`workload_spec`)."""
        metadata: Object = {
            "name": self.view.workload,
            "annotations": dict(annotations or {}),
            "generation": generation,
        }
        metadata |= {"deletionTimestamp": "2026-01-01T00:00:30Z"} if deleted else {}
        item: Object = {"metadata": metadata, "spec": workload_spec(**spec), "status": status or {}}
        self.view.workloads.put(self.client.store(WORKLOADS, NAMESPACE, item))

    def put_policy(
        self, policy: FailurePolicySpec, *, conditions: Sequence[Condition] = (), name: str = "policy"
    ) -> None:
        """Have the FailurePolicy."""
        status = {"conditions": [one.to_wire() for one in conditions]}
        item: Object = {"metadata": {"name": name}, "spec": policy.to_wire(), "status": status}
        self.view.policies.put(self.client.store(POLICIES, NAMESPACE, item))

    def put_settings(self, **more: Any) -> None:
        """Have the settings of the workload's monitor (see :func:`settings_of`)."""
        text = settings_of(self.view.workload, **more).model_dump_json(by_alias=True)
        item: Object = {"metadata": {"name": names.settings(self.view.workload)}, "data": {"settings.json": text}}
        self.view.settings_maps.put(self.client.store(CONFIG_MAPS, NAMESPACE, item))

    def put_pods(self, *instances: Instance) -> None:
        """Have the pods of these instances and no others."""
        pods = self.view.pods
        for name in set(pods.items) - {instance.name for instance in instances}:
            pods.apply_event("DELETED", pods.items[name])
            self.client.items.pop((PODS.plural, NAMESPACE, name), None)
        for instance in instances:
            pods.put(self.client.store(PODS, NAMESPACE, pod_of(instance, self.view.workload)))

    def put_gate(self, state: GateState) -> None:
        """Have the gate in a state."""
        kind = self.view.gate_kind
        item = gate_object(kind, self.view.workload, state)
        self.view.gates.put(self.client.store(kind.resource, NAMESPACE, item))

    @property
    def commits(self) -> list[tuple[str, Progress | None]]:
        """Each commit of the gate that was asked for: the pod that it names, and its recovery."""
        return [
            (
                notes[names.ACTIVE],
                Progress.model_validate_json(notes[names.RECOVERY]) if notes[names.RECOVERY] else None,
            )
            for notes in self._annotated(names.EPOCH)
        ]

    @property
    def admissions(self) -> list[str]:
        """Each standby that the gate was asked to admit; empty for none."""
        return [notes[names.ADMITTED] for notes in self._annotated(names.ADMITTED) if names.EPOCH not in notes]

    def _annotated(self, annotation: str) -> list[Mapping[str, str]]:
        """The annotations in each patch of the gate that sets a given one."""
        patches = [body for method, name, body in self.client.requests if method == "PATCH" and name == self.gate_name]
        found = [body["metadata"].get("annotations") or {} for body in patches]
        return [annotations for annotations in found if annotation in annotations]

    @property
    def gate_name(self) -> str:
        """The name of the gate object."""
        return names.gate(self.view.workload)

    @property
    def deleted(self) -> list[str]:
        """The names of the pods whose deletion was asked for."""
        return [name for method, name, _ in self.client.requests if method == "DELETE"]
