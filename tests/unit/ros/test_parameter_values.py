"""The parameters of real nodes, from their parameter events and from their answers."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from tests.unit.ros.judged_tree import Judged
from understudy.ros.actions.instance_calls import InstanceCaller
from understudy.ros.dds.host_ids import HOST
from understudy.ros.observe.parameter_values import EVENTS, ParameterValues, Setting, setting
from understudy.ros.observe.topic_watch import TopicWatch
from understudy.trees.core.observations import TopicRecord

pytestmark = pytest.mark.ros

NODE = "/driver"


@pytest.fixture
def node(processes: Any) -> Callable[..., Any]:
    """Starts nodes with a double ``speed``, a text ``label`` and an integer ``count``."""
    return lambda *speed: processes.node("parameters", NODE, *speed)


OFTEN = 0.3
"""Seconds between two requests."""


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes are asked more often."""
    monkeypatch.setattr("understudy.ros.observe.node_inquiries.PERIOD", OFTEN)


def put(**values: Any) -> None:
    async def put() -> None:
        caller = InstanceCaller("setter")
        try:
            await caller.set_parameters(NODE, values, 30.0)
        finally:
            caller.close()

    asyncio.run(put())


def leaf(name: str = "speed", **expected: Any) -> dict[str, Any]:
    return {"parameter": {"node": NODE, "name": name, **(expected or {"equals": 1.0})}}


def test_a_changed_value_fails_and_earlier_values_are_requested(watching, graph, node, eventually):
    node()
    judged = Judged(watching, leaf())
    eventually(lambda: judged.now().state == "Healthy")
    assert not watching.own(EVENTS) or not watching.own(EVENTS).contents, "it was told by an answer alone"
    put(speed=2.5)
    eventually(lambda: judged.now().state == "Failed")
    assert_golden("ros", judged.now().reason, "/driver", "1.0", "2.5")
    (host,) = {end.gid[HOST] for end in graph.servers(f"{NODE}/get_parameters")}
    for late in (TopicWatch(graph), TopicWatch(graph, host)):
        try:
            other = Judged(late, leaf(equals="2.5"))
            eventually(lambda other=other: other.now().state == "Healthy")
        finally:
            late.close()
    put(speed=1.0)
    eventually(lambda: judged.now().state == "Healthy")
    assert watching.problems == []


def test_a_change_is_received_as_an_event_and_not_only_by_polling(watching, node, eventually, monkeypatch):
    node()
    judged = Judged(watching, leaf(between="0.5 to 1.5"))
    eventually(lambda: judged.now().state == "Healthy")

    def is_received() -> bool:
        put(count=3)
        return bool(judged.now() and watching.own(EVENTS) and watching.own(EVENTS).contents)

    eventually(is_received)
    monkeypatch.setattr("understudy.ros.observe.node_inquiries.PERIOD", 3600.0)
    asked = time.monotonic() + 2 * OFTEN  # the last request was due by then
    eventually(lambda: judged.now() and time.monotonic() > asked)
    put(speed=2.0)
    eventually(lambda: judged.now().state == "Failed")


def test_other_parameters_and_other_nodes_have_no_influence(watching, node, processes, eventually):
    node()
    processes.node("parameters", "/other")
    judged = Judged(watching, {"parallel": [leaf(), leaf("label", one_of="a;b"), leaf("count", equals=1)]})
    eventually(lambda: judged.now().state == "Healthy")

    async def disturb() -> None:
        caller = InstanceCaller("setter")
        try:
            await caller.set_parameters("/other", {"speed": 7.0, "label": "z", "count": 9}, 30.0)
            await caller.set_parameters(NODE, {"label": "b"}, 30.0)
        finally:
            caller.close()

    asyncio.run(disturb())
    states = set()
    parameter = watching.parameter(NODE, "speed").received

    def later() -> bool:
        states.add(judged.now().state)
        return watching.parameter(NODE, "speed").received > parameter + 1.0

    eventually(later)
    assert states == {"Healthy"}
    assert watching.parameter(NODE, "label").value == "b"


@pytest.mark.parametrize(
    ("name", "reason"),
    [("nobodys", " is not set, but "), ("list", " is an array, but "), ("unset", " is not set, but ")],
)
def test_a_missing_or_incomparable_parameter_is_reported(watching, node, eventually, name, reason):
    node()
    judged = Judged(watching, leaf(name), grace=0.001)
    eventually(lambda: judged.now().state == "Failed" and reason in judged.now().reason)


def test_a_missing_node_is_reported(watching, eventually):
    judged = Judged(watching, leaf(), grace=0.001)
    eventually(lambda: judged.now().state == "Failed" and "no such node" in judged.now().reason)


@dataclass
class ReportedSpeed:
    """Returns what the active instance reports about a parameter."""

    received: float
    speed: float

    def mentions(self, text: str) -> bool:
        return text in (NODE, "speed")

    def message(self) -> Any:
        from rcl_interfaces.msg import Parameter, ParameterEvent, ParameterValue

        value = ParameterValue(type=3, double_value=self.speed)
        return ParameterEvent(node=NODE, changed_parameters=[Parameter(name="speed", value=value)])


def test_answers_of_equally_named_nodes_in_several_pods_count_only_if_they_agree(graph, node, eventually):
    node("1.5")
    eventually(lambda: len(graph.servers(f"{NODE}/get_parameters")) == 1)
    (own,) = {end.gid[:12] for end in graph.servers(f"{NODE}/get_parameters")}
    node("2.5")
    eventually(lambda: len(graph.servers(f"{NODE}/get_parameters")) == 2)
    record = TopicRecord(contents=8)
    parameters = ParameterValues(graph, lambda gid: gid[:12] == own, lambda topic: record, alone=False)
    speed, label = (NODE, "speed"), (NODE, "label")
    try:
        parameters.follow([speed, label])
        eventually(lambda: parameters.refresh() or (parameters.problems and parameters.of(label)))
        assert parameters.of(label).value == "a", "both say the same"
        assert_golden("ros", parameters.problems, "/driver", "1.5", "2.5")
        assert not parameters.of(speed).is_known
        record.contents.append(ReportedSpeed(time.time(), 1.75))
        parameters.refresh()
        assert (parameters.of(speed).value, parameters.problems) == (1.75, [])
    finally:
        parameters.close()


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"type": 0}, Setting(None, "it is not set")),
        ({"type": 1, "bool_value": True}, Setting(True)),
        ({"type": 2, "integer_value": -3}, Setting(-3)),
        ({"type": 3, "double_value": 0.5}, Setting(0.5)),
        ({"type": 4, "string_value": "a"}, Setting("a")),
        ({"type": 8, "double_array_value": [0.5]}, Setting(None, "it is an array")),
    ],
)
def test_every_type_of_parameter_value_is_read(fields: dict[str, Any], expected: Setting) -> None:
    from rcl_interfaces.msg import ParameterValue

    found = setting(ParameterValue(**fields))
    assert found == expected
    assert type(found.value) is type(expected.value)
