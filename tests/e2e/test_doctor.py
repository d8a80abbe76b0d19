"""``understudy doctor`` in a cluster that does what it should, in a namespace that doesn't, and ended by Ctrl-C."""

from __future__ import annotations

import json
import signal
from typing import Any

from tests.e2e.console import started, understudy
from tests.e2e.kubectl import Kubectl
from tests.e2e.scenario import Robot, eventually

LABEL = "understudy.dev/doctor"
DENIED = {
    "apiVersion": "networking.k8s.io/v1",
    "kind": "NetworkPolicy",
    "metadata": {"name": "deny-all"},
    "spec": {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]},
}


def levels(told: str) -> dict[str, str]:
    """Each check with what it came to."""
    return {finding["check"]: finding["level"] for finding in json.loads(told)["findings"]}


def left(kubectl: Kubectl) -> list[dict[str, Any]]:
    """What of the doctor's is still there and not about to go."""
    found = kubectl.list("pods,networkpolicies", LABEL)
    return [item for item in found if not item["metadata"].get("deletionTimestamp")]


def test_the_doctor_finds_no_problem_in_a_working_cluster(kubectl: Kubectl) -> None:
    kubectl("label", "namespace", kubectl.namespace, "pod-security.kubernetes.io/enforce=restricted")
    done = understudy(kubectl, "doctor", "-o", "json")
    assert done.returncode == 0, done.stdout + done.stderr
    assert set(levels(done.stdout).values()) == {"OK"}
    assert {
        "Kubernetes",
        "operator",
        "CRD robotworkloads",
        "your rights",
        "operator's rights",
        "gate",
        "clocks",
    } <= set(levels(done.stdout))
    gate = json.loads(done.stdout)["gate"]
    assert len(set(gate["nodes"])) == 2
    assert all(0 <= took < 1 for took in gate["seconds"].values()), gate
    assert left(kubectl) == []

    missing = understudy(kubectl, "doctor", "--image", "localhost/nowhere:1")
    assert missing.returncode == 1
    assert "container doctor (image localhost/nowhere:1) cannot start, ImagePullBackOff" in " ".join(
        missing.stdout.split()
    )
    assert left(kubectl) == []

    kubectl.apply([DENIED])
    denied = understudy(kubectl, "doctor")
    assert denied.returncode == 1
    assert "UDP packets do not get from one pod to another at all" in denied.stdout
    assert "cure: look for a NetworkPolicy that denies UDP" in denied.stdout
    assert left(kubectl) == []


def test_ctrl_c_leaves_nothing_behind(kubectl: Kubectl) -> None:
    with started(kubectl, "doctor") as running:
        eventually(lambda: len(left(kubectl)) > 2, within=60, what="it sends packets through a gate")
        running.send_signal(signal.SIGINT)
        told = running.communicate(timeout=30)[1]
        assert running.returncode == 2, told
    assert "interrupted; the objects that it had created are deleted" in told
    assert left(kubectl) == []


def test_the_doctor_checks_the_discovery_server_of_a_robot(executing: Robot) -> None:
    executing.wait_protected()
    done = understudy(executing.kubectl, "doctor", executing.workload, "-o", "json")
    assert done.returncode == 0, done.stdout + done.stderr
    assert levels(done.stdout)[f"discovery of {executing.workload}"] == "OK"
    assert executing.recoveries() == []
