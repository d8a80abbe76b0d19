"""Late, repeated and missing changes of the cluster."""

from __future__ import annotations

from typing import Any

import pytest

from tests.unit.controller.world import held_pod, hot, pod, policy, source_pod, spare, standby_pod, workload
from understudy.api import names
from understudy.controller.observed import kube_objects, pod_diagnosis
from understudy.controller.pods.pod_counts import EXPECTED_SECONDS
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.expectations import Expectations
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.runtime.resync import kept
from understudy.kube.client import (
    CONFIG_MAPS,
    DEPLOYMENTS,
    NETWORK_POLICIES,
    PODS,
    POLICIES,
    POOLS,
    SECRETS,
    WORKLOADS,
    Object,
)


def at(item: Object, version: int) -> Object:
    return {**item, "metadata": {**item["metadata"], "resourceVersion": str(version)}}


def test_an_older_version_of_an_object_changes_nothing() -> None:
    store = Store()
    store.put(PODS, at(pod("a", ready=True), 5))
    assert store.put(PODS, at(pod("a", ready=False), 4)) is None
    assert store.put(PODS, at(pod("a", ready=False), 5)) is None
    found = store.get(PODS, "fleet", "a")
    assert found is not None
    assert found["metadata"]["resourceVersion"] == "5"


def test_an_old_list_does_not_restore_a_deleted_object() -> None:
    store = Store()
    store.put(PODS, at(pod("a"), 5))
    store.remove(PODS, at(pod("a"), 8))
    assert store.replace(PODS, [at(pod("a"), 5)], 6, None) == []
    assert store.get(PODS, "fleet", "a") is None


def test_a_recreated_object_with_the_same_name_is_a_different_object() -> None:
    store = Store()
    store.put(PODS, at(pod("a"), 5))
    store.remove(PODS, at(pod("a"), 8))
    again = at(pod("a"), 9)
    again["metadata"]["uid"] = "uid-other"
    assert store.put(PODS, again) is not None
    assert store.remove(PODS, at(pod("a"), 8)) is None


def test_a_list_does_not_remove_an_object_that_is_newer_than_the_list() -> None:
    store = Store()
    store.put(PODS, at(pod("new"), 12))
    store.replace(PODS, [], 10, None)
    assert store.get(PODS, "fleet", "new") is not None


def test_a_list_finds_changes_that_the_watch_missed() -> None:
    store = Store()
    store.put(PODS, at(pod("a"), 5))
    store.put(PODS, at(pod("b"), 5))
    changes = store.replace(PODS, [at(pod("b", ready=False), 7), at(pod("c"), 8)], 10, None)
    assert sorted(s.resource.plural + (s.new or s.old or {})["metadata"]["name"] for s in changes) == [
        "podsa",
        "podsb",
        "podsc",
    ]


def test_a_list_of_one_namespace_does_not_change_others() -> None:
    store = Store()
    store.put(PODS, at(pod("a"), 5))
    store.replace(PODS, [], 10, "elsewhere")
    assert store.get(PODS, "fleet", "a") is not None


def test_objects_are_indexed_by_label_and_owner() -> None:
    store = Store()
    item = workload()
    store.put(PODS, at(standby_pod("w-s", of=item), 5))
    assert len(store.labelled(PODS, "fleet", names.WORKLOAD, "w")) == 1
    assert set(store.owned("uid-w")) == {("pods", "w-s")}
    bare = at(pod("w-s"), 6)
    store.put(PODS, bare)
    assert store.labelled(PODS, "fleet", names.WORKLOAD, "w") == []
    assert store.owned("uid-w") == {}


def test_the_data_of_secrets_is_not_stored() -> None:
    store = Store()
    store.put(
        SECRETS,
        at({"kind": "Secret", "metadata": {"name": "s", "namespace": "fleet", "uid": "u"}, "data": {"token": "x"}}, 1),
    )
    assert "data" not in (store.get(SECRETS, "fleet", "s") or {})


def test_a_stored_pod_status_contains_only_what_its_diagnosis_needs() -> None:
    """Then most pods of a fleet say the same, and it is kept once."""
    item = pod("a", ready=True)
    waiting = {"reason": "ImagePullBackOff", "message": "no such image"}
    item["status"] |= {
        "podIP": "10.0.0.1",
        "containerStatuses": [
            {"name": "app", "image": "i", "containerID": "c", "state": {"waiting": waiting}, "restartCount": 1}
        ],
    }
    store = Store()
    store.put(PODS, at(item, 1))
    kept = store.get(PODS, "fleet", "a")
    assert kept is not None
    assert kube_objects.ready(kept)
    assert pod_diagnosis.trouble(kept) == pod_diagnosis.trouble(item) is not None
    assert "10.0.0.1" not in str(kept)


def test_only_objects_of_understudy_are_stored() -> None:
    assert kept(WORKLOADS, workload())
    assert kept(PODS, source_pod("w-a"))
    assert not kept(PODS, pod("stranger"))
    assert not kept(CONFIG_MAPS, {"metadata": {"name": "c", "labels": {"a": "b"}}})


class TestChangeIndex:
    def store(self) -> Store:
        store = Store()
        for resource, item in (
            (WORKLOADS, workload("w")),
            (WORKLOADS, workload("v", failurePolicyRef={"name": "other"})),
            (POLICIES, policy("hot", "spare")),
            (POLICIES, policy("hot", name="other")),
            (POOLS, hot()),
            (POOLS, spare()),
        ):
            store.put(resource, item)
        return store

    def keys(self, change: ObservedChange) -> set[tuple[str, str]]:
        return {(key.plural, key.name) for key in change_index.of(change, self.store()).keys}

    def test_an_instance_reconciles_its_workload(self) -> None:
        assert self.keys(ObservedChange(PODS, None, source_pod("w-a"))) == {("robotworkloads", "w")}

    def test_a_standby_reconciles_its_workload_and_its_pool(self) -> None:
        found = self.keys(ObservedChange(PODS, None, standby_pod("w-s", of=workload())))
        assert found == {("robotworkloads", "w"), ("fallbackpools", "hot")}

    def test_an_unclaimed_pod_reconciles_its_pool_and_the_workloads_whose_policy_names_it(self) -> None:
        found = self.keys(ObservedChange(PODS, None, held_pod("spare-a", of=spare())))
        assert found == {("fallbackpools", "spare"), ("robotworkloads", "w")}

    def test_one_of_several_unclaimed_pods_reconciles_only_its_pool(self) -> None:
        """Or a fleet's workloads would all be looked at with each claim, and with each step of a pod that comes up."""
        store, pool = self.store(), spare()
        first = ObservedChange(PODS, None, held_pod("spare-a", of=pool))
        for others, known in ((0, True), (1, False)):
            if others:
                store.put(PODS, held_pod("spare-b", of=pool))
            found = {(key.plural, key.name) for key in change_index.of(first, store).keys}
            assert ("fallbackpools", "spare") in found
            assert (("robotworkloads", "w") in found) is known

    def test_an_unclaimed_pod_reconciles_workloads_if_the_others_are_reserved_or_not_ready(self) -> None:
        for pool, other in (
            (spare(reserve={"pods": 1, "poolPriority": 100}), held_pod("spare-b", of=spare())),
            (spare(), held_pod("spare-b", of=spare(), ready=False)),
        ):
            store = self.store()
            store.put(POOLS, at(pool, 11))
            store.put(PODS, other)
            found = change_index.of(ObservedChange(PODS, None, held_pod("spare-a", of=spare())), store).keys
            assert Key("robotworkloads", "fleet", "w") in found

    @pytest.mark.parametrize("others", [0, 1])
    def test_a_claim_reads_the_pods_of_its_pool_once(self, monkeypatch: pytest.MonkeyPatch, others: int) -> None:
        store, before = self.store(), held_pod("spare-a", of=spare())
        for number in range(others):
            store.put(PODS, held_pod(f"spare-{number}", of=spare()))
        labels = {names.WORKLOAD: "v", names.POOL: "spare"}
        claimed = at(pod("spare-a", labels=labels, annotations={names.CLAIM: "v"}), 9)
        looks: list[Any] = []
        labelled = store.labelled

        def looking(*arguments: Any) -> Any:
            looks.append(arguments)
            return labelled(*arguments)

        monkeypatch.setattr(store, "labelled", looking)
        found = change_index.of(ObservedChange(PODS, before, claimed), store)
        assert len(looks) == 1
        assert found.is_claim is bool(others)
        assert (Key("robotworkloads", "fleet", "w") in found.keys) is not bool(others)
        assert Key("robotworkloads", "fleet", "v") in found.keys

    def test_the_policy_of_claimed_pods_is_part_of_a_claim(self) -> None:
        """Its write follows that of the pod, in the middle of a recovery."""
        owner = kube_objects.owner("RobotWorkload", workload())
        before = {"metadata": {"name": "w-claimed", "namespace": "fleet", "uid": "u", "ownerReferences": [owner]}}
        found = change_index.of(ObservedChange(NETWORK_POLICIES, before, at(before, 9)), self.store())
        assert (found.keys, found.is_claim) == ({Key("robotworkloads", "fleet", "w")}, True)

    def test_an_unclaimed_pod_is_of_no_workload(self) -> None:
        found = self.keys(ObservedChange(PODS, None, held_pod("spare-a", of=spare())))
        assert ("robotworkloads", "") not in found

    def test_a_claim_tampers_with_no_label(self) -> None:
        after = at(pod("spare-a", labels={names.WORKLOAD: "w", names.INSTANCE: "spare-a", names.POOL: "spare"}), 9)
        before = held_pod("spare-a", of=spare())
        del before["metadata"]["labels"][names.COMPONENT]
        after["metadata"] |= {
            "uid": before["metadata"]["uid"],
            "ownerReferences": [kube_objects.owner("RobotWorkload", workload())],
        }
        assert change_index.tampered(ObservedChange(PODS, before, after)) is None

    def test_a_claim_reconciles_the_pool_and_the_workload(self) -> None:
        before = held_pod("spare-a", of=spare())
        after = at(pod("spare-a", labels={names.WORKLOAD: "v", names.POOL: "spare"}), 9)
        found = self.keys(ObservedChange(PODS, before, after))
        assert {("fallbackpools", "spare"), ("robotworkloads", "v")} <= found

    def test_a_changed_policy_reconciles_its_workloads(self) -> None:
        assert self.keys(ObservedChange(POLICIES, None, policy("hot"))) == {
            ("failurepolicies", "policy"),
            ("robotworkloads", "w"),
        }

    def test_a_changed_status_reconciles_only_its_own_object(self) -> None:
        old, new = workload("w"), workload("w", status={"health": "Healthy"})
        assert self.keys(ObservedChange(WORKLOADS, old, new)) == {("robotworkloads", "w")}

    def test_an_object_reconciles_the_workload_that_owns_it(self) -> None:
        from tests.unit.controller.world import gate

        found = self.keys(ObservedChange(NETWORK_POLICIES, None, gate(workload())))
        assert ("robotworkloads", "w") in found

    def test_an_unlabelled_pod_of_a_referenced_deployment_reconciles_the_workload(self) -> None:
        store = Store()
        store.put(WORKLOADS, workload("r", workloadRef={"kind": "Deployment", "name": "nav2"}))
        owner = {"kind": "ReplicaSet", "name": "nav2-5d8f", "uid": "u", "controller": True}
        new = pod("nav2-5d8f-x", labels={"pod-template-hash": "5d8f"}, owner=owner)
        assert change_index.referring(PODS, new, store) == {Key("robotworkloads", "fleet", "r")}
        assert change_index.referring(PODS, pod("stranger"), store) == set()

    def test_a_referenced_controller_also_reconciles_the_pools_that_copy_its_template(self) -> None:
        store = Store()
        store.put(WORKLOADS, workload("r", workloadRef={"kind": "Deployment", "name": "nav2"}))
        store.put(POOLS, spare(templateFrom={"workload": "r"}))
        found = {Key("robotworkloads", "fleet", "r"), Key("fallbackpools", "fleet", "spare")}
        deployment = {"kind": "Deployment", "metadata": {"name": "nav2", "namespace": "fleet"}}
        assert change_index.referring(DEPLOYMENTS, deployment, store) == found
        assert set(change_index.unlisted(store)) == found


def test_expectations_end_when_they_are_met_or_expire() -> None:
    now = [0.0]
    expectations = Expectations(clock=lambda: now[0])
    key = Key("fallbackpools", "fleet", "spare")
    expectations.expect(key, "spare", "spare-a")
    expectations.expect(key, "spare", "spare-b")
    assert expectations.count(key, "spare") == 2
    expectations.settled(key, "spare", "spare-a")
    assert expectations.count(key, "spare") == 1
    assert expectations.count(key, "other") == 0
    now[0] = EXPECTED_SECONDS
    assert expectations.count(key, "spare") == 0


def test_an_observed_pod_is_no_longer_expected_even_if_the_answer_was_lost() -> None:
    expectations = Expectations()
    key = Key("fallbackpools", "fleet", "spare")
    expectations.expect(key, "spare", "spare-a")
    expectations.expect(key, "spare", "spare-b")
    assert expectations.count(key, "spare", observed=lambda name: name == "spare-a") == 1
    assert expectations.count(key, "spare") == 1


def test_a_change_from_several_sources_is_noticed_once() -> None:
    store, noticed = Store(), list[ObservedChange]()
    store.noticed = noticed.append
    store.put(PODS, at(pod("a"), 5))  # the answer to a write of ours
    store.put(PODS, at(pod("a"), 5))  # the watch
    store.replace(PODS, [at(pod("a"), 5)], 6, None)
    store.remove(PODS, at(pod("a"), 7))
    assert [(change.old is None, change.new is None) for change in noticed] == [(True, False), (False, True)]


def test_a_list_by_label_does_not_remove_objects_without_the_label() -> None:
    store = Store()
    store.put(NETWORK_POLICIES, at(pod("unlabelled"), 5))
    store.replace(NETWORK_POLICIES, [], 10, None, covered=lambda item: False)
    assert store.get(NETWORK_POLICIES, "fleet", "unlabelled") is not None


class TestReleasedPods:
    """A ReplicaSet releases a pod whose labels somebody removed. It still runs, so it is still known."""

    @staticmethod
    def stripped(**metadata: Any) -> Any:
        found = source_pod("w-a")
        found["metadata"] |= {"labels": {}, "ownerReferences": [], **metadata}
        agent = {"name": names.AGENT_CONTAINER, "env": [{"name": names.WORKLOAD_VARIABLE, "value": "w"}]}
        found["spec"] = {"nodeName": "node-1", "containers": [{"name": "app"}, agent]}
        return at(found, 9)

    def test_a_pod_without_labels_and_owner_is_kept_as_that_of_its_workload(self) -> None:
        store, released = Store(), self.stripped()
        assert kept(PODS, released)
        store.put(PODS, at(source_pod("w-a"), 5))
        change = store.put(PODS, released)
        assert [kube_objects.name(item) for item in store.released("fleet", "w")] == ["w-a"]
        assert change is not None
        assert change_index.of(change, store).keys == {Key("robotworkloads", "fleet", "w")}
        store.put(PODS, at(source_pod("w-a"), 10))
        assert not store.released("fleet", "w")

    def test_it_affects_its_workload_also_if_it_was_never_seen_with_labels(self) -> None:
        store = Store()
        change = store.put(PODS, self.stripped())
        assert change is not None
        assert change_index.of(change, store).keys == {Key("robotworkloads", "fleet", "w")}

    def test_a_pod_of_somebody_else_is_not_kept(self) -> None:
        assert not kept(PODS, at(pod("w-a"), 9))

    def test_a_standby_without_labels_affects_the_workload_that_owns_it(self) -> None:
        standby = standby_pod("w-s", of=workload())
        standby["metadata"]["labels"] = {}
        found = change_index.of(ObservedChange(PODS, None, standby), Store())
        assert found.keys == {Key("robotworkloads", "fleet", "w")}
