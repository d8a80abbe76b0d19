"""The pods of shared pools on a real API server: claims, tokens, sizes, new templates, and nodes that are emptied."""

from __future__ import annotations

import json
import threading
import time
import uuid
from collections.abc import Iterator

import pytest

from tests.cluster.operator_objects import identities
from tests.cluster.operators import APPS, CORE, POLICY, RBAC, Fleet, Operator, policy, spare, template, workload
from tests.support.cluster import Cluster, Object, Refused, until
from understudy.api import names
from understudy.cli.plan import size
from understudy.controller.desired import monitor_deployment
from understudy.controller.observed import kube_objects


def claimed_from_a_pool(fleet: Fleet, *, replicas: int) -> Object:
    """A pod that workload w has claimed and that drives it; its pool is filled again."""
    fleet.create(policy("spare", "Restart"), spare(replicas=replicas), workload())
    fleet.wait_built()
    until(lambda: len(fleet.held()) == replicas, "the pool to be filled")
    claimed = fleet.held()[0]
    fleet.make_ready(claimed)
    claimed = fleet.get("Pod", claimed["metadata"]["name"], CORE)
    fleet.claim(claimed)
    fleet.commit(claimed)
    until(lambda: len(fleet.held()) == replicas, "the pool to be refilled")
    return claimed


def test_claimed_pods_belong_to_their_workload_and_the_pool_is_refilled(fleet: Fleet, operator: Operator) -> None:
    claimed = claimed_from_a_pool(fleet, replicas=2)
    until(lambda: fleet.get("FallbackPool", "spare").get("status", {}).get("claimed") == 1, "the claim to be counted")
    # a claimed pod drives and nobody wants another as a standby
    until(lambda: fleet.get("ReplicaSet", "w", APPS)["spec"]["replicas"] == 0, "the workload's own pod to go")
    fleet.cluster.patch(fleet.get("FallbackPool", "spare"), {"spec": {"replicas": 0}})
    until(lambda: not fleet.held(), "the pool to be emptied")
    token = fleet.get("Secret", names.pool_secret("spare"), CORE)
    fleet.cluster.delete(fleet.get("FallbackPool", "spare"))
    time.sleep(3)
    assert claimed["metadata"]["uid"] in identities(fleet.instances())
    assert fleet.get("Secret", names.pool_secret("spare"), CORE)["metadata"]["uid"] == token["metadata"]["uid"]
    assert "spare" in monitor_deployment.commanded(fleet.get("Role", names.monitor("w"), RBAC))
    fleet.cluster.delete(fleet.get("Pod", claimed["metadata"]["name"], CORE))
    until(lambda: fleet.get("ReplicaSet", "w", APPS)["spec"]["replicas"] == 1, "the workload's own pod to come back")
    until(lambda: fleet.find("Secret", names.pool_secret("spare"), CORE) is None, "its agent's token to go")
    until(
        lambda: "spare" not in monitor_deployment.commanded(fleet.get("Role", names.monitor("w"), RBAC)),
        "the right to go",
    )


def test_a_pool_that_is_deleted_without_an_operator_leaves_the_token_of_a_claimed_pod(fleet: Fleet) -> None:
    def token() -> Object | None:
        return fleet.find("Secret", names.pool_secret("spare"), CORE)

    with Operator(fleet.cluster.kubeconfig, fleet.namespace):
        claimed = claimed_from_a_pool(fleet, replicas=1)
    before = token()
    assert before is not None
    fleet.cluster.delete(fleet.get("FallbackPool", "spare"))
    until(lambda: not fleet.held(), "what is the pool's to be collected", seconds=60)
    time.sleep(5)
    assert (token() or {}).get("metadata", {}).get("uid") == before["metadata"]["uid"]
    with Operator(fleet.cluster.kubeconfig, fleet.namespace):
        fleet.wait_condition("FailurePolicy", "policy", "Accepted", "PoolNotFound")
        assert (token() or {}).get("metadata", {}).get("uid") == before["metadata"]["uid"]
        fleet.cluster.delete(fleet.get("Pod", claimed["metadata"]["name"], CORE))
        until(lambda: token() is None, "the token that nobody needs to go")


def test_the_token_that_a_pool_of_an_earlier_version_owns_is_taken_from_it(fleet: Fleet) -> None:
    with Operator(fleet.cluster.kubeconfig, fleet.namespace, resync_every=1):
        fleet.create(spare(replicas=0))
        token = until(lambda: fleet.find("Secret", names.pool_secret("spare"), CORE), "its token")
        assert token is not None
        owner = kube_objects.owner("FallbackPool", fleet.get("FallbackPool", "spare"))
        fleet.cluster.patch(token, {"metadata": {"ownerReferences": [owner], "labels": {names.POOL: None}}})

        def released() -> bool:
            metadata = fleet.get("Secret", names.pool_secret("spare"), CORE)["metadata"]
            return not metadata.get("ownerReferences") and metadata["labels"].get(names.POOL) == "spare"

        until(released, "it to be nobody's")
        assert fleet.get("Secret", names.pool_secret("spare"), CORE)["data"] == token["data"]


def test_a_pool_is_never_overfilled_while_pods_come_and_go(fleet: Fleet, operator: Operator) -> None:
    fleet.create(spare(replicas=4), workload(), policy("spare"))
    most, begun = 0, time.monotonic()
    full: float | None = None  # when it first was
    while (now := time.monotonic()) < (begun + 60 if full is None else full + 8):
        found = fleet.held()
        most = max(most, len(found))
        if len(found) == 4:
            full = full or now
            fleet.cluster.delete(found[0])
            fleet.cluster.patch(
                fleet.get("FallbackPool", "spare"), {"metadata": {"labels": {"n": str(time.time_ns())}}}
            )
    assert most == 4


def test_a_pool_s_size_follows_the_failures_that_its_robots_status_tells_of(
    fleet: Fleet, operator: Operator, capsys: pytest.CaptureFixture[str]
) -> None:
    sizing = {"risk": "1%", "failuresPerRobotHour": 1, "refill": "10m", "max": 5}
    pool = spare(sizing=sizing)
    del pool["spec"]["replicas"]
    fleet.create(policy("spare"), pool, workload())
    assumed = until(lambda: (fleet.get("FallbackPool", "spare").get("status") or {}).get("sizing"), "a size")
    assert (assumed["size"], assumed["failures"], assumed["robots"]) == (3, 0, 1)
    asked = ("--robots=1", "--failures-per-robot-hour=1", "--recovery-seconds=2", "--refill-seconds=600", "--risk=0.01")
    assert size.main([*asked, "-o", "json"]) == 0
    assert json.loads(capsys.readouterr().out)["needed"]["loss"] == assumed["size"], "understudy size comes to the same"
    until(lambda: len(fleet.held()) == 3, "the pods that it asks for")
    detected = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time.time() + 1))
    time.sleep(2)
    attempts = [{"strategy": "Fallback/Uninitialized", "pod": "spare-abcde", "result": "Verified"}]
    recovery = {"reason": "it ended", "result": "Recovered", "moments": {"detected": detected}, "attempts": attempts}
    failed = {"recoveryCount": 10, "recoveries": [{"id": str(number), **recovery} for number in range(10)]}
    fleet.cluster.patch(fleet.get("RobotWorkload", "w"), {"status": failed}, subresource="status")
    until(lambda: len(fleet.held()) == 5, "as many as there may be")
    found = fleet.wait_condition("FallbackPool", "spare", "Sized", "AtMaximum")
    assert "requested a pod 10 times" in found["message"]
    assert "spec.sizing.max is 5" in found["message"]
    told = until(lambda: fleet.told("spare", "Resized"), "an Event, which comes after the status")
    assert [event["message"].partition(":")[0] for event in told] == ["from 3 to 5 pods"]
    before = fleet.settled()
    operator.stop()
    with Operator(fleet.cluster.kubeconfig, fleet.namespace):
        assert fleet.settled() == before


def test_a_rollout_of_a_pool_s_template_keeps_the_configured_number_ready(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("spare"), spare(replicas=3, updateStrategy={"minReady": 2}), workload())
    until(lambda: len(fleet.held()) == 3, "three held pods")
    old = fleet.held()
    for pod in old:
        fleet.make_ready(pod)
    until(lambda: fleet.get("FallbackPool", "spare").get("status", {}).get("ready") == 3, "all of them to be ready")
    fleet.cluster.patch(fleet.get("FallbackPool", "spare"), {"spec": {"template": template(args=["--new"])}})

    def counts() -> tuple[int, int]:
        held = identities(fleet.held())
        return len(held - identities(old)), len(held & identities(old))

    until(lambda: counts() == (3, 2), "three new ones, and two of the old ones")
    new = [pod for pod in fleet.held() if pod["metadata"]["uid"] not in identities(old)]
    until(
        lambda: (
            "2 of 5 unclaimed pods" in fleet.wait_condition("FallbackPool", "spare", "Updated", "RollingOut")["message"]
        ),
        "what is so to be told",
    )
    fleet.make_ready(new[0])
    until(lambda: fleet.get("FallbackPool", "spare")["status"].get("updated") == 3, "its numbers")
    time.sleep(2)
    assert len(fleet.held()) == 5
    assert fleet.get("FallbackPool", "spare")["status"]["ready"] == 2, "those of the old template"
    fleet.make_ready(new[1])
    until(lambda: identities(fleet.held()) == identities(new), "the old ones to go")
    fleet.wait_condition("FallbackPool", "spare", "Updated", "Updated", "True")


def test_on_replenish_pods_of_an_old_template_wait_on_and_may_be_claimed(fleet: Fleet, operator: Operator) -> None:
    fleet.create(policy("spare"), spare(replicas=2, updateStrategy={"type": "OnReplenish"}), workload())
    fleet.wait_built()
    until(lambda: len(fleet.held()) == 2, "two held pods")
    old = fleet.held()
    for pod in old:
        fleet.make_ready(pod)
    fleet.cluster.patch(fleet.get("FallbackPool", "spare"), {"spec": {"template": template(args=["--new"])}})
    fleet.wait_condition("FallbackPool", "spare", "Updated", "OnReplenish", "True")
    assert identities(fleet.held()) == identities(old)
    assert fleet.get("FallbackPool", "spare")["status"]["ready"] == 2
    settings = json.loads(fleet.get("ConfigMap", "w-settings", CORE)["data"]["settings.json"])
    assert settings["pools"][0].get("templateHash", "") == ""
    claimed = fleet.get("Pod", old[0]["metadata"]["name"], CORE)
    fleet.claim(claimed)
    fleet.commit(claimed)
    until(lambda: len(fleet.held()) == 2, "another in its place")
    (new,) = [pod for pod in fleet.held() if pod["metadata"]["uid"] not in identities(old)]
    assert new["metadata"]["labels"][names.TEMPLATE_HASH] != old[0]["metadata"]["labels"][names.TEMPLATE_HASH]


@pytest.fixture
def nodes(cluster: Cluster) -> Iterator[list[Object]]:
    """Two nodes that nothing runs on, and that no scheduler takes: pods of other tests would wait there for ever."""
    taint = {"key": "understudy.dev/test", "effect": "NoSchedule"}
    made = []
    stop = threading.Event()

    def beat() -> None:
        """What kubelets say again and again, or Kubernetes takes their nodes as lost, here after 6 s."""
        begun = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        ready = {"type": "Ready", "status": "True", "reason": "Test", "message": "", "lastTransitionTime": begun}
        while True:
            moment = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
            for node in made:
                said = {"status": {"conditions": [ready | {"lastHeartbeatTime": moment}]}}
                cluster.patch(node, said, subresource="status")
            if stop.wait(1):
                return

    for number in range(2):
        name = f"understudy-{uuid.uuid4().hex[:6]}-{number}"
        node = {"apiVersion": CORE, "kind": "Node", "metadata": {"name": name}, "spec": {"taints": [taint]}}
        made.append(cluster.create(node))
        cluster.patch(made[-1], {"spec": {"taints": [taint]}})
    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    yield made
    stop.set()
    thread.join(40)
    for node in made:
        cluster.delete(node)


def test_pods_on_a_node_that_is_to_be_emptied_are_replaced_before_they_go(
    fleet: Fleet, operator: Operator, nodes: list[Object]
) -> None:
    def place(pod: Object, node: Object) -> None:
        """What a scheduler does, and then a kubelet."""
        target = {"apiVersion": CORE, "kind": "Node", "name": node["metadata"]["name"]}
        body = {"apiVersion": CORE, "kind": "Binding", "metadata": {"name": pod["metadata"]["name"]}, "target": target}
        path = fleet.cluster.path(CORE, "Pod", fleet.namespace, pod["metadata"]["name"], "binding")
        fleet.cluster.request("POST", path, body=body)
        fleet.make_ready(pod)

    def evict(pod: Object) -> None:
        """What ``kubectl drain`` asks for."""
        metadata = {"name": pod["metadata"]["name"], "namespace": fleet.namespace}
        path = fleet.cluster.path(CORE, "Pod", fleet.namespace, pod["metadata"]["name"], "eviction")
        fleet.cluster.request("POST", path, body={"apiVersion": POLICY, "kind": "Eviction", "metadata": metadata})

    fleet.create(policy("spare"), spare(replicas=1), workload())
    (old,) = until(fleet.held, "a held pod")
    place(old, nodes[0])
    until(lambda: fleet.get("FallbackPool", "spare").get("status", {}).get("ready") == 1, "it to be ready")
    fleet.cluster.patch(nodes[0], {"spec": {"unschedulable": True}})
    until(lambda: len(fleet.held()) == 2, "another one beside it")
    with pytest.raises(Refused, match="disruption budget") as refused:
        evict(old)
    assert refused.value.status == 429
    assert identities([old]) <= identities(fleet.held())
    found = fleet.wait_condition("FallbackPool", "spare", "Moving", "NodeLeaves", "True")
    assert nodes[0]["metadata"]["name"] in found["message"]
    (new,) = [pod for pod in fleet.held() if pod["metadata"]["uid"] != old["metadata"]["uid"]]
    place(new, nodes[1])
    until(lambda: identities(fleet.held()) == identities([new]), "the one on the cordoned node to go")
    until(lambda: not fleet.condition("FallbackPool", "spare", "Moving"), "that to be over")
