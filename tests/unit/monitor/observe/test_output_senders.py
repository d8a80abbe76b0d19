"""Who sends on the outputs, over real DDS: also on outputs that no tree watches, and from pods that are gone."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import Twist
from std_msgs.msg import String
from std_srvs.srv import Trigger

from tests.unit.monitor.cluster_objects import ClusterObjects, parsed_spec
from tests.unit.monitor.gates import PacketsOfReached
from tests.unit.monitor.observed_robot import count, observing, own_address, policy_with, publisher, until
from understudy.api.kinds.robot_workload import Output
from understudy.clock import CLOCK
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.pinned import PinnedPod
from understudy.monitor.judge.possible_senders import LASTS
from understudy.monitor.judge.sole_driver import SoleDriver
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.observe.robot.known_senders import Caller, host_at
from understudy.ros.observe.topic_watch import SourceRecord

pytestmark = pytest.mark.ros

ARM = {"topic": "/arm", "type": "geometry_msgs/msg/Twist"}
BEAT = {"topic": "/beat", "type": "std_msgs/msg/String"}


@pytest.fixture
def observer(monkeypatch: pytest.MonkeyPatch) -> Iterator[HealthObserver]:
    """An observer whose health tree watches /beat, while /arm is an output too."""
    for found in observing(monkeypatch):
        tree = policy_with({"topic": {"name": "/beat", "gap": "1s"}})
        found.follow(tree, parsed_spec(outputs=[BEAT, ARM, {"topic": "/odd", "type": "no_such_msgs/msg/Thing"}]))
        yield found


def test_a_sender_on_an_output_that_no_tree_watches_is_heard(observer: HealthObserver) -> None:
    publisher(observer, "/beat", String)
    arm, address = publisher(observer, "/arm", Twist), own_address(observer)
    until(observer, observer.output_senders, each=lambda: arm.publish(Twist()))
    (unknown,) = observer.output_senders()
    assert (unknown.topic, unknown.name, unknown.uid) == ("/arm", "/understudy_monitor", ""), "a node, and no instance"
    assert observer.gated == ["/beat"], "it is not expected"
    observer.drain([Instance("w-2", "uid-2", ip=address)], "w-2")
    (known,) = observer.output_senders()
    assert (known.name, known.uid, known.may_be) == ("w-2", "uid-2", ("uid-2",))


def test_a_sender_that_no_address_tells_may_be_the_instance_with_an_ipv6_address(observer: HealthObserver) -> None:
    publisher(observer, "/beat", String)
    arm, active = publisher(observer, "/arm", Twist), Instance("w-2", "uid-2", ip="fd00::2")
    until(observer, observer.output_senders, each=lambda: arm.publish(Twist()), instances=[active])
    (sender,) = observer.output_senders()
    assert (sender.uid, sender.may_be) == ("", ("uid-2",))
    (problem,) = (one for one in observer.problems if "fd00::2" in one)
    assert "w-2" in problem


def test_a_vanished_instance_that_was_let_through_is_heard_by_a_new_monitor(observer: HealthObserver) -> None:
    publisher(observer, "/beat", String)
    arm, address = publisher(observer, "/arm", Twist), own_address(observer)
    pinned = [PinnedPod(name="w-1", uid="uid-1", ip=address)]
    until(observer, observer.output_senders, each=lambda: arm.publish(Twist()))
    observer.drain([], "", pinned)
    (sender,) = observer.output_senders()
    assert (sender.name, sender.uid) == ("w-1", "uid-1")
    assert observer.addresses == {"w-1": address}, "its samples do not count for the active instance"


@pytest.mark.parametrize(("topic", "message"), [("/beat", String()), ("/arm", Twist())])
async def test_another_instance_is_heard_on_each_output_with_the_period_of_its_samples(
    observer: HealthObserver, topic: str, message: String | Twist
) -> None:
    publisher(observer, "/beat", String)
    output = publisher(observer, topic, type(message))
    former = Instance("w-1", "uid-1", ip=own_address(observer))
    active = Instance("w-2", "uid-2", ip="10.255.255.1")
    until(
        observer,
        lambda: len(observer.arrivals(topic, "w-1")) > 5,
        each=lambda: output.publish(message),
        instances=[former],
    )
    objects = ClusterObjects()
    objects.put_pods(former, active)
    objects.put_gate(GateState(epoch=4, active="w-2", active_uid="uid-2"))
    readers = observer.outputs(objects.pods, objects.gate)
    arrivals = list(observer.arrivals(topic, "w-1"))
    assert readers.last_from_others(active) == (CLOCK.of_system(arrivals[-1]), "w-1")
    assert readers.last_from_others(former) == (0.0, "")
    mean = (arrivals[-1] - arrivals[0]) / (len(arrivals) - 1)
    assert readers.period_of_others(active) == pytest.approx(mean)
    assert readers.period_of_others(former) == 0.0


SNAP = {"service": "/snap", "type": "std_srvs/srv/Trigger"}


@pytest.fixture
def calling(observer: HealthObserver) -> HealthObserver:
    """An observer of a robot's service, in a process that has a client of it."""
    observer.follow(policy_with({"topic": {"name": "/beat", "gap": "1s"}}), parsed_spec(outputs=[BEAT, SNAP]))
    observer.graph.node.create_client(Trigger, "/snap")
    return observer


def test_an_instance_with_a_client_of_a_service_could_call_it(calling: HealthObserver) -> None:
    instance = Instance("w-1", "uid-1", ip=own_address(calling))
    until(calling, calling.callers, instances=[instance])
    assert calling.callers() == [Caller("/snap", ("uid-1",))]
    calling.drain([], "", [PinnedPod(name="w-1", uid="uid-1", ip=instance.ip)])
    assert calling.callers() == [Caller("/snap", ("uid-1",))], "also if its pod is gone"
    calling.drain(
        [Instance("w-2", "uid-2", ip=instance.ip)], "w-2", [PinnedPod(name="w-1", uid="uid-1", ip=instance.ip)]
    )
    assert calling.callers() == [Caller("/snap", ("uid-2", "uid-1"))], "another pod has its address"
    calling.drain([Instance("w-3", "uid-3", ip="10.255.255.1")], "w-3")
    calling.drain([Instance("w-3", "uid-3", ip="fd00::3")], "w-3")
    assert "uid-3" not in {uid for one in calling.callers() for uid in one.may_be}


def test_an_instance_that_serves_an_output_is_called_by_the_robot(calling: HealthObserver) -> None:
    instance = Instance("w-1", "uid-1", ip=own_address(calling))
    until(calling, calling.callers, instances=[instance])
    calling.graph.node.create_service(Trigger, "/snap", lambda request, response: response)
    until(calling, lambda: not calling.callers(), instances=[instance])


def test_a_vanished_pod_whose_process_lives_makes_the_sole_driver_unknown_to_a_new_monitor(
    calling: HealthObserver,
) -> None:
    objects, active = ClusterObjects(), Instance("w-2", "uid-2", ip="10.255.255.1", has_agent=False)
    pinned = (PinnedPod(name="w-1", uid="uid-1", ip=own_address(calling)),)
    objects.put_gate(GateState(epoch=4, active="w-2", active_uid="uid-2", pinned=pinned))
    judged, now = SoleDriver(objects.gate, PacketsOfReached(), calling, objects.notices), time.time()
    until(calling, lambda: calling.graph.clients(Output.model_validate(SNAP)), instances=[active])
    calling.drain([active], "w-2", pinned)
    judged.update([active], now)
    judged.update([active], now + LASTS)
    judged.report(now + LASTS)
    status, reason, message = objects.notices.conditions["SoleDriver"]
    assert (status, reason) == ("Unknown", "PossibleSender")
    assert "/snap by w-1" in message


def test_two_samples_far_apart_do_not_make_a_slow_sender_where_another_one_is_fast(observer: HealthObserver) -> None:
    beat = publisher(observer, "/beat", String)
    until(observer, lambda: count(observer, "/beat") > 5, each=lambda: beat.publish(String()))
    (known,) = observer.output_senders()
    brief, now = SourceRecord(60.0), time.time()
    observer.observations.records("/beat")[host_at("192.0.2.1")] = brief
    for received in (now - 15.5, now):  # somebody edited its label twice, for a moment
        brief.add(received)
    found = {sender.host: sender.interval for sender in observer.output_senders()}
    assert found == {known.host: known.interval, host_at("192.0.2.1"): known.interval}
    assert known.interval < 1.0
    brief.add(now + 15.5)
    assert observer.output_senders()[1].interval == pytest.approx(15.5), "it is slow"


def test_a_sender_that_is_no_known_instance_prevents_safe_commands(observer: HealthObserver) -> None:
    publisher(observer, "/beat", String)
    arm, objects = publisher(observer, "/arm", Twist), ClusterObjects()
    objects.put_gate(GateState(epoch=4))
    observer.own_host = host_at("192.0.2.1")
    readers, began = observer.outputs(objects.pods, objects.gate), CLOCK.now()
    assert not readers.heard()
    until(observer, readers.heard, each=lambda: arm.publish(Twist()))
    ((last, interval),) = readers.heard()
    assert began <= last <= CLOCK.now()
    assert interval > 0
    observer.own_host = host_at(own_address(observer))
    assert not readers.heard(), "what this pod sends does not count"
