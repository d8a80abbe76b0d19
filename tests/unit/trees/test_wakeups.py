"""Which topics are looked at as their messages come: those of which one message can be a failure, and no others."""

from __future__ import annotations

import pytest

from understudy.trees.languages.short.health_loader import load

BATTERY = {"topic": "/battery", "type": "sensor_msgs/msg/BatteryState", "holds": "percentage > 0.15"}
SCAN = {"topic": "/scan", "type": "sensor_msgs/msg/LaserScan", "most": "300ms"}
CAMERA = {"name": "camera: driver", "worst": "WARN"}
BASE = {"child": "base_link", "gap": "500ms"}


@pytest.mark.parametrize(
    ("leaf", "prompt"),
    [
        ({"value": BATTERY}, True),
        ({"value": BATTERY | {"for": "50ms"}}, True),
        ({"value": BATTERY | {"for": "100ms"}}, False),
        ({"age": SCAN}, True),
        ({"age": SCAN | {"for": "1s"}}, False),
        ({"diagnostics": CAMERA}, True),
        ({"diagnostics": CAMERA | {"for": "1s"}}, False),
        ({"log": {"level": "ERROR"}}, True),
        ({"transform": BASE}, False),
        ({"transform": BASE | {"at_most": "200ms"}}, True),
        ({"transform": BASE | {"at_most": "200ms", "for": "1s"}}, False),
        ({"lifecycle": {"node": "/controller_server"}}, True),
        ({"lifecycle": {"node": "/controller_server", "for": "1s"}}, False),
        ({"topic": {"name": "/scan", "gap": "50ms", "rate": "> 8 Hz"}}, False),
        ({"progress": {"action": "/go", "gap": "5s"}}, False),
        ({"publisher": {"topic": "/cmd_vel"}}, False),
        ({"node": {"name": "/controller_server"}}, False),
    ],
)
def test_a_topic_where_one_message_can_be_a_failure_wakes_the_monitor(leaf, prompt) -> None:
    assert any(topic.prompt for topic in load(leaf).topics) is prompt


def test_one_leaf_that_needs_wakeups_is_enough() -> None:
    patient = BATTERY | {"for": "1s"}
    for leaves in ([BATTERY, patient], [patient, BATTERY]):
        named = [{"name": name, "value": leaf} for name, leaf in zip(("a", "b"), leaves, strict=True)]
        (topic,) = load({"parallel": named}).topics
        assert topic.prompt
