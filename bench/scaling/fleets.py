"""The objects of the bench's users: robots in fleets, each fleet in a namespace with its policy and its shared pool."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from understudy.api.base import API_VERSION
from understudy.kube.client import Object

IMAGE = "understudy.invalid/simulated:1"
POOL, POLICY = "spare", "policy"
_LABELS = {"app": "drive"}


@dataclass(frozen=True)
class Robot:
    """One RobotWorkload."""

    namespace: str
    name: str

    @property
    def key(self) -> str:
        """A unique key of the robot."""
        return f"{self.namespace}/{self.name}"


@dataclass(frozen=True)
class Fleet:
    """Robots that share a namespace and a pool."""

    namespace: str
    robots: tuple[Robot, ...]


def fleets(robots: int, size: int) -> list[Fleet]:
    """Return this many robots in fleets of a size; the last fleet may be smaller."""
    found = []
    for number, first in enumerate(range(0, robots, size)):
        namespace = f"fleet-{number}"
        members = (Robot(namespace, f"robot-{n}") for n in range(first, min(robots, first + size)))
        found.append(Fleet(namespace, tuple(members)))
    return found


def _template() -> Object:
    """Return a pod template with one container. Its scheduling is real, its node is not."""
    app = {"name": "app", "image": IMAGE, "command": ["run"], "resources": {"requests": {"cpu": "100m"}}}
    return {"metadata": {"labels": dict(_LABELS)}, "spec": {"terminationGracePeriodSeconds": 1, "containers": [app]}}


def shared(pool: int) -> Iterator[Object]:
    """Yield a fleet's policy, and its pool of ``pool`` pods."""
    tree = {"topic": {"name": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "gap": "500ms"}}
    strategies = [
        {"type": "Fallback", "poolRef": {"name": POOL}, "verifyWithin": "30s", "waitFor": "30s"},
        {"type": "Restart", "verifyWithin": "60s"},
    ]
    yield _custom("FailurePolicy", POLICY, {"monitoring": {"yaml": tree}, "strategies": strategies})
    spec = {
        "readiness": "Uninitialized",
        "replicas": pool,
        "workloadSelector": {"matchLabels": dict(_LABELS)},
        "template": _template(),
    }
    yield _custom("FallbackPool", POOL, spec)


def workload(robot: Robot) -> Object:
    """Return a robot's RobotWorkload."""
    spec = {
        "template": _template(),
        "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
        "failurePolicyRef": {"name": POLICY},
    }
    return _custom("RobotWorkload", robot.name, spec)


def _custom(kind: str, name: str, spec: Object) -> Object:
    return {"apiVersion": API_VERSION, "kind": kind, "metadata": {"name": name, "labels": dict(_LABELS)}, "spec": spec}
