"""A workload that refers to a controller of its own: its pods are used, and it is never written."""

from __future__ import annotations

import pytest

from tests.unit.controller.world import (
    World,
    applied,
    created,
    custom,
    deleted,
    gate,
    hot,
    patched,
    pod,
    policy,
    source_pod,
    standby_pod,
    workload,
)
from understudy.api import names
from understudy.controller.desired import workload_objects
from understudy.controller.observed.workload_reference import ReferencedObjects
from understudy.kube.client import Object


class TestReference:
    def deployment(self, **spec: object) -> Object:
        made = {
            "replicas": 1,
            "selector": {"matchLabels": {"app": "nav", "robot": "17"}},
            "template": {
                "metadata": {"labels": {"app": "nav", "robot": "17", "team": "a"}},
                "spec": {"containers": [{"name": "app", "image": "app:1"}]},
            },
            **spec,
        }
        return custom("Deployment", "nav2", made) | {"apiVersion": "apps/v1"}

    def world(self, referred: ReferencedObjects, *pods: Object) -> World:
        item = workload(workloadRef={"kind": "Deployment", "name": "nav2"})
        return World(item, policy("hot"), hot(), pods=pods, reference=referred)

    def user_pod(self, name: str, **more: object) -> Object:
        owner = {"apiVersion": "apps/v1", "kind": "ReplicaSet", "name": "nav2-1", "uid": "uid-rs", "controller": True}
        return pod(name, owner=owner, **more)  # type: ignore[arg-type]

    def test_the_referenced_controller_is_never_written(self) -> None:
        plan = self.world(ReferencedObjects(self.deployment(), [self.user_pod("nav2-1-x")])).plan()
        assert "nav2" not in applied(plan, "deployments")
        assert "nav2" not in patched(plan, "deployments")
        assert "nav2" not in deleted(plan)
        assert not applied(plan, "replicasets")

    def test_the_pods_of_the_controller_receive_the_labels_that_the_gate_selects(self) -> None:
        plan = self.world(ReferencedObjects(self.deployment(), [self.user_pod("nav2-1-x")])).plan()
        assert patched(plan, "pods")["nav2-1-x"] == {
            "metadata": {"labels": {names.WORKLOAD: "w", names.INSTANCE: "nav2-1-x"}}
        }

    def test_labelled_pods_are_not_changed(self) -> None:
        labelled = self.user_pod("nav2-1-x", labels={names.WORKLOAD: "w", names.INSTANCE: "nav2-1-x"})
        plan = self.world(ReferencedObjects(self.deployment(), [labelled]), labelled).plan()
        assert not patched(plan, "pods")

    def test_pods_of_an_earlier_reference_lose_the_labels(self) -> None:
        earlier = self.user_pod("old-1-x", labels={names.WORKLOAD: "w", names.INSTANCE: "old-1-x"})
        plan = self.world(ReferencedObjects(self.deployment(), []), earlier).plan()
        assert patched(plan, "pods")["old-1-x"] == {
            "metadata": {"labels": {names.WORKLOAD: None, names.INSTANCE: None}}
        }

    def test_a_pod_that_its_controller_released_stays_gated(self) -> None:
        released = pod("nav2-1-x", labels={names.WORKLOAD: "w", names.INSTANCE: "nav2-1-x"})
        plan = self.world(ReferencedObjects(self.deployment(), [self.user_pod("nav2-1-y")]), released).plan()
        assert "nav2-1-x" not in patched(plan, "pods")

    def test_pods_of_a_deleted_workload_lose_the_labels_except_created_ones(self) -> None:
        labelled = self.user_pod("nav2-1-x", labels={names.WORKLOAD: "w", names.INSTANCE: "nav2-1-x"})
        ours = [source_pod("w-a"), standby_pod("w-s", of=workload())]
        assert set(patched(workload_objects.abandoned("w", [labelled, *ours]), "pods")) == {"nav2-1-x"}

    def test_the_selector_of_the_controller_does_not_match_standbys(self) -> None:
        plan = self.world(ReferencedObjects(self.deployment(), [])).plan()
        (standby,) = created(plan, "pods")
        assert {"app", "robot"}.isdisjoint(standby["metadata"]["labels"])
        assert standby["metadata"]["labels"]["team"] == "a"

    def test_a_referenced_workload_needs_another_standby_while_a_standby_is_active(self) -> None:
        world = self.world(ReferencedObjects(self.deployment(), [self.user_pod("nav2-1-x")]))
        driving = standby_pod("w-s", of=world.workload)
        world.own(gate(world.workload, active=driving, epoch=2))
        world.pods = [driving]
        assert len(created(world.plan(), "pods")) == 1
        protected = world.condition("Protected")
        assert (protected["status"], protected["reason"]) == ("False", "StandbyNotReady")
        world.pods.append(standby_pod("w-t", of=world.workload, template_hash=world.template_hash))
        plan = world.plan()
        assert not created(plan, "pods")
        assert not deleted(plan)
        assert world.condition("Protected")["status"] == "True"

    def test_the_pods_of_the_controller_are_gated_from_their_creation(self) -> None:
        found = applied(self.world(ReferencedObjects(self.deployment(), [])).plan(), "networkpolicies")
        assert found["w-standby-ref"]["spec"]["podSelector"] == {"matchLabels": {"app": "nav", "robot": "17"}}
        peers = [peer["podSelector"]["matchExpressions"] for peer in found["w-standby"]["spec"]["ingress"][0]["from"]]
        not_ours = {"key": names.WORKLOAD, "operator": "NotIn", "values": ["w"]}
        assert peers == [
            [not_ours, {"key": "app", "operator": "NotIn", "values": ["nav"]}],
            [not_ours, {"key": "robot", "operator": "NotIn", "values": ["17"]}],
        ]
        assert found["w-standby-ref"]["spec"]["egress"] == found["w-standby"]["spec"]["egress"]

    @pytest.mark.parametrize(
        ("referred", "rivals", "reason"),
        [
            (ReferencedObjects(None), [], "ReferenceNotFound"),
            (
                ReferencedObjects(
                    custom("Deployment", "nav2", {"replicas": 2, "selector": {"matchLabels": {"a": "b"}}})
                ),
                [],
                "ReplicasNotOne",
            ),
            (
                ReferencedObjects(
                    custom("Deployment", "nav2", {"replicas": 1, "selector": {"matchLabels": {"a": "b"}}})
                ),
                ["older"],
                "ReferenceTaken",
            ),
        ],
    )
    def test_a_reference_that_cannot_be_protected_is_reported(
        self, referred: ReferencedObjects, rivals: list[str], reason: str
    ) -> None:
        world = self.world(referred)
        world.rivals = rivals
        assert world.condition("Accepted")["reason"] == reason
        assert "nav2" in world.condition("Accepted")["message"]
        assert not created(world.plan(), "pods")

    @pytest.mark.parametrize(
        ("metadata", "spec", "field"),
        [
            ({}, {"hostNetwork": True}, "spec.hostNetwork"),
            *(
                ({"annotations": {key: "robot-lan"}}, {}, f"metadata.annotations[{key}]")
                for key in ("k8s.v1.cni.cncf.io/networks", "v1.multus-cni.io/default-network")
            ),
        ],
        ids=["host-network", "further-networks", "default-network"],
    )
    def test_a_controller_whose_pods_bypass_the_gate_is_refused(
        self, metadata: Object, spec: Object, field: str
    ) -> None:
        deployment = self.deployment()
        template = deployment["spec"]["template"]
        template["metadata"] |= metadata
        template["spec"] |= spec
        world = self.world(ReferencedObjects(deployment, [self.user_pod("nav2-1-x")]))
        accepted = world.condition("Accepted")
        assert (accepted["status"], accepted["reason"]) == ("False", "TemplateInvalid")
        assert accepted["message"].startswith(f"Deployment nav2: spec.template.{field}")
        plan = world.plan()
        assert not created(plan, "pods")
        assert not applied(plan, "networkpolicies")

    def test_a_second_workload_does_not_change_the_pods_of_the_first_one(self) -> None:
        # With the label of another workload the pod that drives is behind no gate that is open.
        labels = {"app": "nav", "robot": "17", names.WORKLOAD: "older", names.INSTANCE: "nav2-abc"}
        world = self.world(ReferencedObjects(self.deployment(), [pod("nav2-abc", labels=labels)]))
        world.rivals = ["older"]
        assert not patched(world.plan(), "pods")
        mistaken = pod("nav2-abc", labels={**labels, names.WORKLOAD: "w"})
        world.pods = [mistaken]
        world.reference = ReferencedObjects(self.deployment(), [mistaken])
        assert not patched(world.plan(), "pods")
