"""What a monitor's account and others may do to pods, asked of a real API server in their names."""

from __future__ import annotations

import pytest

from tests.cluster import monitor_accounts
from tests.cluster.conftest import Release
from tests.cluster.monitor_accounts import MINE, NOWHERE, OTHER, allow, refusal, until_refused
from tests.support.cluster import Cluster, Object, Refused, account, until
from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.controller.desired import monitor_deployment


@pytest.fixture
def monitor(cluster: Cluster, release: Release, namespace: str) -> str:
    """The user name of the monitor of MINE, with the rights that the operator gives it; its workload refers to Deployment nav2."""
    user = monitor_accounts.create(cluster, namespace, MINE)

    probe = _pod(cluster, namespace, "probe", {})
    until_refused(
        lambda: cluster.delete(probe, user=user, dry_run=True),
        "may delete only pods",
        "the admission policy to be enforced",
    )
    return user


@pytest.fixture
def person(cluster: Cluster, release: Release, namespace: str) -> str:
    """The name of a user who may change all pods of the namespace."""
    name = "person@example.com"
    _may_change_pods(cluster, namespace, name)
    probe = _pod(cluster, namespace, "probe", {})
    until_refused(
        lambda: cluster.patch(probe, {"metadata": {"labels": {names.WORKLOAD: MINE}}}, user=name, dry_run=True),
        "may not change",
        "the admission policy of labels to be enforced",
    )
    return name


def _may_change_pods(cluster: Cluster, namespace: str, user: str) -> None:
    allow(cluster, namespace, user, {"apiGroups": [""], "resources": ["pods", "pods/status"], "verbs": ["*"]})


@pytest.fixture
def statefulset_monitor(cluster: Cluster, monitor: str, namespace: str) -> str:
    """The same where the workload refers to StatefulSet nav2."""
    _refer(cluster, namespace, "StatefulSet", "nav2")
    return monitor


def _refer(cluster: Cluster, namespace: str, kind: str, name: str) -> None:
    """The workload's pods are those of another controller now."""
    for part, item in monitor_deployment.access(MINE, source=(kind, name), policy="policy", pools=[]):
        if part == "Role":
            path = cluster.path(item["apiVersion"], part, namespace, item["metadata"]["name"])
            cluster.request("PUT", path, body=item)


def _pod(cluster: Cluster, namespace: str, name: str, labels: dict[str, str]) -> Object:
    metadata: Object = {"name": name, "labels": labels}
    return cluster.create({"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": NOWHERE}, namespace)


def _instance(cluster: Cluster, namespace: str, workload: str, name: str = "instance") -> Object:
    return _pod(cluster, namespace, name, {names.WORKLOAD: workload, names.INSTANCE: name})


def _held(cluster: Cluster, namespace: str) -> Object:
    return _pod(cluster, namespace, "spare-1", {names.POOL: "spare", names.HELD: "true", names.INSTANCE: "spare-1"})


def _controlled(cluster: Cluster, namespace: str, kind: str, name: str) -> Object:
    """The pod that a real controller makes."""
    labels = {"app": name}
    controller: Object = {
        "apiVersion": "apps/v1",
        "kind": kind,
        "metadata": {"name": name},
        "spec": {
            "replicas": 1,
            "selector": {"matchLabels": labels},
            "template": {"metadata": {"labels": labels}, "spec": NOWHERE},
        },
    }
    if kind == "StatefulSet":
        controller["spec"]["serviceName"] = name
    cluster.create(controller, namespace)
    (pod,) = until(lambda: cluster.list("v1", "Pod", namespace, labels=f"app={name}"), f"the pod of {kind} {name}")
    return {"apiVersion": "v1", "kind": "Pod", **pod}


def _owner(workload: str) -> Object:
    uid = "5c3d1f6e-0000-4000-8000-000000000002"
    return {"apiVersion": API_VERSION, "kind": "RobotWorkload", "name": workload, "uid": uid, "controller": True}


def _claim(workload: str, pod: Object) -> Object:
    return {
        "metadata": {
            "uid": pod["metadata"]["uid"],
            "labels": {names.HELD: None, names.WORKLOAD: workload},
            "annotations": {names.CLAIM: "uid/1"},
            "ownerReferences": [_owner(workload)],
        }
    }


def test_a_monitor_deletes_its_own_pod(cluster: Cluster, namespace: str, monitor: str) -> None:
    pod = _instance(cluster, namespace, MINE)
    cluster.delete(pod, user=monitor)
    until(lambda: cluster.find("v1", "Pod", "instance", namespace) is None, "the pod to be gone")


def test_a_monitor_does_not_delete_the_pod_of_another(cluster: Cluster, namespace: str, monitor: str) -> None:
    pod = _instance(cluster, namespace, OTHER)
    message = refusal(lambda: cluster.delete(pod, user=monitor))
    assert (
        f"the monitor of RobotWorkload {namespace}/{MINE} may delete only pods labelled understudy.dev/workload={MINE} "
        f"and pods of that workload that lost the label; "
        f"pod {namespace}/instance has {OTHER}"
    ) in message
    assert cluster.find("v1", "Pod", "instance", namespace) is not None


def test_a_monitor_does_not_delete_a_pod_of_nobody(cluster: Cluster, namespace: str, monitor: str) -> None:
    message = refusal(lambda: cluster.delete(_pod(cluster, namespace, "database", {}), user=monitor))
    assert f"pod {namespace}/database has no such label" in message


def test_a_monitor_does_not_delete_an_unclaimed_pod(cluster: Cluster, namespace: str, monitor: str) -> None:
    assert "may delete only pods" in refusal(lambda: cluster.delete(_held(cluster, namespace), user=monitor))


def test_a_monitor_claims_an_unclaimed_pod(cluster: Cluster, namespace: str, monitor: str) -> None:
    pod = _held(cluster, namespace)
    # Only judged and not stored: the garbage collector would take away a pod whose owner doesn't exist.
    claimed = cluster.patch(pod, _claim(MINE, pod), user=monitor, dry_run=True)
    assert claimed["metadata"]["labels"][names.WORKLOAD] == MINE
    assert names.HELD not in claimed["metadata"]["labels"]
    assert [(o["kind"], o["name"]) for o in claimed["metadata"]["ownerReferences"]] == [("RobotWorkload", MINE)]


def test_a_monitor_does_not_claim_for_another(cluster: Cluster, namespace: str, monitor: str) -> None:
    pod = _held(cluster, namespace)
    message = refusal(lambda: cluster.patch(pod, _claim(OTHER, pod), user=monitor))
    assert f"may set the label understudy.dev/workload only to {MINE} and never remove it" in message
    assert f"pod {namespace}/spare-1 would have {OTHER}" in message


def test_a_claimed_pod_has_one_owner_for_good(cluster: Cluster, namespace: str, monitor: str) -> None:
    pod = _held(cluster, namespace)
    claimed = cluster.patch(pod, {"metadata": {"labels": {names.HELD: None, names.WORKLOAD: OTHER}}})
    # Without a resourceVersion, as a monitor that has lost its way might.
    message = refusal(lambda: cluster.patch(claimed, _claim(MINE, claimed), user=monitor))
    assert f"may change only pods labelled understudy.dev/workload={MINE}" in message
    assert f"pod {namespace}/spare-1 has {OTHER}" in message


def test_a_claim_takes_the_pod_whole(cluster: Cluster, namespace: str, monitor: str) -> None:
    pod = _held(cluster, namespace)
    still_held = _claim(MINE, pod)
    del still_held["metadata"]["labels"][names.HELD]
    assert "may remove the label understudy.dev/held with a claim only" in refusal(
        lambda: cluster.patch(pod, still_held, user=monitor)
    )
    foreign = _claim(MINE, pod)
    foreign["metadata"]["ownerReferences"][0]["name"] = OTHER
    assert f"only with a claim and only to RobotWorkload {MINE}" in refusal(
        lambda: cluster.patch(pod, foreign, user=monitor)
    )
    only_annotated = {"metadata": {"annotations": {names.CLAIM: "uid/1"}}}
    assert f"pod {namespace}/spare-1 would have none" in refusal(
        lambda: cluster.patch(pod, only_annotated, user=monitor)
    )


@pytest.mark.parametrize("value", [OTHER, None], ids=["to-another", "to-none"])
def test_a_monitor_does_not_give_its_pod_away(
    cluster: Cluster, namespace: str, monitor: str, value: str | None
) -> None:
    pod = _instance(cluster, namespace, MINE)
    message = refusal(lambda: cluster.patch(pod, {"metadata": {"labels": {names.WORKLOAD: value}}}, user=monitor))
    assert f"would have {value or 'none'}" in message


def test_the_instance_label_is_the_name_of_the_pod(cluster: Cluster, namespace: str, monitor: str) -> None:
    pod = _instance(cluster, namespace, MINE)
    message = refusal(lambda: cluster.patch(pod, {"metadata": {"labels": {names.INSTANCE: "twin"}}}, user=monitor))
    assert "may set the label understudy.dev/instance only to the name of the pod" in message
    assert "would have twin" in message


def test_a_monitor_changes_neither_spec_nor_finalizers_nor_owners_of_its_pod(
    cluster: Cluster, namespace: str, monitor: str
) -> None:
    pod = _instance(cluster, namespace, MINE)
    image = {"spec": {"containers": [pod["spec"]["containers"][0] | {"image": "evil.invalid/evil"}]}}
    deadline = {"spec": {"activeDeadlineSeconds": 1}}
    finalizer = {"metadata": {"finalizers": ["example.com/stay"]}}
    owner = {"metadata": {"ownerReferences": [_owner(MINE)]}}
    for body in (image, deadline, finalizer):
        message = refusal(lambda body=body: cluster.patch(pod, body, user=monitor))  # type: ignore[misc]
        assert "may change only labels, annotations and owners" in message
    assert "only with a claim" in refusal(lambda: cluster.patch(pod, owner, user=monitor))


def test_a_monitor_labels_pods_of_the_deployment_it_refers_to(cluster: Cluster, namespace: str, monitor: str) -> None:
    pod = _controlled(cluster, namespace, "Deployment", "nav2")
    labels = {names.WORKLOAD: MINE, names.INSTANCE: pod["metadata"]["name"]}
    changed = cluster.patch(pod, {"metadata": {"labels": labels}}, user=monitor)
    assert labels.items() <= changed["metadata"]["labels"].items()


@pytest.mark.parametrize("deployment", ["other", "nav2-other", "nav"])
def test_a_monitor_does_not_label_pods_of_other_deployments(
    cluster: Cluster, namespace: str, monitor: str, deployment: str
) -> None:
    pod = _controlled(cluster, namespace, "Deployment", deployment)
    message = refusal(lambda: cluster.patch(pod, {"metadata": {"labels": {names.WORKLOAD: MINE}}}, user=monitor))
    assert "pods of the controller it refers to" in message
    assert "has no such label" in message


def test_a_monitor_does_not_label_a_pod_without_a_controller(cluster: Cluster, namespace: str, monitor: str) -> None:
    pod = _pod(cluster, namespace, "nav2-abc-1", {"pod-template-hash": "abc"})
    assert "may change only pods" in refusal(
        lambda: cluster.patch(pod, {"metadata": {"labels": {names.WORKLOAD: MINE}}}, user=monitor)
    )


def _until_labelled(cluster: Cluster, pod: Object, monitor: str) -> None:
    """Have the monitor label a pod, as soon as its changed Role counts."""
    body = {"metadata": {"labels": {names.WORKLOAD: MINE, names.INSTANCE: pod["metadata"]["name"]}}}

    def labelled() -> bool:
        try:
            cluster.patch(pod, body, user=monitor)
        except Refused:
            return False
        return True

    until(labelled, "the changed Role to count")


def test_a_monitor_labels_pods_of_the_statefulset_it_refers_to(
    cluster: Cluster, namespace: str, statefulset_monitor: str
) -> None:
    _until_labelled(cluster, _controlled(cluster, namespace, "StatefulSet", "nav2"), statefulset_monitor)
    other = _controlled(cluster, namespace, "StatefulSet", "other")
    body = {"metadata": {"labels": {names.WORKLOAD: MINE, names.INSTANCE: "other-0"}}}
    assert "pods of the controller it refers to" in refusal(
        lambda: cluster.patch(other, body, user=statefulset_monitor)
    )


def _agent(workload: str) -> Object:
    """The spec of a pod whose agent serves a workload."""
    agent = {
        "name": names.AGENT_CONTAINER,
        "image": "none.invalid/none",
        "env": [
            {"name": names.POD_VARIABLE, "valueFrom": {"fieldRef": {"fieldPath": "metadata.name"}}},
            {"name": names.WORKLOAD_VARIABLE, "value": workload},
        ],
    }
    return {**NOWHERE, "containers": [*NOWHERE["containers"], agent]}


def _unlabelled(
    cluster: Cluster, namespace: str, spec: Object, owner: Object | None = None, labels: dict[str, str] | None = None
) -> Object:
    """A pod that lost the label of its workload."""
    # The garbage collector does not look for owners of a version that does not exist. It would delete the pod, because there is no owner.
    owners = [{**owner, "apiVersion": f"{names.GROUP}/none"}] if owner is not None else []
    metadata: Object = {"name": "lost", "labels": labels or {}, "ownerReferences": owners}
    return cluster.create({"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": spec}, namespace)


RESTORED: Object = {"metadata": {"labels": {names.WORKLOAD: MINE, names.INSTANCE: "lost"}}}


@pytest.mark.parametrize("labels", [{}, {names.WORKLOAD: OTHER}], ids=["removed", "changed"])
@pytest.mark.parametrize(
    ("spec", "owner"), [(NOWHERE, _owner(MINE)), (_agent(MINE), None)], ids=["standby", "released"]
)
def test_a_monitor_restores_the_label_of_its_pod(
    cluster: Cluster, namespace: str, monitor: str, spec: Object, owner: Object | None, labels: dict[str, str]
) -> None:
    pod = _unlabelled(cluster, namespace, spec, owner, labels)
    cluster.delete(pod, user=monitor, dry_run=True)
    assert "would have " in refusal(lambda: cluster.patch(pod, {"metadata": {"labels": {"a": "b"}}}, user=monitor))
    changed = cluster.patch(pod, RESTORED, user=monitor)
    assert changed["metadata"]["labels"] == RESTORED["metadata"]["labels"]


@pytest.mark.parametrize(
    ("spec", "owner"),
    [(_agent(MINE), _owner(OTHER)), (_agent(OTHER), None), (_agent(""), None)],
    ids=["standby", "released", "held"],
)
def test_a_monitor_does_not_label_the_pods_of_another_workload(
    cluster: Cluster, namespace: str, monitor: str, spec: Object, owner: Object | None
) -> None:
    pod = _unlabelled(cluster, namespace, spec, owner)
    assert "may change only pods" in refusal(lambda: cluster.patch(pod, RESTORED, user=monitor))
    assert "may delete only pods" in refusal(lambda: cluster.delete(pod, user=monitor))


def test_a_monitor_labels_pods_of_the_replica_set_of_its_workload(
    cluster: Cluster, namespace: str, monitor: str
) -> None:
    _refer(cluster, namespace, "ReplicaSet", MINE)
    pod = _controlled(cluster, namespace, "ReplicaSet", MINE)
    _until_labelled(cluster, pod, monitor)
    other = _controlled(cluster, namespace, "ReplicaSet", OTHER)
    labels = {names.WORKLOAD: MINE, names.INSTANCE: other["metadata"]["name"]}
    assert "may change only pods" in refusal(
        lambda: cluster.patch(other, {"metadata": {"labels": labels}}, user=monitor)
    )


def test_a_monitor_has_no_rights_in_another_namespace(cluster: Cluster, release: Release, monitor: str) -> None:
    pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "any", "namespace": release.namespace}}
    assert "cannot delete resource" in refusal(lambda: cluster.delete(pod, user=monitor))


def test_everybody_else_deletes_and_annotates_pods(cluster: Cluster, namespace: str, person: str) -> None:
    pod = _instance(cluster, namespace, OTHER)
    body = {"metadata": {"labels": {"team": "blue"}, "annotations": {"note": "seen"}}}
    changed = cluster.patch(pod, body, user=person)
    assert changed["metadata"]["labels"]["team"] == "blue"
    cluster.delete(changed, user=person)


@pytest.mark.parametrize(
    "labels",
    [{names.WORKLOAD: None}, {names.POOL: None}, {names.INSTANCE: "active"}, {names.HELD: "true"}],
    ids=["workload-removed", "pool-removed", "instance-changed", "held-added"],
)
@pytest.mark.parametrize("subresource", ["", "status"])
def test_nobody_else_changes_the_labels_of_an_instance(
    cluster: Cluster, namespace: str, person: str, labels: dict[str, str | None], subresource: str
) -> None:
    pod = _pod(
        cluster,
        namespace,
        "instance",
        {names.WORKLOAD: MINE, names.INSTANCE: "instance", names.POOL: "hot", "app": "nav"},
    )
    (key,) = labels
    body = {"metadata": {"labels": labels}}
    message = refusal(lambda: cluster.patch(pod, body, user=person, subresource=subresource))
    assert f"{person} may not change {key} of pod {namespace}/instance" in message
    live = cluster.get("v1", "Pod", "instance", namespace)
    assert live["metadata"]["labels"] == pod["metadata"]["labels"]


@pytest.mark.parametrize("claim", ["a/b", None])
def test_nobody_else_writes_or_removes_the_claim_of_a_pod(
    cluster: Cluster, namespace: str, person: str, release: Release, claim: str | None
) -> None:
    """A pod with a forged claim would count as one of a shared pool, and its workload would get another standby."""
    pod = _pod(cluster, namespace, "instance", {names.WORKLOAD: MINE, names.INSTANCE: "instance"})
    if claim is None:
        operator = account(release.namespace, release.operator)
        pod = cluster.patch(pod, {"metadata": {"annotations": {names.CLAIM: "u/1"}}}, user=operator)
    body = {"metadata": {"annotations": {names.CLAIM: claim}}}
    message = refusal(lambda: cluster.patch(pod, body, user=person))
    assert f"{person} may not change the annotation {names.CLAIM} of pod {namespace}/instance" in message


def test_nobody_else_makes_an_instance_of_a_pod(cluster: Cluster, namespace: str, person: str) -> None:
    pod = _pod(cluster, namespace, "camera", {"app": "camera"})
    assert f"may not change {names.WORKLOAD} of pod" in refusal(
        lambda: cluster.patch(pod, {"metadata": {"labels": {names.WORKLOAD: MINE}}}, user=person)
    )


def test_a_monitor_of_another_namespace_is_anybody_else(
    cluster: Cluster, namespace: str, release: Release, person: str
) -> None:
    pod = _instance(cluster, namespace, MINE)
    stranger = account("elsewhere", names.monitor_account(MINE))
    _may_change_pods(cluster, namespace, stranger)
    message = refusal(lambda: cluster.patch(pod, {"metadata": {"labels": {names.WORKLOAD: None}}}, user=stranger))
    assert "of its own namespace only" in message or f"may not change {names.WORKLOAD}" in message


def test_the_operator_changes_the_labels_of_instances(cluster: Cluster, namespace: str, release: Release) -> None:
    pod = _instance(cluster, namespace, OTHER)
    operator = account(release.namespace, release.operator)
    changed = cluster.patch(pod, {"metadata": {"labels": {names.WORKLOAD: MINE}}}, user=operator)
    assert changed["metadata"]["labels"][names.WORKLOAD] == MINE


@pytest.mark.parametrize("policy", ["monitors", "gates", "labels", "new-pods", "authors", "templates"])
def test_the_policies_have_no_type_errors(cluster: Cluster, release: Release, policy: str) -> None:
    name = f"{release.name}-{policy}"

    def status() -> Object:
        policy = cluster.get("admissionregistration.k8s.io/v1", "ValidatingAdmissionPolicy", name)
        found: Object = policy.get("status") or {}
        return found if found.get("observedGeneration") == policy["metadata"]["generation"] else {}

    checked = until(status, "the controller manager to check the policy's types")
    assert not checked.get("typeChecking", {}).get("expressionWarnings"), checked
