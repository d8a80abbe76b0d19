"""Delete everything, and nothing is left behind."""

from __future__ import annotations

import json

import pytest

from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Robot, eventually

OURS = "robotworkloads,failurepolicies,fallbackpools"
OF_KUBERNETES = {("ConfigMap", "kube-root-ca.crt"), ("ServiceAccount", "default")}


def left(kubectl: Kubectl) -> set[tuple[str, str]]:
    """Every object of the namespace but Events and what Kubernetes itself keeps there."""
    kinds = kubectl("api-resources", "--namespaced", "--verbs=list", "-o", "name").split()
    wanted = ",".join(k for k in kinds if not k.startswith("events") and "metrics.k8s.io" not in k)
    items = json.loads(kubectl("get", wanted, "-o", "json"))["items"]
    return {(item["kind"], item["metadata"]["name"]) for item in items} - OF_KUBERNETES


@pytest.mark.own_robot
def test_deleting_the_workload_and_its_robot_leaves_nothing(executing: Robot) -> None:
    kubectl = executing.kubectl
    old = executing.wait_protected()
    executing.fail(old, "killed")
    executing.wait_recovered(1)
    for item in kubectl.list(OURS):
        assert not item["metadata"].get("finalizers"), "a finalizer could block the namespace's deletion"
    kubectl("delete", OURS, "--all")
    kubectl("delete", "deployment", executing.name)
    eventually(lambda: not left(kubectl), within=90, what="nothing is left", note=lambda: str(left(kubectl)))


def test_deleting_the_namespace_is_never_blocked_even_without_the_operator(
    uninitialized: Robot, without_operator: None
) -> None:
    kubectl = uninitialized.kubectl
    kubectl("delete", "namespace", kubectl.namespace, "--wait=true", timeout=120)
    assert kubectl.find("namespace", kubectl.namespace) is None
