"""Definitions in recordings are what other tools read messages by: rosbags' parser reads each as rosidl has it."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from understudy.ros.runtime import type_definitions
from understudy.ros.runtime.interface_types import TypeNotInstalled
from understudy.ros.runtime.type_definitions import definition

pytestmark = pytest.mark.ros

TYPES = (
    "geometry_msgs/msg/TwistStamped",
    "sensor_msgs/msg/PointCloud2",
    "nav_msgs/msg/Odometry",
    "diagnostic_msgs/msg/DiagnosticArray",
    "test_msgs/msg/Arrays",
    "test_msgs/msg/BoundedSequences",
    "test_msgs/msg/Strings",
    "test_msgs/msg/WStrings",
    "test_msgs/msg/Empty",
)


@pytest.mark.parametrize("installed", [True, False], ids=["installed file", "generated from fields"])
@pytest.mark.parametrize("type_name", TYPES)
def test_a_definition_describes_the_type(type_name: str, installed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not installed:
        monkeypatch.setattr(type_definitions, "_installed", lambda _: "")
    store = get_typestore(Stores.ROS2_JAZZY)
    found = get_types_from_msg(definition(type_name), type_name)
    assert type_name in found
    if type_name in store.fielddefs:
        for name, (_, fields) in found.items():
            assert [(field, kind) for field, kind in fields] == list(store.fielddefs[name][1]), name


def test_the_messages_of_an_action_are_written_out() -> None:
    text = definition("test_msgs/action/Fibonacci_FeedbackMessage")
    assert text.startswith("unique_identifier_msgs/UUID goal_id\ntest_msgs/Fibonacci_Feedback feedback\n")
    assert "MSG: test_msgs/Fibonacci_Feedback\nint32[] sequence\n" in text
    assert "MSG: unique_identifier_msgs/UUID\n" in text


def test_a_definition_contains_the_constants_of_the_package() -> None:
    assert "byte STALE=3" in definition("diagnostic_msgs/msg/DiagnosticStatus")


def test_the_packages_of_an_installation_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "share/std_msgs/msg").mkdir(parents=True)
    (tmp_path / "share/std_msgs/msg/String.msg").write_text("# another\nstring data")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/none:{tmp_path}")
    assert definition("std_msgs/msg/String") == "# another\nstring data\n"


def test_a_missing_type_is_reported() -> None:
    with pytest.raises(TypeNotInstalled):
        definition("no_msgs/msg/Such")
