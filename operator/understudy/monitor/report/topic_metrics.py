"""How the watched topics are doing, as metrics that are worked out when somebody asks for them: a look costs nothing more."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from understudy.trees.core.observations import TopicRecord


class TopicMetrics(Collector):
    """Messages of each topic that the health tree watches, of those that count for the instance in control."""

    def __init__(self, records: Callable[[], Mapping[str, TopicRecord]]) -> None:
        """``records`` gives what was received by topic."""
        self._records = records

    def describe(self) -> Iterable[Metric]:
        """Their names, without looking at anything: asked for when it is registered."""
        return _families({}, 0.0)

    def collect(self) -> Iterable[Metric]:
        """All of them as of now."""
        return _families(self._records(), time.time())


def _families(records: Mapping[str, TopicRecord], now: float) -> list[Metric]:
    messages = CounterMetricFamily(
        "understudy_topic_messages",
        "Messages of a watched topic that count for the instance in control; their rate is the topic's.",
        labels=["topic"],
    )
    last = GaugeMetricFamily(
        "understudy_topic_last_message_timestamp_seconds",
        "When the last of them was received (Unix time).",
        labels=["topic"],
    )
    gap = GaugeMetricFamily(
        "understudy_topic_longest_gap_seconds",
        "Longest time between two of them in the last minute or two, the present silence included.",
        labels=["topic"],
    )
    for topic, record in records.items():
        messages.add_metric([topic], record.count)
        if record.last is not None:
            last.add_metric([topic], record.last)
        if (longest := record.longest_gap(now)) is not None:
            gap.add_metric([topic], longest)
    return [messages, last, gap]
