"""What the operator's account may do, asked of a real API server in its name."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import pytest

from tests.cluster.conftest import Release
from tests.support.cluster import Cluster, Object, Refused, account, until
from tests.support.golden import assert_golden
from tests.support.rights import OF_ALL, OF_EVERYBODY, WHO_WAITS, as_lines, named, of_all, rights_of
from understudy.api import names
from understudy.controller.desired import discovery_server, monitor_deployment
from understudy.controller.plan import Images


@pytest.fixture
def operator(release: Release) -> str:
    """The user name of the operator."""
    return account(release.namespace, release.operator)


def _access(
    kind: str, namespace: str, *, policy: str | None = "hot", pools: Sequence[str] = ("spare",)
) -> list[Object]:
    found = monitor_deployment.access(
        "robot-17", source=(kind, "nav2"), policy=policy, pools=pools, upstream=["robot-17-localization"]
    )
    items = [copy.deepcopy(item) for _, item in found]
    for item in items:
        for subject in item.get("subjects", ()):
            subject["namespace"] = namespace
    return items


@pytest.mark.parametrize("policy", ["hot", None])
@pytest.mark.parametrize("kind", ["ReplicaSet", "Deployment", "StatefulSet"])
def test_the_operator_may_give_a_monitor_its_rights(
    cluster: Cluster, namespace: str, operator: str, kind: str, policy: str | None
) -> None:
    """Kubernetes lets nobody grant what they don't hold, and the operator may not escalate."""
    for item in _access(kind, namespace, policy=policy):
        cluster.create(item, namespace, user=operator)


def test_the_operator_may_not_grant_more_than_it_holds(cluster: Cluster, namespace: str, operator: str) -> None:
    (role,) = [item for item in _access("Deployment", namespace) if item["kind"] == "Role"]
    role["rules"].append({"apiGroups": [""], "resources": ["pods/exec"], "verbs": ["create"]})
    with pytest.raises(Refused, match="attempting to grant RBAC permissions not currently held") as refused:
        cluster.create(role, namespace, user=operator)
    assert refused.value.status == 403


def test_the_operator_never_changes_fields_of_users(cluster: Cluster, namespace: str, operator: str) -> None:
    pool: Object = {
        "apiVersion": "understudy.dev/v1alpha1",
        "kind": "FallbackPool",
        "metadata": {"name": "none"},
        "spec": {"readiness": "Executing", "perWorkload": 0, "workloadSelector": {"matchLabels": {"no": "workload"}}},
    }
    made = cluster.create(pool, namespace)
    with pytest.raises(Refused, match='cannot patch resource "fallbackpools"'):
        cluster.patch(made, {"spec": {"perWorkload": 1}}, user=operator)
    changed = cluster.patch(made, {"status": {"desired": 0}}, subresource="status", user=operator)
    assert changed["status"]["desired"] == 0


def test_the_operator_looks_at_nodes_and_changes_none(cluster: Cluster, operator: str) -> None:
    path = cluster.path("v1", "Node", None)
    node = cluster.request("GET", path, user=operator)["items"][0]
    found = {"apiVersion": "v1", "kind": "Node", "metadata": {"name": node["metadata"]["name"]}}
    with pytest.raises(Refused, match='cannot patch resource "nodes"'):
        cluster.patch(found, {"spec": {"unschedulable": True}}, user=operator, dry_run=True)


def _running(name: str) -> Object:
    resources = {"requests": {"cpu": "50m"}, "limits": {"cpu": "100m"}}
    container = {"name": "app", "image": "understudy.invalid/nowhere:1", "resources": resources}
    return {
        "apiVersion": "v1",
        "kind": "Pod",
        "metadata": {"name": name},
        "spec": {"schedulerName": "nobody", "terminationGracePeriodSeconds": 0, "containers": [container]},
    }


def test_the_operator_resizes_pods_and_monitors_do_not(cluster: Cluster, namespace: str, operator: str) -> None:
    body: Object = {"spec": {"containers": [{"name": "app", "resources": {"limits": {"cpu": "200m"}}}]}}
    made = cluster.create(_running("growing"), namespace)
    path = cluster.path("v1", "Pod", namespace, "growing", "resize")
    for item in _access("Deployment", namespace):
        cluster.create(item, namespace)
    monitor = account(namespace, names.monitor_account("robot-17"))
    kind = "application/strategic-merge-patch+json"
    with pytest.raises(Refused, match='cannot patch resource "pods/resize"'):
        cluster.request("PATCH", path, body=body, content_type=kind, user=monitor)
    changed = cluster.request("PATCH", path, body=body, content_type=kind, user=operator)
    assert changed["spec"]["containers"][0]["resources"]["limits"] == {"cpu": "200m"}
    assert changed["metadata"]["uid"] == made["metadata"]["uid"]


def test_a_monitor_reads_all_waiting_claims_and_changes_only_its_own_gate(cluster: Cluster, namespace: str) -> None:
    for item in _access("Deployment", namespace):
        cluster.create(item, namespace)
    monitor = account(namespace, names.monitor_account("robot-17"))
    version, kind = "networking.k8s.io/v1", "NetworkPolicy"
    path = cluster.path(version, kind, namespace)
    until(lambda: _allowed(cluster, path, monitor), "the monitor's role to take effect")
    made = [
        cluster.create(
            {
                "apiVersion": version,
                "kind": kind,
                "metadata": {"name": names.gate(workload)},
                "spec": {"podSelector": {"matchLabels": {names.WORKLOAD: workload}}, "policyTypes": ["Egress"]},
            },
            namespace,
        )
        for workload in ("robot-17", "robot-18")
    ]
    body: Object = {"metadata": {"labels": {names.WAITS_FOR: "spare"}}}
    assert cluster.patch(made[0], body, user=monitor)["metadata"]["labels"] == {names.WAITS_FOR: "spare"}
    with pytest.raises(Refused, match="cannot patch resource"):
        cluster.patch(made[1], body, user=monitor)


@pytest.mark.parametrize("where", ["robots", "own"])
def test_the_rights_of_the_operator_are_these(
    cluster: Cluster, namespace: str, release: Release, operator: str, where: str
) -> None:
    place = namespace if where == "robots" else release.namespace
    assert_golden("rights", as_lines(rights_of(cluster, place, operator)))


def test_the_rights_of_the_account_of_helm_test_are_these(cluster: Cluster, namespace: str, release: Release) -> None:
    user = account(release.namespace, f"{release.name}-test-understudy-monitor")
    for place in (release.namespace, namespace):
        assert_golden("rights", as_lines(rights_of(cluster, place, user)))


@pytest.mark.parametrize("kind", ["ReplicaSet", "Deployment", "StatefulSet"])
def test_the_rights_of_a_monitor_are_these(cluster: Cluster, namespace: str, kind: str) -> None:
    for item in _access(kind, namespace):
        cluster.create(item, namespace)
    user = account(namespace, names.monitor_account("robot-17"))
    until(lambda: any(one.resource == "pods" for one in rights_of(cluster, namespace, user)), "its role to take effect")
    for place in (namespace, "default"):
        assert_golden("rights", as_lines(rights_of(cluster, place, user)))


@pytest.mark.parametrize("pools", [["spare"], []], ids=["with a pool", "without pools"])
@pytest.mark.parametrize("policy", ["hot", None], ids=["with a policy", "without a policy"])
def test_the_rights_of_a_monitor_follow_from_its_policy_and_its_pools(
    cluster: Cluster, namespace: str, policy: str | None, pools: list[str]
) -> None:
    for item in _access("ReplicaSet", namespace, policy=policy, pools=pools):
        cluster.create(item, namespace)
    user = account(namespace, names.monitor_account("robot-17"))
    until(lambda: any(one.resource == "pods" for one in rights_of(cluster, namespace, user)), "its role to take effect")
    assert_golden("rights", as_lines(rights_of(cluster, namespace, user)))


def test_the_account_of_a_discovery_server_has_no_rights(cluster: Cluster, namespace: str) -> None:
    server = discovery_server.deployment("robot-17", Images("monitor"), "10.0.0.1")["spec"]["template"]["spec"]
    assert server["automountServiceAccountToken"] is False
    user = account(namespace, server.get("serviceAccountName", "default"))
    rights = rights_of(cluster, namespace, user)
    assert not named(rights)
    assert of_all(rights) == OF_EVERYBODY


@pytest.mark.parametrize("pools", [["spare"], []])
def test_can_i_lists_only_objects_of_the_workload_for_its_monitor(
    cluster: Cluster, namespace: str, pools: list[str]
) -> None:
    for item in _access("Deployment", namespace, pools=pools):
        cluster.create(item, namespace)
    user = account(namespace, names.monitor_account("robot-17"))
    until(lambda: any(one.resource == "pods" for one in rights_of(cluster, namespace, user)), "its role to take effect")
    upstream = names.gate("robot-17-localization")  # that of the workload on which it depends
    own = {
        "leases.coordination.k8s.io": {upstream},
        "networkpolicies.networking.k8s.io": {
            names.gate("robot-17"),
            upstream,
            *([names.claimed("robot-17")] if pools else []),
        },
        "robotworkloads.understudy.dev": {"robot-17", "robot-17-localization"},  # on which it depends
        "robotworkloads.understudy.dev/status": {"robot-17"},
        "failurepolicies.understudy.dev": {"hot"},
        "configmaps": {names.settings("robot-17")},
        "secrets": {names.agent_secret("robot-17"), *map(names.pool_secret, pools)},
        "deployments.apps": {"nav2"},
    }
    found = rights_of(cluster, namespace, user)
    assert named(found) == own
    assert of_all(found) == OF_ALL | (WHO_WAITS if pools else {})
    assert not {"create", "update", "*"} & {verb for right in found if right.names for verb in right.verbs}


def test_a_monitor_reads_its_policy_by_name_and_no_other(cluster: Cluster, namespace: str) -> None:
    for item in _access("Deployment", namespace):
        cluster.create(item, namespace)
    monitor = account(namespace, names.monitor_account("robot-17"))
    path = cluster.path("understudy.dev/v1alpha1", "FailurePolicy", namespace)

    def may_list(selector: dict[str, str]) -> bool:
        try:
            cluster.request("GET", path, params=selector, user=monitor)
        except Refused:
            return False
        return True

    until(lambda: may_list({"fieldSelector": "metadata.name=hot"}), "the monitor's role to take effect")
    assert not may_list({"fieldSelector": "metadata.name=cold"})
    assert not may_list({})


def _allowed(cluster: Cluster, path: str, user: str) -> bool:
    try:
        cluster.request("GET", path, params={"labelSelector": names.WAITS_FOR}, user=user)
    except Refused:
        return False
    return True
