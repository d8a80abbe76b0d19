"""When a robot counts as idle, and what must be watched to know it."""

from __future__ import annotations

import time
from typing import Any

import pytest

pytest.importorskip("rclpy")

from tests.unit.dds import isolate_discovery
from understudy.api.kinds.degraded_spec import InlineTree
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.monitor.observe.robot.degraded_tree import DegradedTrees
from understudy.trees.core.observations import RecordedObservations, TopicRecord
from understudy.trees.languages.notations import load_inline

STATUS = "/go/_action/status"
STILL = {"yaml": {"topic": {"name": "/beat", "gap": "1s"}}}


def policy(reschedule: dict[str, Any] | None) -> FailurePolicySpec:
    actions = [] if reschedule is None else [{"resize": {"cpu": "1"}}, {"reschedule": reschedule}]
    return FailurePolicySpec.model_validate(
        {
            "monitoring": {"yaml": {"topic": {"name": "/scan", "gap": "1s"}}},
            "strategies": [{"type": "Restart"}],
            "degraded": {"monitoring": {"yaml": {"topic": {"name": "/scan", "rate": "> 9 Hz"}}}, "actions": actions},
        }
    )


def workload(*actions: str) -> RobotWorkloadSpec:
    return RobotWorkloadSpec.model_validate(
        {
            "template": {"spec": {}},
            "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
            "tasks": [{"action": action, "type": "test_msgs/action/Fibonacci"} for action in actions],
            "failurePolicyRef": {"name": "p"},
        }
    )


def wellness(reschedule: dict[str, Any] | None, *actions: str) -> DegradedTrees:
    found = DegradedTrees()
    assert found.follow(policy(reschedule), workload(*actions))
    return found


def busy(found: DegradedTrees, observed: RecordedObservations) -> str:
    now = time.time()
    observed_health = found.busy(observed, now=now, since=now - 100)
    return observed_health.words if observed_health is not None else ""


def test_the_status_of_tasks_is_watched_only_if_idleness_matters() -> None:
    assert {topic.name for topic in wellness(None, "/go").topics} == {"/scan"}
    found = wellness({}, "/go").topics
    assert {topic.name for topic in found} == {"/scan", STATUS}
    assert next(topic for topic in found if topic.name == STATUS).task


def test_the_topics_of_the_idle_tree_cause_no_wakeups() -> None:
    log = {"yaml": {"log": {"level": "ERROR"}}}
    assert load_inline(InlineTree.model_validate(log), path="", grace=1.0).topics[0].prompt
    (rosout,) = (topic for topic in wellness({"idle": log}).topics if topic.name == "/rosout")
    assert not rosout.prompt


def test_an_active_goal_is_work() -> None:
    found = wellness({}, "/go", "/dock")
    assert busy(found, RecordedObservations({})) == ""
    assert busy(found, RecordedObservations({}, {"/dock/_action/status": 1.0})) == "a goal of /dock is active"


def test_a_robot_without_tasks_and_idle_tree_is_never_idle() -> None:
    assert "has no tasks" in busy(wellness({}), RecordedObservations({}))


def test_the_idle_tree_must_hold_in_addition() -> None:
    found, record = wellness({"idle": STILL}, "/go"), TopicRecord()
    assert busy(found, RecordedObservations({"/beat": record})) != ""
    record.add(time.time())
    assert busy(found, RecordedObservations({"/beat": record})) == ""
    assert busy(found, RecordedObservations({"/beat": record}, {STATUS: 1.0})) == "a goal of /go is active"


def test_without_tasks_the_idle_tree_is_sufficient() -> None:
    record = TopicRecord()
    record.add(time.time())
    assert busy(wellness({"idle": STILL}), RecordedObservations({"/beat": record})) == ""


def test_a_robot_with_an_unwatched_topic_is_not_idle() -> None:
    found, record = wellness({"idle": STILL}, "/go"), TopicRecord()
    record.add(time.time())
    found.leave_out(frozenset({"/beat"}))
    assert busy(found, RecordedObservations({"/beat": record})) == "/beat cannot be watched"


def test_an_invalid_idle_tree_is_reported_with_its_path() -> None:
    found = DegradedTrees()
    found.follow(policy({"idle": {"yaml": {"topic": {"name": "/beat", "gap": "1"}}}}), None)
    (problem,) = found.problems
    assert "spec.degraded.actions[1].reschedule.idle.yaml.topic.gap" in problem


@pytest.mark.ros
def test_real_topics_show_degradation_and_an_active_goal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    isolate_discovery(monkeypatch)
    from action_msgs.msg import GoalStatus, GoalStatusArray
    from rclpy.qos import qos_profile_action_status_default
    from std_msgs.msg import String

    from understudy.monitor.observe.robot.health_observer import HealthObserver
    from understudy.ros.runtime.graph_node import Graph

    policy_spec = FailurePolicySpec.model_validate(
        {
            "monitoring": {"yaml": {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1m"}}},
            "strategies": [{"type": "Restart"}],
            "degraded": {
                "monitoring": {"yaml": {"topic": {"name": "/beat", "gap": "500ms"}}},
                "actions": [{"reschedule": {}}],
            },
        }
    )
    observer, robot = HealthObserver(), Graph("robot")
    try:
        observer.follow(policy_spec, workload("/go"))
        beat = robot.node.create_publisher(String, "/beat", 10)
        status = robot.node.create_publisher(GoalStatusArray, STATUS, qos_profile_action_status_default)
        started_at = time.time()

        def until(holds: Any, what: str, *, beating: bool) -> None:
            end = time.monotonic() + 30
            while True:
                if beating:
                    beat.publish(String(data="x"))
                observer.drain([], "")
                if holds():
                    return
                assert time.monotonic() < end, f"30 s were not enough for {what}"
                time.sleep(0.02)

        def states() -> tuple[str, str]:
            now = time.time()
            return observer.verdict(now=now, since=started_at).state, observer.degraded_verdict(
                now=now, since=started_at
            ).state

        def is_busy() -> bool:
            return observer.busy(now=time.time(), since=started_at) is not None

        until(lambda: states() == ("Healthy", "Healthy"), "it to be well", beating=True)
        until(lambda: states() == ("Healthy", "Failed"), "it to be short of that", beating=False)
        until(lambda: states() == ("Healthy", "Healthy"), "it to be well again", beating=True)
        assert not is_busy()
        status.publish(GoalStatusArray(status_list=[GoalStatus(status=GoalStatus.STATUS_EXECUTING)]))
        until(is_busy, "the goal to be known", beating=False)
        status.publish(GoalStatusArray(status_list=[GoalStatus(status=GoalStatus.STATUS_SUCCEEDED)]))
        until(lambda: not is_busy(), "its end to be known", beating=False)
    finally:
        observer.graph.close()
        robot.close()
