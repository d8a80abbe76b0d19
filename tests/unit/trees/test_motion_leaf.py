"""The leaf `motion`: what it says of a robot that is seen from outside, and what it leaves to others."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.support.golden import assert_golden
from tests.support.ros_messages import Odometry, Twist, TwistStamped, TwistWithCovariance, Vector3
from tests.unit.trees.world import START, TASK, World, mistakes, states_in_both_forms, written
from understudy.trees.core.health_tree import SEVERITY, Verdict
from understudy.trees.languages.short.health_loader import TreeError, load
from understudy.trees.languages.short.procedure_loader import load_procedure

ODOMETRY, COMMANDS = "/tracker/robot/odometry", "/cmd_vel"
FAILED = (
    "the robot does not move as /cmd_vel commands, according to /tracker/robot/odometry: "
    "forward 0.00 m/s observed, 0.30 m/s commanded"
)


def leaf(**more: Any) -> dict[str, Any]:
    return {"motion": {"topic": ODOMETRY, "commands": COMMANDS, **more}}


def twist(speed: float, turn: float = 0.0) -> Twist:
    return Twist(Vector3(x=speed), Vector3(z=turn))


def odometry(speed: float, turn: float = 0.0, variance: float = 1e-6) -> Odometry:
    covariance = [variance if index % 7 == 0 else 0.0 for index in range(36)]
    return Odometry(TwistWithCovariance(twist(speed, turn), covariance))


def drive(
    world: World,
    begin: float,
    end: float,
    measured: float | None,
    commanded: float | None = 0.3,
    *,
    stamped: bool = False,
    look: bool = True,
) -> World:
    """Commands and odometry at 10 Hz from one time to another, each looked at as it comes."""
    for tick in range(round((end - begin) * 10)):
        now = begin + tick / 10
        if commanded is not None:
            world.hear(COMMANDS, now, TwistStamped(twist(commanded)) if stamped else twist(commanded))
        if measured is not None:
            world.hear(ODOMETRY, now + 0.01, odometry(measured))
        if look:
            world.at(now + 0.01)
    return world


@pytest.mark.parametrize("stamped", [False, True])
def test_the_leaf_fails_if_the_robot_stands_despite_a_command(stamped):
    world = drive(World(leaf()), 1.0, 4.0, 0.3, stamped=stamped)
    assert world.at(4.0) == Verdict("Healthy", "", "", None)
    assert world.deadline(4.0) is None
    drive(world, 4.0, 5.0, 0.0, stamped=stamped)
    assert world.at(5.0) == Verdict("Failed", FAILED, "tracker/robot.motion", pytest.approx(START + 4.01))
    drive(world, 5.0, 6.0, 0.3, stamped=stamped)
    assert world.at(6.0).state == "Healthy"


def test_several_messages_in_one_evaluation_are_all_considered():
    world = drive(World(leaf()), 1.0, 4.0, 0.3, look=False)
    assert world.at(4.0).state == "Healthy"
    drive(world, 4.0, 5.0, 0.0, look=False)
    assert world.at(5.0).reason == FAILED


def test_a_robot_that_is_commanded_to_stop_may_stand():
    world = drive(World(leaf()), 1.0, 4.0, 0.3)
    drive(world, 4.0, 4.5, 0.2, commanded=0.0)
    assert drive(world, 4.5, 9.0, 0.0, commanded=0.0).at(9.0).state == "Healthy"


def test_a_small_slip_is_tolerated():
    assert drive(World(leaf()), 1.0, 30.0, 0.26).at(30.0).state == "Healthy"
    strict = leaf(slip="1 %", tolerance="0.005 m/s")
    assert drive(World(strict), 1.0, 30.0, 0.26).at(30.0).state == "Failed"


def test_a_robot_out_of_sight_is_undecided_and_does_not_fail():
    world = drive(World(leaf()), 1.0, 4.0, 0.3)
    assert drive(world, 4.0, 20.0, None).at(20.0).state == "Healthy"
    # Nor does one that had failed stay so.
    drive(world, 20.0, 24.0, 0.0)
    assert world.at(24.0).state == "Failed"
    assert world.deadline(24.0) is None
    drive(world, 24.0, 24.8, None)
    assert world.at(24.8).state == "Failed"
    assert world.at(23.91 + 1.0).state == "Healthy"


def test_without_observations_or_commands_the_leaf_is_healthy():
    world = World(leaf(), grace=2)
    assert world.at(0.5).state == "Healthy"
    assert drive(world, 1.0, 9.0, None).at(9.0).state == "Healthy"
    assert drive(World(leaf()), 1.0, 9.0, 0.5, commanded=None).at(9.0).state == "Healthy"


def test_the_node_reports_why_it_is_undecided():
    world = World(leaf())
    world.at(0.5)
    (node,) = world.tree.root.iterate() if world.tree.root is not None else ()
    assert_golden("health_tree", node.reason("Healthy"), "/cmd_vel", "/tracker/robot/odometry")
    drive(world, 1.0, 3.0, 0.3)
    assert node.reason("Healthy") == "the robot moves as /cmd_vel commands"
    world.hear(COMMANDS, 3.0, "it is no Twist").at(3.0)
    assert_golden("health_tree", node.reason("Healthy"), "/cmd_vel")
    world.hear(ODOMETRY, 3.1, odometry(math.nan)).at(3.1)
    assert "(nan, 0.0, 0.0) is no velocity" in node.reason("Healthy")


def test_the_next_instance_is_judged_by_its_own_commands():
    world = drive(World(leaf()), 1.0, 4.0, 0.3)
    drive(world, 4.0, 5.0, 0.0)
    assert world.at(5.0).state == "Failed"
    world.since = START + 5.0
    assert world.at(5.01).state == "Healthy"
    assert drive(world, 5.1, 7.5, 0.0).at(7.5).state == "Failed"


def test_only_the_active_instance_is_judged_by_the_motion_of_the_robot():
    world = drive(World(leaf()), 1.0, 4.0, 0.3, look=False)
    drive(world, 4.0, 6.0, 0.0, look=False)
    observed = world.observed()
    observed.in_control = False
    assert world.tree.evaluate(observed, now=START + 6.0, since=START).state == "Healthy"
    assert world.at(6.0).state == "Failed"


def test_for_a_task_only_motion_during_the_task_counts():
    world = drive(World({**TASK, "do": leaf()}), 1.0, 6.0, 0.0)
    assert world.at(6.0).state == "Healthy"
    world.task = 6.0
    drive(world, 6.0, 6.9, 0.0)
    assert world.at(6.9).state == "Healthy", "it has a second to settle"
    drive(world, 6.9, 8.5, 0.0)
    assert world.at(8.5).reason == f"{FAILED} while a goal of /go is active"
    world.task = None
    assert world.at(8.6).state == "Healthy"


def test_a_clock_step_moves_remembered_times():
    world = drive(World(leaf()), 1.0, 4.0, 0.3)
    for record in world.records.values():
        record.shift(3600.0)
    drive(world, 3604.0, 3605.0, 0.0)
    assert world.at(3605.0).state == "Failed"


def test_the_leaf_needs_both_topics_and_is_left_out_without_one():
    tree = load({"parallel": [leaf(type="geometry_msgs/msg/Twist"), {"topic": {"name": "/scan", "gap": "1s"}}]})
    found = {topic.name: topic for topic in tree.topics}
    assert found[ODOMETRY].type == "nav_msgs/msg/Odometry"
    assert found[COMMANDS].type == "geometry_msgs/msg/Twist"
    assert all(found[name].whole and found[name].contents for name in (ODOMETRY, COMMANDS))
    for name in (ODOMETRY, COMMANDS):
        tree.leave_out({name})
        assert tree.root is not None
        assert [node.name for node in tree.root.iterate() if not node.children] == ["scan"]


def test_after_a_switchover_odometry_is_expected_and_commands_are_not():
    world = drive(World(leaf()), 1.0, 2.0, 0.3)
    assert world.tree.counting(world.observed(), now=START + 2.0, since=START) == {ODOMETRY}


def test_the_leaf_and_a_gap_of_its_topic_are_judged_separately():
    world = drive(World({"parallel": [leaf(), {"topic": {"name": COMMANDS, "gap": "500ms"}}]}), 1.0, 3.0, 0.3)
    assert world.at(3.0).state == "Healthy"
    drive(world, 3.0, 4.0, 0.3, commanded=None)
    assert world.at(4.0).leaf == "cmd_vel"


def test_a_procedure_cannot_contain_the_leaf():
    with pytest.raises(TreeError, match=r"unknown key 'motion'"):
        load_procedure({"sequence": [leaf()]}, path="spec.yaml")


@pytest.mark.parametrize(
    ("found", "place", "expected"),
    [
        (
            COMMANDS,
            "",
            "found '/cmd_vel'; 'motion' must be a mapping such as {topic: /tracker/robot/odometry, commands: /cmd_vel}",
        ),
        (
            {"commands": COMMANDS},
            ".topic",
            "missing; give the topic's fully qualified name, such as /tracker/robot/odometry",
        ),
        ({"topic": ODOMETRY}, ".commands", "missing; give the topic's fully qualified name, such as /cmd_vel"),
        (
            {"topic": COMMANDS, "commands": COMMANDS},
            ".commands",
            "found '/cmd_vel', which is the topic too; give the topic of the commands",
        ),
        (leaf(commands="cmd_vel")["motion"], ".commands", "found 'cmd_vel'; did you mean '/cmd_vel'?"),
        (
            leaf(type="std_msgs/msg/String")["motion"],
            ".type",
            "found 'std_msgs/msg/String'; commands are of geometry_msgs/msg/Twist or geometry_msgs/msg/TwistStamped",
        ),
        (leaf(slip=0.2)["motion"], ".slip", "found 0.2; write a number with %, such as 20 %"),
        (leaf(slip="20 m/s")["motion"], ".slip", "found '20 m/s'; write a number with %, such as 20 %"),
        (leaf(tolerance="0 m/s")["motion"], ".tolerance", "found '0 m/s'; give 0.001 to 100 m/s"),
        (
            leaf(acceleration="1 m/s")["motion"],
            ".acceleration",
            "found '1 m/s'; write a number with m/s2, such as 0.5 m/s2",
        ),
        (
            leaf(delay=0.3)["motion"],
            ".delay",
            "found 0.3, which has no unit; write it with ms, s, m or h, such as 500ms",
        ),
        (leaf(delays="1s")["motion"], ".delays", "unknown key 'delays', did you mean 'delay'?"),
    ],
)
def test_a_mistake_is_reported_with_its_place_and_the_valid_values(found, place, expected):
    assert mistakes("motion", found) == [f"{place}: {expected}"]


def test_xml_gives_the_same_leaf_as_the_short_form():
    more = {
        "type": "geometry_msgs/msg/TwistStamped",
        "delay": "200ms",
        "window": "400ms",
        "acceleration": "0.7 m/s2",
        "turn_acceleration": "2 rad/s2",
        "slip": "10 %",
        "tolerance": "0.02 m/s",
        "turn_tolerance": "0.2 rad/s",
    }
    short = leaf(**more)
    ports = " ".join(f'{key}="{value}"' for key, value in short["motion"].items())

    def driven(world: World) -> Iterator[Verdict | float | None]:
        for begin, measured in ((1.0, 0.3), (2.0, 0.3), (3.0, 0.0), (4.0, 0.3), (5.0, None)):
            drive(world, begin, begin + 1.0, measured, stamped=True)
            yield from (world.at(begin + 1.0), world.deadline(begin + 1.0))

    states = states_in_both_forms(written(f"<Motion {ports}/>"), short, driven)
    assert states == ["Healthy", "Healthy", "Healthy", "Failed", "Healthy", "Healthy"]


@settings(max_examples=60, deadline=None)
@given(
    runs=st.lists(st.tuples(st.integers(1, 15), st.sampled_from([0.3, 0.0, None])), max_size=6),
    node=st.sampled_from([leaf(), {"inverter": leaf()}, {**TASK, "do": leaf()}]),
    task=st.none() | st.integers(0, 40),
    after=st.integers(0, 20),
)
def test_the_deadline_is_the_first_moment_with_a_worse_verdict(runs, node, task, after):
    """Times in tenths of a second."""
    world, now = World(node, grace=2.0), 1.0
    for length, measured in runs:
        drive(world, now, now + length / 10, measured, commanded=0.3)
        now += length / 10
        if task is not None and task / 10 <= now:
            world.task = task / 10
    now += after / 10
    present = SEVERITY[world.at(now).state]
    deadline = world.deadline(now)
    assert SEVERITY[world.at(now).state] == present
    later = [now + step / 100 for step in range(1, 400)]
    worse = next((time for time in later if SEVERITY[world.at(time).state] > present), None)
    if deadline is None:
        assert worse is None
    else:
        assert worse is not None
        assert math.isclose(worse, deadline, abs_tol=0.011)
        assert SEVERITY[world.at(deadline + 1e-5).state] > present
        assert SEVERITY[world.at(deadline - 1e-5).state] <= present
