"""Planned switchovers, seen from the robot: asked for in the console, and by a node that is drained."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from understudy_demo.recovery import Recovered

from tests.e2e.console import REPOSITORY, shell_environment, understudy
from tests.e2e.kubectl import Failed, Kubectl
from tests.e2e.scenario import Robot, eventually
from tests.e2e.test_strategies import ENFORCEMENT, assert_handed_over
from understudy.api import names

PERIOD = 0.05
"""Seconds between two commands of the quickstart's application."""

BUSY = 0.1
"""Seconds that a command may be late on a machine that is busy with other things."""

ATTRIBUTED = 0.75
"""Seconds until a mux has learned from discovery whose writers those of an instance are that has just started to send."""


@pytest.fixture
def cordoned(kubectl: Kubectl) -> Iterator[list[str]]:
    """The nodes that a test has cordoned, which is undone."""
    found: list[str] = []
    yield found
    for node in found:
        kubectl("uncordon", node)


def assert_unnoticed(robot: Robot, recovery: Recovered, *, kind: str) -> None:
    """The robot was never without commands for longer than ever, and never driven by two."""
    assert_handed_over(robot, recovery)
    handover = robot.log().handover(recovery.old, recovery.new, switch=recovery.moments["decided"])
    assert handover.gap is not None
    attributed = ATTRIBUTED if robot.gate_kind == "Mux" else 0.0
    assert handover.gap <= PERIOD + ENFORCEMENT + BUSY + attributed
    entry = robot.record(recovery.number)
    assert (entry["planned"], entry["switchover"]) == (True, kind)
    assert entry["parts"]["detection"] == entry["parts"]["startup"] == entry["parts"]["reinitialization"] == 0
    said = robot.status()["switchover"]
    assert (said["kind"], said["phase"], said["recovery"]) == (kind, "Done", entry["id"])


def node_of(robot: Robot, pod: str) -> str:
    node: str = robot.kubectl.get("pod", pod)["spec"]["nodeName"]
    return node


def drain(robot: Robot, node: str, within: float = 120.0) -> None:
    """As an administrator does it, of this robot's instances only: other tests' pods stay. Raises Failed."""
    options = ("--ignore-daemonsets", "--delete-emptydir-data", f"--timeout={within:g}s")
    for label in (names.WORKLOAD, names.CLAIMED_BY):
        robot.kubectl("drain", node, f"--pod-selector={label}={robot.workload}", *options, timeout=within + 30)


def test_the_robot_does_not_notice_a_requested_switchover(executing: Robot, gate_kind: str) -> None:
    old = executing.wait_protected()
    executing.wait_standby()
    epoch = executing.status()["gate"]["epoch"]
    done = understudy(executing.kubectl, "failover", executing.workload, "--yes")
    assert done.returncode == 0, done.stderr
    assert f" by Fallback/Executing, gate epoch {epoch + 1}" in done.stdout
    # A mux does not report when it forwarded the last output of an instance.
    observed = "outputs of the new instance arrive" if gate_kind == "Mux" else "no command for "
    assert f"at the robot: {observed}" in done.stdout
    recovery = executing.wait_recovered(1)
    assert recovery.old == old
    assert_unnoticed(executing, recovery, kind="Failover")
    eventually(lambda: not executing.has_pod(old), within=60, what=f"{old} is gone", note=executing.describe)
    executing.replace_monitor()
    assert executing.wait_protected() == recovery.new
    time.sleep(3)
    assert len(executing.recoveries()) == 1, "a new monitor doesn't carry it out again"


@pytest.mark.long
def test_a_switchover_requested_by_annotation_works_as_documented(executing: Robot, tmp_path: Path) -> None:
    kubectl, page = executing.kubectl, (REPOSITORY / "docs" / "switchover.md").read_text()
    (typed,) = re.findall(r"```sh\n(asked=.*?)```", page, re.DOTALL)
    executing.wait_protected()
    executing.wait_standby()
    environment = shell_environment(kubectl.kubeconfig, tmp_path, namespace=kubectl.namespace)
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", typed.replace("robot-17-navigation", executing.workload)],
        env=environment, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    print(done.stdout, done.stderr)
    assert done.returncode == 0
    assert "Done: " in done.stdout
    assert_unnoticed(executing, executing.wait_recovered(1), kind="Failover")


@pytest.mark.long
def test_an_initialized_standby_is_activated_before_the_switch(managed: Robot) -> None:
    managed.wait_protected()
    done = understudy(managed.kubectl, "failover", managed.workload, "--yes")
    assert done.returncode == 0, done.stdout + done.stderr
    recovery = managed.wait_recovered(1)
    assert recovery.strategy == "Fallback/Initialized", recovery
    assert_unnoticed(managed, recovery, kind="Failover")


def test_a_pod_of_a_shared_pool_takes_over_and_control_returns_to_the_workload_s_own_pod(uninitialized: Robot) -> None:
    uninitialized.wait_protected()
    done = understudy(uninitialized.kubectl, "failover", uninitialized.workload, "--yes")
    assert done.returncode == 0, done.stdout + done.stderr
    away = uninitialized.wait_recovered(1)
    assert away.strategy == "Fallback/Uninitialized", away
    assert_unnoticed(uninitialized, away, kind="Failover")
    assert uninitialized.wait_protected() == away.new

    done = understudy(uninitialized.kubectl, "failback", uninitialized.workload, "--yes")
    assert done.returncode == 0, done.stdout + done.stderr
    home = uninitialized.wait_recovered(2)
    assert home.old == away.new
    assert_unnoticed(uninitialized, home, kind="Failback")
    labels = uninitialized.kubectl.get("pod", home.new)["metadata"]["labels"]
    assert labels.get("understudy.dev/source") == "workload"
    again = understudy(uninitialized.kubectl, "failback", uninitialized.workload, "--yes")
    assert again.returncode == 0
    assert "is active already" in " ".join(again.stdout.split())  # lines end where the terminal ends
    assert len(uninitialized.recoveries()) == 2


@pytest.mark.long
def test_a_switchover_without_an_understudy_is_refused_with_the_reason(restarting: Robot) -> None:
    active = restarting.wait_protected()
    done = understudy(restarting.kubectl, "failover", restarting.workload, "--yes")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "NOT done: " in done.stdout
    assert "runs only one pod, and this pod is active" in " ".join(done.stdout.split())
    assert restarting.wait_driven() == active
    assert restarting.recoveries() == []


def test_a_drained_node_lets_its_robot_be_driven_from_another_one_first(executing: Robot, cordoned: list[str]) -> None:
    old = executing.wait_protected()
    executing.wait_standby()
    node = node_of(executing, old)
    cordoned.append(node)
    drain(executing, node)
    recovery = executing.wait_recovered(1)
    assert recovery.old == old
    assert_unnoticed(executing, recovery, kind="Drain")
    assert node_of(executing, recovery.new) != node
    executing.wait_protected()
    eventually(lambda: not executing.condition("Draining"), within=30, what="that is over", note=executing.describe)


def test_an_eviction_waits_until_an_understudy_is_ready(managed: Robot, cordoned: list[str]) -> None:
    old = managed.wait_protected()
    node = node_of(managed, old)
    cordoned.append(node)
    drain(managed, node)
    recovery = managed.wait_recovered(1)
    assert_unnoticed(managed, recovery, kind="Drain")
    assert node_of(managed, recovery.new) != node


@pytest.mark.long
def test_evictions_are_not_held_up_for_ever(executing: Robot, cordoned: list[str]) -> None:
    kubectl = executing.kubectl
    old = executing.wait_protected()
    kubectl.patch("fallbackpool", "quickstart-executing", {"spec": {"perWorkload": 0}})
    kubectl.patch("robotworkload", executing.workload, {"spec": {"draining": {"holdFor": "30s"}}})
    eventually(lambda: len(executing.pods()) == 1, within=60, what="no standby is left", note=executing.describe)
    node = node_of(executing, old)
    cordoned.append(node)
    kubectl("cordon", node)
    eventually(
        lambda: executing.condition("Draining").get("status") == "True",
        within=10,
        what="the drain is noticed",
        note=executing.describe,
    )
    with pytest.raises(Failed, match="disruption budget"):
        drain(executing, node, within=5)
    assert executing.wait_driven() == old, "the eviction waits"
    eventually(
        lambda: executing.condition("Draining").get("reason") == "HoldEnded",
        within=60,
        what="nobody is held up any longer",
        note=executing.describe,
    )
    drain(executing, node)
    recovery = executing.wait_recovered(1)
    assert (recovery.strategy, recovery.old) == ("Restart", old)
    assert not executing.record(1)["planned"]
    executing.wait_driven()
