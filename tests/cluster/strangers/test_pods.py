"""What the account of a compromised monitor cannot do with pods, and what a correct monitor must be able to do.

All is asked of a real API server.
"""

from __future__ import annotations

import pytest

from tests.cluster.monitor_accounts import ACTIVE, MINE, NOWHERE, OTHER, OWNER, refusal
from tests.support.cluster import Cluster, Object
from understudy.api import names
from understudy.api.base import API_VERSION
from understudy.kube import claims
from understudy.kube.client import PODS, Client


def _pod(cluster: Cluster, namespace: str, name: str, labels: dict[str, str]) -> Object:
    owner = {**OWNER, "kind": "FallbackPool" if names.HELD in labels else "RobotWorkload"}
    metadata: Object = {"name": name, "labels": labels, "annotations": {"note": "seen"}, "ownerReferences": [owner]}
    return cluster.create({"apiVersion": "v1", "kind": "Pod", "metadata": metadata, "spec": NOWHERE}, namespace)


def _instance(cluster: Cluster, namespace: str, name: str = ACTIVE) -> Object:
    labels = {names.WORKLOAD: MINE, names.INSTANCE: name, names.TEMPLATE_HASH: "1", "app": "nav"}
    return _pod(cluster, namespace, name, labels)


def _held(cluster: Cluster, namespace: str, name: str = "spare-1") -> Object:
    labels = {names.POOL: "spare", names.HELD: "true", names.INSTANCE: name, names.PART: "3"}
    return _pod(cluster, namespace, name, labels)


@pytest.mark.parametrize(
    "labels",
    [
        {"app": "database"},
        {"app": None},
        {"pod-template-hash": "1"},
        {names.TEMPLATE_HASH: "2"},
        {names.POOL: "spare"},
        {names.SOURCE: "workload"},
        {names.COMPONENT: "monitor"},
        {names.MONITORED: OTHER},
    ],
    ids=lambda labels: "-".join(labels),
)
def test_a_monitor_does_not_change_other_labels_of_its_pods(
    cluster: Cluster, namespace: str, compromised_monitor: str, labels: Object
) -> None:
    pod = _instance(cluster, namespace)
    message = refusal(lambda: cluster.patch(pod, {"metadata": {"labels": labels}}, user=compromised_monitor))
    assert f"would change {next(iter(labels))}" in message


@pytest.mark.parametrize(
    "annotations",
    [
        {"note": "failed"},
        {"note": None},
        {"k8s.v1.cni.cncf.io/networks": "other"},
        {names.PROFILES_HASH: "1"},
        {names.CLAIM: "uid/2"},
        {names.CLAIMED_AT: "1700000000"},
    ],
    ids=lambda annotations: "-".join(annotations),
)
def test_a_monitor_does_not_annotate_its_pods(
    cluster: Cluster, namespace: str, compromised_monitor: str, annotations: Object
) -> None:
    pod = _instance(cluster, namespace)
    message = refusal(lambda: cluster.patch(pod, {"metadata": {"annotations": annotations}}, user=compromised_monitor))
    assert f"would change {next(iter(annotations))}" in message


def _owner(workload: str) -> Object:
    return {"apiVersion": API_VERSION, "kind": "RobotWorkload", "name": workload, "uid": "uid-w", "controller": True}


def _claim(pod: Object, **annotations: str) -> Object:
    return {
        "metadata": {
            "uid": pod["metadata"]["uid"],
            "labels": {names.HELD: None, names.WORKLOAD: MINE},
            "annotations": {names.CLAIM: "uid/1", **annotations},
            "ownerReferences": [_owner(MINE)],
        }
    }


@pytest.mark.parametrize("time", ["²", "9" * 5000, "-1", "soon", ""], ids=["digit", "long", "negative", "word", "none"])
def test_a_claim_has_a_time(cluster: Cluster, namespace: str, compromised_monitor: str, time: str) -> None:
    pod = _held(cluster, namespace)
    claim = _claim(pod, **{names.CLAIMED_AT: time})
    assert "in whole Unix seconds" in refusal(lambda: cluster.patch(pod, claim, user=compromised_monitor))


def test_a_claim_changes_nothing_else(cluster: Cluster, namespace: str, compromised_monitor: str) -> None:
    pod = _held(cluster, namespace)
    for labels in ({"app": "database"}, {names.POOL: None}, {names.PART: "4"}, {names.TEMPLATE_HASH: "2"}):
        claim = _claim(pod)
        claim["metadata"]["labels"] |= labels
        assert "would change" in refusal(lambda claim=claim: cluster.patch(pod, claim, user=compromised_monitor))  # type: ignore[misc]
    claim = _claim(pod, note="failed")
    assert "would change note" in refusal(lambda: cluster.patch(pod, claim, user=compromised_monitor))
    claim = _claim(pod)
    claim["metadata"]["ownerReferences"] = []
    assert "only with a claim and only to RobotWorkload" in refusal(
        lambda: cluster.patch(pod, claim, user=compromised_monitor)
    )


@pytest.mark.parametrize("whole", [True, False], ids=["read", "from-a-table"])
async def test_a_correct_monitor_claims_and_labels_pods(
    correct_monitor: Client, cluster: Cluster, namespace: str, whole: bool
) -> None:
    pod = _held(cluster, namespace)
    if not whole:
        known = ("name", "namespace", "uid", "labels")
        pod = {"metadata": {key: value for key, value in pod["metadata"].items() if key in known}}
    claimed = await claims.claim(correct_monitor, pod, workload=MINE, workload_uid="uid-w", claim="uid-w/1")
    assert claimed["metadata"]["annotations"][names.CLAIM] == "uid-w/1"
    assert claimed["metadata"]["annotations"][names.CLAIMED_AT].isdigit()


async def test_a_correct_monitor_restores_the_labels_of_a_pod(
    correct_monitor: Client, cluster: Cluster, namespace: str
) -> None:
    pod = _instance(cluster, namespace)
    cluster.patch(pod, {"metadata": {"labels": {names.INSTANCE: None}}})
    labels = {names.WORKLOAD: MINE, names.INSTANCE: ACTIVE}
    restored = await correct_monitor.patch(
        PODS, namespace, ACTIVE, {"metadata": {"uid": pod["metadata"]["uid"], "labels": labels}}
    )
    assert restored["metadata"]["labels"] == pod["metadata"]["labels"]
