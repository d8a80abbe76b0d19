"""What a RobotWorkload comes to, and above all what never happens to it."""

from __future__ import annotations

import json

import pytest

from tests.support.golden import assert_golden
from tests.unit.controller.world import (
    IMAGES,
    NAMESPACE,
    World,
    applied,
    claimed_pod,
    created,
    deleted,
    gate,
    hot,
    patched,
    policy,
    source_pod,
    spare,
    standby_pod,
    workload,
)
from understudy.api import names
from understudy.controller.desired import workload_objects
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Apply
from understudy.kube.client import Object
from understudy.kube.gates import registry


def every_object(world: World) -> list[Object]:
    plan = world.plan()
    return [write.body for write in plan.writes if hasattr(write, "body") and "metadata" in write.body]


def test_every_object_of_a_workload_is_created() -> None:
    world = World(workload(), policy("hot", "Restart"), hot())
    plan = world.plan()
    assert set(applied(plan, "replicasets")) == {"w"}
    assert set(applied(plan, "networkpolicies")) == {"w-standby", "w-control-plane"}
    assert [kube_objects.name(body) for body in created(plan, "networkpolicies")] == ["w-gate"]
    assert set(applied(plan, "configmaps")) == {"w-robot-env", "w-robot-profiles", "w-instance-profiles", "w-settings"}
    assert set(applied(plan, "deployments")) == {"w-monitor", "w-discovery"}
    assert set(applied(plan, "services")) == {"w-discovery"}
    assert set(applied(plan, "serviceaccounts")) == {"w-understudy-monitor"}
    assert set(applied(plan, "roles")) == set(applied(plan, "rolebindings")) == {"w-monitor"}
    assert [kube_objects.name(body) for body in created(plan, "secrets")] == ["w-agent"]
    assert [kube_objects.name(body) for body in created(plan, "pods")] == ["w-new01"]


def test_every_object_is_owned_by_the_workload_without_blocking_its_deletion() -> None:
    for body in every_object(World(workload(), policy("hot"), hot())):
        (owner,) = body["metadata"]["ownerReferences"]
        assert (owner["kind"], owner["name"], owner["controller"]) == ("RobotWorkload", "w", True), body["kind"]
        assert owner["blockOwnerDeletion"] is False
        assert body["metadata"]["namespace"] == NAMESPACE


def test_no_object_has_a_finalizer() -> None:
    assert "finalizers" not in json.dumps(every_object(World(workload(), policy("hot", "spare"), hot(), spare())))


def test_network_policies_are_written_before_the_pods_that_they_restrict() -> None:
    plan = World(workload(), policy("hot"), hot()).plan()
    order = [write.resource.plural for write in plan.writes]
    assert max(i for i, plural in enumerate(order) if plural == "networkpolicies") < min(
        order.index("replicasets"), order.index("pods")
    )


def test_no_instance_is_created_before_the_discovery_server_has_an_address() -> None:
    world = World(workload(), policy("hot"), hot())
    world.owned.clear()
    plan = world.plan()
    assert {write.resource.plural for write in plan.writes} == {"services"}
    assert world.condition("Reconciled")["reason"] == "InProgress"


def test_the_discovery_server_announces_the_address_of_its_service() -> None:
    world = World(workload(), policy("hot"), hot())
    (container,) = applied(world.plan(), "deployments")["w-discovery"]["spec"]["template"]["spec"]["containers"]
    assert container["args"] == ["10.96.0.9", "11811"], "images of all versions take these"


def test_the_discovery_server_prefers_a_node_without_instances() -> None:
    pod = applied(World(workload(), policy("Restart")).plan(), "deployments")["w-discovery"]["spec"]["template"]
    (term,) = pod["spec"]["affinity"]["podAntiAffinity"]["preferredDuringSchedulingIgnoredDuringExecution"]
    assert term["podAffinityTerm"]["topologyKey"] == "kubernetes.io/hostname"
    instance = source_pod("w-a")["metadata"]["labels"]
    assert term["podAffinityTerm"]["labelSelector"]["matchLabels"].items() <= instance.items()
    assert not term["podAffinityTerm"]["labelSelector"]["matchLabels"].items() <= pod["metadata"]["labels"].items()


def test_a_recreated_discovery_service_requests_its_former_address() -> None:
    world = World(workload(), policy("hot"), hot())
    world.build()
    del world.owned[("services", "w-discovery")]
    assert applied(world.plan(), "services")["w-discovery"]["spec"]["clusterIP"] == "10.96.0.9"


def test_a_discovery_server_is_deleted_if_it_is_no_longer_managed() -> None:
    world = World(workload(), policy("hot"), hot())
    world.build()
    world.workload["spec"]["ros"] = {"discovery": {"mode": "External", "server": "10.0.0.7:11811"}}
    plan = world.plan()
    assert sorted(deleted(plan)) == ["w-discovery", "w-discovery"]
    assert applied(plan, "configmaps")["w-robot-env"]["data"]["ROS_DISCOVERY_SERVER"] == "10.0.0.7:11811"


class TestGate:
    def test_a_new_gate_is_closed(self) -> None:
        (made,) = created(World(workload(), policy("Restart")).plan(), "networkpolicies")
        assert registry.DEFAULT.let_through(made) == ()
        assert made["spec"]["podSelector"]["matchExpressions"][1]["values"] == [names.NOBODY]
        assert made["metadata"]["annotations"][names.EPOCH] == "0"

    def test_an_existing_gate_is_not_written(self) -> None:
        world = World(workload(), policy("hot"), hot())
        active = source_pod("w-a")
        world.pods = [active]
        world.own(gate(world.workload, active=active, epoch=41))
        plan = world.plan()
        assert "w-gate" not in applied(plan, "networkpolicies")
        assert not created(plan, "networkpolicies")
        assert not patched(plan, "networkpolicies")

    def test_repair_of_a_gate_does_not_change_its_selector_and_annotations(self) -> None:
        world = World(workload(), policy("Restart"))
        active = source_pod("w-a")
        broken = gate(world.workload, active=active, epoch=41)
        broken["spec"]["egress"] = []
        broken["metadata"]["labels"] = {}
        world.own(broken)
        patch = patched(world.plan(), "networkpolicies")["w-gate"]
        rules = gate(world.workload, active=active, epoch=41)["spec"]["egress"]
        assert patch["spec"] == {"policyTypes": ["Egress"], "egress": rules, "ingress": None}
        assert "podSelector" not in patch["spec"]
        assert set(patch["metadata"]) == {"labels"}

    @pytest.mark.parametrize("pause", [None, {"reason": "work", "owner": "somebody"}], ids=["watched", "paused"])
    @pytest.mark.parametrize(
        "selector", [{}, {"matchLabels": {names.WORKLOAD: "w"}}], ids=["every-pod", "every-instance"]
    )
    def test_a_gate_that_does_not_name_its_instances_is_restored_from_its_record(
        self, selector: Object, pause: Object | None
    ) -> None:
        world = World(workload(**({"pause": pause} if pause else {})), policy("Restart"))
        active = source_pod("w-a")
        broken = gate(world.workload, active=active, epoch=41)
        broken["spec"]["podSelector"] = selector
        world.own(broken)
        assert patched(world.plan(), "networkpolicies")["w-gate"] == registry.DEFAULT.routing("w", "w-a")

    def test_a_recreated_gate_continues_at_the_epoch_of_the_status(self) -> None:
        world = World(workload(status={"gate": {"epoch": 41, "active": "w-a"}}), policy("Restart"))
        (made,) = created(world.plan(), "networkpolicies")
        assert made["metadata"]["annotations"][names.EPOCH] == "41"


class TestInvalidInput:
    def built(self, *others: Object) -> World:
        world = World(workload(), *others)
        active = source_pod("w-a")
        world.pods = [active, standby_pod("w-s", of=world.workload)]
        world.build()
        world.own(gate(world.workload, active=active, epoch=1))
        world.pods[1] = standby_pod("w-s", of=world.workload, template_hash=world.template_hash)
        return world

    def test_a_missing_policy_removes_nothing_that_protects(self) -> None:
        world = self.built(policy("hot", "spare"), hot(), spare())
        before = world.owned[("configmaps", "w-settings")]["data"]
        world.others = [hot(), spare()]
        plan = world.plan()
        assert not deleted(plan)
        assert applied(plan, "configmaps")["w-settings"]["data"] == before
        rules = applied(plan, "roles")["w-monitor"]["rules"]
        assert rules == world.owned[("roles", "w-monitor")]["rules"]
        assert world.condition("Accepted")["reason"] == "PolicyNotFound"
        assert world.condition("Protected")["status"] == "False"

    def test_a_policy_with_an_invalid_tree_removes_nothing_that_protects(self) -> None:
        world = self.built(policy("hot"), hot())
        world.others = [policy("hot", tree={"topik": {}}), hot()]
        assert not deleted(world.plan())
        accepted = world.condition("Accepted")
        assert accepted["reason"] == "PolicyNotAccepted"
        assert "spec.monitoring.yaml" in accepted["message"]
        assert "topik" in accepted["message"]

    def test_an_invalid_template_changes_nothing(self) -> None:
        world = self.built(policy("hot"), hot())
        world.workload["spec"]["template"]["spec"]["hostNetwork"] = True
        assert world.plan().writes == []
        assert world.condition("Accepted")["reason"] == "TemplateInvalid"
        assert "hostNetwork" in world.condition("Accepted")["message"]
        assert world.condition("Protected")["status"] == "True"

    def test_a_template_that_the_api_server_refuses_changes_nothing(self) -> None:
        import dataclasses

        from tests.unit.controller.world import IMAGES
        from understudy.controller.plan import Problem

        world = self.built(policy("hot"), hot())
        world.workload["spec"]["template"]["spec"]["containers"][0]["image"] = " bad"
        understood = dataclasses.replace(world.understood(), problem=Problem("TemplateInvalid", "its own words"))
        assert workload_objects.plan(world.observed(), understood, IMAGES, world.names.fresh()).writes == []

    def test_an_invalid_stored_spec_changes_nothing(self) -> None:
        world = self.built(policy("hot"), hot())
        actions = [{"action": f"/a{i}", "type": "nav2_msgs/action/NavigateToPose"} for i in range(25)]
        world.workload["spec"]["outputs"] = actions
        assert world.plan().writes == []
        assert world.condition("Accepted")["reason"] == "SpecInvalid"
        assert "spec.outputs" in world.condition("Accepted")["message"]

    def test_a_missing_pool_leaves_the_next_strategy(self) -> None:
        world = self.built(policy("missing", "hot"), hot())
        protected = world.condition("Protected")
        assert (protected["status"], protected["reason"]) == ("False", "NoPool")
        assert '"missing"' in protected["message"]
        assert_golden("operator", protected["message"], "Fallback from pool hot")


class TestSettings:
    def settings(self, world: World) -> Object:
        found: Object = json.loads(applied(world.plan(), "configmaps")["w-settings"]["data"]["settings.json"])
        return found

    def test_the_settings_list_the_pools_of_the_policy_that_serve_the_workload(self) -> None:
        other = spare("other", workloadSelector={"matchLabels": {"task": "none"}})
        world = World(workload(), policy("spare", "other", "hot"), hot(), spare(), other)
        held = {"metadata": {"name": "spare-held", "annotations": {names.TEMPLATE_HASH: "abc"}}}
        world.held_policies = {"spare": held}
        assert self.settings(world)["pools"] == [
            {"name": "spare", "readiness": "Uninitialized", "templateHash": "abc", "reserved": 0},
            {"name": "hot", "readiness": "Executing", "templateHash": "", "reserved": 0},
        ]

    def test_the_settings_contain_the_environment_of_a_claimed_pod(self) -> None:
        world = World(workload(), policy("Restart"))
        env = [
            {"name": "ROBOT", "value": "17"},
            {"name": "IP", "valueFrom": {"fieldRef": {"fieldPath": "status.podIP"}}},
            {"name": "URL", "value": "http://$(IP)"},
            {"name": "RMW_IMPLEMENTATION", "value": "rmw_other"},
        ]
        world.workload["spec"]["template"]["spec"]["containers"][0]["env"] = env
        found = self.settings(world)["containerEnvironment"]["app"]
        assert found["ROBOT"] == "17"
        assert found["ROS_DISCOVERY_SERVER"] == "10.96.0.9:11811"
        assert found["RMW_IMPLEMENTATION"] == "rmw_other"
        assert {"IP", "URL"}.isdisjoint(found)


def test_a_workload_in_deletion_gets_no_new_objects() -> None:
    world = World(workload(), policy("hot"), hot())
    world.workload["metadata"]["deletionTimestamp"] = "2026-01-01T00:00:00Z"
    assert world.plan().writes == []


def test_the_token_of_the_agents_is_not_created_again() -> None:
    world = World(workload(), policy("hot"), hot())
    world.build()
    assert not created(world.plan(), "secrets")


def test_the_monitor_may_change_only_its_own_workload() -> None:
    world = World(workload(), policy("spare", "hot"), hot(), spare())
    (role,) = applied(world.plan(), "roles").values()
    only = {
        (r, v): rule.get("resourceNames") for rule in role["rules"] for r in rule["resources"] for v in rule["verbs"]
    }
    assert _only(world, "networkpolicies", "patch") == [["w-gate"], ["w-claimed"]]
    assert only["robotworkloads/status", "patch"] == ["w"]
    assert only["secrets", "get"] == ["w-agent", "spare-pool-agent"]
    assert only["replicasets/scale", "patch"] == ["w"]
    assert only["configmaps", "get"] == ["w-settings"]
    assert ("secrets", "list") not in only
    assert ("pods", "create") not in only


class TestClaimedPods:
    def test_a_workload_without_a_shared_pool_has_no_policy_of_claimed_pods(self) -> None:
        assert "w-claimed" not in applied(World(workload(), policy("hot"), hot()).plan(), "networkpolicies")

    def test_a_claimed_pod_is_named_as_long_as_it_exists(self) -> None:
        world = World(workload(), policy("spare"), spare())
        world.pods = [source_pod("w-a"), claimed_pod("spare-1", of=spare(), by=world.workload)]
        assert self.named(world) == ["spare-1"]
        world.pods = [source_pod("w-a")]
        assert self.named(world) == [names.NOBODY]

    def test_the_pods_of_the_pools_of_a_workload_are_no_peers_of_its_claimed_pods(self) -> None:
        world = World(workload(), policy("spare"), spare())
        spec = applied(world.plan(), "networkpolicies")["w-claimed"]["spec"]
        peers = [peer["podSelector"] for peer in (*spec["ingress"][0]["from"], *spec["egress"][0]["to"])]
        left_out = {"key": names.POOL, "operator": "NotIn", "values": ["spare"]}
        assert all(left_out in peer["matchExpressions"] for peer in peers if "matchExpressions" in peer)
        assert sum("matchExpressions" in peer for peer in peers) == 2

    def test_a_pod_that_an_earlier_version_has_claimed_has_the_label_of_the_workload(self) -> None:
        world = World(workload(), policy("spare"), spare())
        world.pods = [standby_pod("spare-1", of=world.workload, pool="spare")]
        assert self.named(world) == [names.NOBODY]

    def named(self, world: World) -> list[str]:
        selector = applied(world.plan(), "networkpolicies")["w-claimed"]["spec"]["podSelector"]
        found: list[str] = selector["matchExpressions"][1]["values"]
        return found

    def test_the_policy_of_claimed_pods_is_maintained_after_its_pool_is_no_longer_used(self) -> None:
        world = World(workload(), policy("spare"), spare())
        world.build()
        world.others = [policy("Restart")]
        assert "w-claimed" in applied(world.plan(), "networkpolicies")


def _only(world: World, resource: str, verb: str) -> list[list[str] | None]:
    """The names for which each rule of the monitor's role lets it do that; None for all."""
    (role,) = applied(world.plan(), "roles").values()
    found = (rule for rule in role["rules"] if resource in rule["resources"] and verb in rule["verbs"])
    return [rule.get("resourceNames") for rule in found]


def _says(world: World, image: str) -> None:
    """The monitor signs the status."""
    world.workload["status"] = {"monitor": {"version": "0.2.0", "image": image}}


def test_the_monitor_may_read_only_its_policy_after_it_reports_that_it_reads_by_name() -> None:
    world = World(workload(), policy("Restart"))
    world.build()
    assert _only(world, "failurepolicies", "watch") == [None], "it may be of a version that asks for all"
    assert _only(world, "networkpolicies", "list") == [["w-gate"], None]
    _says(world, IMAGES.monitor)
    assert _only(world, "failurepolicies", "watch") == [["policy"]]
    assert _only(world, "networkpolicies", "list") == [["w-gate"]], "it can't wait for a pod of a pool"
    world.workload["spec"]["failurePolicyRef"] = {"name": "other"}
    world.others.append(policy("Restart", name="other"))
    assert _only(world, "failurepolicies", "watch") == [["other"]]


def test_the_monitor_of_a_workload_with_a_shared_pool_may_list_gates() -> None:
    world = World(workload(), policy("spare"), spare())
    world.build()
    _says(world, IMAGES.monitor)
    assert _only(world, "networkpolicies", "list") == [["w-gate"], None]


def test_the_right_to_read_all_policies_is_granted_before_the_monitor_image_changes() -> None:
    world = World(workload(), policy("Restart"))
    world.build()
    _says(world, IMAGES.monitor)
    world.build()
    world.workload["spec"]["monitor"] = {"image": "mine/monitor:old"}
    applies = [w for w in world.plan().writes if isinstance(w, Apply)]
    order = [w.resource.plural for w in applies if kube_objects.name(w.body) == "w-monitor"]
    assert order.index("roles") < order.index("deployments")
    assert _only(world, "failurepolicies", "watch") == [None], "it will be of another image, of whatever version"
    world.build()
    assert _only(world, "failurepolicies", "watch") == [None]
    _says(world, "mine/monitor:old")
    assert _only(world, "failurepolicies", "watch") == [["policy"]]
    world.workload["spec"].pop("monitor")
    assert _only(world, "failurepolicies", "watch") == [None], "as long as the one that is there may start anew"


def test_a_change_of_gated_ports_restarts_the_monitor() -> None:
    world = World(workload(), policy("Restart"))
    before = applied(world.plan(), "deployments")["w-monitor"]["spec"]["template"]
    world.workload["spec"]["outputs"].insert(0, {"topic": "/arm", "type": "std_msgs/msg/String"})
    assert applied(world.plan(), "deployments")["w-monitor"]["spec"]["template"] != before


def test_the_monitor_prefers_another_node_than_its_pods() -> None:
    spec = applied(World(workload(), policy("Restart")).plan(), "deployments")["w-monitor"]["spec"]["template"]["spec"]
    (preferred,) = spec["affinity"]["podAntiAffinity"]["preferredDuringSchedulingIgnoredDuringExecution"]
    assert preferred["podAffinityTerm"]["labelSelector"] == {"matchLabels": {names.WORKLOAD: "w"}}


def test_equal_objects_give_equal_plans() -> None:
    first = World(workload(), policy("hot", "spare"), hot(), spare()).plan()
    second = World(workload(), policy("hot", "spare"), hot(), spare()).plan()
    assert json.dumps([w.body for w in first.writes], sort_keys=True) == json.dumps(  # type: ignore[union-attr]
        [w.body for w in second.writes],  # type: ignore[union-attr]
        sort_keys=True,
    )
