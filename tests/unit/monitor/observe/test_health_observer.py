"""What the monitor expects of the instance in control, by the health tree and by whether there is a task."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Iterator

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from geometry_msgs.msg import Twist
from std_msgs.msg import String
from std_srvs.srv import Empty

from tests.support.clock import Clock, set_clock
from tests.unit.monitor.cluster_objects import ClusterObjects, parsed_spec
from tests.unit.monitor.observed_robot import STATUS, begin_task, count, observing, own_address, publisher, until
from tests.unit.monitor.observed_robot import policy_with as _policy
from tests.unit.monitor.senses import GivenSenses
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.clock import CLOCK
from understudy.failover.interfaces import GateState, Instance
from understudy.monitor.judge.failure_detection import FailureDetector
from understudy.monitor.observe.robot import degraded_tree, health_observer
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.observe.robot.known_senders import host_at
from understudy.ros.runtime.graph_node import Graph
from understudy.trees.languages.short import health_loader
from understudy.trees.leaves.custom_leaf import kind_of

pytestmark = pytest.mark.ros


@pytest.fixture
def observer(monkeypatch: pytest.MonkeyPatch) -> Iterator[HealthObserver]:
    yield from observing(monkeypatch)


def test_an_output_of_a_task_is_expected_only_while_the_task_is_active(observer: HealthObserver) -> None:
    assert observer.gated == ["/beat", "/cmd_vel"]
    assert observer.expected == observer.never_silent == ["/beat"]
    begin_task(observer)
    assert observer.expected == observer.never_silent == ["/beat", "/cmd_vel"]


def test_an_output_that_the_health_tree_does_not_watch_is_never_silent(observer: HealthObserver) -> None:
    observer.follow(_policy({"topic": {"name": "/beat", "gap": "1s"}}), parsed_spec())
    assert observer.gated == []
    assert observer.never_silent == ["/cmd_vel"]


def test_a_tree_in_xml_replaces_one_in_yaml_and_stays_if_the_next_is_invalid(
    observer: HealthObserver,
) -> None:
    def follow(text: str) -> None:
        spec = {"monitoring": {"xml": text}, "strategies": [{"type": "Restart"}]}
        observer.follow(FailurePolicySpec.model_validate(spec), None)

    good = '<root BTCPP_format="4"><BehaviorTree ID="A"><Topic topic="/beat" gap="1s"/></BehaviorTree></root>'
    follow(good)
    assert observer.gated == ["/beat"]
    follow(good.replace("<Topic", "<Topik"))
    assert observer.gated == ["/beat"]
    (problem,) = (problem for problem in observer.problems if "health tree" in problem)
    assert_golden("monitor", problem, "spec.monitoring.xml", "line 1, column 45", "'Topic'")
    follow(good)
    assert not any("health tree" in problem for problem in observer.problems)


def test_a_tree_in_openscenario_replaces_one_in_yaml(observer: HealthObserver) -> None:
    tree = 'import osc.understudy\nscenario healthy:\n    do topic("/beat", gap: 1s)\n'
    spec = {"monitoring": {"osc": tree}, "strategies": [{"type": "Restart"}]}
    observer.follow(FailurePolicySpec.model_validate(spec), None)
    assert observer.gated == ["/beat"]
    assert not any("health tree" in problem for problem in observer.problems)


def test_an_output_of_an_earlier_task_is_not_the_last_healthy_output(observer: HealthObserver) -> None:
    beat, command = publisher(observer, "/beat", String), publisher(observer, "/cmd_vel", Twist)
    active = Instance("w-1", "uid-1", ip=own_address(observer))
    until(observer, lambda: observer.last_from("w-1"), each=lambda: command.publish(Twist()), instances=[active])
    assert observer.last_well("w-1") is None
    last = observer.last_from("w-1")
    assert last is not None
    until(observer, lambda: observer.last_well("w-1"), each=lambda: beat.publish(String()), instances=[active])
    well = observer.last_well("w-1")
    assert well is not None
    assert well > last
    assert well == observer.last_from("w-1")


async def test_the_wait_for_the_first_output_ends_with_the_task(observer: HealthObserver) -> None:
    driving = {"while": {"task_active": {"action": "/go"}}, "do": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}}
    observer.follow(_policy(driving), None)
    objects, standby = ClusterObjects(), Instance("standby", "u", running=True)
    objects.put_pods(standby)
    objects.put_gate(GateState(epoch=4, active="standby", active_uid="u"))
    readers = observer.outputs(objects.pods, objects.gate)
    end_task = begin_task(observer)
    waiting = asyncio.create_task(readers.first_from(standby, since=0.0))
    await asyncio.sleep(0.1)
    assert not waiting.done()
    end_task()
    async with asyncio.timeout(20):
        assert await waiting is None


def test_a_reader_of_the_robot_does_not_shorten_the_grace_of_an_instance_that_is_not_discovered(
    observer: HealthObserver,
) -> None:
    """As after a restart of the discovery server, which may bring the robot back before the instance."""
    objects = ClusterObjects()
    inherited = Instance("w-1", "uid-1", ip=own_address(observer), running=True, ready=True)
    objects.put_pods(inherited)
    objects.put_gate(GateState(epoch=3, active="w-1", active_uid="uid-1"))
    agents = GivenSenses(objects).agents
    judging = FailureDetector(objects.pods, objects.gate, agents, observer, driven_epoch=3)
    start = judging.since
    robot = Graph("robot")
    robot.subscribe("/beat", "std_msgs/msg/String", depth=1)
    until(observer, lambda: observer.graph.subscribers("/beat")[1:])
    assert judging.verdict(inherited, start + 1).state == "Starting"
    assert judging.verdict(inherited, start + 29).state == "Starting"
    publisher(observer, "/beat", String)
    until(observer, lambda: observer.graph.publishers("/beat"))
    now = time.time()
    assert judging.verdict(inherited, now).state == "Starting"
    assert judging.verdict(inherited, now + 5.1).state == "Failed"
    robot.close()


def test_an_instance_is_discovered_by_an_endpoint_of_an_output_on_its_own_host(observer: HealthObserver) -> None:
    outputs = [
        {"topic": "/beat", "type": "std_msgs/msg/String"},
        {"service": "/reset", "type": "std_srvs/srv/Empty"},
    ]
    observer.follow(_policy({"topic": {"name": "/beat", "gap": "1s"}}), parsed_spec(outputs=outputs))
    other = Graph("other")
    other.subscribe("/beat", "std_msgs/msg/String", depth=1)
    until(observer, lambda: observer.graph.subscribers("/beat")[1:])
    here = Instance("w-1", "uid-1", ip=own_address(observer))
    elsewhere = Instance("w-2", "uid-2", ip="10.99.0.1")
    assert observer.discovered(here) is False
    server = other.node.create_service(Empty, "/reset", lambda request, response: response)
    until(observer, lambda: observer.discovered(here))
    assert observer.discovered(elsewhere) is False
    other.node.destroy_service(server)
    until(observer, lambda: observer.discovered(here) is False)
    publisher(observer, "/beat", String)
    until(observer, lambda: observer.discovered(here))
    other.close()


def test_a_reader_on_a_further_host_is_somebody_else_than_the_instance_and_this_monitor(
    observer: HealthObserver,
) -> None:
    observer.follow(
        _policy({"topic": {"name": "/beat", "gap": "1s"}}),
        parsed_spec(outputs=[{"topic": "/beat", "type": "std_msgs/msg/String"}]),
    )
    instance = Instance("w-1", "uid-1", ip="10.99.0.1")
    until(observer, lambda: observer.graph.subscribers("/beat"))
    observer.own_host = host_at(own_address(observer))
    assert not observer.others_discovered(instance)
    observer.own_host = host_at("10.99.0.2")
    assert observer.others_discovered(instance)
    assert not observer.others_discovered(Instance("w-1", "uid-1", ip=own_address(observer)))


def test_a_monitor_hears_nobody_until_a_message_of_anybody_arrives(observer: HealthObserver) -> None:
    outputs = parsed_spec(outputs=[{"topic": "/beat", "type": "std_msgs/msg/String"}])
    beat = {"topic": {"name": "/beat", "gap": "1s"}}
    observer.follow(_policy(beat), outputs)
    assert not observer.hears_nobody, "the silence of the instance alone says nothing about this monitor"
    observer.follow(_policy({"parallel": [beat, {"topic": {"name": "/said", "gap": "1s"}}]}), outputs)
    assert observer.hears_nobody
    said = publisher(observer, "/said", String)
    until(observer, lambda: not observer.hears_nobody, each=lambda: said.publish(String()))


def test_a_topic_of_the_robot_that_was_never_received_is_named_once_the_tree_fails_by_it(
    observer: HealthObserver,
) -> None:
    trees = {"parallel": [{"topic": {"name": topic, "gap": "1s"}} for topic in ("/beat", "/said")]}
    observer.follow(_policy(trees), parsed_spec(outputs=[{"topic": "/beat", "type": "std_msgs/msg/String"}]))
    now = time.time()
    observer.verdict(now=now, since=now)
    assert observer.unheard == "", "it may still come"
    assert observer.verdict(now=now + 60, since=now).state == "Failed"
    assert observer.unheard == "/said", "the other one is the instance's"
    said = publisher(observer, "/said", String)
    until(observer, lambda: not observer.unheard, each=lambda: said.publish(String()))


def test_what_is_missed_is_known_although_a_message_arrives_after_the_evaluation(observer: HealthObserver) -> None:
    observer.follow(
        _policy({"topic": {"name": "/said", "gap": "200ms"}}),
        parsed_spec(outputs=[{"topic": "/beat", "type": "std_msgs/msg/String"}]),
    )
    said, begun = publisher(observer, "/said", String), time.time()
    until(observer, lambda: not observer.awaited, each=lambda: said.publish(String()))
    time.sleep(0.3)
    assert observer.verdict(now=time.time(), since=begun).state == "Failed"
    arrived = observer.records["/said"].arrivals[-1]
    until(observer, lambda: observer.records["/said"].arrivals[-1] > arrived, each=lambda: said.publish(String()))
    assert observer.unheard == ""


@pytest.mark.parametrize("kind", ["inverter", "selector"])
def test_a_topic_of_the_robot_that_need_not_be_received_is_not_missed(observer: HealthObserver, kind: str) -> None:
    never = {"topic": {"name": "/emergency", "gap": "1s"}}
    beat = {"topic": {"name": "/beat", "gap": "1s"}}
    tree = {"inverter": never} if kind == "inverter" else {"selector": [never, {"inverter": beat}]}
    observer.follow(_policy(tree), parsed_spec(outputs=[{"topic": "/beat", "type": "std_msgs/msg/String"}]))
    now = time.time()
    assert observer.verdict(now=now + 60, since=now).state == "Healthy"
    assert observer.awaited == ["/emergency"]
    assert observer.unheard == ""


def test_whether_an_instance_is_discovered_is_unknown_without_an_ipv4_address_or_outputs(
    observer: HealthObserver,
) -> None:
    assert observer.discovered(Instance("w-1", "uid-1", ip="fd00::1")) is None
    assert observer.discovered(Instance("w-1", "uid-1")) is None
    new = HealthObserver()
    assert new.discovered(Instance("w-1", "uid-1", ip="10.0.0.1")) is None
    new.graph.close()


def test_a_restarted_process_of_a_pod_is_distinguished_from_the_one_before(observer: HealthObserver) -> None:
    beat = publisher(observer, "/beat", String)
    active = Instance("w-1", "uid-1", ip=own_address(observer))
    assert observer.processes("w-1") == frozenset()
    until(observer, lambda: observer.processes("w-1"), each=lambda: beat.publish(String()), instances=[active])
    (before,) = observer.processes("w-1")
    restarted = Graph("restarted")
    again = restarted.node.create_publisher(String, "/beat", 1)
    until(
        observer,
        lambda: len(observer.processes("w-1")) == 2,
        each=lambda: again.publish(String()),
        instances=[active],
    )
    assert before in observer.processes("w-1")
    restarted.close()


def test_an_instance_that_had_sent_before_has_less_time_for_its_first_message_until_the_tree_changes(
    observer: HealthObserver,
) -> None:
    since = time.time()
    observer.expect_samples(since=since, heard_from=since)
    assert observer.verdict(now=since + 4.9, since=since).state == "Starting"
    assert observer.deadline(now=since + 4.9, since=since) == pytest.approx(since + 5)
    assert observer.verdict(now=since + 5.1, since=since).state == "Failed"
    observer.follow(_policy({"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "2s"}}), None)
    assert observer.verdict(now=since + 5.1, since=since).state == "Starting"


@pytest.mark.parametrize("step", [-60.0, 60.0])
async def test_samples_from_before_a_clock_step_are_as_old_as_they_are_for_a_recovery(
    observer: HealthObserver, monkeypatch: pytest.MonkeyPatch, step: float
) -> None:
    said, begun = publisher(observer, "/beat", String), CLOCK.now()
    objects, sender = ClusterObjects(), Instance("w-1", "uid-1", ip=own_address(observer), running=True)
    objects.put_pods(sender)
    objects.put_gate(GateState(epoch=4, active="w-1", active_uid="uid-1"))
    until(observer, lambda: observer.last_from("w-1"), each=lambda: said.publish(String()), instances=[sender])
    readers = observer.outputs(objects.pods, objects.gate)
    other = Instance("w-2", "uid-2")
    last, _ = readers.last_from_others(other)
    set_clock(monkeypatch, step)
    assert readers.last_from_others(other) == (pytest.approx(last, abs=0.01), "w-1")
    assert readers.heard() == [(pytest.approx(last, abs=0.01), pytest.approx(math.inf))]
    assert begun - 0.01 <= last <= CLOCK.now()
    async with asyncio.timeout(5):
        assert await readers.first_from(sender, since=begun - 0.01) == pytest.approx(last, abs=5)


def test_an_output_with_only_a_publisher_leaf_is_not_expected(observer: HealthObserver) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    observer.follow(_policy({"parallel": [gap, {"publisher": {"topic": "/cmd_vel"}}]}), None)
    assert observer.gated == observer.expected == ["/beat"]
    assert observer.observations.topic("/cmd_vel") is None
    observer.drain([], "")
    assert observer.observations.publishers("/cmd_vel").nodes == ()


def test_a_node_with_the_name_of_an_output_is_watched_and_not_expected_as_a_topic(observer: HealthObserver) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    observer.follow(_policy({"parallel": [gap, {"node": {"name": "/cmd_vel"}}]}), None)
    assert observer.gated == observer.expected == ["/beat"]
    observer.drain([], "")
    assert not observer.observations.node("/cmd_vel").there
    assert observer.summary == "Watching /beat, /cmd_vel."


def test_an_output_of_a_motion_leaf_is_received_but_not_expected(observer: HealthObserver) -> None:
    motion = {"motion": {"topic": "/seen", "commands": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}}
    observer.follow(_policy(motion), None)
    assert observer.observations.in_control
    assert observer.observations.topic("/cmd_vel") is not None
    assert observer.observations.topic("/seen") is not None
    assert observer.expected == [], "a robot that is told nothing stands, and is well"


def test_with_a_reflex_an_output_with_only_a_publisher_leaf_is_received(observer: HealthObserver) -> None:
    spec = {
        "template": {"spec": {}},
        "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
        "failurePolicyRef": {"name": "p"},
        "gate": {"reflex": {"deadline": "100ms"}},
    }
    observer.follow(_policy({"publisher": {"topic": "/cmd_vel"}}), RobotWorkloadSpec.model_validate(spec))
    assert observer.observations.topic("/cmd_vel") is not None
    assert observer.expected == []


def test_a_condition_with_an_unknown_field_leaves_the_last_tree_in_force(observer: HealthObserver) -> None:
    leaf = {"topic": "/battery", "type": "sensor_msgs/msg/BatteryState", "holds": "percent > 0.15"}
    observer.follow(_policy({"value": leaf}), None)
    (problem,) = observer.problems
    assert_golden("monitor", problem, "spec.monitoring.yaml.value.holds", "0.15", "sensor_msgs", "BatteryState")
    assert observer.gated == ["/beat", "/cmd_vel"]


def test_the_topics_of_a_new_tree_have_the_startup_grace(observer: HealthObserver) -> None:
    now = time.time()
    assert observer.verdict(now=now, since=now - 3600).state == "Starting"
    leaf = {"topic": "/battery", "type": "sensor_msgs/msg/BatteryState", "holds": "percentage > 0.15"}
    observer.follow(_policy({"value": leaf}), None)
    now = time.time()
    assert observer.verdict(now=now, since=now - 3600).state == "Starting"
    assert observer.verdict(now=now + 60, since=now - 3600).reason == "no /battery within 30 s of the start"


def test_a_condition_with_a_missing_type_is_left_out(observer: HealthObserver) -> None:
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


def received(observer: HealthObserver, *topics: str) -> set[str]:
    """Which of these topics are received."""
    return {topic for topic in topics if observer.observations.topic(topic) is not None}


def test_a_topic_of_both_trees_is_received_once_with_the_needs_of_both(observer: HealthObserver) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    well = {"parallel": [{"topic": {"name": "/beat", "rate": "> 9 Hz"}}, {"topic": {"name": "/scan", "gap": "1s"}}]}
    beat = publisher(observer, "/beat", String)
    observer.follow(_degraded(gap, None), None)
    until(observer, lambda: count(observer, "/beat"), each=lambda: beat.publish(String()))
    assert received(observer, "/beat", "/scan", "/cmd_vel") == {"/beat"}
    before, subscriptions = count(observer, "/beat"), beat.get_subscription_count()
    observer.follow(_degraded(gap, well), None)
    assert received(observer, "/beat", "/scan", "/cmd_vel") == {"/beat", "/scan"}
    assert (count(observer, "/beat"), beat.get_subscription_count()) == (before, subscriptions), "it is the same one"
    record = observer.observations.topic("/beat")
    assert record is not None
    assert record.window > 0
    assert observer.gated == ["/beat"], "what is waited for at a failover is the health tree's alone"
    observer.follow(_degraded(gap, None), None)
    assert received(observer, "/beat", "/scan") == {"/beat"}


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock with which trees begin."""
    clock = Clock()
    for module in (health_observer, degraded_tree):
        monkeypatch.setattr(module, "time", clock)
    return clock


GRACE = 30.0
"""Seconds that a tree gives what it names to come, from its begin on."""


def test_a_change_of_the_degraded_tree_does_not_restart_the_health_tree(observer: HealthObserver, clock: Clock) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    observer.follow(_degraded(gap, None), None)
    started_at, clock.now = clock.now, clock.now + 20
    observer.follow(_degraded(gap, {"topic": {"name": "/beat", "rate": "> 9 Hz"}}), None)
    assert observer.verdict(now=started_at + GRACE - 1, since=started_at).state == "Starting"
    assert observer.verdict(now=started_at + GRACE + 1, since=started_at).state == "Failed"


def test_a_missing_type_of_the_degraded_tree_does_not_affect_the_health_tree(
    observer: HealthObserver,
) -> None:
    health = {"parallel": [{"topic": {"name": "/beat", "gap": "1s"}}, {"publisher": {"topic": "/battery"}}]}
    well = {"value": {"topic": "/battery", "type": "nobodys_msgs/msg/Battery", "holds": "charge > 0.5"}}
    observer.follow(_degraded(health, well), None)
    observer.drain([], "")
    assert any("nobodys_msgs/msg/Battery is not installed" in problem for problem in observer.problems)
    assert observer.summary == "Watching /beat, /battery."
    now = time.time()
    assert observer.degraded_verdict(now=now, since=now).state == "Starting"


def test_an_invalid_degraded_tree_is_reported_and_the_last_one_stays(observer: HealthObserver, clock: Clock) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    good = {"topic": {"name": "/beat", "rate": "> 9 Hz"}}
    observer.follow(_degraded(gap, good), None)
    started_at, clock.now = clock.now, clock.now + 20
    observer.follow(_degraded(gap, {"topic": {"name": "/beat", "rate": "> 9 Herz"}}), None)
    (problem,) = observer.problems
    assert "spec.degraded.monitoring.yaml.topic.rate" in problem
    assert observer.degraded_verdict(now=started_at + GRACE + 1, since=started_at).state == "Failed"
    observer.follow(_degraded(gap, good), None)
    assert observer.problems == []


def test_topics_of_situations_do_not_affect_the_health_tree(observer: HealthObserver, clock: Clock) -> None:
    gap = {"topic": {"name": "/beat", "type": "std_msgs/msg/String", "gap": "1s"}}
    strategies = [{"type": "Restart"}]
    carrying = {"name": "carrying", "when": {"task": {"action": "/go"}}, "strategies": strategies}
    loads = {"value": {"topic": "/load", "type": "nobodys_msgs/msg/Load", "holds": "data > 5"}}
    loaded = {"name": "loaded", "when": {"yaml": loads}, "strategies": strategies}
    spec = {"monitoring": {"yaml": gap}, "strategies": strategies, "situations": [carrying, loaded]}
    observer.follow(_policy(gap), None)
    assert received(observer, "/beat", "/load") == {"/beat"}
    started_at, clock.now = clock.now, clock.now + 20
    observer.follow(FailurePolicySpec.model_validate(spec), None)
    assert observer.verdict(now=started_at + GRACE + 1, since=started_at).state == "Failed", "it did not begin again"
    clock.now = time.time()
    observer.drain([], "")
    now = time.time()
    situations = observer.situations([], now=now, since=now)
    assert (situations["carrying"].so, situations["loaded"].so) == (False, None)
    assert any("nobodys_msgs/msg/Load is not installed" in problem for problem in observer.problems)
    begin_task(observer)
    assert observer.situations([], now=now, since=now)["carrying"].so
    assert observer.summary == "Watching /beat."
    observer.follow(_policy(gap), None)
    assert observer.observations.task(STATUS) is None, "nobody watches it any more"


def test_a_custom_leaf_that_raises_is_reported_and_is_no_failure(
    observer: HealthObserver, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Broken:
        def judge(self, message: object) -> str:
            return str(message.percentage)  # type: ignore[attr-defined]

    monkeypatch.setattr(health_loader, "LEAVES", {**health_loader.LEAVES, "acme_leaf": kind_of("acme_leaf", Broken)})
    monkeypatch.setattr(health_loader, "KINDS", (*health_loader.KINDS, "acme_leaf"))
    observer.follow(_policy({"acme_leaf": {"topic": "/beat", "type": "std_msgs/msg/String"}}), None)
    beat = publisher(observer, "/beat", String)
    since, end = time.time(), time.monotonic() + 20
    while not observer.problems and time.monotonic() < end:
        beat.publish(String(data="x"))
        time.sleep(0.05)
        observer.drain([], "")
        verdict = observer.verdict(now=time.time(), since=since)
    assert_golden("monitor", observer.problems, "acme_leaf", "/beat", "AttributeError", "'String'", "'percentage'")
    assert verdict.state == "Healthy"
