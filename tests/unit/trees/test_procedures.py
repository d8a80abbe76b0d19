"""Procedures over an instance of plain Python: what is done, in which order, and what is said when it can't be."""

from __future__ import annotations

import asyncio

import pytest

from tests.support.golden import assert_golden
from tests.unit.trees.messages import Battery, ReceivedMessage
from tests.unit.trees.procedure_world import LONG, Instance
from understudy.trees.core.observations import TopicRecord
from understudy.trees.core.procedure_steps import ProcedureFailed
from understudy.trees.languages.short.procedure_loader import load_check, load_procedure
from understudy.trees.source.problems import TreeError


def procedure(tree: object):
    return load_procedure(tree, path="bringUp")


async def test_a_sequence_runs_its_nodes_in_order() -> None:
    instance = Instance()
    tree = procedure(
        {
            "sequence": [
                {"set_lifecycle": {"node": "/map_server", "state": "active"}},
                {"restore_state": {"only": ["/amcl_pose"]}},
                {"call_service": {"service": "/go", "type": "std_srvs/srv/Trigger", "expect": {"success": True}}},
                {"set_parameters": {"node": "/amcl", "values": {"rate": 1.0}}},
                {"publish": {"topic": "/mode", "type": "std_msgs/msg/String", "message": {"data": "auto"}}},
                {"wait_for": {"topic": "/scan", "type": "sensor_msgs/msg/LaserScan"}},
                {"resend_goals": {}},
            ]
        }
    )
    instance.answers["/go"] = [{"success": True, "message": ""}]

    await tree.run(instance, LONG)

    assert instance.done == [
        "active /map_server",
        "restore /amcl_pose",
        "call /go",
        "set /amcl",
        "publish /mode",
        "sample /scan",
        "resend goals",
    ]
    assert tree.restores_state


async def test_a_failed_leaf_is_reported_with_its_path_and_ends_the_sequence() -> None:
    instance = Instance()
    instance.answers["/go"] = [{"success": False, "message": "no map"}]
    tree = procedure(
        {
            "sequence": [
                {"call_service": {"service": "/go", "type": "std_srvs/srv/Trigger", "expect": {"success": True}}},
                {"set_lifecycle": {"node": "/amcl", "state": "active"}},
            ]
        }
    )

    with pytest.raises(ProcedureFailed) as failure:
        await tree.run(instance, LONG)

    assert_golden("procedures", str(failure.value), "bringUp.sequence[0].call_service: service /go", "success is False")
    assert instance.done == ["call /go"]


async def test_a_service_with_a_repeat_time_is_called_again_at_that_interval() -> None:
    instance = Instance()
    tree = procedure({"call_service": {"service": "/go", "type": "std_srvs/srv/Trigger", "repeat": "1500ms"}})

    await tree.run(instance, LONG)

    assert instance.done == ["call every 1.5 s /go"]


async def test_a_parallel_runs_all_nodes_at_once_and_a_failure_cancels_the_others() -> None:
    instance = Instance()
    instance.never = {"/slow"}
    instance.answers["/go"] = [{"success": False}]
    tree = procedure(
        {
            "parallel": [
                {"set_lifecycle": {"node": "/slow", "state": "active"}},
                {"call_service": {"service": "/go", "type": "std_srvs/srv/Trigger", "expect": {"success": True}}},
            ]
        }
    )

    with pytest.raises(ProcedureFailed, match=r"parallel\[1\]"):
        await tree.run(instance, LONG)

    assert instance.cancelled == ["/slow"]


async def test_a_parallel_runs_each_of_its_nodes_once() -> None:
    instance = Instance()
    instance.answers["/go"] = [{"success": False}, {"success": False}, {"success": True}]
    go = {"call_service": {"service": "/go", "type": "std_srvs/srv/Trigger", "expect": {"success": True}}}
    tree = procedure(
        {
            "parallel": [
                {"set_lifecycle": {"node": "/map_server", "state": "active"}},
                {"retry": {"times": 5, "wait": "10ms", "do": go}},
            ]
        }
    )

    await tree.run(instance, LONG)

    assert sorted(instance.done) == ["active /map_server", "call /go", "call /go", "call /go"]


async def test_a_selector_stops_at_the_first_success() -> None:
    instance = Instance()
    tree = procedure(
        {
            "selector": [
                {"lifecycle_is": {"node": "/amcl", "state": "active"}},
                {"set_lifecycle": {"node": "/amcl", "state": "active"}},
            ]
        }
    )

    await tree.run(instance, LONG)
    await tree.run(instance, LONG)

    assert instance.done == ["active /amcl"], "what is so already is left alone the second time"


async def test_a_failed_selector_reports_all_reasons() -> None:
    tree = procedure({"selector": [{"node_present": {"node": "/a"}}, {"service_present": {"service": "/b"}}]})
    with pytest.raises(ProcedureFailed) as failure:
        await tree.run(Instance(), LONG)
    assert_golden(
        "procedures",
        str(failure.value),
        "bringUp.selector[0].node_present",
        "/a",
        "bringUp.selector[1].service_present",
        "/b",
    )


async def test_a_procedure_that_never_ends_fails_after_its_timeout_and_names_the_running_leaf() -> None:
    instance = Instance()
    instance.never = {"/amcl"}
    tree = procedure({"sequence": [{"resend_goals": {}}, {"set_lifecycle": {"node": "/amcl", "state": "active"}}]})

    with pytest.raises(ProcedureFailed) as failure:
        await tree.run(instance, 0.3)

    assert_golden("procedures", str(failure.value), "0.3 s", "bringUp.sequence[1].set_lifecycle")
    assert instance.cancelled == ["/amcl"]


async def test_endless_retries_fail_after_the_timeout_with_the_last_reason() -> None:
    instance = Instance()
    tree = procedure({"retry": {"times": 1000, "wait": "100s", "do": {"node_present": {"node": "/amcl"}}}})
    with pytest.raises(ProcedureFailed) as failure:
        await tree.run(instance, 0.3)
    assert_golden("procedures", str(failure.value), "0.3 s", "bringUp.retry.do.node_present", "/amcl")


async def test_a_timeout_limits_its_node() -> None:
    instance = Instance()
    instance.never = {"/amcl"}
    tree = procedure({"timeout": {"within": "200ms", "do": {"set_lifecycle": {"node": "/amcl", "state": "active"}}}})
    with pytest.raises(ProcedureFailed) as failure:
        await tree.run(instance, LONG)
    assert_golden("procedures", str(failure.value), "bringUp.timeout", "0.2 s", "bringUp.timeout.do.set_lifecycle")
    assert instance.cancelled == ["/amcl"]


async def test_a_leaf_knows_the_remaining_time() -> None:
    class RecordingInstance(Instance):
        async def bring_to(self, node: str, state: str, within: float) -> None:
            self.within = within

    instance = RecordingInstance()
    tree = procedure({"timeout": {"within": "10s", "do": {"set_lifecycle": {"node": "/amcl", "state": "active"}}}})
    await tree.run(instance, 1000)
    assert 5 < instance.within < 10


async def test_a_cancelled_procedure_cancels_the_running_leaf() -> None:
    instance = Instance()
    instance.never = {"/amcl"}
    running = asyncio.create_task(
        procedure({"set_lifecycle": {"node": "/amcl", "state": "active"}}).run(instance, LONG)
    )
    while not instance.done:
        await asyncio.sleep(0.01)

    running.cancel()

    with pytest.raises(asyncio.CancelledError):
        await running
    assert instance.cancelled == ["/amcl"]


async def test_a_procedure_waits_for_a_topic_and_a_check_evaluates_it_once() -> None:
    instance = Instance()
    leaf = {"topic": {"name": "/scan", "gap": "1h"}}
    with pytest.raises(ProcedureFailed, match="waiting for the first /scan"):
        await load_check(leaf, path="check").run(instance, LONG)
    running = asyncio.create_task(procedure(leaf).run(instance, LONG))
    await asyncio.sleep(0.1)
    assert not running.done()
    instance.record = TopicRecord()
    instance.record.add(asyncio.get_running_loop().time())
    await running
    await load_check(leaf, path="check").run(instance, LONG)
    assert [topic.name for topic in procedure(leaf).topics] == ["/scan"]


async def test_a_procedure_waits_for_a_value() -> None:
    instance = Instance()
    leaf = {"value": {"topic": "/scan", "type": "t/msg/Battery", "holds": "percentage > 0.5"}}
    with pytest.raises(TreeError, match=r"bringUp\.value\.holds: found 'percentage >'"):
        procedure({"value": {**leaf["value"], "holds": "percentage >"}})
    instance.record = TopicRecord(contents=1)
    instance.record.contents.append(ReceivedMessage(asyncio.get_running_loop().time(), Battery(percentage=0.4)))
    running = asyncio.create_task(procedure(leaf).run(instance, LONG))
    await asyncio.sleep(0.1)
    assert not running.done()
    with pytest.raises(
        ProcedureFailed, match=r"/scan: percentage was 0.4, but percentage > 0.5 is required \(not met yet\)"
    ):
        await load_check(leaf, path="check").run(instance, LONG)
    instance.record.contents.append(ReceivedMessage(asyncio.get_running_loop().time(), Battery(percentage=0.6)))
    await running
    await load_check(leaf, path="check").run(instance, LONG)


async def test_an_inverter_succeeds_if_its_node_fails() -> None:
    instance = Instance()
    tree = load_check({"inverter": {"lifecycle_is": {"node": "/amcl", "state": "finalized"}}}, path="check")
    await tree.run(instance, LONG)
    instance.states["/amcl"] = "finalized"
    with pytest.raises(
        ProcedureFailed, match=r"check\.inverter\.lifecycle_is: the condition is true, but must be false"
    ):
        await tree.run(instance, LONG)


async def test_a_parameter_is_compared_with_the_expected_value() -> None:
    instance = Instance()
    instance.parameters["rate"] = 2.0
    tree = load_check({"parameter_is": {"node": "/amcl", "name": "rate", "value": 2}}, path="check")
    await tree.run(instance, LONG)
    instance.parameters["rate"] = 3.0
    with pytest.raises(ProcedureFailed, match=r"parameter rate of node /amcl is 3\.0, not 2"):
        await tree.run(instance, LONG)


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({}, "p: the node is empty; give one of sequence"),
        ("x", "p: found 'x'; a node is a mapping with one of sequence"),
        ({"sequence": []}, "p.sequence: the list is empty"),
        ({"sequense": []}, "p.sequense: unknown key 'sequense', did you mean 'sequence'?"),
        ({"sequence": [], "parallel": []}, "found sequence and parallel in one node"),
        (
            {"set_lifecycle": {"node": "amcl", "state": "active"}},
            "p.set_lifecycle.node: found 'amcl'; did you mean '/amcl'?",
        ),
        (
            {"set_lifecycle": {"node": "/amcl", "state": "on"}},
            "p.set_lifecycle.state: found 'on'; give one of unconfigured",
        ),
        ({"set_lifecycle": {"node": "/amcl"}}, "p.set_lifecycle.state: found nothing"),
        ({"node": "/a"}, "p.node: found '/a'; 'node' must be a mapping such as {name: /controller_server}"),
        ({"set_lifecycle": []}, "p.set_lifecycle: found a list; 'set_lifecycle' must be a mapping of node and state"),
        (
            {"call_service": {"service": "/x", "typ": "a"}},
            "p.call_service.typ: unknown key 'typ', did you mean 'type'?",
        ),
        ({"call_service": {"service": "/x", "type": "std_msgs/msg/String"}}, "p.call_service.type: found"),
        ({"call_service": {"type": "std_srvs/srv/Trigger"}}, "p.call_service.service: missing"),
        ({"wait_for": {"topic": "/x", "node": "/y"}}, "p.wait_for: found topic and node of topic, service and node"),
        ({"wait_for": {"topic": "/x"}}, "p.wait_for.type: missing; give package/msg/Name"),
        ({"wait_for": {"node": "/x", "within": 5}}, "p.wait_for.within: found 5, which has no unit"),
        ({"retry": {"times": 0, "do": {"resend_goals": {}}}}, "p.retry.times: found 0; give the number of attempts"),
        ({"retry": {"times": 3}}, "p.retry.do: missing"),
        ({"timeout": {"do": {"resend_goals": {}}}}, "p.timeout.within: missing"),
        ({"restore_state": {"only": []}}, "p.restore_state.only: found a list; give a list of kept topics"),
        ({"topic": {"name": "/x"}}, "p.topic: neither gap nor rate is given"),
        ({"set_parameters": {"node": "/x", "values": {}}}, "p.set_parameters.values: missing"),
        ({"resend_goals": {}, "within": "5s"}, "p.within: unknown key; within belongs inside timeout or retry"),
    ],
)
def test_a_mistake_is_reported_with_the_valid_form(tree: object, message: str) -> None:
    with pytest.raises(TreeError) as error:
        load_procedure(tree, path="p")
    assert message in str(error.value)


def test_a_check_contains_only_conditions() -> None:
    with pytest.raises(TreeError) as error:
        load_check({"sequence": [{"set_lifecycle": {"node": "/amcl", "state": "active"}}]}, path="p")
    assert_golden("procedures", str(error.value), "p.sequence[0].set_lifecycle: ")


def test_all_mistakes_are_reported_at_once() -> None:
    with pytest.raises(TreeError) as error:
        load_procedure({"sequence": [{"resend_goals": {"x": 1}}, {"topic": {"name": "/x"}}, 3]}, path="p")
    assert len(error.value.problems) == 3
