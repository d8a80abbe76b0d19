"""What a policy would have detected in a bag: when exactly, why, and when it was over."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.support.bag_recording import RecordedMessage, Storage, every, policy, unix, write
from tests.support.golden import assert_golden
from understudy.cli.common.errors import CommandError
from understudy.cli.simulate import policy_file
from understudy.cli.simulate.bags import Bag
from understudy.cli.simulate.leaf_history import Failure
from understudy.cli.simulate.replay import Replay, replay

TWIST, SCAN, BATTERY = "geometry_msgs/msg/Twist", "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/BatteryState"
STATUS, STATUSES = "/go/_action/status", "action_msgs/msg/GoalStatusArray"
BOTH: tuple[Storage, ...] = ("mcap", "sqlite3")


def clock(end: float) -> list[RecordedMessage]:
    """Something that goes on for as long as the recording does."""
    return every("/clock_of_the_test", "std_msgs/msg/Empty", 0.0, end, 10)


def goals(at: float, *statuses: int) -> RecordedMessage:
    return RecordedMessage(at, STATUS, STATUSES, {"status_list": [{"status": status} for status in statuses]})


class Replayed:
    """A policy over what was recorded."""

    def __init__(
        self,
        folder: Path,
        messages: list[RecordedMessage],
        tree: str,
        storage: Storage = "mcap",
        also: dict[str, str] | None = None,
        **of: str,
    ) -> None:
        file = folder / "policy.yaml"
        file.write_text(policy(tree, **of))
        bag = write(folder / "bag", messages, storage, also)
        with Bag.open(str(bag)) as opened:
            read = policy_file.read(str(file))
            self.found: Replay = replay(read.tree(opened.definitions.fields), read.debounce, opened)

    @property
    def detections(self) -> list[Failure]:
        return self.found.evaluation.detections

    def states(self, path: str) -> list[str]:
        return [span.state for span in self.found.evaluation.spans[path]]

    def only(self) -> Failure:
        (one,) = self.detections
        return one


@pytest.mark.parametrize("storage", BOTH)
def test_a_silence_is_detected_after_its_gap_and_ends_with_the_next_message(tmp_path: Path, storage: Storage) -> None:
    messages = [*clock(8), *every("/cmd_vel", TWIST, 0, 3, 20), *every("/cmd_vel", TWIST, 5, 8, 20)]
    found = Replayed(tmp_path, messages, "{topic: {name: /cmd_vel, gap: 500ms}}", storage).only()
    assert found.detected == unix(2.95) + 0.5
    assert (found.leaf, found.reason) == ("cmd_vel", "no /cmd_vel for 500 ms")
    assert (found.onset, found.recovered) == (unix(2.95), unix(5))


@pytest.mark.parametrize("storage", BOTH)
def test_a_dropped_rate_is_detected_although_messages_arrive(tmp_path: Path, storage: Storage) -> None:
    messages = [*every("/odom", "nav_msgs/msg/Odometry", 0, 5, 30), *every("/odom", "nav_msgs/msg/Odometry", 5, 12, 10)]
    tried = Replayed(tmp_path, messages, "{topic: {name: /odom, rate: '> 20 Hz', window: 2s}}", storage)
    assert tried.states("odom") == ["Starting", "Healthy", "Failed"]
    assert unix(5.5) < (tried.only().detected or 0) < unix(7)
    assert tried.only().recovered is None


@pytest.mark.parametrize("storage", BOTH)
def test_a_value_is_read_from_the_messages(tmp_path: Path, storage: Storage) -> None:
    levels = [(0, 0.5), (1, 0.2), (2, 0.1), (3, 0.09), (4, 0.4), (5, 0.4)]
    messages = [RecordedMessage(at, "/battery", BATTERY, {"percentage": level}) for at, level in levels]
    tree = f'{{value: {{topic: /battery, type: {BATTERY}, holds: "percentage > 0.15"}}}}'
    found = Replayed(tmp_path, messages, tree, storage).only()
    assert (found.detected, found.onset, found.recovered) == (unix(2), unix(1), unix(4))
    assert_golden("simulate", found.reason, "percentage > 0.15", "/battery", "percentage was 0.1")


def test_nested_fields_arrays_and_booleans_are_decoded_as_in_ros(tmp_path: Path) -> None:
    messages = [
        RecordedMessage(
            0,
            "/battery",
            BATTERY,
            {"header": {"frame_id": "a"}, "present": True, "cell_voltage": [3.5, 3.9], "power_supply_status": 2},
        ),
        RecordedMessage(
            1,
            "/battery",
            BATTERY,
            {"header": {"frame_id": "a"}, "present": True, "cell_voltage": [3.5, 1.0], "power_supply_status": 2},
        ),
    ]
    holds = "present and header.frame_id == 'a' and power_supply_status == 2 and len(cell_voltage) == 2"
    holds += " and all(v > 3 for v in cell_voltage)"
    found = Replayed(tmp_path, messages, f'{{value: {{topic: /battery, type: {BATTERY}, holds: "{holds}"}}}}').only()
    assert found.detected == unix(1)


def test_diagnostics_ages_and_transforms_are_evaluated_as_in_a_live_graph(tmp_path: Path) -> None:
    def diagnostics(at: float, level: int) -> RecordedMessage:
        return RecordedMessage(
            at, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", {"status": [{"name": "camera", "level": level}]}
        )

    def transform(at: float, child: str) -> RecordedMessage:
        return RecordedMessage(
            at,
            "/tf",
            "tf2_msgs/msg/TFMessage",
            {"transforms": [{"child_frame_id": child, "header": {"frame_id": "odom"}}]},
        )

    def scan(at: float, late: float) -> RecordedMessage:
        nanoseconds = round(unix(at - late) * 1e9)
        stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
        return RecordedMessage(at, "/scan", SCAN, {"header": {"stamp": stamp}})

    messages = [
        *(diagnostics(at, 2 if at == 3 else 0) for at in range(9)),
        *(transform(at / 10, "base" if at < 60 else "arm") for at in range(90)),
        *(scan(at / 10, 0.4 if 45 <= at < 50 else 0.05) for at in range(90)),
    ]
    tree = (
        "{parallel: [{diagnostics: {name: camera, worst: WARN}}, {transform: {parent: odom, child: base, gap: 500ms}}, "
        f"{{age: {{topic: /scan, type: {SCAN}, most: 300ms}}}}]}}"
    )
    tried = Replayed(tmp_path, messages, tree)
    assert [(one.detected, one.leaf) for one in tried.detections] == [
        (unix(3), "diagnostics"),
        (unix(4.5), "scan.age"),
        (unix(5.9) + 0.5, "base.transform"),
    ]


def test_diagnostics_that_a_monitor_published_are_not_evidence(tmp_path: Path) -> None:
    def diagnostics(at: float, name: str, level: int) -> RecordedMessage:
        return RecordedMessage(
            at, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", {"status": [{"name": name, "level": level}]}
        )

    messages = [*clock(9), *(diagnostics(at, "understudy: robot-1-drive", 2) for at in range(9))]
    messages += [diagnostics(at + 0.5, "camera", 0) for at in range(4)]
    gap = "{name: heard, topic: {name: /diagnostics, gap: 2s}}"
    tried = Replayed(tmp_path, messages, f"{{parallel: [{{diagnostics: {{worst: WARN}}}}, {gap}]}}")
    assert tried.states("diagnostics") == ["Starting", "Healthy"]
    assert tried.only().detected == unix(3.5) + 2.0


def test_the_status_of_an_action_determines_whether_a_task_is_active(tmp_path: Path) -> None:
    messages = [*clock(20), goals(4, 1), goals(5, 1, 2), goals(15, 4), *every("/cmd_vel", TWIST, 5.5, 10, 10)]
    tree = "{while: {task_active: {action: /go}}, do: {topic: {name: /cmd_vel, gap: 500ms}}}"
    tried = Replayed(tmp_path, messages, tree)
    assert tried.states("cmd_vel") == ["Idle", "Healthy", "Failed", "Idle"]
    assert tried.only().detected == unix(9.9) + 0.5
    assert tried.only().recovered == unix(15), "it isn't needed any more"


def test_a_failure_shorter_than_the_debounce_is_not_detected(tmp_path: Path) -> None:
    messages = [*clock(9), *(RecordedMessage(at, "/cmd_vel", TWIST) for at in (0, 1, 2.2, 3, 6, 7, 8))]
    tried = Replayed(tmp_path, messages, "{topic: {name: /cmd_vel, gap: 1s}}", debounce="300ms")
    assert tried.only().failed == unix(3) + 1.0
    assert tried.only().detected == unix(3) + 1.0 + 0.3
    passed = [one for one in tried.found.evaluation.failures if one.detected is None]
    assert [(one.failed, one.recovered) for one in passed] == [(unix(1) + 1.0, unix(2.2))]


def test_a_topic_that_never_arrives_fails_when_the_grace_time_from_the_bag_start_ends(tmp_path: Path) -> None:
    tried = Replayed(tmp_path, clock(9), "{topic: {name: /scan, gap: 1s}}", also={"/scan": SCAN}, grace="5s")
    assert tried.only().detected == unix(0) + 5.0
    assert tried.found.evaluation.healthy is None


def test_a_recovery_without_a_message_is_recorded_at_its_time(tmp_path: Path) -> None:
    messages = [*clock(9), *every("/odom", TWIST, 0, 3, 10), *every("/odom", TWIST, 3, 4, 30)]
    tried = Replayed(tmp_path, messages, "{topic: {name: /odom, rate: '<= 20 Hz', window: 1s}}")
    last = max(one.at for one in messages if one.topic == "/odom")
    recovered = tried.only().recovered
    assert recovered is not None
    assert unix(last) < recovered < unix(last) + 1.0, "no message came then"


def test_leaves_that_a_bag_cannot_answer_are_left_out_and_reported(tmp_path: Path) -> None:
    tree = (
        "{parallel: [{topic: {name: /scan, gap: 1s}}, {topic: {name: /imu, gap: 1s}}, {publisher: {topic: /scan}}, "
        "{name: sent, age: {topic: /scan, most: 1s, by: source}}, {pod: {condition: Ready}}, "
        "{parameter: {node: /a, name: b, equals: 1}}, "
        "{name: driving, while: {task_active: {action: /go}}, do: {topic: {name: /scan, gap: 100ms}}}]}"
    )
    tried = Replayed(tmp_path, every("/scan", SCAN, 0, 5, 5), tree)
    assert tried.detections == []
    assert list(tried.found.topics) == ["scan"]
    reasons = {leaf: one.why for one in tried.found.left_out for leaf in one.leaves}
    assert reasons.keys() == {"imu", "scan.publisher", "sent", "pod.Ready", "a.b.parameter", "driving/scan"}
    assert reasons["imu"] == "the bag does not contain /imu"
    assert "needs the live ROS graph" in reasons["scan.publisher"]
    assert_golden("simulate", reasons["sent"], "/scan")
    assert_golden("simulate", reasons["pod.Ready"], "(pod)")
    assert "needs the live ROS graph" in reasons["a.b.parameter"]
    assert "--include-hidden-topics" in reasons["driving/scan"]


def test_a_tree_without_answerable_leaves_gives_no_verdict(tmp_path: Path) -> None:
    with pytest.raises(
        CommandError,
        match="this bag contains nothing that the policy's tree can evaluate\nimu: the bag does not contain /imu",
    ):
        Replayed(tmp_path, clock(2), "{topic: {name: /imu, gap: 1s}}")


steps = st.lists(st.integers(1, 1500), min_size=1, max_size=40)
"""Milliseconds between messages."""


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(steps=steps, gap=st.integers(50, 900), debounce=st.integers(0, 400), storage=st.sampled_from(BOTH))
def test_each_gap_is_detected_exactly_when_its_duration_ends(
    tmp_path_factory: pytest.TempPathFactory, steps: list[int], gap: int, debounce: int, storage: Storage
) -> None:
    times = [0.0, *(total / 1000 for total in itertools.accumulate(steps))]
    end = times[-1] + 3
    messages = [
        *(RecordedMessage(at, "/cmd_vel", TWIST) for at in times),
        RecordedMessage(end, "/clock_of_the_test", "std_msgs/msg/Empty"),
    ]
    tried = Replayed(
        tmp_path_factory.mktemp("bag"),
        messages,
        f"{{topic: {{name: /cmd_vel, gap: {gap}ms}}}}",
        storage,
        debounce=f"{debounce}ms",
    )
    expected = [
        ((unix(last) + gap / 1000) + debounce / 1000, unix(last), unix(following))
        for last, following in itertools.pairwise([*times, end])
        if (unix(last) + gap / 1000) + debounce / 1000 < unix(following)
    ]
    assert [(one.detected, one.onset) for one in tried.detections] == [(at, last) for at, last, _ in expected]
    assert [one.recovered for one in tried.detections[:-1]] == [over for _, _, over in expected[:-1]]
