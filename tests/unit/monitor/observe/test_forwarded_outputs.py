"""With a mux, its reports show what reaches the robot: a sample that an instance sends is none until it is forwarded."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import pytest

pytest.importorskip("rclpy")

from tests.unit.monitor.cluster_objects import parsed_spec
from tests.unit.monitor.observed_robot import policy_with
from understudy.api.protocol.mux_messages import Order, Report
from understudy.clock import CLOCK
from understudy.failover.interfaces import GateState, Instance
from understudy.kube.gates.mux_reports import MuxReports
from understudy.monitor.observe.robot.health_observer import HealthObserver
from understudy.ros.runtime.graph_node import Graph

ORDER = Order(1000.0, 5, "w-1")
REPORT = Report(
    ORDER.token, "w-1", "n", forwarded=1, since=0.0, heard={"w-1": {"/cmd_vel": 0.0}, "w-2": {"/cmd_vel": 0.0}}
)
INSTANCE, OTHER = Instance("w-1", "uid-1"), Instance("w-2", "uid-2")


class Instances:
    """The instances of the workload."""

    def of_workload(self) -> Sequence[Instance]:
        return [INSTANCE, OTHER]


class Gate:
    """An open gate."""

    state = GateState(epoch=5, active="w-1", active_uid="uid-1")
    unanswered_since = None


@pytest.fixture
def reports() -> MuxReports:
    found = MuxReports()
    found.ordered("uid-1", ORDER, "n")
    return found


@pytest.fixture
def observer(reports: MuxReports) -> HealthObserver:
    made = HealthObserver(forwarding=reports)
    made.follow(policy_with({"topic": {"name": "/cmd_vel", "gap": "500ms"}}), parsed_spec())
    return made


async def test_an_instance_drives_once_each_expected_output_of_it_was_forwarded(
    observer: HealthObserver, reports: MuxReports
) -> None:
    outputs, began = observer.outputs(cast(Any, Instances()), cast(Any, Gate())), CLOCK.now()
    reports.add(replace(REPORT, forwarded=0, since=math.inf))
    waiting = asyncio.create_task(outputs.first_from(INSTANCE, since=began))
    await asyncio.sleep(0.01)
    reports.add(replace(REPORT, forwarded=0, since=math.inf))
    await asyncio.sleep(0.01)
    reports.add(replace(REPORT, heard={"w-1": {"/lamp": 0.0}}))
    await asyncio.sleep(0.01)
    assert not waiting.done(), "the mux has forwarded nothing that is expected"
    reports.add(REPORT)
    first = await waiting
    assert first is not None
    assert began <= first <= CLOCK.now()


async def test_a_report_from_before_the_order_is_no_evidence_of_the_instance_to_which_the_mux_had_switched(
    observer: HealthObserver, reports: MuxReports
) -> None:
    outputs, began = observer.outputs(cast(Any, Instances()), cast(Any, Gate())), CLOCK.now()
    reports.add(replace(REPORT, token=replace(ORDER.token, count=1), source="w-2"))
    reports.ordered("uid-2", Order(1000.0, 6, "w-2"), "n-2")
    waiting = asyncio.create_task(outputs.first_from(OTHER, since=began))
    await asyncio.sleep(0.02)
    assert not waiting.done(), "the mux may have switched from it since"
    reports.add(replace(REPORT, nonce="n-2", token=replace(ORDER.token, epoch=6), source="w-2"))
    assert await waiting is not None
    assert outputs.switched_to(OTHER) == ""
    reports.add(replace(REPORT, nonce="n-2", token=replace(ORDER.token, epoch=6, count=1)))
    assert outputs.switched_to(OTHER) == "w-1"


async def test_while_no_mux_reports_what_an_instance_sends_has_to_do(
    observer: HealthObserver, reports: MuxReports, monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs, began = observer.outputs(cast(Any, Instances()), cast(Any, Gate())), CLOCK.now()
    monkeypatch.setattr(outputs, "_heard_from", lambda instance, since: since + 0.5)
    assert reports.is_silent
    assert await outputs.first_from(INSTANCE, since=began) == began + 0.5


async def test_a_switchover_waits_until_the_mux_hears_each_expected_topic_of_the_understudy(
    observer: HealthObserver, reports: MuxReports
) -> None:
    outputs = observer.outputs(cast(Any, Instances()), cast(Any, Gate()))
    await outputs.heard_held_back(OTHER)  # no mux reports: waiting would not help
    reports.add(replace(REPORT, heard={"w-1": {"/cmd_vel": 0.0}, "w-2": {"/lamp": 0.0}}))
    waiting = asyncio.create_task(outputs.heard_held_back(OTHER))
    await asyncio.sleep(0.1)
    reports.add(replace(REPORT, heard={"w-1": {"/cmd_vel": 0.0}, "w-2": {"/cmd_vel": 5.0}}))
    await asyncio.sleep(0.1)
    assert not waiting.done(), "it was heard once, and is not now"
    reports.add(REPORT)
    await waiting


async def test_no_other_instance_reaches_the_robot(observer: HealthObserver, reports: MuxReports) -> None:
    outputs = observer.outputs(cast(Any, Instances()), cast(Any, Gate()))
    reports.add(REPORT)
    assert outputs.last_from_others(INSTANCE) == (0.0, "")
    ((at, interval),) = outputs.heard()
    assert (at, interval) == (pytest.approx(CLOCK.now(), abs=1.0), math.inf)
    assert observer.callers() == []


async def test_a_writer_beside_the_mux_is_an_unknown_sender(observer: HealthObserver, reports: MuxReports) -> None:
    reports.add(REPORT)
    assert observer.output_senders() == []
    reports.add(replace(REPORT, strangers=("/cmd_vel by /teleop",)))
    (sender,) = observer.output_senders()
    assert (sender.topic, sender.name, sender.uid) == ("/cmd_vel", "/teleop", "")


async def test_a_topic_that_the_mux_misses_is_known_by_what_this_monitor_receives(
    observer: HealthObserver, reports: MuxReports, monkeypatch: pytest.MonkeyPatch
) -> None:
    received = [time.time() - age for age in (9.0, 2.0, 0.1)]
    monkeypatch.setattr(observer, "arrivals", lambda topic, pod: received)
    assert observer.unreached("w-1") == "", "no mux reports"
    reports.add(replace(REPORT, heard={"w-1": {"/cmd_vel": 2.0}}))
    assert observer.unreached("w-1") == "", "the latest may be on its way"
    reports.add(replace(REPORT, heard={"w-1": {"/cmd_vel": 9.0}}))
    assert observer.unreached("w-1") == "/cmd_vel"
    reports.add(replace(REPORT, heard={"w-2": {"/cmd_vel": 0.0}}))
    assert observer.unreached("w-1") == "/cmd_vel"
    received.clear()
    assert observer.unreached("w-1") == "", "this monitor receives nothing either"


async def test_a_monitor_is_blind_while_it_has_discovered_neither_a_node_nor_a_writer(
    observer: HealthObserver, monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs, writers = observer.outputs(cast(Any, Instances()), cast(Any, Gate())), dict[str, int]()
    monkeypatch.setattr(Graph, "is_alone", True)
    monkeypatch.setattr(observer.graph, "publisher_count", lambda topic: writers.get(topic, 0))
    assert outputs.blind
    writers["/cmd_vel"] = 1
    assert not outputs.blind, "a process without a node writes it"
