"""Robot, planners and client as they run in their pods, as processes over loopback."""

from __future__ import annotations

import json
import math
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.unit.navigation.processes import Run
from tests.unit.processes import stop

pytestmark = pytest.mark.ros
pytest.importorskip("rclpy")
pytest.importorskip("mujoco")
pytest.importorskip("ompl")

NODES = str(Path(__file__).with_name("nodes.py"))

ASIDE = (
    "--ros-args",
    *(
        word
        for name in ("send_goal", "cancel_goal", "get_result", "feedback", "status")
        for word in ("-r", f"/move_to_pose/_action/{name}:=/aside/_action/{name}")
    ),
)
"""Gives the action another name, where the product keeps the instances' actions apart by partitions."""


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Run]:
    with ExitStack() as stack:
        yield Run(tmp_path, stack)


def robot(run: Run, event: str) -> list[dict[str, Any]]:
    """What the robot wrote down of one kind."""
    return [record for record in run.records("robot") if record["event"] == event]


def goals(run: Run) -> list[dict[str, Any]]:
    """Those that the client has sent."""
    return [record for record in run.records("client") if record["event"] == "goal"]


def wait_moving(run: Run, goal: int = 1) -> None:
    """Wait until the arm moves to the client's n-th goal."""

    def moving() -> bool:
        return len(goals(run)) == goal and any(r["speed"] > 0.25 for r in robot(run, "arm")[-3:])

    run.wait("the arm moves", moving, within=60)


def wait_held(run: Run) -> None:
    run.wait("the arm holds", lambda: (r := robot(run, "arm")[-1])["held"] and r["speed"] < 0.02)


def assert_reached(run: Run) -> None:
    results = [record for record in run.records("client") if record["event"] == "result"]
    assert {result["status"] for result in results} == {"succeeded"}, results
    goal = goals(run)[-1]
    last = robot(run, "arm")[-1]
    assert math.dist((last["x"], last["y"], last["z"]), (goal["x"], goal["y"], goal["z"])) < 0.01
    assert not robot(run, "bumped")


def assert_no_jump(run: Run) -> None:
    """After the hand-over no step is larger than twice the largest one before it."""
    steps: dict[str, list[float]] = {}
    for record in robot(run, "command"):
        steps.setdefault(record["writer"], []).append(record["step"])
    first, second = steps.values()
    assert max(second) <= 2 * max(first), (max(first), max(second))
    assert second[0] <= 2 * max(first)


@pytest.mark.timeout(180)
def test_a_restarted_planner_completes_the_motion(run: Run) -> None:
    arm = run.start("robot", "-m", "manipulation_robot")
    planner = run.start("planner", "-m", "manipulation_stack")
    client = run.start("client", "-m", "manipulation_client", "--goals", "1")
    wait_moving(run)
    stop(planner)
    wait_held(run)
    left = len(robot(run, "command"))
    run.start("next", "-m", "manipulation_stack")
    # Where the task proxy would send the goal again, another client does.
    stop(client)
    again = run.start("client", "-m", "manipulation_client", "--goals", "1")
    assert again.wait(90) == 0
    assert_reached(run)
    assert len(robot(run, "command")) > left
    assert_no_jump(run)
    arm.send_signal(signal.SIGTERM)
    assert arm.wait(20) == 0
    assert json.loads((run.folder / "robot.jsonl").read_text().splitlines()[0])["event"] == "started"


@pytest.mark.timeout(180)
def test_an_executing_standby_completes_the_motion_without_a_jump(run: Run) -> None:
    run.start("robot", "-m", "manipulation_robot")
    opened = run.folder / "opened"
    run.start("gate", NODES, str(opened))
    held = "/arm_controller/joint_trajectory:=/held/joint_trajectory"
    run.start("standby", "-m", "manipulation_stack", *ASIDE, "-r", held)
    planner = run.start("planner", "-m", "manipulation_stack")
    run.wait("the gate is there", lambda: run.records("gate"))
    # Where the task proxy would give the goals to both, each has a client.
    first = run.start("first", "-m", "manipulation_client", "--goals", "2")
    client = run.start("client", "-m", "manipulation_client", "--goals", "2", *ASIDE)
    # The second one's way leads round the post, and the two don't plan the same way round it.
    wait_moving(run, 2)
    stop(planner)
    stop(first)
    wait_held(run)
    opened.touch()
    assert client.wait(90) == 0
    assert_reached(run)
    assert_no_jump(run)


@pytest.mark.timeout(120)
def test_an_unreachable_pose_is_refused_with_the_reason(run: Run, tmp_path: Path) -> None:
    run.start("robot", "-m", "manipulation_robot")
    run.start("planner", "-m", "manipulation_stack")
    asking = tmp_path / "asking.py"
    asking.write_text(
        "import rclpy\n"
        "from manipulation_arm import Pose\n"
        "from manipulation_client.__main__ import Poser\n"
        "from navigation_robot.journal import Journal\n"
        "rclpy.init()\n"
        "Poser(Journal(None)).run([Pose(0.9, 0.0, 0.2), Pose(0.2, 0.0, 0.2, qw=0.0)])\n"
    )
    assert run.start("client", str(asking)).wait(90) == 0
    results = [record for record in run.records("client") if record["event"] == "result"]
    assert [(r["status"], r["error_code"]) for r in results] == [("aborted", 2), ("aborted", 1)]
    assert "reach" in results[0]["error_msg"]
    assert not robot(run, "command")


@pytest.mark.timeout(120)
def test_the_arm_executes_a_whole_trajectory_and_then_holds(run: Run, tmp_path: Path) -> None:
    run.start("robot", "-m", "manipulation_robot")
    asking = tmp_path / "asking.py"
    asking.write_text(
        "import json\n"
        "import rclpy\n"
        "from control_msgs.action import FollowJointTrajectory\n"
        "from manipulation_arm import HOME, JOINTS\n"
        "from rclpy.action import ActionClient\n"
        "from rclpy.node import Node\n"
        "from trajectory_msgs.msg import JointTrajectoryPoint\n"
        "rclpy.init()\n"
        "node = Node('asking')\n"
        "client = ActionClient(node, FollowJointTrajectory, '/arm_controller/follow_joint_trajectory')\n"
        "client.wait_for_server()\n"
        "goal = FollowJointTrajectory.Goal()\n"
        "goal.trajectory.joint_names = list(JOINTS)\n"
        "point = JointTrajectoryPoint(positions=(HOME + [0.5, 0, 0, 0, 0, 0]).tolist())\n"
        "point.time_from_start.sec = 1\n"
        "goal.trajectory.points = [point]\n"
        "sent = client.send_goal_async(goal)\n"
        "rclpy.spin_until_future_complete(node, sent)\n"
        "answer = sent.result().get_result_async()\n"
        "rclpy.spin_until_future_complete(node, answer)\n"
        "print(json.dumps({'event': 'answer', 'code': answer.result().result.error_code}), flush=True)\n"
    )
    client = run.start("client", str(asking))
    assert client.wait(60) == 0
    assert run.records("client") == [{"event": "answer", "code": 0}]
    wait_held(run)
    last = robot(run, "arm")[-1]
    assert math.atan2(last["y"], last["x"]) == pytest.approx(0.5, abs=0.02)
