"""On Cilium with 1,000 peers: too small policy maps and an open gate are reported; with the documented setting, no gate is open.

A pod of which only the identity exists counts like any other peer. Which of the tests run depends on the settings of the cluster:
``UNDERSTUDY_CILIUM_SETTINGS='{"bpf-policy-map-max": "65536"}' scripts/cluster up --network cilium``.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterator

import pytest

from tests.e2e.console import understudy
from tests.e2e.kubectl import Failed, Kubectl, Object
from tests.e2e.scenario import Robot, eventually
from understudy.controller.reconcile.policy_maps import EVERY
from understudy.kube.gates.cilium import ENTRIES

pytestmark = [pytest.mark.local_only, pytest.mark.network_policy, pytest.mark.long]

PEERS = 1000
FIRST = 40_000
"""From which number on the identities are. Cilium gives pods numbers from 256 to 65535."""

CROWD = "e2e-crowd"
"""Label of the identities."""

REPORTED = 5.0
"""Seconds from the switch until the workload reports that the gate is open."""


@pytest.fixture
def crowd(executing: Robot, gate_kind: str) -> Iterator[None]:
    """Have many peers in the namespace of a robot."""
    kubectl = executing.kubectl
    if gate_kind == "Mux":
        pytest.skip("a mux needs no policies")
    try:
        taken = {one["metadata"]["name"] for one in kubectl.list("ciliumidentities")}
    except Failed:
        pytest.skip("the network is not Cilium")
    executing.wait_protected()
    executing.wait_standby()
    free = (name for name in map(str, itertools.count(FIRST)) if name not in taken)
    peers = [_identity(name, kubectl.namespace) for name in itertools.islice(free, PEERS)]
    given = json.dumps({"apiVersion": "v1", "kind": "List", "items": peers})
    try:
        kubectl("create", "--validate=false", "-f", "-", given=given, timeout=300)
        yield
    finally:
        kubectl("delete", "--raw", f"/apis/cilium.io/v2/ciliumidentities?labelSelector={CROWD}")


def _identity(name: str, namespace: str) -> Object:
    labels = {
        "k8s:io.kubernetes.pod.namespace": namespace,
        "k8s:io.cilium.k8s.namespace.labels.kubernetes.io/metadata.name": namespace,
        "k8s:io.cilium.k8s.policy.cluster": "understudy",
        "k8s:app": f"peer-{name}",
    }
    metadata = {"name": name, "labels": {"io.kubernetes.pod.namespace": namespace, CROWD: ""}}
    return {"apiVersion": "cilium.io/v2", "kind": "CiliumIdentity", "metadata": metadata, "security-labels": labels}


def _room(kubectl: Kubectl) -> int:
    settings = kubectl.in_namespace("kube-system").get("configmap", "cilium-config")["data"]
    return int(settings.get("bpf-policy-map-max", ENTRIES))


def _enforced(robot: Robot) -> tuple[str, str]:
    found = robot.condition("GateEnforced")
    return found.get("status", ""), found.get("reason", "")


def _renew_standby(robot: Robot) -> None:
    """Delete the standby, and wait until a new one runs."""
    active = robot.status()["gate"]["active"]
    before = {pod["metadata"]["uid"] for pod in robot.pods()}
    robot.kubectl("delete", "pod", *[n for n in (pod["metadata"]["name"] for pod in robot.pods()) if n != active])

    def new() -> bool:
        return any(
            pod["metadata"]["uid"] not in before and pod["status"].get("phase") == "Running" for pod in robot.pods()
        )

    eventually(new, within=60, what="a new standby runs")


def _assert_enforced(robot: Robot, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        assert _enforced(robot)[0] != "False", robot.condition("GateEnforced")
        time.sleep(0.5)


def test_an_open_gate_is_reported_within_seconds_beyond_the_room_of_the_policy_maps(
    executing: Robot, crowd: None
) -> None:
    """Beyond the room, the network closes no gate any more. The agent of a frozen application goes on sending test packets."""
    if _room(executing.kubectl) > ENTRIES:
        pytest.skip("the maps have room for all peers")
    failed, epoch = executing.status()["gate"]["active"], executing.status()["gate"]["epoch"]
    executing.fail(failed, "frozen")
    eventually(lambda: executing.status()["gate"]["epoch"] > epoch, within=10, what="the gate is switched")
    switched = time.monotonic()
    eventually(lambda: _enforced(executing) == ("False", "NotEnforced"), within=20, what="the open gate is reported")
    print(f"reported {time.monotonic() - switched:.1f} s after the switch")
    assert time.monotonic() - switched < REPORTED
    assert failed in executing.condition("GateEnforced")["message"]


def test_doctor_reports_too_little_room_and_that_gates_are_not_enforced(executing: Robot, crowd: None) -> None:
    if _room(executing.kubectl) > ENTRIES:
        pytest.skip("the maps have room for all peers")
    done = understudy(executing.kubectl, "doctor")
    assert "room in Cilium" in done.stdout
    assert "no longer enforces changes" in " ".join(done.stdout.split())
    assert "gates are not enforced" in " ".join(done.stdout.split())


def test_the_operator_reports_that_the_policy_maps_have_too_little_room(executing: Robot, crowd: None) -> None:
    """With either size: 1,000 peers need nearly all of the largest maps."""
    expected = "PolicyMapFull" if _room(executing.kubectl) <= ENTRIES else "PolicyMapNearlyFull"

    def reported() -> bool:
        found = executing.condition("PolicyMapSufficient")
        return (found.get("status"), found.get("reason")) == ("False", expected)

    eventually(reported, within=EVERY + 60.0, what="the operator reports the room")
    events = executing.kubectl.list("events")
    assert ("Warning", expected) in {(one["type"], one["reason"]) for one in events}


def test_no_gate_is_open_with_the_documented_setting(executing: Robot, crowd: None) -> None:
    if _room(executing.kubectl) <= ENTRIES:
        pytest.skip("the maps have the default size")
    _renew_standby(executing)
    _assert_enforced(executing, 20.0)
    executing.wait_standby()
    assert understudy(executing.kubectl, "failover", executing.workload, "--yes").returncode == 0
    assert executing.wait_recovered(1).strategy == "Fallback/Executing"
    _assert_enforced(executing, 10.0)
