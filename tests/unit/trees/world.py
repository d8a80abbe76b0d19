"""A health tree with messages that come when the test says."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from tests.unit.trees.messages import Battery, Heard, fields
from understudy.trees.btcpp.trees import load_xml
from understudy.trees.health import HealthTree, Verdict
from understudy.trees.loading import load
from understudy.trees.observations import Publishers, Recorded, TopicRecord

START = 1.7e9


class World:
    """A tree with messages that come when the test says; times are seconds since START."""

    def __init__(self, tree: dict[str, Any], *, grace: float = 30.0, since: float = 0.0) -> None:
        self.tree: HealthTree = load(tree, grace=grace, fields=fields)
        self.since = START + since
        self.task: float | None = None
        self.published: dict[str, Publishers] = {}
        self.records = {topic.name: TopicRecord(topic.window, topic.contents) for topic in self.tree.topics}

    def hear(self, topic: str, time: float, said: object = None, late: float | None = None) -> World:
        self.records[topic].add(START + time)
        self.records[topic].contents.append(Heard(START + time, said, late))
        return self

    def look(self, topic: str, time: float, *nodes: str) -> World:
        """A look at who publishes a topic."""
        self.published[topic] = Publishers(START + time, nodes)
        return self

    def battery(self, time: float, percentage: float) -> World:
        return self.hear("/battery", time, Battery(percentage=percentage))

    def observed(self) -> Recorded:
        """What has been received and seen so far."""
        tasks = {"/go/_action/status": START + self.task} if self.task is not None else {}
        return Recorded(self.records, tasks, self.published)

    def at(self, now: float) -> Verdict:
        return self.tree.evaluate(self.observed(), now=START + now, since=self.since)

    def deadline(self, now: float) -> float | None:
        moment = self.tree.deadline(self.observed(), now=START + now, since=self.since)
        return None if moment is None else round(moment - START, 6)

    def states(self, times: list[float]) -> list[str]:
        return [self.at(time).state for time in times]


def written(leaves: str) -> str:
    """A file with these leaves in a parallel."""
    return f'<root BTCPP_format="4"><BehaviorTree ID="Healthy"><Parallel>{leaves}</Parallel></BehaviorTree></root>'


def states_in_both_forms(
    text: str, short: dict[str, Any], drive: Callable[[World], Iterable[Verdict | float | None]]
) -> list[str]:
    """The states of a tree's verdicts, of which XML and the short form give the same, with the same deadlines."""
    read, same = load_xml(text), load(short)
    assert read.topics == same.topics
    trace = []
    for tree in (read, same):
        world = World(short, grace=5)
        world.tree = tree
        trace.append([world.at(0.5), *drive(world)])
    assert trace[0] == trace[1]
    return [found.state for found in trace[0] if isinstance(found, Verdict)]
