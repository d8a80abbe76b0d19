"""Who sends on the outputs, over real DDS: also on outputs that no tree watches, and from pods that are gone."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy")

from geometry_msgs.msg import Twist
from std_msgs.msg import String

from tests.unit.monitor.cluster_objects import ClusterObjects, parsed_spec
from tests.unit.monitor.observed_robot import count, observing, own_address, policy_with, publisher, until
from understudy.clock import CLOCK
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.pinned import PinnedPod
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.monitor.observe.robot.known_senders import host_at
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
