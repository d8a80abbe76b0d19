"""Which pods count as instances or monitors: a neighbour who may create pods creates none that does.

test_controllers.py has the controllers that create pods.
"""

from __future__ import annotations

import pytest

from tests.cluster.conftest import Release
from tests.cluster.monitor_accounts import ACTIVE, MINE, NOWHERE, OTHER, allow, refusal, until_refused
from tests.support.cluster import Cluster, Object, account, until
from understudy.api import names
from understudy.controller import plan

LABELS: dict[str, dict[str, str]] = {
    "the-active-instance": {names.WORKLOAD: MINE, names.INSTANCE: ACTIVE},
    "an-instance": {names.WORKLOAD: MINE},
    "an-instance-of-nobody": {names.INSTANCE: ACTIVE},
    "a-standby": {names.WORKLOAD: MINE, names.POOL: "hot", "app": "nav"},
    "an-unclaimed-pod": {names.POOL: "spare", names.HELD: "true"},
    "a-monitor": {names.COMPONENT: "monitor", names.MONITORED: MINE},
    "a-monitor-of-nobody": {names.COMPONENT: "monitor"},
}
SELECTED = (names.WORKLOAD, names.INSTANCE, names.POOL, names.HELD, names.MONITORED, names.COMPONENT)
"""The labels with which network policies select pods, in the order of the message."""


@pytest.fixture
def neighbour(cluster: Cluster, release: Release, namespace: str) -> str:
    """The name of a user who may create pods and ReplicaSets in the namespace."""
    user = "neighbour@example.com"
    _may_create(cluster, namespace, user)
    until_refused(
        lambda: cluster.create(_pod("probe", LABELS["an-instance"]), namespace, user=user, dry_run=True),
        "may not create pod",
        "the admission policy of new pods to be enforced",
    )
    return user


def _may_create(cluster: Cluster, namespace: str, user: str) -> None:
    allow(
        cluster, namespace, user, {"apiGroups": ["", "apps"], "resources": ["pods", "replicasets"], "verbs": ["create"]}
    )


def _pod(name: str, labels: dict[str, str], owner: str = "") -> Object:
    owners = [{"apiVersion": "apps/v1", "kind": "ReplicaSet", "name": owner, "uid": "uid-r", "controller": True}]
    metadata: Object = {"name": name, "labels": labels, "ownerReferences": owners if owner else []}
    return {"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": NOWHERE}


def _replica_set(name: str, labels: dict[str, str]) -> Object:
    labels = {"of": name, **labels}
    return {
        "apiVersion": "apps/v1",
        "kind": "ReplicaSet",
        "metadata": {"name": name},
        "spec": {
            "replicas": 1,
            "selector": {"matchLabels": {"of": name}},
            "template": {"metadata": {"labels": labels}, "spec": NOWHERE},
        },
    }


@pytest.mark.parametrize("labels", LABELS.values(), ids=LABELS)
def test_a_neighbour_creates_no_pod_that_counts_as_an_instance(
    cluster: Cluster, namespace: str, neighbour: str, labels: dict[str, str]
) -> None:
    for owner in ("", MINE):
        message = refusal(lambda owner=owner: cluster.create(_pod(ACTIVE, labels, owner), namespace, user=neighbour))  # type: ignore[misc]
        named = ", ".join(key for key in SELECTED if key in labels)
        assert f"{neighbour} may not create pod {namespace}/{ACTIVE} with {named}:" in message


@pytest.mark.parametrize(
    ("name", "labels"),
    [
        (name, labels)
        for name in (MINE, "tenants", f"{OTHER}-monitor-x")
        for which, labels in LABELS.items()
        if (name, which) != (MINE, "an-instance")
    ],
)
def test_a_replica_set_with_another_name_or_other_labels_creates_none_either(
    cluster: Cluster, namespace: str, neighbour: str, labels: dict[str, str], name: str
) -> None:
    """Whoever wrote it: here a user whom the chart names."""
    made = cluster.create(_replica_set(name, labels), namespace)

    def refused() -> str:
        live = cluster.get("apps/v1", "ReplicaSet", made["metadata"]["name"], namespace)
        conditions = (live.get("status") or {}).get("conditions") or []
        return next((c["message"] for c in conditions if c["type"] == "ReplicaFailure"), "")

    assert "may not create pod" in until(refused, "the ReplicaSet to fail")
    assert not cluster.list("v1", "Pod", namespace)


def test_a_neighbour_creates_other_pods(cluster: Cluster, namespace: str, neighbour: str) -> None:
    cluster.create(_pod("database", {"app": "database"}), namespace, user=neighbour)
    cluster.create(_replica_set("tenants", {"app": "nav"}), namespace, user=neighbour)
    until(lambda: len(cluster.list("v1", "Pod", namespace)) == 2, "the pod of the ReplicaSet")


def test_the_replica_set_of_a_workload_creates_its_instances(cluster: Cluster, namespace: str, neighbour: str) -> None:
    labels = {names.WORKLOAD: MINE, names.SOURCE: "workload", names.COMPONENT: "instance", names.TEMPLATE_HASH: "1"}
    cluster.create(_replica_set(MINE, labels), namespace)
    (pod,) = until(lambda: cluster.list("v1", "Pod", namespace), "its pod")
    assert labels.items() <= pod["metadata"]["labels"].items()


@pytest.mark.parametrize("name", [names.monitor(MINE), names.discovery(MINE)])
def test_a_deployment_of_the_operator_creates_monitors_and_discovery_servers(
    cluster: Cluster, namespace: str, release: Release, neighbour: str, name: str
) -> None:
    labels = {names.COMPONENT: name.rpartition("-")[2], names.MONITORED: MINE}
    deployment = plan.deployment(name, labels, {}, NOWHERE)
    cluster.create(deployment, namespace, user=account(release.namespace, release.operator))
    (pod,) = until(lambda: cluster.list("v1", "Pod", namespace), "its pod")
    assert labels.items() <= pod["metadata"]["labels"].items()


def test_the_operator_creates_instances_and_unclaimed_pods(
    cluster: Cluster, namespace: str, release: Release, neighbour: str
) -> None:
    operator = account(release.namespace, release.operator)
    for number, labels in enumerate(LABELS.values()):
        cluster.create(_pod(f"pod-{number}", labels), namespace, user=operator)


def test_the_account_of_a_monitor_creates_no_instance(cluster: Cluster, namespace: str, neighbour: str) -> None:
    monitor = account(namespace, names.monitor_account(MINE))
    _may_create(cluster, namespace, monitor)

    def judged() -> bool:
        message = refusal(lambda: cluster.create(_pod(ACTIVE, LABELS["an-instance"]), namespace, user=monitor))
        return "may not create pod" in message

    until(judged, "the additional right to count")
