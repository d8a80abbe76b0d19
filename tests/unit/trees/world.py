"""A health tree with messages that come when the test says."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import pytest

from tests.unit.trees.btcpp_texts import load_xml
from tests.unit.trees.messages import Battery, Feedback, ReceivedMessage, fields
from tests.unit.trees.osc_texts import load_osc
from tests.unit.trees.scenarios import ScenarioWriter
from understudy.trees.core.health_tree import SEVERITY, HealthTree, Verdict
from understudy.trees.core.observations import (
    NodePresence,
    NodeState,
    ParameterState,
    ParameterValue,
    PodCondition,
    PodState,
    PodUsage,
    Publishers,
    RecordedObservations,
    TopicRecord,
)
from understudy.trees.languages.short.health_loader import TreeError, load

START = 1.7e9
ROOT = "spec.monitoring.yaml"
TASK = {"while": {"task_active": {"action": "/go"}}, "settle": "1s"}


def mistakes(kind: str, leaf: object) -> list[str]:
    """What is wrong with a leaf of this kind, each with its place in the leaf."""
    with pytest.raises(TreeError) as caught:
        load({kind: leaf})
    return [str(problem).removeprefix(f"{ROOT}.{kind}") for problem in caught.value.problems]


class World:
    """A tree with messages that come when the test says; times are seconds since START."""

    def __init__(self, tree: dict[str, Any], *, grace: float = 30.0, since: float = 0.0) -> None:
        self.tree: HealthTree = load(tree, grace=grace, fields=fields)
        self.since = START + since
        self.task: float | None = None
        self.published: dict[str, Publishers] = {}
        self.nodes: dict[str, NodePresence] = {}
        self.managed: dict[str, NodeState] = {}
        self.parameters: dict[tuple[str, str], ParameterState] = {}
        self.pod: PodState | None = None
        self.in_control = True
        self.records = {topic.name: TopicRecord(topic.window, topic.contents) for topic in self.tree.topics}

    def hear(
        self, topic: str, time: float, message: object = None, late: float | None = None, way: float | None = None
    ) -> World:
        """A message that is ``late`` by its header's stamp, and ``way`` by when it was sent."""
        self.records[topic].add(START + time)
        self.records[topic].contents.append(ReceivedMessage(START + time, message, late, way))
        return self

    def look(self, topic: str, time: float, *nodes: str) -> World:
        """A look at who publishes a topic."""
        self.published[topic] = Publishers(START + time, nodes)
        return self

    def find(self, node: str, time: float, *, there: bool = True, elsewhere: bool = False) -> World:
        """A look for a node."""
        self.nodes[node] = NodePresence(START + time, node, there, elsewhere or there)
        return self

    def tell(self, node: str, time: float, state: str | None) -> World:
        """What is known of a managed node."""
        self.managed[node] = NodeState(START + time, state)
        return self

    def set(
        self, name: str, time: float, value: ParameterValue | None, lacks: str = "", *, reported: bool = True
    ) -> World:
        """What is known of a parameter of the node /controller."""
        self.parameters["/controller", name] = ParameterState(START + time, value, lacks, reported)
        return self

    def pod_says(self, time: float, restarts: int = 0, usage: PodUsage | None = None, **conditions: str) -> World:
        """A look at the pod; a condition is its status, with the reason behind it if there is one: ``False NotReady``."""
        found = [PodCondition(type_, *condition.split()) for type_, condition in conditions.items()]
        self.pod = PodState(START + time, found, restarts, usage)
        return self

    def feed_back(self, time: float, goal: int = 1, **values: float) -> World:
        """Feedback of the action /go."""
        return self.hear("/go/_action/feedback", time, Feedback(goal, **values))

    def battery(self, time: float, percentage: float) -> World:
        return self.hear("/battery", time, Battery(percentage=percentage))

    def observed(self) -> RecordedObservations:
        """What has been received and seen so far."""
        tasks = {"/go/_action/status": START + self.task} if self.task is not None else {}
        return WorldObservations(self, tasks)

    def at(self, now: float) -> Verdict:
        return self.tree.evaluate(self.observed(), now=START + now, since=self.since)

    def deadline(self, now: float) -> float | None:
        moment = self.tree.deadline(self.observed(), now=START + now, since=self.since)
        return None if moment is None else round(moment - START, 6)

    def states(self, times: list[float]) -> list[str]:
        return [self.at(time).state for time in times]


class WorldObservations(RecordedObservations):
    """What a world's messages, graph, nodes and pod are."""

    def __init__(self, world: World, tasks: Mapping[str, float]) -> None:
        super().__init__(world.records, tasks)
        self._world, self.in_control = world, world.in_control

    def publishers(self, name: str) -> Publishers | None:
        return self._world.published.get(name)

    def node(self, name: str) -> NodePresence | None:
        return self._world.nodes.get(name)

    def lifecycle(self, name: str) -> NodeState | None:
        return self._world.managed.get(name)

    def parameter(self, node: str, name: str) -> ParameterState | None:
        return self._world.parameters.get((node, name))

    def pod(self) -> PodState | None:
        return self._world.pod


def assert_deadline_is_the_first_worse_moment(world: World, now: float) -> None:
    """That of a tree, asked at ``now`` (seconds) without changing what is; moments are tried to a hundredth, for five seconds."""
    present = SEVERITY[world.at(now).state]
    deadline = world.deadline(now)
    assert SEVERITY[world.at(now).state] == present
    later = [now + step / 100 for step in range(1, 500)]
    worse = next((time for time in later if SEVERITY[world.at(time).state] > present), None)
    if deadline is None:
        assert worse is None
    else:
        assert math.isclose(worse, deadline, abs_tol=0.011)
        assert SEVERITY[world.at(deadline + 1e-5).state] > present
        assert SEVERITY[world.at(deadline - 1e-5).state] <= present


def written(leaves: str) -> str:
    """A file with these leaves in a parallel."""
    return f'<root BTCPP_format="4"><BehaviorTree ID="Healthy"><Parallel>{leaves}</Parallel></BehaviorTree></root>'


def states_in_both_forms(
    text: str, short: dict[str, Any], drive: Callable[[World], Iterable[Verdict | float | None]]
) -> list[str]:
    """The states of a tree's verdicts, of which XML, OpenSCENARIO and the short form give the same, with the same deadlines."""
    trees = (load(short), load_xml(text), load_osc(ScenarioWriter().file(short)))
    trace = []
    for tree in trees:
        assert tree.topics == trees[0].topics
        world = World(short, grace=5)
        world.tree = tree
        trace.append([world.at(0.5), *drive(world)])
    assert all(other == trace[0] for other in trace)
    return [found.state for found in trace[0] if isinstance(found, Verdict)]
