"""A fleet as the API server would return it, built from the models of the API, so that it cannot contain removed
fields."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from tests.unit.controller import world
from understudy import __version__
from understudy.api import names
from understudy.api.base import API_VERSION, Model
from understudy.api.conditions import Condition
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.fallback_pool import FallbackPoolSpec, FallbackPoolStatus
from understudy.api.kinds.robot_workload import (
    Attempt,
    GateStatus,
    Moments,
    MonitorStatus,
    Parts,
    Recovery,
    RobotWorkloadSpec,
    RobotWorkloadStatus,
)
from understudy.api.kinds.state_spec import RestoredState
from understudy.failover.progress import PodIdentity, Progress, rfc3339

NAMESPACE = world.NAMESPACE
NOW = datetime(2026, 11, 22, 14, 6, 24, tzinfo=UTC).timestamp()
GENERATION = 2
Object = dict[str, Any]
TREE: Object = {"parallel": [{"topic": {"name": "/cmd_vel", "gap": "500ms"}}]}


def ago(seconds: float) -> str:
    """Return a time in the past as a status has it."""
    return rfc3339(NOW - seconds)


def condition(type_: str, status: str, reason: str, message: str = "", *, since: float = 252.0) -> Condition:
    return Condition(
        type=type_, status=status, reason=reason, message=message, last_transition_time=ago(since)[:19] + "Z"
    )  # type: ignore[arg-type]


def custom(kind: str, name: str, spec: Model, status: Model | None, **metadata: Any) -> Object:
    found: Object = {
        "apiVersion": API_VERSION,
        "kind": kind,
        "metadata": {
            "name": name,
            "namespace": NAMESPACE,
            "uid": f"uid-{name}",
            "resourceVersion": "10",
            "generation": GENERATION,
            "creationTimestamp": ago(2 * 86400 + 3 * 3600)[:19] + "Z",
            "labels": {"app": "navigation", "task": "critical"},
            **metadata,
        },
        "spec": spec.to_wire(),
    }
    return found | ({"status": status.to_wire()} if status is not None else {})


def policy(*strategies: Object, name: str = "navigation", **spec: Any) -> Object:
    fields = {
        "monitoring": {"yaml": TREE},
        "strategies": list(strategies)
        or [
            {"type": "Fallback", "poolRef": {"name": "navigation-hot"}, "verifyWithin": "1s"},
            {"type": "Fallback", "poolRef": {"name": "navigation-spare"}, "verifyWithin": "20s"},
            {"type": "Restart", "verifyWithin": "60s"},
        ],
        **spec,
    }
    return custom("FailurePolicy", name, FailurePolicySpec.model_validate(fields), None)


def hot(**status: Any) -> Object:
    spec = {"readiness": "Executing", "perWorkload": 1, "workloadSelector": {"matchLabels": {"task": "critical"}}}
    return custom(
        "FallbackPool",
        "navigation-hot",
        FallbackPoolSpec.model_validate(spec),
        _pool_status({"desired": 3, "ready": 2, "claimed": 1} | status),
    )


def spare(*, size: Object | None = None, **status: Any) -> Object:
    spec = {
        "readiness": "Uninitialized",
        **(size or {"replicas": 4}),
        "workloadSelector": {"matchLabels": {"app": "navigation"}},
        "template": world.TEMPLATE,
    }
    return custom(
        "FallbackPool",
        "navigation-spare",
        FallbackPoolSpec.model_validate(spec),
        _pool_status({"desired": 4, "ready": 3, "claimed": 1} | status),
    )


def _pool_status(counts: Object) -> FallbackPoolStatus:
    return FallbackPoolStatus(**({"observed_generation": GENERATION} | counts))


def recovery(
    number: int,
    seconds_ago: float,
    *,
    strategy: str = "Fallback/Executing",
    parts: tuple[float, float, float, float] = (0.503, 0.006, 0.0, 0.0),
    old: str = "robot-17-navigation-7k2xq",
    new: str = "robot-17-navigation-x8v2m",
    **more: Any,
) -> Recovery:
    """Build a recovery that began some time ago. Its moments follow from its parts."""
    start, total = NOW - seconds_ago, sum(parts)
    detection, cluster, startup, _ = parts
    moments = {
        "last_healthy": start,
        "detected": start + detection,
        "decided": start + detection + 0.0004,
        "fenced": start + detection + cluster,
        "routed": start + total,
        "first_output": start + total + 0.031,
        "verified": start + total + 0.052,
    }
    if startup:
        moments |= {"started": start + detection + cluster + startup, "ready": start + total}
    fields: dict[str, Any] = {
        "id": f"r{number}",
        "number": number,
        "reason": "commands: no /cmd_vel for 500 ms while /navigate_to_pose was active",
        "result": "Recovered",
        "strategy": strategy,
        "from_pod": old,
        "to_pod": new,
        "epoch": 38 + number,
        "recovery_seconds": total,
        "parts": Parts(detection=detection, cluster=cluster, startup=startup, reinitialization=parts[3]),
        "moments": Moments(**{name: rfc3339(moment) for name, moment in moments.items()}),
        "attempts": [Attempt(strategy=strategy, pod=new, result="Verified")],
    }
    return Recovery(**(fields | more))


def recoveries() -> list[Recovery]:
    """Return three recoveries, newest first. In the second, the pool had no standby."""
    restart = recovery(
        2,
        3780.0,
        strategy="Restart",
        parts=(0.502, 1.832, 0.758, 0.590),
        old="robot-17-navigation-m2c7p",
        new="robot-17-navigation-7k2xq",
        attempts=[
            Attempt(
                strategy="Fallback/Executing",
                result="NotAvailable",
                message="robot-17-navigation-v4d9s: its agent is not connected yet",
            ),
            Attempt(strategy="Restart", pod="robot-17-navigation-7k2xq", result="Verified"),
        ],
        state=[
            RestoredState(name="/amcl_pose", restored=True, age_seconds=0.612, carried_metres=0.21),
            RestoredState(name="/map", restored=False, message="it never came"),
        ],
    )
    first = recovery(1, 90000.0, old="robot-17-navigation-q6t4n", new="robot-17-navigation-m2c7p")
    kept = [RestoredState(name="/amcl_pose", restored=True, age_seconds=0.104)]
    return [recovery(3, 252.6, state=kept), restart, first]


def workload(name: str, *, status: RobotWorkloadStatus | None = None, **spec: Any) -> Object:
    fields = {
        "template": world.TEMPLATE,
        "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
        "failurePolicyRef": {"name": "navigation"},
        **spec,
    }
    return custom("RobotWorkload", name, RobotWorkloadSpec.model_validate(fields), status)


def status(name: str, ending: str, epoch: int, *conditions: Condition, **more: Any) -> RobotWorkloadStatus:
    """Build the status of a robot with a working active instance and protection, except for the given changes."""
    active = f"{name}-{ending}" if ending else ""
    usual = [
        condition("Accepted", "True", "Accepted"),
        condition("Reconciled", "True", "Reconciled"),
        condition("Protected", "True", "FirstStrategyReady"),
        condition("Healthy", "True", "Healthy"),
        condition("GateEnforced", "True", "SeenFromPackets"),
        condition("Recovering", "False", "Recovered"),
    ]
    conditions_by_type = {c.type: c for c in usual} | {c.type: c for c in conditions}
    fields: dict[str, Any] = {
        "observed_generation": GENERATION,
        "active": active,
        "health": "Healthy",
        "standby": "Executing (1/1)",
        "strategy": "Executing",
        "gate": GateStatus(epoch=epoch, active=active),
        "monitor": MonitorStatus(version=__version__, image="understudy/monitor"),
        "recovery_count": 0,
        "conditions": list(conditions_by_type.values()),
    }
    return RobotWorkloadStatus(**(fields | more))


def well() -> Object:
    name, found = "robot-17-navigation", recoveries()
    return workload(name, status=status(name, "x8v2m", 41, recoveries=found, recovery_count=3))


def muxed(*conditions: Condition, **more: Any) -> Object:
    """Build the same robot with a mux as its gate, and further fields of its spec."""
    name, found = "robot-17-navigation", recoveries()
    usual = condition("GateEnforced", "True", "ReportedByMux")
    known = status(name, "x8v2m", 41, usual, *conditions, recoveries=found, recovery_count=3)
    return workload(name, status=known, **{"gate": {"kind": "Mux"}, **more})


def degraded() -> Object:
    name = "robot-18-navigation"
    words = "/scan at 8.6 Hz (band 9.0 to 11.0), from the tree's leaf sensors/scan."
    return workload(
        name,
        status=status(name, "m9d4z", 3, condition("Degraded", "True", "NotWell", words, since=38), health="Degraded"),
    )


IMAGE = (
    "pod robot-19-navigation-w7h5k: container app (image registry.lab/nav2:2.1) cannot start, ImagePullBackOff: manifest unknown. "
    "Check the image name, the registry's availability and imagePullSecrets."
)


def unprotected() -> Object:
    name = "robot-19-navigation"
    outlook = "If it failed now, Fallback from pool navigation-spare would be used: it has pods ready (Uninitialized)."
    return workload(
        name,
        status=status(
            name,
            "c5n8r",
            7,
            condition("Protected", "False", "ImagePullBackOff", f"{IMAGE} {outlook}", since=192),
            condition("Reconciled", "False", "ImagePullBackOff", IMAGE, since=192),
            standby="Executing (0/1)",
            strategy="Uninitialized",
        ),
    )


def unwatched() -> Object:
    name = "robot-20-navigation"
    words = "the monitor (Deployment robot-20-navigation-monitor) is not ready. Until the monitor is ready, a failure is not detected."
    return workload(
        name, status=status(name, "t3f6w", 1, condition("Protected", "False", "MonitorNotReady", words, since=9))
    )


def under_way(*, began: float = NOW - 1, **changes: Any) -> Progress:
    """Build a recovery of robot-17-navigation that its monitor has committed to the gate and not yet written to the
    status."""
    name = "robot-17-navigation"
    failed = [PodIdentity(name=f"{name}-x8v2m", uid="uid-x8v2m")]
    progress = Progress.begin("no /cmd_vel for 500 ms", last_healthy=began - 0.5, detected=began, failed=failed)
    progress.id, progress.strategy = "r4", "Fallback/Executing"
    progress.target = PodIdentity(name=f"{name}-w7h5k", uid="uid-w7h5k")
    return progress.model_copy(update=changes)


def gate(
    item: Object, progress: Progress | None, *, active: str = "robot-17-navigation-w7h5k", epoch: int = 42
) -> Object:
    """Build a robot's gate, with the record of a recovery, if any."""
    made = world.gate(item, active=world.pod(active) if active else None, epoch=epoch)
    made["metadata"]["annotations"][names.RECOVERY] = progress.model_dump_json() if progress is not None else ""
    return made


def short_of_one() -> Object:
    conditions = [
        condition("Accepted", "True", "Accepted", "The spec is valid."),
        condition("Ready", "False", "ImagePullBackOff", f"2 of 3 are ready; {IMAGE}", since=192),
    ]
    return hot(claimed=0, conditions=conditions)


def short_of_another() -> Object:
    conditions = [
        condition("Accepted", "True", "Accepted", "The spec is valid."),
        condition("Ready", "False", "PodsNotReady", "3 of 4 are ready.", since=4),
    ]
    return spare(conditions=conditions)


def fleet() -> list[Object]:
    return [well(), degraded(), unprotected(), short_of_one(), short_of_another()]


# -- objects around a robot
# ---------------------------------------------------------------------------------------------


def on(node: str, pod: Object, waiting: str = "") -> Object:
    pod["spec"] = {"nodeName": node, "containers": [{"name": "app"}, {"name": names.AGENT_CONTAINER}]}
    if waiting:
        container = pod["status"]["containerStatuses"][0]
        container["image"], container["state"]["waiting"]["message"] = "registry.lab/nav2:2.1", waiting
    return pod


def around(item: Object, *, standby_waits: str = "") -> list[Object]:
    """Return the objects in the namespace of a robot: policy, pools, gate, pods."""
    name = item["metadata"]["name"]
    active = item["status"]["active"]
    driving = on("node-1", world.source_pod(active, of=name))
    standby = world.standby_pod(
        f"{name}-w7h5k", of=item, pool="navigation-hot", ready=not standby_waits, waiting=standby_waits
    )
    shared = spare()
    held = [
        on("node-1", world.held_pod("navigation-spare-b4x2c", of=shared)),
        on("node-2", world.held_pod("navigation-spare-k9r3f", of=shared)),
        on("node-3", world.held_pod("navigation-spare-p6m8t", of=shared)),
        on("node-3", world.held_pod("navigation-spare-z5j7d", of=shared, ready=False)),
    ]
    monitor = world.pod(f"{name}-monitor-1", labels={names.MONITORED: name, names.COMPONENT: "monitor"})
    discovery = world.pod(f"{name}-discovery-1", labels={names.MONITORED: name, names.COMPONENT: "discovery"})
    gate = world.gate(item, active=driving, epoch=item["status"]["gate"]["epoch"])
    return [
        item,
        policy(),
        hot(),
        shared,
        gate,
        driving,
        on("node-2", standby, "manifest unknown" if standby_waits else ""),
        *held,
        monitor,
        discovery,
    ]


def event(seconds_ago: float, reason: str, message: str, *, kind: str = "Warning", count: int = 1) -> Object:
    return {
        "kind": "Event",
        "type": kind,
        "reason": reason,
        "message": message,
        "count": count,
        "lastTimestamp": ago(seconds_ago)[:19] + "Z",
        "metadata": {"name": reason.lower(), "creationTimestamp": ago(seconds_ago)[:19] + "Z"},
    }
