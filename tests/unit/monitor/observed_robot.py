"""A health observer over real DDS, for tests, and a robot that publishes."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
from action_msgs.msg import GoalStatus, GoalStatusArray
from rclpy.qos import DurabilityPolicy, QoSProfile

from tests.unit.monitor.cluster_objects import parsed_spec
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.failover.interfaces import Instance
from understudy.monitor.observe.objects.resource_meter import ResourceMeter
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.ros.dds.host_ids import host_id

STATUS = "/go/_action/status"


def policy_with(tree: dict[str, object]) -> FailurePolicySpec:
    """Return a policy with this health tree."""
    return FailurePolicySpec.model_validate({"monitoring": {"yaml": tree}, "strategies": [{"type": "Restart"}]})


def observing(monkeypatch: pytest.MonkeyPatch, meter: ResourceMeter | None = None) -> Iterator[HealthObserver]:
    """An observer that watches /beat, and /cmd_vel while there is a task."""
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(10 + os.getpid() % 90))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    made = HealthObserver(meter)
    beat = {"topic": {"name": "/beat", "gap": "1s", "type": "std_msgs/msg/String"}}
    driving = {
        "while": {"task_active": {"action": "/go"}},
        "do": {"topic": {"name": "/cmd_vel", "gap": "500ms"}},
    }
    outputs = [
        {"topic": "/beat", "type": "std_msgs/msg/String"},
        {"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"},
    ]
    made.follow(policy_with({"parallel": [beat, driving]}), parsed_spec(outputs=outputs))
    yield made
    made.graph.close()


def publisher(observer: HealthObserver, topic: str, type_: type, *, latched: bool = False) -> Any:
    """Return a publisher of the robot, on this host."""
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    return observer.graph.node.create_publisher(type_, topic, QoSProfile(depth=10, durability=durability))


def until(
    observer: HealthObserver,
    holds: Callable[[], object],
    *,
    each: Callable[[], None] = lambda: None,
    instances: Sequence[Instance] = (),
) -> None:
    """Drain until something holds. The first instance is the active one."""
    end = time.monotonic() + 20
    while not holds():
        assert time.monotonic() < end
        each()
        time.sleep(0.02)
        observer.drain(instances, instances[0].name if instances else "")


def count(observer: HealthObserver, topic: str) -> int:
    """Return how many messages of a topic were received."""
    record = observer.observations.topic(topic)
    return record.count if record is not None else 0


def begin_task(observer: HealthObserver) -> Callable[[], None]:
    """Have a goal of /go be worked on, and wait until the observer knows. Returns what ends it."""
    server = publisher(observer, STATUS, GoalStatusArray, latched=True)

    def say(status: int) -> None:
        server.publish(GoalStatusArray(status_list=[GoalStatus(status=status)]))

    say(GoalStatus.STATUS_EXECUTING)
    until(observer, lambda: observer.observations.task(STATUS) is not None)
    return lambda: say(GoalStatus.STATUS_SUCCEEDED)


def own_address(observer: HealthObserver) -> str:
    """Return an address with which the endpoints of this process are those of a pod."""
    end = time.monotonic() + 20
    while not (ends := observer.graph.subscribers("/beat")):
        assert time.monotonic() < end
        time.sleep(0.02)
    addresses = (f"10.{a}.{b}.{c}" for a in range(16) for b in range(256) for c in range(256))
    return next(address for address in addresses if host_id(address) == ends[0].gid[2:4])
