"""The monitor's metrics of the watched topics."""

from __future__ import annotations

from prometheus_client import CollectorRegistry

from understudy.monitor.report.monitor_metrics import ObservationMetrics
from understudy.trees.core.observations import TopicRecord


def test_messages_and_their_last_time_are_exported_by_topic() -> None:
    received_topic, silent = TopicRecord(), TopicRecord()
    for received in (10.0, 10.1, 10.2):
        received_topic.add(received)
    registry = CollectorRegistry()
    registry.register(ObservationMetrics(lambda: {"/cmd_vel": received_topic, "/odom": silent}, lambda: (5, 1)))
    value = registry.get_sample_value
    assert value("understudy_topic_messages_total", {"topic": "/cmd_vel"}) == 3
    assert value("understudy_topic_last_message_timestamp_seconds", {"topic": "/cmd_vel"}) == 10.2
    assert value("understudy_topic_messages_total", {"topic": "/odom"}) == 0
    assert value("understudy_topic_last_message_timestamp_seconds", {"topic": "/odom"}) is None
    gap = value("understudy_topic_longest_gap_seconds", {"topic": "/cmd_vel"})
    assert gap is not None
    assert gap > 1e9, "it has been silent since 1970"
    assert value("understudy_topic_longest_gap_seconds", {"topic": "/odom"}) is None
    assert (value("understudy_tree_evaluations_total"), value("understudy_tree_overruns_total")) == (5, 1)
    received_topic.add(10.3)
    assert value("understudy_topic_messages_total", {"topic": "/cmd_vel"}) == 4
