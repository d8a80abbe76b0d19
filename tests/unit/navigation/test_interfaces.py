"""The interface packages that were built from source, as they are installed."""

from __future__ import annotations

import importlib
import subprocess
import sys
from importlib.metadata import metadata
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")

INTERFACES = Path(__file__).parents[3] / "examples" / "navigation" / "interfaces"

# As Nav2 1.3 and geometry2 0.36 have them (Jazzy): field names, types and order are what goes over the wire.
NAV2 = {
    "action.NavigateToPose.Goal": {"pose": "geometry_msgs/PoseStamped", "behavior_tree": "string"},
    "action.NavigateToPose.Result": {"error_code": "uint16", "error_msg": "string"},
    "action.NavigateToPose.Feedback": {
        "current_pose": "geometry_msgs/PoseStamped",
        "navigation_time": "builtin_interfaces/Duration",
        "estimated_time_remaining": "builtin_interfaces/Duration",
        "number_of_recoveries": "int16",
        "distance_remaining": "float",
    },
    "action.ComputePathToPose.Goal": {
        "goal": "geometry_msgs/PoseStamped",
        "start": "geometry_msgs/PoseStamped",
        "planner_id": "string",
        "use_start": "boolean",
    },
    "action.ComputePathToPose.Result": {
        "path": "nav_msgs/Path",
        "planning_time": "builtin_interfaces/Duration",
        "error_code": "uint16",
        "error_msg": "string",
    },
    "action.FollowPath.Goal": {
        "path": "nav_msgs/Path",
        "controller_id": "string",
        "goal_checker_id": "string",
        "progress_checker_id": "string",
    },
    "action.FollowPath.Result": {"result": "std_msgs/Empty", "error_code": "uint16", "error_msg": "string"},
    "action.FollowPath.Feedback": {"distance_to_goal": "float", "speed": "float"},
    "srv.ManageLifecycleNodes.Request": {"command": "uint8"},
    "srv.ManageLifecycleNodes.Response": {"success": "boolean"},
    "msg.ParticleCloud": {"header": "std_msgs/Header", "particles": "sequence<nav2_msgs/Particle>"},
}
TF2 = {"msg.TFMessage": {"transforms": "sequence<geometry_msgs/TransformStamped>"}}
# As py_trees_ros_interfaces 2.1 has them (Jazzy).
PY_TREES = {
    "msg.ActivityItem": dict.fromkeys(
        ("key", "client_name", "activity_type", "previous_value", "current_value"), "string"
    ),
    "msg.Behaviour": {
        "name": "string",
        "class_name": "string",
        "own_id": "unique_identifier_msgs/UUID",
        "parent_id": "unique_identifier_msgs/UUID",
        "tip_id": "unique_identifier_msgs/UUID",
        "child_ids": "sequence<unique_identifier_msgs/UUID>",
        "current_child_id": "unique_identifier_msgs/UUID",
        "type": "uint8",
        "additional_detail": "string",
        "blackbox_level": "uint8",
        "status": "uint8",
        "message": "string",
        "is_active": "boolean",
        "blackboard_access": "sequence<py_trees_ros_interfaces/KeyValue>",
    },
    "msg.BehaviourTree": {
        "behaviours": "sequence<py_trees_ros_interfaces/Behaviour>",
        "changed": "boolean",
        "blackboard_on_visited_path": "sequence<diagnostic_msgs/KeyValue>",
        "blackboard_activity": "sequence<py_trees_ros_interfaces/ActivityItem>",
        "statistics": "py_trees_ros_interfaces/Statistics",
    },
    "msg.KeyValue": {"key": "string", "value": "string"},
    "msg.SnapshotStreamParameters": {
        "snapshot_period": "double",
        "blackboard_data": "boolean",
        "blackboard_activity": "boolean",
    },
    "msg.Statistics": {
        "count": "int64",
        "stamp": "builtin_interfaces/Time",
        "tick_duration": "float",
        "tick_duration_average": "float",
        "tick_duration_variance": "float",
        "tick_interval": "float",
        "tick_interval_average": "float",
        "tick_interval_variance": "float",
    },
    "srv.OpenSnapshotStream.Request": {
        "topic_name": "string",
        "parameters": "py_trees_ros_interfaces/SnapshotStreamParameters",
    },
    "srv.OpenSnapshotStream.Response": {"topic_name": "string"},
    "srv.ReconfigureSnapshotStream.Request": {
        "topic_name": "string",
        "parameters": "py_trees_ros_interfaces/SnapshotStreamParameters",
    },
    "srv.ReconfigureSnapshotStream.Response": {"result": "boolean"},
    "srv.CloseSnapshotStream.Request": {"topic_name": "string"},
    "srv.CloseSnapshotStream.Response": {"result": "boolean"},
}
# As control_msgs 5 has them (Jazzy).
_POINT, _POINTS = "trajectory_msgs/JointTrajectoryPoint", "trajectory_msgs/MultiDOFJointTrajectoryPoint"
CONTROL = {
    "action.FollowJointTrajectory.Goal": {
        "trajectory": "trajectory_msgs/JointTrajectory",
        "multi_dof_trajectory": "trajectory_msgs/MultiDOFJointTrajectory",
        "path_tolerance": "sequence<control_msgs/JointTolerance>",
        "component_path_tolerance": "sequence<control_msgs/JointComponentTolerance>",
        "goal_tolerance": "sequence<control_msgs/JointTolerance>",
        "component_goal_tolerance": "sequence<control_msgs/JointComponentTolerance>",
        "goal_time_tolerance": "builtin_interfaces/Duration",
    },
    "action.FollowJointTrajectory.Result": {"error_code": "int32", "error_string": "string"},
    "action.FollowJointTrajectory.Feedback": {
        "header": "std_msgs/Header",
        "joint_names": "sequence<string>",
        **dict.fromkeys(("desired", "actual", "error"), _POINT),
        "multi_dof_joint_names": "sequence<string>",
        **dict.fromkeys(("multi_dof_desired", "multi_dof_actual", "multi_dof_error"), _POINTS),
    },
    "msg.JointTolerance": {"name": "string", **dict.fromkeys(("position", "velocity", "acceleration"), "double")},
}
PACKAGES = ("nav2_msgs", "tf2_msgs", "py_trees_ros_interfaces", "control_msgs", "manipulation_interfaces")


@pytest.mark.parametrize(
    ("package", "type_name", "fields"),
    [("nav2_msgs", name, fields) for name, fields in NAV2.items()]
    + [("tf2_msgs", name, fields) for name, fields in TF2.items()]
    + [("py_trees_ros_interfaces", name, fields) for name, fields in PY_TREES.items()]
    + [("control_msgs", name, fields) for name, fields in CONTROL.items()],
)
def test_types_have_the_fields_of_the_originals(package: str, type_name: str, fields: dict[str, str]) -> None:
    kind, *names = type_name.split(".")
    found = importlib.import_module(f"{package}.{kind}")
    for name in names:
        found = getattr(found, name)
    assert list(found.get_fields_and_field_types().items()) == list(fields.items())


def test_messages_are_unchanged_by_serialization() -> None:
    from nav2_msgs.action import NavigateToPose
    from rclpy.serialization import deserialize_message, serialize_message
    from tf2_msgs.msg import TFMessage

    goal = NavigateToPose.Goal(behavior_tree="tree")
    goal.pose.header.frame_id = "map"
    goal.pose.pose.position.x = 1.5
    assert deserialize_message(serialize_message(goal), NavigateToPose.Goal) == goal
    assert deserialize_message(serialize_message(TFMessage()), TFMessage) == TFMessage()


@pytest.mark.parametrize("package", PACKAGES)
def test_wheels_have_the_metadata_of_their_packages(package: str) -> None:
    described = ElementTree.parse(INTERFACES / package / "package.xml").getroot()
    installed = metadata(f"ros-jazzy-{package.replace('_', '-')}")
    assert installed["Version"] == described.findtext("version")
    assert installed["License"] == described.findtext("license")
    needed = {f"ros-jazzy-{(node.text or '').replace('_', '-')}" for node in described.findall("depend")}
    assert needed <= set(installed.get_all("Requires-Dist") or [])


def test_every_defined_interface_is_built() -> None:
    for package in PACKAGES:
        listed = (INTERFACES / package / "CMakeLists.txt").read_text()
        for file in (INTERFACES / package).glob("*/*.*"):
            assert f'"{file.parent.name}/{file.name}"' in listed
            assert hasattr(importlib.import_module(f"{package}.{file.parent.name}"), file.stem)


def test_a_folder_that_is_not_an_environment_is_reported(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, INTERFACES / "build", "--environment", tmp_path / "none", "--out", tmp_path],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert f"--environment {tmp_path / 'none'}: no virtual environment" in done.stderr
