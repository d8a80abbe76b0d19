"""What is kept of a real failure, fetched as a user would and opened as a bag of rosbag2's; and the policy, tried over it."""

from __future__ import annotations

import json
import time
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader

from tests.e2e.console import offline, understudy
from tests.e2e.scenario import Robot, eventually
from understudy.api.base import seconds
from understudy.cli.simulate.bags import Bag, BagTrack

COMMANDS, EVENTS, TREE = "/cmd_vel", "/understudy/events", "/understudy/tree"
KEPT = 5.0
"""Seconds before the failure that are kept."""


def told(robot: Robot) -> dict[str, Any]:
    done = understudy(robot.kubectl, "blackbox", robot.workload, "-o", "json")
    found: dict[str, Any] = json.loads(done.stdout or "{}")
    return found


def messages(bag: Bag, topic: str) -> list[tuple[BagTrack, Any]]:
    (type_,) = bag.topics[topic].types
    return [(taken, bag.definitions.read(taken.data, type_)) for taken in bag.messages({topic: type_})]


@pytest.mark.own_robot  # its policy is changed, and the first recovery is number 1
def test_the_black_box_keeps_a_failure_and_the_time_before_it(executing: Robot, tmp_path: Path) -> None:
    old = executing.wait_protected()
    executing.kubectl.patch("failurepolicy", "quickstart-executing", {"spec": {"blackBox": {"window": f"{KEPT:g}s"}}})
    eventually(lambda: told(executing).get("on"), within=30, every=1.0, what="the black box is on")
    time.sleep(KEPT)
    executing.fail(old, "frozen")
    recovery = executing.wait_recovered(1)
    (kept,) = eventually(lambda: told(executing).get("recordings"), within=30, every=1.0, what="it is recorded")
    assert (kept["number"], kept["result"], kept["strategy"]) == (1, "Recovered", "Fallback/Executing")
    path = tmp_path / "failure.mcap"
    fetched = understudy(executing.kubectl, "blackbox", executing.workload, "--fetch", "--to", str(path))
    assert fetched.returncode == 0, fetched.stderr
    assert path.stat().st_size == kept["size"]

    last, detected = recovery.moments["lastHealthy"], recovery.moments["detected"]
    with Bag.open(str(path)) as bag:
        commands = [(taken.received, command) for taken, command in messages(bag, COMMANDS)]
        before = [(at, command) for at, command in commands if at <= last + 0.001]
        assert before[-1][0] == pytest.approx(last, abs=0.002), "the last command before the failure is in it"
        assert before[0][0] < last - KEPT / 2
        assert {command.header.frame_id for _, command in before} == {old}, (
            "the quickstart's commands say who sent them"
        )
        assert commands[-1][1].header.frame_id == recovery.new, "those of the one that took over are in it too"
        driven = [value for command in executing.log().of(old) for value in (command.linear, command.angular)]
        recorded = [value for _, one in before for value in (one.twist.linear.x, one.twist.angular.z)]
        assert recorded[-40:] == pytest.approx(driven[-40:], abs=1e-3), "as the robot had them"
        logs = [(taken.received, log.level, log.name, log.msg) for taken, log in messages(bag, EVENTS)]
        (failed,) = [log for log in logs if log[3].startswith("detected: ")]
        assert abs(failed[0] - detected) < 0.001
        assert failed[3] == f"detected: {kept['reason']}"
        assert any(name == f"RobotWorkload/{executing.workload}" and "Recovered" in text for _, _, name, text in logs)
        traces = [json.loads(message.data) for _, message in messages(bag, TREE)]
    assert {"Healthy", "Failed"} <= {node["state"] for trace in traces for node in trace["tree"]["children"]}
    policy = tmp_path / "policy.yaml"
    policy.write_text(executing.kubectl("get", "failurepolicy", "quickstart-executing", "-o", "yaml"))
    simulated = offline("simulate", str(policy), "--bag", str(path), "-o", "json")
    assert simulated.returncode == 1, simulated.stderr
    found = [datetime.fromisoformat(one["detectedWall"]) for one in json.loads(simulated.stdout)["detections"]]
    assert min(abs(one.timestamp() - detected) for one in found) < 0.1, "as its monitor did"
    learnt = offline("learn", "--bag", str(path), "--topic", COMMANDS)
    assert learnt.returncode == 0, learnt.stderr
    (leaf,) = yaml.safe_load(learnt.stdout)["parallel"]
    assert leaf["topic"]["name"] == COMMANDS
    assert seconds(leaf["topic"]["gap"]) > 2 * 0.5, "the silence is in it: bounds are to be learnt where all was well"
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        (metadata,), summary = reader.iter_metadata(), reader.get_summary()
    assert summary is not None
    offered = {one.topic: yaml.safe_load(one.metadata["offered_qos_profiles"]) for one in summary.channels.values()}
    assert {one["reliability"] for one in offered[COMMANDS]} == {"reliable"}
    assert metadata.metadata["workload"] == executing.workload
