"""A health tree over topics whose samples arrive when the test says."""

from __future__ import annotations

from typing import Any

from understudy.trees.core.health_tree import HealthTree, Verdict
from understudy.trees.core.observations import RecordedObservations, TopicRecord
from understudy.trees.languages.short.health_loader import load

START = 1.7e9


def gap(topic: str, length: str = "500ms", **node: Any) -> dict[str, Any]:
    return {"topic": {"name": topic, "gap": length}, **node}


def rate(topic: str, band: str = "> 8 Hz", window: str = "2s", **node: Any) -> dict[str, Any]:
    return {"topic": {"name": topic, "rate": band, "window": window}, **node}


class World:
    """A tree with topics that arrive when the test says; times are seconds since START."""

    def __init__(self, tree: dict[str, Any], *, grace: float = 30.0, since: float = 0.0) -> None:
        self.tree: HealthTree = load(tree, grace=grace)
        self.since = START + since
        self.records = {topic.name: TopicRecord(topic.window) for topic in self.tree.topics}

    def arrive(self, topic: str, *times: float) -> World:
        for time in times:
            self.records[topic].add(START + time)
        return self

    def at(self, now: float) -> Verdict:
        return self.tree.evaluate(RecordedObservations(self.records), now=START + now, since=self.since)

    def deadline(self, now: float) -> float | None:
        moment = self.tree.deadline(RecordedObservations(self.records), now=START + now, since=self.since)
        return None if moment is None else round(moment - START, 6)


def steady(hertz: float, start: float, end: float) -> list[float]:
    return [start + i / hertz for i in range(int((end - start) * hertz))]
