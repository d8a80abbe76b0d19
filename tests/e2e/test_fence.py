"""A robot is fenced by hand, seen from the robot; and what a robot outside the cluster is given is what the one inside has."""

from __future__ import annotations

import json
import time

import pytest

from tests.e2e.console import understudy
from tests.e2e.scenario import Robot

ENFORCED_WITHIN = 0.5
"""Seconds after which nothing may come through a closed gate, on a machine that is busy with other things."""


def test_nobody_drives_a_robot_that_was_fenced_until_somebody_resumes(executing: Robot) -> None:
    kubectl, name = executing.kubectl, executing.workload
    active = executing.wait_protected()
    executing.wait_standby()
    epoch = executing.status()["gate"]["epoch"]

    asked = understudy(kubectl, "fence", name, "--reason", "it is in the wrong aisle")
    assert asked.returncode == 2, "there is no terminal to ask in"
    assert "give --yes to confirm" in asked.stderr
    assert not executing.get()["spec"].get("pause")

    done = understudy(kubectl, "fence", name, "--reason", "it is in the wrong aisle", "--owner", "ann", "--yes")
    fenced = time.time()
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"gate closed at epoch {epoch + 1} (fenced: {active})." in done.stdout
    assert "The workload is paused by ann: fenced: it is in the wrong aisle." in done.stdout
    executing.replace_monitor()
    time.sleep(5)
    late = [c for c in executing.log().commands if c.received > fenced + ENFORCED_WITHIN]
    assert not late, f"{late[0].source} drove {late[0].received - fenced:.3f} s after it was fenced"
    assert executing.has_pod(active)
    assert executing.recoveries() == []
    assert executing.condition("Paused")["status"] == "True"

    assert understudy(kubectl, "resume", name).returncode == 0
    executing.wait_protected()


@pytest.mark.network_policy  # with a mux, the robot needs no profile
def test_a_robot_outside_the_cluster_gets_the_same_profile_as_one_inside(restarting: Robot) -> None:
    kubectl, name = restarting.kubectl, restarting.workload
    told = understudy(kubectl, "robot-profile", name, "-o", "json")
    assert told.returncode == 0, told.stderr
    given = json.loads(told.stdout)
    inside = kubectl.shell(restarting.robot_pod(), "robot", 'cat "$FASTRTPS_DEFAULT_PROFILES_FILE"; env')
    assert given["files"]["profiles.xml"].strip() in inside
    assert set(given["files"]["ros.env"].split()) <= set(inside.split())
    assert given["ports"] == {"/cmd_vel": 7950}
