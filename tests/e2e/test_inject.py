"""Failures that a user makes to rehearse them: refused where nobody has allowed them, undone, and recovered from."""

from __future__ import annotations

import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.console import REPOSITORY, shell_environment, understudy
from tests.e2e.scenario import Robot
from tests.e2e.test_strategies import assert_handed_over

LENGTH = 3.0
WINDOW = 2.0
"""Seconds over which a rate is taken."""

SHARE = 90
"""Percent of the time for which a slow application is stopped."""


ALLOWED, STANDARD = "understudy.dev/allow-inject", "pod-security.kubernetes.io/enforce"


@pytest.fixture(autouse=True)
def forbidden_again(executing: Robot) -> Iterator[None]:
    """What a test allows in the robot's namespace isn't allowed to the next one."""
    yield
    executing.kubectl.label_namespace(f"{ALLOWED}-", f"{STANDARD}-")


def rate(robot: Robot, pod: str, begin: float) -> float:
    """Commands of a pod that reached the robot in a second, from a moment on."""
    return sum(begin < c.received <= begin + WINDOW for c in robot.log().of(pod)) / WINDOW


def lowest_rate(robot: Robot, pod: str, begin: float, end: float) -> float:
    """The lowest between two moments."""
    received = [c.received for c in robot.log().of(pod)]
    begins = [begin + step / 10 for step in range(int(10 * (end - WINDOW - begin)))]
    return min(sum(one < at <= one + WINDOW for at in received) for one in begins) / WINDOW


def test_failures_are_injected_only_in_a_namespace_that_allows_them(executing: Robot) -> None:
    kubectl, name = executing.kubectl, executing.workload
    active = executing.wait_protected()
    executing.wait_standby()

    refused = understudy(kubectl, "inject", name, "kill", "--yes")
    assert refused.returncode == 2
    assert f"kubectl label namespace {kubectl.namespace} {ALLOWED}=true" in refused.stderr
    assert executing.has_pod(active)
    kubectl.label_namespace(f"{ALLOWED}=true", f"{STANDARD}=baseline")
    refused = understudy(kubectl, "inject", name, "partition", "--yes")
    assert refused.returncode == 2
    assert f"kubectl label --overwrite namespace {kubectl.namespace} {STANDARD}=privileged" in refused.stderr
    kubectl.label_namespace(f"{STANDARD}=privileged")

    # While it is left alone, what undoes a fault is seen.
    assert understudy(kubectl, "pause", name, "--reason", "a rehearsal").returncode == 0
    time.sleep(2)
    for fault in (["freeze"], ["slow", "--percent", str(SHARE)], ["partition"]):
        begun = time.time()
        healthy = rate(executing, active, begun - WINDOW)
        done = understudy(kubectl, "inject", name, *fault, "--for", f"{LENGTH:g}s", "--yes")
        assert done.returncode == 0, done.stderr
        ended = time.time()
        lowest = lowest_rate(executing, active, begun, ended)
        assert lowest < healthy / 1.5, f"{fault[0]}: {lowest} Hz instead of {healthy} Hz"
        assert (lowest == 0) == (fault[0] != "slow")
        time.sleep(WINDOW + 0.5)
        assert rate(executing, active, ended) > healthy / 1.5, "it goes on"
    assert understudy(kubectl, "resume", name).returncode == 0
    executing.wait_protected()

    assert understudy(kubectl, "inject", name, "freeze", "--for", "5s", "--yes").returncode == 0
    first = executing.wait_recovered(1)
    assert (first.old, first.strategy) == (active, "Fallback/Executing")
    executing.wait_protected()
    executing.wait_standby()
    assert understudy(kubectl, "inject", name, "kill", "--yes").returncode == 0
    assert executing.wait_recovered(2).old == first.new


def test_a_pod_that_is_cut_off_is_replaced_and_never_drives_beside_its_successor(executing: Robot) -> None:
    kubectl, name = executing.kubectl, executing.workload
    kubectl.label_namespace(f"{ALLOWED}=true")
    active = executing.wait_protected()

    # From everything; then from the monitor alone, which hears nothing of it while it drives on until the gate is closed to it.
    for number, whom in ((1, []), (2, ["--from", "monitor"])):
        executing.wait_standby()
        done = understudy(kubectl, "inject", name, "partition", *whom, "--for", "10s", "--yes")
        assert done.returncode == 0, done.stderr
        recovery = executing.wait_recovered(number)
        assert (recovery.old, recovery.strategy) == (active, "Fallback/Executing")
        active = executing.wait_protected()
        assert active == recovery.new
        assert_handed_over(executing, recovery)
        detected = recovery.moments["detected"]
        driven_on = [c for c in executing.log().of(recovery.old) if detected - 0.3 < c.received < detected]
        assert bool(driven_on) == bool(whom), "what the robot received while the monitor received nothing"
    assert len(executing.recoveries()) == 2


@pytest.mark.long
def test_the_script_for_ci_ends_well_after_a_failure_that_was_recovered(executing: Robot, tmp_path: Path) -> None:
    kubectl, page = executing.kubectl, (REPOSITORY / "docs/how-to/rehearsing-failures.md").read_text()
    (script,) = re.findall(r"```sh\n(set -eu\n.*?)```", page, re.DOTALL)
    executing.wait_standby()
    kubectl.label_namespace(f"{ALLOWED}=true")

    environment = shell_environment(kubectl.kubeconfig, tmp_path, namespace=kubectl.namespace)
    done = subprocess.run(
        ["bash", "-c", script, "rehearse.sh", executing.workload],
        env=environment, capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    print(done.stdout, done.stderr)
    assert done.returncode == 0
    assert re.search(r"^Fallback/Executing in [\d.]+ s$", done.stdout, re.MULTILINE)
