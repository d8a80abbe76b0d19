"""The environment that containers of ours begin in has what the ROS wheels would set up by a second start of Python."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests.unit.ros.processes import PACKAGE

pytestmark = pytest.mark.ros

COMMAND = PACKAGE.parent / "docker" / "ros-environment"
SHOW = "import os; print(os.environ['LD_LIBRARY_PATH'])"


def _run(*command: object, **more: str) -> str:
    left_out = ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
    environment = {key: value for key, value in os.environ.items() if key not in left_out}
    environment |= {"UNDERSTUDY_ENVIRONMENT": sys.prefix, **more}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.strip()


def test_the_environment_contains_the_folders_that_ros_finds_by_itself() -> None:
    found = _run(sys.executable, "-c", SHOW)
    environment = _run(COMMAND, sys.executable, "-c", SHOW)
    assert len(found.split(":")) > 2
    assert sorted(environment.split(":")) == sorted(found.split(":"))


def test_python_does_not_restart_itself_in_the_environment() -> None:
    # One that did would have put them in an order of its own.
    assert _run(COMMAND, sys.executable, "-c", SHOW) == _run(COMMAND, "printenv", "LD_LIBRARY_PATH")


def test_the_previous_library_path_is_appended() -> None:
    assert _run(COMMAND, "printenv", "LD_LIBRARY_PATH", LD_LIBRARY_PATH="/elsewhere").endswith(":/elsewhere")


def test_ros_works_in_the_environment() -> None:
    code = "from rclpy.serialization import serialize_message; from std_msgs.msg import Empty; print(serialize_message(Empty()))"
    assert _run(COMMAND, sys.executable, "-c", code)


def test_a_command_receives_its_arguments_and_its_exit_code_is_returned() -> None:
    assert _run(COMMAND, "printf", "%s|", "a b", "*", "") == "a b|*||"
    assert subprocess.run([COMMAND, "sh", "-c", "exit 7"]).returncode == 7
