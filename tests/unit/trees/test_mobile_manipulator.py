"""The example of the paper: what must work depends on what the robot does, in whichever language the policy is written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.golden import assert_golden
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.cli.check.command import check
from understudy.trees.core.health_tree import HealthTree, Verdict
from understudy.trees.core.observations import RecordedObservations, TopicRecord
from understudy.trees.languages.notations import FORMS, load_monitoring

FOLDER = Path(__file__).parents[3] / "examples" / "mobile_manipulator" / "policies"
FILES = {"yaml": FOLDER / "short.yaml", "xml": FOLDER / "xml.yaml", "osc": FOLDER / "osc.yaml"}
START = 1.7e9

RATES = {
    "/cmd_vel": 20,
    "/joint_states": 100,
    "/scan": 10,
    "/imu/data": 100,
    "/base_camera/camera_info": 15,
    "/wrist_camera/camera_info": 15,
}
NAVIGATE = "/navigate_to_pose/_action/status"
GRIP = "/arm_controller/follow_joint_trajectory/_action/status"
BASE, ARM = {"/cmd_vel"}, {"/joint_states"}
SENSORS = RATES.keys() - BASE - ARM


@dataclass
class Robot:
    """What the robot does and says; times are seconds since START."""

    silent: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """By topic, from when to when nothing comes."""
    tasks: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """By status topic, from when to when a goal is active."""
    until: float = 30.0

    def arrival_times(self, topic: str, after: float, until: float) -> list[float]:
        """When messages came in a time; those of base and arm come only while they work."""
        rate = RATES[topic]
        begin, end = self.silent.get(topic, (1.0, 0.0))
        times = [index / rate for index in range(int(after * rate), int(until * rate) + 2)]
        return [
            time for time in times if after < time <= until and not begin <= time < end and self._works(topic, time)
        ]

    def _works(self, topic: str, time: float) -> bool:
        if topic in SENSORS:
            return True
        begin, end = self.tasks.get(NAVIGATE if topic in BASE else GRIP, (1.0, 0.0))
        return begin <= time < end

    def trace(self, tree: HealthTree) -> list[tuple[float, Verdict, float | None]]:
        """What the tree says ten times a second, and when it says that it would be worse."""
        verdicts = []
        records = {topic.name: TopicRecord(topic.window) for topic in tree.topics if not topic.task}
        for index in range(int(self.until * 10) + 1):
            time = index / 10
            for topic, record in records.items():
                for moment in self.arrival_times(topic, (index - 1) / 10, time):
                    record.add(START + moment)
            active = {status: START + begin for status, (begin, end) in self.tasks.items() if begin <= time < end}
            observations = RecordedObservations(records, active)
            now = START + time
            verdict = tree.evaluate(observations, now=now, since=START)
            verdicts.append((time, verdict, tree.deadline(observations, now=now, since=START)))
        return verdicts


def policy(form: str) -> dict[str, Any]:
    (found,) = yaml.safe_load_all(FILES[form].read_text())
    assert isinstance(found, dict)
    return found


def trees() -> dict[str, HealthTree]:
    return {form: load_monitoring(FailurePolicySpec.model_validate(policy(form)["spec"]).monitoring) for form in FORMS}


def failures(robot: Robot) -> dict[str, tuple[float, float]]:
    """The leaves that fail, each with the first and the last moment of that; all languages say the same at all times."""
    traces = {form: robot.trace(tree) for form, tree in trees().items()}
    assert all(trace == traces["yaml"] for trace in traces.values())
    found: dict[str, tuple[float, float]] = {}
    for time, verdict, _ in traces["yaml"]:
        if verdict.state == "Failed":
            first, _ = found.get(verdict.leaf, (time, time))
            found[verdict.leaf] = (first, time)
    return found


def test_the_policies_differ_only_in_language_and_name() -> None:
    specs = {form: policy(form)["spec"] for form in FORMS}
    for form, spec in specs.items():
        assert spec["monitoring"].pop(form)
    assert specs["yaml"] == specs["xml"] == specs["osc"]
    topics = {form: sorted(tree.topics, key=lambda topic: topic.name) for form, tree in trees().items()}
    assert topics["yaml"] == topics["xml"] == topics["osc"]
    assert {topic.name for topic in topics["yaml"]} == {*RATES, NAVIGATE, GRIP}


def test_the_manifests_pass_the_check_together() -> None:
    result = check([(file.name, file.read_bytes()) for file in FILES.values()])
    assert result.findings == []
    assert_golden("check", result.totals(), "3 objects", "3 files", "0 errors", "0 warnings")


def test_an_idle_robot_is_healthy() -> None:
    assert failures(Robot()) == {}


DRIVES = {NAVIGATE: (5.0, 15.0)}
GRIPS = {GRIP: (18.0, 26.0)}


def test_a_robot_that_drives_and_then_grips_is_healthy() -> None:
    assert failures(Robot(tasks=DRIVES | GRIPS)) == {}


def test_velocities_are_required_while_the_robot_drives() -> None:
    ((leaf, (first, last)),) = failures(Robot({"/cmd_vel": (10.0, 30.0)}, DRIVES | GRIPS)).items()
    assert leaf == "driving/cmd_vel"
    assert 10.0 < first <= 11.0
    assert last == 14.9, "the goal is over then, and velocities don't matter any more"


def test_velocities_are_not_required_while_the_robot_grips() -> None:
    assert failures(Robot({"/cmd_vel": (0.0, 30.0)}, GRIPS)) == {}


def test_joint_states_are_required_while_the_robot_grips() -> None:
    ((leaf, (first, last)),) = failures(Robot({"/joint_states": (20.0, 30.0)}, DRIVES | GRIPS)).items()
    assert leaf == "manipulating/joint_states"
    assert 20.0 < first <= 21.0
    assert last == 25.9


def test_joint_states_are_not_required_while_the_robot_drives() -> None:
    assert failures(Robot({"/joint_states": (0.0, 30.0)}, DRIVES)) == {}


@pytest.mark.parametrize("tasks", [{}, {NAVIGATE: (2.0, 30.0)}, {GRIP: (2.0, 30.0)}], ids=["stands", "drives", "grips"])
@pytest.mark.parametrize(
    ("topic", "leaf"),
    [
        ("/scan", "sensors/lidar"),
        ("/imu/data", "sensors/imu"),
        ("/base_camera/camera_info", "sensors/base_camera"),
        ("/wrist_camera/camera_info", "sensors/wrist_camera"),
    ],
)
def test_each_sensor_is_required_in_every_task(topic: str, leaf: str, tasks: Mapping[str, tuple[float, float]]) -> None:
    ((found, (first, last)),) = failures(Robot({topic: (8.0, 10.0)}, tasks, until=12.0)).items()
    assert found == leaf
    assert 8.0 < first <= 9.1
    assert 9.8 <= last <= 11.0
