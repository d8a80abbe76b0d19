"""The robots of a campaign have their own objects, and their logs show what happened."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.chaos.robots import HOUSE, CampaignRobot
from bench.chaos.ways import WAYS
from bench.chaos.witness import between, tracebacks
from tests.e2e.kubectl import Kubectl


@pytest.fixture
def robots(monkeypatch: pytest.MonkeyPatch) -> list[CampaignRobot]:
    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}")
    kubectl = Kubectl(Path("/nowhere"), "chaos")
    return [CampaignRobot(kubectl, index, way, 1.0) for index, way in enumerate(WAYS)]


def test_no_two_robots_share_an_object(robots: list[CampaignRobot]) -> None:
    found = [(item["kind"], item["metadata"]["name"]) for robot in robots for item in robot.all_objects()]
    assert len(found) == len(set(found))
    assert [robot.way.name for robot in robots] == [way.name for way in WAYS]


def test_references_name_the_robots_own_objects(robots: list[CampaignRobot]) -> None:
    for robot in robots:
        objects = robot.all_objects()
        named = {(item["kind"], item["metadata"]["name"]) for item in objects}
        for item in objects:
            spec = item["spec"]
            if item["kind"] == "RobotWorkload":
                assert item["metadata"]["name"] == robot.workload
                assert ("FailurePolicy", spec["failurePolicyRef"]["name"]) in named
            if item["kind"] == "FailurePolicy":
                pools = {strategy["poolRef"]["name"] for strategy in spec["strategies"] if "poolRef" in strategy}
                assert {("FallbackPool", pool) for pool in pools} <= named
                gaps = {leaf["topic"]["name"]: leaf["topic"]["gap"] for leaf in spec["monitoring"]["yaml"]["parallel"]}
                assert gaps["/cmd_vel"] == "1000ms"
            if item["kind"] == "FallbackPool":
                assert spec["workloadSelector"] == {"matchLabels": {"app": robot.workload}}
                assert spec.get("templateFrom", {"workload": robot.workload}) == {"workload": robot.workload}


def test_robots_stay_on_a_node_that_is_never_lost_and_instances_do_not_run_there(robots: list[CampaignRobot]) -> None:
    for item in (item for robot in robots for item in robot.all_objects()):
        if item["kind"] == "Deployment":
            assert item["spec"]["template"]["spec"]["nodeSelector"] == {"kubernetes.io/hostname": HOUSE}
        if item["kind"] == "RobotWorkload":
            affinity = item["spec"]["template"]["spec"]["affinity"]["nodeAffinity"]
            (term,) = affinity["requiredDuringSchedulingIgnoredDuringExecution"]["nodeSelectorTerms"]
            assert term["matchExpressions"] == [
                {"key": "kubernetes.io/hostname", "operator": "NotIn", "values": [HOUSE]}
            ]


def test_a_workload_is_without_a_monitor_between_the_pods_of_its_monitor() -> None:
    """A pod and its successor may overlap, and a reading that failed shortens nothing if the pod is seen again."""
    assert list(between([(95.0, 120.0), (0.0, 40.0), (60.0, 100.0)])) == [(40.0, 60.0)]
    assert list(between([])) == []


def test_a_traceback_is_found_with_what_was_raised() -> None:
    line = "2026-11-25T22:00:00.123456789Z stderr F "
    text = "\n".join(
        line + part
        for part in (
            "starting",
            "Traceback (most recent call last):",
            '  File "a.py", line 1, in b',
            "    c()",
            "rclpy._rclpy_pybind11.InvalidHandle: cannot use Destroyable",
            "going on",
        )
    )
    (found,) = tracebacks(text, "pod/agent", 5.0)
    assert found.last == "rclpy._rclpy_pybind11.InvalidHandle: cannot use Destroyable"
    assert len(found.text.splitlines()) == 4
    assert list(tracebacks(line + "all is well", "pod/agent", 5.0)) == []
