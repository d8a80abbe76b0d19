"""Which controllers create pods that count as instances or monitors: a neighbour who may write all kinds of them writes none that does."""

from __future__ import annotations

import pytest

from tests.cluster.conftest import Release
from tests.cluster.monitor_accounts import MINE, NOWHERE, allow, refusal, until_refused
from tests.cluster.strangers.test_new_pods import LABELS, SELECTED
from tests.support.cluster import Cluster, Object, account, until
from understudy.api import names
from understudy.controller import plan

KINDS = {
    "Deployment": "apps/v1",
    "ReplicaSet": "apps/v1",
    "StatefulSet": "apps/v1",
    "DaemonSet": "apps/v1",
    "Job": "batch/v1",
    "CronJob": "batch/v1",
    "ReplicationController": "v1",
}
MAY_WRITE: list[Object] = [
    {"apiGroups": [group], "resources": resources, "verbs": ["create", "patch"]}
    for group, resources in {
        "apps": ["deployments", "deployments/scale", "replicasets", "statefulsets", "daemonsets"],
        "batch": ["jobs", "cronjobs"],
        "": ["pods", "replicationcontrollers"],
    }.items()
]
MONITOR = {names.COMPONENT: "monitor", names.MONITORED: MINE}


@pytest.fixture
def neighbour(cluster: Cluster, release: Release, namespace: str) -> str:
    """The name of a user who may write controllers of all kinds in the namespace."""
    user = "controlling@example.com"
    allow(cluster, namespace, user, *MAY_WRITE)
    until_refused(
        lambda: cluster.create(_controller("ReplicaSet", "probe", MONITOR), namespace, user=user, dry_run=True),
        "may not write the pod template",
        "the admission policy of controllers to be enforced",
    )
    return user


@pytest.fixture
def monitor(cluster: Cluster, namespace: str, release: Release, neighbour: str) -> Object:
    """The Deployment of a monitor, as the operator creates it."""
    made = plan.deployment(names.monitor(MINE), MONITOR, {}, NOWHERE)
    return cluster.create(made, namespace, user=account(release.namespace, release.operator))


def _controller(kind: str, name: str, labels: dict[str, str]) -> Object:
    """Return a controller of pods on no node."""
    pods: Object = {"metadata": {"labels": {"of": name, **labels}}, "spec": dict(NOWHERE)}
    spec: Object = {"template": pods}
    match kind:
        case "Job":
            pods["spec"]["restartPolicy"] = "Never"
        case "CronJob":
            pods["spec"]["restartPolicy"] = "Never"
            spec = {"schedule": "0 0 1 1 *", "jobTemplate": {"spec": spec}}
        case "ReplicationController":
            spec["selector"] = {"of": name}
        case _:
            spec["selector"] = {"matchLabels": {"of": name}}
    if kind == "StatefulSet":
        spec["serviceName"] = name
    return {"apiVersion": KINDS[kind], "kind": kind, "metadata": {"name": name}, "spec": spec}


def _pods(kind: str, changes: Object) -> Object:
    """Return a merge patch of the pod template of a controller."""
    template = {"template": changes}
    return {"spec": {"jobTemplate": {"spec": template}} if kind == "CronJob" else template}


@pytest.mark.parametrize("kind", KINDS)
def test_a_neighbour_creates_no_controller_of_pods_that_count(
    cluster: Cluster, namespace: str, neighbour: str, kind: str
) -> None:
    for labels in LABELS.values():
        made = _controller(kind, "tenants", labels)
        message = refusal(lambda made=made: cluster.create(made, namespace, user=neighbour))  # type: ignore[misc]
        named = ", ".join(key for key in SELECTED if key in labels)
        assert f"{neighbour} may not write the pod template of {kind} {namespace}/tenants with {named}:" in message


@pytest.mark.parametrize(
    ("name", "labels"),
    [(f"{names.monitor(MINE)}-x", MONITOR), (MINE, LABELS["an-instance"])],
    ids=["of a monitor", "of a workload that refers to a Deployment"],
)
def test_a_neighbour_creates_no_replica_set_with_the_name_of_one_that_counts(
    cluster: Cluster, namespace: str, neighbour: str, name: str, labels: dict[str, str]
) -> None:
    made = _controller("ReplicaSet", name, labels)
    refusal(lambda: cluster.create(made, namespace, user=neighbour))
    owner = {"apiVersion": "apps/v1", "kind": "Deployment", "name": "d", "uid": "uid-d", "controller": True}
    made["metadata"]["ownerReferences"] = [owner]
    refusal(lambda: cluster.create(made, namespace, user=neighbour))
    assert not cluster.list("apps/v1", "ReplicaSet", namespace)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "Job"])
def test_a_neighbour_gives_no_controller_these_labels_later(
    cluster: Cluster, namespace: str, neighbour: str, kind: str
) -> None:
    """The template of a Job never changes."""
    made = cluster.create(_controller(kind, "tenants", {}), namespace, user=neighbour)
    changes = _pods(kind, {"metadata": {"labels": MONITOR}})
    assert "may not write the pod template" in refusal(lambda: cluster.patch(made, changes, user=neighbour))


def test_a_neighbour_changes_no_pods_of_the_operator_s_controllers(
    cluster: Cluster, namespace: str, neighbour: str, monitor: Object
) -> None:
    (replica_set,) = until(lambda: cluster.list("apps/v1", "ReplicaSet", namespace), "the Deployment's ReplicaSet")
    replica_set |= {"apiVersion": "apps/v1", "kind": "ReplicaSet"}
    image = {"spec": {"containers": [{"name": "c", "image": "mine.invalid/mine"}]}}
    network = {"metadata": {"annotations": {"k8s.v1.cni.cncf.io/networks": "robots"}}}
    for item in (monitor, replica_set):
        for changes in (image, network):
            message = refusal(lambda i=item, c=changes: cluster.patch(i, _pods(i["kind"], c), user=neighbour))  # type: ignore[misc]
            assert "may not write the pod template" in message
            cluster.patch(item, _pods(item["kind"], changes), dry_run=True)  # a user whom the chart names


def test_a_neighbour_restarts_scales_and_annotates_the_operator_s_controllers(
    cluster: Cluster, namespace: str, neighbour: str, monitor: Object
) -> None:
    (first,) = until(lambda: cluster.list("v1", "Pod", namespace), "the monitor's pod")
    cluster.patch(monitor, {"metadata": {"annotations": {"note": "mine"}}}, user=neighbour)
    restart = {"metadata": {"annotations": {"kubectl.kubernetes.io/restartedAt": "2026-01-01T00:00:00Z"}}}
    cluster.patch(monitor, _pods("Deployment", restart), user=neighbour)

    def rolled_out() -> bool:
        found = cluster.list("v1", "Pod", namespace)
        return [pod["metadata"]["uid"] for pod in found] not in ([], [first["metadata"]["uid"]])

    until(rolled_out, "the pod of the next ReplicaSet")
    cluster.patch(monitor, {"spec": {"replicas": 0}}, subresource="scale", user=neighbour)
    until(lambda: not _undeleted(cluster, namespace), "no pods after a scale to zero")


def _undeleted(cluster: Cluster, namespace: str) -> list[Object]:
    return [pod for pod in cluster.list("v1", "Pod", namespace) if "deletionTimestamp" not in pod["metadata"]]


@pytest.mark.parametrize("kind", KINDS)
def test_a_neighbour_writes_controllers_of_other_pods(
    cluster: Cluster, namespace: str, neighbour: str, kind: str
) -> None:
    made = cluster.create(_controller(kind, "tenants", {"app": "nav", "example.com/component": "monitor"}), namespace)
    if kind != "Job":
        changes = _pods(kind, {"metadata": {"labels": {"app": "nav2"}}})
        cluster.patch(made, changes, user=neighbour)


def test_the_pods_of_a_neighbour_s_deployment_are_replaced_when_its_template_changes(
    cluster: Cluster, namespace: str, neighbour: str
) -> None:
    made = cluster.create(_controller("Deployment", "tenants", {}), namespace, user=neighbour)
    until(lambda: cluster.list("v1", "Pod", namespace), "its pod")
    cluster.patch(made, _pods("Deployment", {"metadata": {"labels": {"version": "2"}}}), user=neighbour)
    until(lambda: cluster.list("v1", "Pod", namespace, labels="version=2"), "the pod of the new template")
