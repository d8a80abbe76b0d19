"""What the monitor tells of the watched topics by metrics."""

from __future__ import annotations

from prometheus_client import CollectorRegistry

from understudy.monitor.report.topic_metrics import TopicMetrics
from understudy.trees.core.observations import TopicRecord


def test_messages_and_the_last_one_are_told_by_topic() -> None:
    heard, silent = TopicRecord(), TopicRecord()
    for received in (10.0, 10.1, 10.2):
        heard.add(received)
    registry = CollectorRegistry()
    registry.register(TopicMetrics(lambda: {"/cmd_vel": heard, "/odom": silent}))
    value = registry.get_sample_value
    assert value("understudy_topic_messages_total", {"topic": "/cmd_vel"}) == 3
    assert value("understudy_topic_last_message_timestamp_seconds", {"topic": "/cmd_vel"}) == 10.2
    assert value("understudy_topic_messages_total", {"topic": "/odom"}) == 0
    assert value("understudy_topic_last_message_timestamp_seconds", {"topic": "/odom"}) is None
    gap = value("understudy_topic_longest_gap_seconds", {"topic": "/cmd_vel"})
    assert gap is not None
    assert gap > 1e9, "it has been silent since 1970"
    assert value("understudy_topic_longest_gap_seconds", {"topic": "/odom"}) is None
    heard.add(10.3)
    assert value("understudy_topic_messages_total", {"topic": "/cmd_vel"}) == 4
