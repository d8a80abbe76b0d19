"""The chart as one runs it in production (docs/how-to/production.md): in namespaces at Pod Security `restricted`, verified by `helm
test`, and upgraded while robots are driven.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import pytest
import yaml

from tests.e2e.conftest import CHART, SYSTEM, install
from tests.e2e.kubectl import Kubectl, Object, helm
from tests.e2e.scenario import Robot, eventually, manifest
from tests.e2e.test_strategies import assert_handed_over
from tests.support.cluster import account
from tests.support.rights import OF_ALL, WHO_WAITS, Right, listed, named, of_all
from understudy.api import names

LONGEST = 0.45
"""Seconds without a command, which is due every 50 ms; after 500 ms the robot stops by itself."""


@pytest.fixture
def restricted(kubectl: Kubectl) -> Kubectl:
    """kubectl in a namespace in which no pod may do more than Pod Security `restricted` allows."""
    kubectl("label", "namespace", kubectl.namespace, "pod-security.kubernetes.io/enforce=restricted")
    return kubectl


def protected(kubectl: Kubectl, strategy: str) -> Robot:
    """A robot whose application is protected by one of the quickstart's strategies."""
    robot = Robot(kubectl)
    kubectl.apply(manifest(f"strategies/{strategy}.yaml"))
    kubectl.apply(robot.objects(policy=f"quickstart-{strategy}"))
    return robot


def test_the_operator_s_namespace_is_restricted(release: Kubectl) -> None:
    labels = release.get("namespace", SYSTEM)["metadata"]["labels"]
    assert labels["pod-security.kubernetes.io/enforce"] == "restricted", "the chart was installed in it"


@pytest.mark.parametrize("strategy", ["executing", pytest.param("uninitialized", marks=pytest.mark.long)])
def test_a_robot_in_a_restricted_namespace_is_protected_and_recovered(restricted: Kubectl, strategy: str) -> None:
    robot = protected(restricted, strategy)
    old = robot.wait_protected()
    user = account(restricted.namespace, names.monitor_account(robot.workload))

    def rights() -> list[Right]:
        return listed(restricted("auth", "can-i", "--list", f"--as={user}"))

    eventually(
        lambda: "failurepolicies.understudy.dev" not in of_all(rights()),
        within=20, what="its monitor has said that it asks by name", note=robot.describe,
    )  # fmt: skip
    assert of_all(rights()) == OF_ALL | (WHO_WAITS if strategy == "uninitialized" else {})
    assert named(rights())["failurepolicies.understudy.dev"] == {f"quickstart-{strategy}"}
    robot.fail(old, "killed")
    assert_handed_over(robot, robot.wait_recovered(1))


@pytest.mark.long
def test_another_policy_is_followed_by_a_monitor_that_may_read_its_own_only(restricted: Kubectl) -> None:
    """In a restricted namespace, as each right has to be given: the next one's comes with the change."""
    robot = protected(restricted, "executing")
    old = robot.wait_protected()
    (policy,) = [item for item in manifest("strategies/executing.yaml") if item["kind"] == "FailurePolicy"]
    policy["metadata"]["name"] = "patient"
    policy["spec"]["monitoring"] = {"yaml": {"topic": {"name": "/cmd_vel", "gap": "4s"}}}
    restricted.apply([policy])
    refer = {"spec": {"failurePolicyRef": {"name": "patient"}}}
    restricted("patch", "robotworkload", robot.workload, "--type=merge", "--patch", json.dumps(refer))
    user = account(restricted.namespace, names.monitor_account(robot.workload))

    def may_read() -> set[str]:
        return named(listed(restricted("auth", "can-i", "--list", f"--as={user}"))).get(
            "failurepolicies.understudy.dev", set()
        )

    eventually(lambda: may_read() == {"patient"}, within=30, what="the right is the next one's", note=robot.describe)
    time.sleep(6)  # longer than a watch waits that was refused
    robot.fail(old, "frozen")
    recovery = robot.wait_recovered(1)
    assert recovery.parts["detection"] == pytest.approx(4, abs=1), "it is found by the next policy"
    assert_handed_over(robot, recovery)


@pytest.mark.long
def test_an_instance_is_fenced_in_a_restricted_namespace_too(restricted: Kubectl) -> None:
    """With the reflex, the application is begun by a script through which the agent can hold it: that takes no right."""
    restricted.apply(manifest("strategies/executing.yaml"))
    robot = Robot(restricted)

    def reflex(workload: Object) -> None:
        workload["spec"]["gate"] = {"reflex": {"deadline": "400ms"}}

    restricted.apply(robot.objects(policy="quickstart-executing", edit=reflex))
    robot.wait_protected()
    eventually(
        lambda: robot.condition("Reflex").get("reason") == "Armed", within=60, what="it's armed", note=robot.describe
    )


def test_helm_test_says_that_the_installation_works(release: Kubectl) -> None:
    said = helm(release.kubeconfig, "test", "understudy", "--namespace", SYSTEM, "--logs", "--timeout", "120s")
    assert "Phase:          Succeeded" in said
    lines = [line for line in said.splitlines() if line.startswith(("ok ", "FAILED"))]
    assert len(lines) == 5, said
    assert all(line.startswith("ok ") for line in lines), said


# -- upgrades -----------------------------------------------------------------------------------------------------------

ADDED = ("spec", "monitor", "resources")
"""A field that the earlier version of the chart doesn't know."""

NEW = ["registry"]
"""The Secrets with which images are pulled in production."""


@pytest.fixture
def earlier(release: Kubectl, tmp_path: Path) -> Iterator[None]:
    """The release is of an earlier version of the chart; afterwards it is that of this one again, whatever happened.

    It is this one with another version, definitions that lack a field, and pods that differ in what changes with every version: with
    Secrets that aren't there, all that has the monitor's image gets another template, as with another tag.
    """
    chart = tmp_path / "understudy"
    shutil.copytree(CHART, chart)
    metadata = yaml.safe_load((chart / "Chart.yaml").read_text())
    (chart / "Chart.yaml").write_text(yaml.safe_dump(metadata | {"version": "0.0.9", "appVersion": "0.0.9"}))
    file = chart / "files" / "crds" / "understudy.dev_robotworkloads.yaml"
    definition = yaml.safe_load(file.read_text())
    del fields(definition, *ADDED[:-1])[ADDED[-1]]
    file.write_text(yaml.safe_dump(definition, sort_keys=False))
    install(release.kubeconfig, chart, "--set", "images.monitorPullSecrets[0].name=earlier")
    yield
    install(release.kubeconfig)


PRIORITY = {
    "apiVersion": "scheduling.k8s.io/v1",
    "kind": "PriorityClass",
    "metadata": {"name": "understudy"},
    "value": 1000000,
}


@pytest.fixture
def priority(release: Kubectl) -> Iterator[None]:
    """The PriorityClass that the values for production name."""
    release.apply([PRIORITY])
    yield
    release("delete", "priorityclass", "understudy")


def install_for_production(release: Kubectl) -> None:
    """Upgrade with the values for production, but for what this cluster hasn't: named namespaces and a Prometheus operator."""
    without = "watchNamespaces=null,metrics.podMonitors.enabled=false,metrics.rules.enabled=false"
    install(release.kubeconfig, CHART, "--values", str(CHART / "production.yaml"), "--set", without)


def fields(definition: Object, *path: str) -> Object:
    """The properties of a part of a definition's schema."""
    found: Object = definition["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]
    for name in path:
        found = found[name]["properties"]
    return found


def secrets(pod_template: Object) -> list[str]:
    """The Secrets with which the images of a pod or a template are pulled."""
    return [secret["name"] for secret in pod_template["spec"].get("imagePullSecrets") or []]


def start(pod: Object) -> tuple[float, float]:
    """When a pod was made and when it was ready, in whole unix seconds."""
    ready = next(c["lastTransitionTime"] for c in pod["status"]["conditions"] if c["type"] == "Ready")
    made, done = (datetime.fromisoformat(text).timestamp() for text in (pod["metadata"]["creationTimestamp"], ready))
    return made, done


def starting(pod: Object) -> float:
    """Seconds (whole ones) from when a pod was made to when it was ready."""
    made, done = start(pod)
    return done - made


@pytest.mark.long
def test_an_upgrade_leaves_no_gap_at_the_robot(
    priority: None, earlier: None, kubectl: Kubectl, release: Kubectl
) -> None:
    robot = protected(kubectl, "executing")
    old = robot.wait_protected()
    assert secrets(kubectl.get("pod", old)) == ["earlier"]
    crd = "robotworkloads.understudy.dev"
    assert ADDED[-1] not in fields(release.get("crd", crd), *ADDED[:-1])

    begun = time.time()
    install_for_production(release)
    installed = time.time()
    assert ADDED[-1] in fields(release.get("crd", crd), *ADDED[:-1]), "Helm upgrades the definitions too"

    def renewed() -> bool:
        """Monitor, discovery server and standby are those of the new version, and ready."""
        deployments = kubectl.list("deployments", f"{names.MONITORED}={robot.workload}")
        rolled = [d for d in deployments if secrets(d["spec"]["template"]) == NEW]
        done = [d for d in rolled if d["status"].get("readyReplicas") == d["status"].get("updatedReplicas") == 1]
        pods = [p for p in robot.pods() if not p["metadata"].get("deletionTimestamp")]
        standbys = [secrets(p) for p in pods if p["metadata"]["name"] != old]
        return len(done) == 2 and bool(standbys) and all(found == NEW for found in standbys)

    eventually(renewed, within=120, what="all around the robot is of the new version", note=robot.describe)
    robot.wait_protected()
    time.sleep(2)
    ended = time.time()
    (monitor,) = robot.monitor_pods()
    assert monitor["spec"]["priorityClassName"] == "understudy"
    during = robot.log().between(begun, ended)
    longest = during.longest_silence()
    assert longest is not None
    print(
        f"\nupgrade: helm {installed - begun:.1f} s, all of it {ended - begun:.1f} s; {len(during.commands)} commands, "
        f"the longest time without one {longest.seconds * 1000:.0f} ms; by {during.sources()}; "
        f"the monitor's pod was ready after {starting(monitor):.0f} s"
    )
    assert longest.seconds <= LONGEST
    assert during.sources() == [old], "one pod drove all the while"
    assert not robot.recoveries(), "and nothing was taken for a failure"
    assert secrets(kubectl.get("pod", old)) == ["earlier"], "the pod in control stays as it is"

    robot.fail(old, "killed")
    recovery = robot.wait_recovered(1)
    assert recovery.strategy == "Fallback/Executing"
    assert_handed_over(robot, recovery)
    eventually(
        lambda: all(secrets(pod) == NEW for pod in robot.pods()),
        within=60, what="all its pods are of the new version", note=robot.describe,
    )  # fmt: skip
