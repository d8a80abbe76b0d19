"""The discovery server is replaced under a robot that drives: nobody notices, and whoever comes later finds it all."""

from __future__ import annotations

import time

import pytest

from tests.e2e.scenario import Robot, eventually
from tests.e2e.test_strategies import assert_handed_over


def serving(robot: Robot) -> list[str]:
    """The ready pods of the discovery server."""
    selector = f"understudy.dev/monitored={robot.workload},understudy.dev/component=discovery"
    return [
        pod["metadata"]["name"]
        for pod in robot.kubectl.list("pods", selector)
        if not pod["metadata"].get("deletionTimestamp")
        and any(c["type"] == "Ready" and c["status"] == "True" for c in pod["status"].get("conditions", []))
    ]


@pytest.mark.long
@pytest.mark.parametrize("how", ["deleted", "by force"])
def test_another_discovery_server_knows_the_robot_that_was_there_before(executing: Robot, how: str) -> None:
    old = executing.wait_protected()
    before = serving(executing)
    options = ["--grace-period=0", "--force"] if how == "by force" else []
    executing.kubectl("delete", "pod", *before, "--wait=false", *options)
    eventually(
        lambda: (now := serving(executing)) and not set(now) & set(before),
        within=60,
        what="another server serves",
        note=executing.describe,
    )
    time.sleep(5.0)  # for as long it stays away, so that nobody takes it for the one before
    assert executing.status()["active"] == old, "nobody noticed"
    assert executing.recoveries() == []
    executing.delete(old, force=True)
    recovery = executing.wait_recovered(1)
    assert_handed_over(executing, recovery)
    # The standby was there before the server, the one that is made now was not: it has to find the robot by the new one.
    executing.wait_protected(180)
    executing.delete(recovery.new, force=True)
    recovery = executing.wait_recovered(2)
    assert_handed_over(executing, recovery)
