"""While nobody drives the robot it receives the policy's safe command, and only then."""

from __future__ import annotations

import time
from itertools import pairwise

import pytest

from tests.e2e.scenario import Robot, eventually

SAFE = "safe"
AFTER, EVERY = 0.1, 0.05
LATE = 0.25
"""Seconds that a message or its sender may be held up by a busy machine."""


@pytest.mark.own_robot  # its policy is changed
def test_a_robot_without_an_active_instance_receives_the_safe_command(restarting: Robot) -> None:
    old = restarting.wait_protected()
    command = {"topic": "/cmd_vel", "every": "50ms", "message": {"header": {"frame_id": SAFE, "stamp": "now"}}}
    policy = restarting.get()["spec"]["failurePolicyRef"]["name"]
    restarting.kubectl.patch(
        "failurepolicy", policy, {"spec": {"safety": {"after": "100ms", "commands": [command]}, "priority": "Safety"}}
    )
    eventually(
        lambda: SAFE in str(restarting.kubectl("get", "failurepolicy", policy, "-o", "json")),
        within=10,
        what="the policy is changed",
    )
    time.sleep(3)  # the robot's reader and the monitor's new publisher get to know each other
    assert restarting.condition("Monitored").get("status") == "True", restarting.describe()
    assert not restarting.log().of(SAFE), "the application drives"

    restarting.fail(old, "frozen")
    recovery = restarting.wait_recovered(1)
    restarting.wait_protected()
    time.sleep(2)
    log = restarting.log()
    told = log.of(SAFE)
    fenced, first = recovery.moments["fenced"], log.of(recovery.new)[0].received
    print(
        f"\nfenced for {first - fenced:.3f} s; {len(told)} safe commands from {told[0].received - fenced:.3f} s after the fence "
        f"to {first - told[-1].received:.3f} s before the first command of {recovery.new}"
    )
    assert told[0].received >= fenced + AFTER - 0.01, "whoever was fenced is silent by then"
    assert told[0].received <= fenced + AFTER + EVERY + LATE
    assert told[-1].received <= first + EVERY, "the new instance's commands aren't contradicted"
    assert {(c.linear, c.angular) for c in told} == {(0.0, 0.0)}
    waiting = [c.received for c in told if c.received < recovery.moments["routed"] - LATE]
    assert max(b - a for a, b in pairwise(waiting)) <= EVERY + LATE, "and it is told again and again"
    still = [m for m in log.motions if told[0].received + 1.0 <= m.time <= first]
    assert all(abs(m.speed) < 0.01 for m in still), "so it stands"
