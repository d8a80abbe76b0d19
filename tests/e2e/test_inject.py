"""Failures that a user makes to rehearse them: refused where nobody has allowed them, undone, and recovered from."""

from __future__ import annotations

import time

from tests.e2e.console import understudy
from tests.e2e.scenario import Robot

LENGTH = 3.0
SHARE = 0.9
"""Of the time for which a slow application is stopped."""


def rate(robot: Robot, pod: str, begin: float, end: float) -> float:
    """Commands of a pod that reached the robot in a second."""
    return sum(begin < c.received < end for c in robot.log().of(pod)) / (end - begin)


def test_failures_are_made_where_they_are_allowed(executing: Robot) -> None:
    kubectl, name = executing.kubectl, executing.workload
    active = executing.wait_protected()
    executing.wait_standby()

    refused = understudy(kubectl, "inject", name, "kill", "--yes")
    assert refused.returncode == 2
    assert f"kubectl label namespace {kubectl.namespace} understudy.dev/allow-inject=true" in refused.stderr
    assert executing.has_pod(active)
    kubectl("label", "namespace", kubectl.namespace, "understudy.dev/allow-inject=true")

    # While it is left alone, what undoes a fault is seen.
    assert understudy(kubectl, "pause", name, "--reason", "a rehearsal").returncode == 0
    time.sleep(2)
    for fault in (["freeze"], ["slow", "--percent", f"{100 * SHARE:.0f}"]):
        healthy = rate(executing, active, time.time() - 2, time.time())
        begun = time.time()
        done = understudy(kubectl, "inject", name, *fault, "--for", f"{LENGTH:g}s", "--yes")
        ended = time.time()
        assert done.returncode == 0, done.stderr
        failing = rate(executing, active, ended - LENGTH + 0.5, ended - 0.5)
        assert failing < healthy / 1.5, f"{fault[0]}: {failing} Hz instead of {healthy} Hz since {begun}"
        assert (failing == 0) == (fault[0] == "freeze")
        time.sleep(2)
        assert rate(executing, active, time.time() - 1.5, time.time()) > healthy / 1.5, "it goes on"
    assert understudy(kubectl, "resume", name).returncode == 0
    executing.wait_protected()

    assert understudy(kubectl, "inject", name, "freeze", "--for", "5s", "--yes").returncode == 0
    first = executing.wait_recovered(1)
    assert (first.old, first.strategy) == (active, "Fallback/Executing")
    executing.wait_protected()
    executing.wait_standby()
    assert understudy(kubectl, "inject", name, "kill", "--yes").returncode == 0
    assert executing.wait_recovered(2).old == first.new
