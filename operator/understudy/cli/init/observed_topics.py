"""The topics of a recording or of a live ROS graph: their types, and when their messages arrived."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from understudy.cli.common.errors import CommandError
from understudy.cli.simulate import live_graph
from understudy.cli.simulate.bags import Bag

REST = 0.02
"""Seconds between two looks at the queues of a live graph. The times are those of the middleware, and not of the look."""

DEPTH = 1000
"""Messages that wait for such a look."""


Choice = Callable[[Mapping[str, str]], Iterable[str]]
"""Which topics to measure, of topics with their types by name."""


@dataclass(frozen=True)
class Observed:
    """What was seen of some topics."""

    source: str
    """Where, for people: such as ``drive/, 60.0 s``."""
    types: Mapping[str, str]
    """Of all topics, by name."""
    arrivals: Mapping[str, Sequence[float]]
    """The times of receipt, in Unix seconds, of the topics that were asked for."""


def in_bag(path: str, choice: Choice) -> Observed:
    """Read the topics of a bag. Raises CommandError."""
    with Bag.open(path) as bag:
        types = {name: topic.types[0] for name, topic in bag.topics.items() if len(topic.types) == 1}
        asked = {name: types[name] for name in choice(types) if name in types}
        arrivals: dict[str, array[float]] = {name: array("d") for name in asked}
        for taken in bag.messages(asked):
            arrivals[taken.topic].append(taken.received)
        return Observed(f"{path}, {bag.end - bag.start:.1f} s", types, arrivals)


def in_graph(length: float, choice: Choice) -> Observed:
    """Listen on the ROS graph that the environment selects, for some seconds. Raises CommandError."""
    with live_graph.joined("init") as graph:
        from understudy.ros.runtime.graph_node import NotReceivable
        from understudy.ros.runtime.interface_types import TypeNotInstalled
        from understudy.ros.runtime.sample_taking import SampleTaker

        taker = SampleTaker()
        end, types = time.monotonic() + length, dict[str, str]()
        subscribed: dict[str, Any] = {}
        arrivals: dict[str, array[float]] = {}
        while time.monotonic() < end:
            types = {name: kinds[0] for name, kinds in graph.node.get_topic_names_and_types() if len(kinds) == 1}
            for name in set(choice(types)) & types.keys() - subscribed.keys():
                try:
                    subscribed[name] = graph.subscribe(name, types[name], depth=DEPTH)
                except (NotReceivable, TypeNotInstalled) as error:
                    raise CommandError(f"{name} cannot be measured: {error}") from error
                arrivals[name] = array("d")
            for name, subscription in subscribed.items():
                with subscription.handle:
                    while (sample := taker.take(subscription.handle.pointer, with_data=False)) is not None:
                        arrivals[name].append(sample.received)
            time.sleep(REST)
        return Observed(f"the ROS graph, {length:.1f} s", types, arrivals)
