"""Real messages are looked into by the leaves of a health tree: their fields, their stamps, their levels."""

import struct
import time

import pytest

from tests.support.clock import set_clock
from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from tests.unit.ros.judged_tree import Judged, tell
from understudy.ros.observe.message_contents import HEAD, Received, begins_with_header
from understudy.ros.runtime.interface_types import message_class, message_fields
from understudy.trees.core.observations import Unreadable
from understudy.trees.languages.short.health_loader import load

pytestmark = pytest.mark.ros

BATTERY, SCAN = "sensor_msgs/msg/BatteryState", "sensor_msgs/msg/LaserScan"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"


def test_a_value_of_a_real_message_fails_and_recovers(watching, processes, eventually):
    leaf = {"topic": "/battery", "type": BATTERY, "holds": "percentage > 0.15", "recovers": "percentage > 0.3"}
    judged = Judged(watching, {"value": {**leaf, "for": "300ms"}})
    node = processes.node("say", "/battery", BATTERY)
    tell(node, percentage=0.5)
    eventually(lambda: judged.now().state == "Healthy")
    tell(node, percentage=0.125)
    verdict = judged.until_failed()
    assert_golden("ros", verdict.reason, "0.15", "/battery", "300 ms", "0.125")
    assert verdict.onset is not None
    assert verdict.onset < time.time() - 0.3
    tell(node, percentage=0.2)
    eventually(lambda: _last(watching, "/battery").percentage == pytest.approx(0.2))
    assert judged.now().state == "Failed"
    tell(node, percentage=0.4)
    eventually(lambda: judged.now().state == "Healthy")


def _last(watching, topic):
    watching.drain()
    return watching.topic(topic).contents[-1].message()


def test_conditions_read_arrays_numbers_and_strings_of_real_messages(watching, processes, eventually):
    conditions = [
        "len(ranges) == 3 and all(r > 0.2 for r in ranges if isfinite(r)) and ranges[2] == 4",
        "header.frame_id == 'laser' and header.stamp.sec > 0 and angle_max - angle_min == 1",
        "max(ranges) == 4 and min(ranges) == 0.5",
    ]
    leaves = [
        {"value": {"topic": "/scan", "type": SCAN, "holds": text}, "name": f"leaf{i}"}
        for i, text in enumerate(conditions)
    ]
    pose = {
        "topic": "/pose",
        "type": "geometry_msgs/msg/PoseWithCovarianceStamped",
        "holds": "pose.covariance[35] < 0.5 and sqrt(pose.pose.position.x) == 2",
    }
    judged = Judged(watching, {"parallel": [*leaves, {"value": pose}]})
    scan, located = processes.node("say", "/scan", SCAN), processes.node("say", "/pose", pose["type"])
    header = {"stamp": "now", "frame_id": "laser"}
    tell(scan, header=header, angle_min=-0.5, angle_max=0.5, ranges=[0.5, 1.0, 4.0])
    tell(located, pose={"pose": {"position": {"x": 4.0}}})
    eventually(lambda: judged.now().state == "Healthy")
    tell(located, pose={"pose": {"position": {"x": 4.0}}, "covariance": [0.0] * 35 + [0.75]})
    eventually(lambda: judged.now().state == "Failed")
    assert_golden("ros", judged.now().reason, "pose.covariance[35] was 0.75", "pose.pose.position.x was 4")


def test_fields_are_checked_if_the_type_is_installed():
    tree = {"value": {"topic": "/battery", "type": BATTERY, "holds": "percent > 0.15"}}
    with pytest.raises(ValueError, match="has no field 'percent', did you mean 'percentage'"):
        load(tree, fields=message_fields)
    tree["value"]["type"] = "nobodys_msgs/msg/Battery"
    assert load(tree, fields=message_fields)
    with pytest.raises(ValueError, match="begin with a header"):
        load({"age": {"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist", "most": "1s"}}, fields=message_fields)


def test_the_age_of_a_real_message_is_measured_by_its_stamp(watching, processes, eventually):
    judged = Judged(watching, {"age": {"topic": "/scan", "most": "5s"}})
    node = processes.node("say", "/scan", SCAN)
    tell(node, header={"stamp": "now"})
    eventually(lambda: judged.now().state == "Healthy")
    tell(node, header={"stamp": {"sec": int(time.time()) - 3600}}, ranges=[1.0] * 1000)
    eventually(lambda: judged.now().state == "Failed")
    assert_golden("ros", judged.now().reason, "5 s", "/scan", "3.6e+03 s")
    tell(node, header={"frame_id": "laser"})
    eventually(lambda: _last_age(watching, "/scan") is None)
    tell(node, header={"stamp": "now"})
    eventually(lambda: judged.now().state == "Healthy")


def _last_age(watching, topic):
    watching.drain()
    return watching.topic(topic).contents[-1].age()


def test_the_levels_of_two_nodes_are_distinguished(watching, processes, eventually):
    judged = Judged(watching, {"diagnostics": {"prefix": "camera", "worst": "WARN"}})
    camera, lidar = (processes.node("say", "/diagnostics", DIAGNOSTICS) for _ in range(2))
    tell(lidar, status=[{"name": "lidar", "level": 2, "message": "dead"}])
    tell(camera, status=[{"name": "camera: a", "level": 0}, {"name": "camera: b", "level": 1}])
    eventually(lambda: judged.now().state == "Healthy")
    tell(camera, status=[{"name": "camera: a", "level": 2, "message": "no frames"}])
    eventually(lambda: judged.now().state == "Failed")
    assert judged.now().reason.startswith("/diagnostics: status 'camera: a' is ERROR (no frames), but ")


def test_messages_of_an_inactive_instance_do_not_count(watching, processes, eventually, address_of):
    judged = Judged(watching, {"value": {"topic": "/battery", "type": BATTERY, "holds": "percentage > 0.15"}})
    node = processes.node("say", "/battery", BATTERY)
    tell(node, percentage=0.5)
    eventually(lambda: judged.now().state == "Healthy")
    (host,) = watching.records("/battery")
    watching.attribute({"elsewhere": "192.0.2.1"}, "elsewhere")
    assert judged.now().state == "Healthy", "the robot's own, as nobody's who is an instance"
    watching.attribute({"elsewhere": "192.0.2.1", "standby": address_of(host)}, "elsewhere")
    record = watching.records("/battery")[host]
    before = record.count
    eventually(lambda: watching.drain() and record.count > before + 3)
    assert not watching.topic("/battery").contents
    assert record.contents, "the agent of that instance looks into them"


def test_only_the_bytes_that_the_tree_needs_are_kept(watching, processes, eventually):
    judged = Judged(watching, {"age": {"topic": "/scan", "most": "1h"}})
    node = processes.node("say", "/scan", SCAN)
    tell(node, header={"stamp": "now"}, ranges=[1.0] * 100)
    eventually(lambda: judged.now().state == "Healthy")
    (content,) = watching.topic("/scan").contents
    assert content.byte(HEAD - 1) is not None
    assert content.byte(HEAD) is None
    with pytest.raises(Unreadable):
        content.message()
    whole = {"value": {"topic": "/scan", "type": SCAN, "holds": "ranges[99] == 1"}}
    both = Judged(watching, {"parallel": [{"age": {"topic": "/scan", "most": "1h"}}, whole]})
    both.since = judged.since
    eventually(lambda: both.now().state == "Healthy")
    Judged(watching, {"topic": {"name": "/scan", "gap": "1s"}})
    assert not watching.topic("/scan").contents


@pytest.mark.parametrize(("order", "mark"), [("<", 1), (">", 0)])
def test_a_stamp_is_read_in_either_byte_order_and_does_not_depend_on_the_clock(order, mark):
    head = bytes([0, mark, 0, 0]) + struct.pack(f"{order}iI", 1_700_000_000, 250_000_000)
    message = message_class(SCAN)
    content = Received(1_700_000_001.0, 1_700_000_001.0, head, message, begins_with_header(message))
    assert content.age() == pytest.approx(0.75, abs=1e-6)
    content.received += 3600
    assert content.age() == pytest.approx(0.75, abs=1e-6)
    assert Received(1.0, 1.0, bytes(12), message, True).age() is None
    assert Received(1.0, 1.0, head[:8], message, True).age() is None
    assert Received(1.0, 1.0, head, message_class("std_msgs/msg/String"), False).age() is None
    assert not begins_with_header(message_class("std_msgs/msg/String"))


def test_bytes_of_another_type_cannot_be_read():
    content = Received(1.0, 1.0, b"\x00\x01\x00\x00\xff\xff\xff\x7f", message_class("std_msgs/msg/String"), False)
    for _ in range(2):
        with pytest.raises(Unreadable, match="it is no String"):
            content.message()


def test_a_clock_step_moves_the_receipt_times_of_messages(watching, processes, eventually, monkeypatch):
    judged = Judged(watching, {"age": {"topic": "/scan", "most": "20s"}})
    node = processes.node("say", "/scan", SCAN)
    tell(node, header={"stamp": "now"})
    eventually(lambda: judged.now().state == "Healthy")

    set_clock(monkeypatch, 3600.0)
    watching.drain()
    (content,) = watching.topic("/scan").contents
    assert content.received == pytest.approx(time.time(), abs=20)
    assert content.age() < 20


def test_an_age_by_source_counts_from_the_sending_and_ignores_the_stamp(watching, graph, eventually, monkeypatch):
    """What its writer kept for those that come late was sent long ago when they get it."""
    from rclpy.qos import DurabilityPolicy, QoSProfile

    message = message_class("std_msgs/msg/Header")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = graph.node.create_publisher(message, "/late", latched)
    publisher.publish(message())
    time.sleep(2.5)
    subscribe = graph.subscribe
    monkeypatch.setattr(graph, "subscribe", lambda *names, depth, **_: subscribe(*names, depth=depth, latched=True))
    leaf = {"topic": "/late", "type": "std_msgs/msg/Header", "most": "2s", "by": "source"}
    judged = Judged(watching, {"age": leaf}, grace=0.0)
    eventually(lambda: " after it was sent, but " in judged.now().reason)
    assert judged.now().state == "Failed"
    assert watching.topic("/late").contents[-1].under_way() >= 2.5

    def again() -> bool:
        publisher.publish(message())  # its stamp is none
        return judged.now().state == "Healthy"

    eventually(again)


@pytest.mark.parametrize("sent", [0.0, 1_700_000_000.0])
def test_the_transmission_time_does_not_change_with_the_clock(sent):
    content = Received(1_700_000_001.5, 1_700_000_001.5, b"", message_class("std_msgs/msg/String"), False, sent)
    expected = pytest.approx(1.5, abs=1e-6) if sent else None
    assert content.under_way() == expected
    content.received += 3600
    assert content.under_way() == expected
