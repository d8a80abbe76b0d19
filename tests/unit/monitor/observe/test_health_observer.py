"""What the monitor expects of the instance in control, by the health tree and by whether there is a task."""

from __future__ import annotations

import asyncio
import os
import time

import pytest

from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.failover.interfaces import GateState, Instance
from understudy.monitor.observe.objects.resource_meter import ResourceMeter
from understudy.trees.core.observations import PodCondition
from understudy.trees.languages.short import health_loader
from understudy.trees.leaves.custom_leaf import kind_of

pytestmark = pytest.mark.ros

STATUS = "/go/_action/status"


@pytest.fixture
def observer(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(10 + os.getpid() % 90))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    from understudy.monitor.observe.robot.health_observer import HealthObserver

    made = HealthObserver()
    made.follow(
        FailurePolicySpec.model_validate(
            {
                "monitoring": {
                    "yaml": {
                        "parallel": [
                            {"topic": {"name": "/beat", "gap": "1s", "type": "std_msgs/msg/String"}},
                            {
                                "while": {"task_active": {"action": "/go"}},
                                "do": {"topic": {"name": "/cmd_vel", "gap": "500ms"}},
                            },
                        ]
                    }
                },
                "strategies": [{"type": "Restart"}],
            }
        ),
        RobotWorkloadSpec.model_validate(
            {
                "template": {"spec": {}},
                "outputs": [
                    {"topic": "/beat", "type": "std_msgs/msg/String"},
                    {"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"},
                ],
                "failurePolicyRef": {"name": "p"},
            }
        ),
    )
    yield made
    made.graph.close()


def test_an_output_of_a_task_is_expected_only_while_that_is_active(observer) -> None:
    assert observer.gated == ["/beat", "/cmd_vel"]
    assert observer.expected == ["/beat"]
    observer._watching._topics[STATUS].active[bytes(16)] = 1.0
    assert observer.expected == ["/beat", "/cmd_vel"]


def test_a_tree_in_xml_takes_the_place_of_one_in_yaml_and_stays_when_the_next_is_broken(observer) -> None:
    def follow(text: str) -> None:
        spec = {"monitoring": {"xml": text}, "strategies": [{"type": "Restart"}]}
        observer.follow(FailurePolicySpec.model_validate(spec), None)

    good = '<root BTCPP_format="4"><BehaviorTree ID="A"><Topic topic="/beat" gap="1s"/></BehaviorTree></root>'
    follow(good)
    assert observer.gated == ["/beat"]
    follow(good.replace("<Topic", "<Topik"))
    assert observer.gated == ["/beat"]
    (problem,) = (problem for problem in observer.problems if "health tree" in problem)
    assert "spec.monitoring.xml, line 1, column 45: <Topik>: unknown node, did you mean 'Topic'?" in problem
    follow(good)
    assert not any("health tree" in problem for problem in observer.problems)


def test_a_tree_in_openscenario_takes_the_place_of_one_in_yaml(observer) -> None:
    tree = 'import osc.understudy\nscenario healthy:\n    do topic("/beat", gap: 1s)\n'
    spec = {"monitoring": {"osc": tree}, "strategies": [{"type": "Restart"}]}
    observer.follow(FailurePolicySpec.model_validate(spec), None)
    assert observer.gated == ["/beat"]
    assert not any("health tree" in problem for problem in observer.problems)


def test_the_last_output_of_an_earlier_task_is_not_when_all_was_well_last(observer) -> None:
    from understudy.ros.dds.host_ids import VENDOR, host_id
    from understudy.ros.observe.topic_watch import SourceRecord

    observer._watching.attribute({"w-1": "192.0.2.1"}, "w-1")
    host = VENDOR + host_id("192.0.2.1")
    for topic, received in (("/cmd_vel", 50.0), ("/beat", 100.0)):
        record = observer._watching._topics[topic].sources[host] = SourceRecord(10.0)
        record.add(received)
    assert observer.last_well("w-1") == 100.0
    del observer._watching._topics["/beat"].sources[host]
    assert observer.last_well("w-1") is None
    assert observer.last_from("w-1") == 50.0


async def test_nothing_more_is_waited_for_when_the_task_ends_before_the_first_output() -> None:
    from understudy.monitor.observe.robot.health_observer import GatedReaders
    from understudy.ros.observe.sample_sources import Sources

    class Sight:
        expected = ("/cmd_vel",)

        def drain(self, instances: object, active: object) -> None:
            """There is nothing to drain."""

    class Watching:
        sources = Sources({})

        def first_from(self, topic: str, pod: str, *, since: float) -> None:
            """Nothing has come."""

    class Fleet:
        def of_workload(self) -> list[Instance]:
            return []

    class Gate:
        state = GateState(active="standby", active_uid="u")

    seen = Sight()
    readers = GatedReaders(seen, Watching(), Fleet(), Gate())  # type: ignore[arg-type]
    waiting = asyncio.create_task(readers.first_from(Instance("standby", "u"), since=0.0))
    await asyncio.sleep(0.1)
    assert not waiting.done()
    seen.expected = ()
    async with asyncio.timeout(20):
        assert await waiting is None


def test_an_output_of_which_only_the_publishers_are_looked_at_is_not_expected(observer) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    observer.follow(_policy({"parallel": [gap, {"publisher": {"topic": "/cmd_vel"}}]}), None)
    assert observer.gated == observer.expected == ["/beat"]
    assert observer.observations.topic("/cmd_vel") is None
    observer.drain([], "")
    assert observer.observations.publishers("/cmd_vel").nodes == ()


def test_a_node_of_the_name_of_an_output_is_looked_for_and_nothing_is_expected_of_it(observer) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    observer.follow(_policy({"parallel": [gap, {"node": {"name": "/cmd_vel"}}]}), None)
    assert observer.gated == observer.expected == ["/beat"]
    observer.drain([], "")
    assert not observer.observations.node("/cmd_vel").there
    assert observer.summary == "Watching /beat, /cmd_vel."


def test_an_output_that_is_compared_with_what_is_seen_is_received_but_not_expected(observer) -> None:
    motion = {"motion": {"topic": "/seen", "commands": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}}
    observer.follow(_policy(motion), None)
    assert observer.observations.in_control
    assert observer.observations.topic("/cmd_vel") is not None
    assert observer.observations.topic("/seen") is not None
    assert observer.expected == [], "a robot that is told nothing stands, and is well"


def test_for_a_reflex_the_messages_of_such_an_output_are_received_too(observer) -> None:
    spec = {
        "template": {"spec": {}},
        "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
        "failurePolicyRef": {"name": "p"},
        "gate": {"reflex": {"deadline": "100ms"}},
    }
    observer.follow(_policy({"publisher": {"topic": "/cmd_vel"}}), RobotWorkloadSpec.model_validate(spec))
    assert observer.observations.topic("/cmd_vel") is not None
    assert observer.expected == []


def _policy(tree: dict[str, object]) -> FailurePolicySpec:
    return FailurePolicySpec.model_validate({"monitoring": {"yaml": tree}, "strategies": [{"type": "Restart"}]})


def test_a_condition_over_a_field_that_is_not_there_leaves_the_last_tree_in_force(observer) -> None:
    leaf = {"topic": "/battery", "type": "sensor_msgs/msg/BatteryState", "holds": "percent > 0.15"}
    observer.follow(_policy({"value": leaf}), None)
    (problem,) = observer.problems
    assert problem.startswith("The policy's health tree does not load, the last good one stays in force")
    assert "spec.monitoring.yaml.value.holds: found 'percent > 0.15': sensor_msgs/msg/BatteryState has no" in problem
    assert observer.gated == ["/beat", "/cmd_vel"]


def test_what_a_new_tree_names_has_the_grace_to_come(observer) -> None:
    now = time.time()
    assert observer.verdict(now=now, since=now - 3600).state == "Starting"
    leaf = {"topic": "/battery", "type": "sensor_msgs/msg/BatteryState", "holds": "percentage > 0.15"}
    observer.follow(_policy({"value": leaf}), None)
    now = time.time()
    assert observer.verdict(now=now, since=now - 3600).state == "Starting"
    assert observer.verdict(now=now + 60, since=now - 3600).reason == "no /battery within 30 s of the start"


def test_a_type_that_is_not_installed_leaves_its_conditions_out(observer) -> None:
    leaf = {"topic": "/battery", "type": "nobodys_msgs/msg/Battery", "holds": "charge > 0.15"}
    tree = {"parallel": [{"value": leaf}, {"topic": {"name": "/beat", "gap": "1s"}}]}
    observer.follow(_policy(tree), None)
    observer.drain([], "")
    assert any("nobodys_msgs/msg/Battery is not installed" in problem for problem in observer.problems)
    assert observer.summary == "Watching /beat."


def _degraded(tree: dict[str, object], well: dict[str, object] | None) -> FailurePolicySpec:
    spec: dict[str, object] = {"monitoring": {"yaml": tree}, "strategies": [{"type": "Restart"}]}
    if well is not None:
        spec["degraded"] = {"monitoring": {"yaml": well}}
    return FailurePolicySpec.model_validate(spec)


def test_a_topic_of_both_trees_is_received_once_and_by_what_both_need(observer) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    well = {"parallel": [{"topic": {"name": "/beat", "rate": "> 9 Hz"}}, {"topic": {"name": "/scan", "gap": "1s"}}]}
    observer.follow(_degraded(gap, None), None)
    subscription = observer._watching._topics["/beat"].subscription
    assert set(observer._watching._topics) == {"/beat"}
    observer.follow(_degraded(gap, well), None)
    assert set(observer._watching._topics) == {"/beat", "/scan"}
    assert observer._watching._topics["/beat"].subscription is subscription
    assert observer._watching._topics["/beat"].want.window > 0
    assert observer.gated == ["/beat"], "what is waited for at a failover is the health tree's alone"
    observer.follow(_degraded(gap, None), None)
    assert set(observer._watching._topics) == {"/beat"}


def test_what_well_means_changes_without_the_health_tree_beginning_anew(observer) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    observer.follow(_degraded(gap, None), None)
    tree = observer._tree
    observer.follow(_degraded(gap, {"topic": {"name": "/beat", "rate": "> 9 Hz"}}), None)
    assert observer._tree is tree


def test_a_type_that_only_well_needs_and_that_is_not_installed_leaves_the_health_tree_whole(observer) -> None:
    health = {"parallel": [{"topic": {"name": "/beat", "gap": "1s"}}, {"publisher": {"topic": "/battery"}}]}
    well = {"value": {"topic": "/battery", "type": "nobodys_msgs/msg/Battery", "holds": "charge > 0.5"}}
    observer.follow(_degraded(health, well), None)
    observer.drain([], "")
    assert any("nobodys_msgs/msg/Battery is not installed" in problem for problem in observer.problems)
    assert observer.summary == "Watching /beat, /battery."
    now = time.time()
    assert observer.wellness(now=now, since=now).state == "Starting"


def test_a_tree_of_what_well_means_that_does_not_load_is_told_and_the_last_one_stays(observer) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    good = {"topic": {"name": "/beat", "rate": "> 9 Hz"}}
    observer.follow(_degraded(gap, good), None)
    well = observer._wellness._well
    observer.follow(_degraded(gap, {"topic": {"name": "/beat", "rate": "> 9 Herz"}}), None)
    (problem,) = observer.problems
    assert "spec.degraded.monitoring.yaml.topic.rate" in problem
    assert observer._wellness._well is well
    observer.follow(_degraded(gap, good), None)
    assert observer.problems == []


def test_the_situation_is_seen_by_what_is_watched_for_it_alone_and_the_health_tree_is_left_as_it_is(observer) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    strategies = [{"type": "Restart"}]
    carrying = {"name": "carrying", "when": {"task": {"action": "/go"}}, "strategies": strategies}
    loads = {"value": {"topic": "/load", "type": "nobodys_msgs/msg/Load", "holds": "data > 5"}}
    loaded = {"name": "loaded", "when": {"yaml": loads}, "strategies": strategies}
    spec = {"monitoring": {"yaml": gap}, "strategies": strategies, "situations": [carrying, loaded]}
    observer.follow(_policy(gap), None)
    assert set(observer._watching._topics) == {"/beat"}
    tree = observer._tree
    observer.follow(FailurePolicySpec.model_validate(spec), None)
    assert observer._tree is tree
    observer.drain([], "")
    now = time.time()
    seen = observer.situations([], now=now, since=now)
    assert (seen["carrying"].so, seen["loaded"].so) == (False, None)
    assert any("nobodys_msgs/msg/Load is not installed" in problem for problem in observer.problems)
    observer._watching._topics[STATUS].active[bytes(16)] = now
    assert observer.situations([], now=now, since=now)["carrying"].so
    assert observer.summary == "Watching /beat."
    observer.follow(_policy(gap), None)
    assert set(observer._watching._topics) == {"/beat"}


def _instance(name: str, ready: str, restarts: int = 0) -> Instance:
    return Instance(name, f"uid-{name}", restarts=restarts, conditions=(PodCondition("Ready", ready),))


def test_a_leaf_about_the_pod_is_judged_by_what_the_cluster_says_of_the_one_in_control(observer) -> None:
    observer.follow(_policy({"pod": {"condition": "Ready"}}), None)
    assert observer.summary == "Watching pod."
    active, standby = _instance("w-1", "True"), _instance("w-2", "False")
    since = time.time()
    observer.drain([active, standby], "w-1")
    assert observer.verdict(now=time.time(), since=since).state == "Healthy"
    observer.drain([active, _instance("w-2", "Unknown")], "w-1")
    assert observer.verdict(now=time.time(), since=since).state == "Healthy"
    observer.drain([_instance("w-1", "False"), standby], "w-1")
    verdict = observer.verdict(now=time.time(), since=since)
    assert (verdict.state, verdict.leaf) == ("Failed", "pod.Ready")
    since = time.time()
    assert observer.verdict(now=time.time(), since=since).state == "Starting", "nobody has looked at the next one"
    observer.drain([_instance("w-2", "True")], "w-2")
    assert observer.verdict(now=time.time(), since=since).state == "Healthy"
    observer.drain([], "w-2")
    assert observer.verdict(now=time.time(), since=since).state == "Healthy", "what is gone is told otherwise"


def test_restarts_of_the_instance_in_control_count(observer) -> None:
    observer.follow(_policy({"pod": {"restarts": 1, "window": "10m"}}), None)
    since = time.time()
    for restarts, expected in ((4, "Healthy"), (5, "Healthy"), (6, "Failed")):
        observer.drain([_instance("w-1", "True", restarts), _instance("w-2", "True", 9 * restarts)], "w-1")
        assert observer.verdict(now=time.time(), since=since).state == expected


def test_what_is_known_of_the_pod_is_said_anew_and_only_where_the_tree_asks_for_it(observer) -> None:
    instances = [_instance("w-1", "True")]
    observer.drain(instances, "w-1")
    assert observer.observations.pod() is None
    observer.follow(_policy({"pod": {"condition": "Ready"}}), None)
    observer.drain(instances, "w-1")
    first = observer.observations.pod()
    assert first is not None
    end = time.monotonic() + 20
    while observer.observations.pod() is first and time.monotonic() < end:
        observer.drain(instances, "w-1")
        time.sleep(0.02)
    assert observer.observations.pod().received > first.received


def test_what_the_pod_takes_is_asked_for_where_the_tree_needs_it_and_judged(observer) -> None:
    meter = ResourceMeter(None, "fleet", "w")  # type: ignore[arg-type]
    observer = type(observer)(meter)
    instances = [_instance("w-1", "True"), _instance("w-2", "True")]
    observer.follow(_policy({"pod": {"condition": "Ready"}}), None)
    observer.drain(instances, "w-1")
    assert meter._pod == "", "nobody asks for it"
    observer.follow(_policy({"pod": {"memory": "< 200Mi"}}), None)
    since = time.time()

    def until(state: str) -> None:
        end = time.monotonic() + 20
        while observer.verdict(now=time.time(), since=since).state != state:
            assert time.monotonic() < end
            observer.drain(instances, "w-1")
            time.sleep(0.02)

    until("Healthy")  # there are no figures yet
    assert meter._pod == "w-1"
    usage = {"cpu": "1", "memory": "300Mi"}
    item = {"metadata": {"name": "w-1"}, "timestamp": "t", "containers": [{"name": "drive", "usage": usage}]}
    meter._take({"items": [item]})
    end = time.monotonic() + 20
    while observer.verdict(now=time.time(), since=since).state == "Healthy" and time.monotonic() < end:
        observer.drain(instances, "w-1")
        time.sleep(0.02)
    assert (
        observer.verdict(now=time.time(), since=since).reason
        == "memory < 200Mi of the pod does not hold (it was 300Mi)"
    )
    observer.drain(instances, "w-2")
    assert (meter._pod, meter.usage) == ("w-2", None)
    meter._problem = "CPU and memory of pods are unknown: because."
    assert meter._problem in observer.problems


def test_a_leaf_of_one_s_own_that_fails_by_itself_is_told_of_and_no_failure(
    observer, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken:
        def judge(self, message: object) -> str:
            return str(message.percentage)  # type: ignore[attr-defined]

    monkeypatch.setattr(health_loader, "LEAVES", {**health_loader.LEAVES, "acme_leaf": kind_of("acme_leaf", Broken)})
    monkeypatch.setattr(health_loader, "KINDS", (*health_loader.KINDS, "acme_leaf"))
    observer.follow(_policy({"acme_leaf": {"topic": "/beat", "type": "std_msgs/msg/String"}}), None)
    from std_msgs.msg import String

    publisher = observer.graph.node.create_publisher(String, "/beat", 10)
    since, end = time.time(), time.monotonic() + 20
    while not observer.problems and time.monotonic() < end:
        publisher.publish(String(data="x"))
        time.sleep(0.05)
        observer.drain([], "")
        verdict = observer.verdict(now=time.time(), since=since)
    assert observer.problems == [
        "acme_leaf cannot judge /beat, AttributeError: 'String' object has no attribute 'percentage'."
    ]
    assert verdict.state == "Healthy"
