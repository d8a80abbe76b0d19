"""Templates, gates, selectors, policies and troubles by themselves."""

from __future__ import annotations

import copy

import pytest

from tests.support.golden import assert_golden
from tests.unit.controller.world import IMAGES, TEMPLATE, hot, pod, policy, spare
from understudy.api import names
from understudy.api.kinds.robot_workload import Ros
from understudy.controller.desired import discovery_server, monitor_deployment
from understudy.controller.observed import policy_reader, workload_reference
from understudy.controller.observed.pod_diagnosis import trouble
from understudy.controller.pods import instance_pod, pod_placement
from understudy.controller.status import policy_status
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.ros.rmw import MIDDLEWARE

ENVIRONMENT = {"ROS_DOMAIN_ID": "7", "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp", "ROS_DISCOVERY_SERVER": "10.0.0.1:11811"}
RECIPE = instance_pod.Recipe(
    workload="w", namespace="fleet", images=IMAGES, secret="w-agent", environment=ENVIRONMENT, pool="hot"
)


def environment(container: Object) -> dict[str, str]:
    return {entry["name"]: entry.get("value", "") for entry in container["env"]}


class TestInstances:
    def test_the_users_template_is_not_changed(self) -> None:
        before = copy.deepcopy(TEMPLATE)
        instance_pod.build(TEMPLATE, RECIPE)
        assert before == TEMPLATE

    def test_environment_variables_of_the_user_take_precedence(self) -> None:
        template = copy.deepcopy(TEMPLATE)
        template["spec"]["containers"][0]["env"] = [{"name": "ROS_DOMAIN_ID", "value": "42"}]
        app = instance_pod.build(template, RECIPE)["spec"]["containers"][0]
        assert [entry["value"] for entry in app["env"] if entry["name"] == "ROS_DOMAIN_ID"] == ["42"]
        assert environment(app)["ROS_DISCOVERY_SERVER"] == "10.0.0.1:11811"

    def test_the_agent_runs_without_privileges(self) -> None:
        agent = instance_pod.build(TEMPLATE, RECIPE)["spec"]["containers"][-1]
        assert agent["name"] == names.AGENT_CONTAINER
        context = agent["securityContext"]
        assert context["runAsNonRoot"]
        assert context["readOnlyRootFilesystem"]
        assert context["capabilities"] == {"drop": ["ALL"]}
        assert not context["allowPrivilegeEscalation"]

    def test_the_agent_sees_the_whole_graph(self) -> None:
        agent = instance_pod.build(TEMPLATE, RECIPE)["spec"]["containers"][-1]
        assert environment(agent)["ROS_SUPER_CLIENT"] == "TRUE"
        assert "ROS_SUPER_CLIENT" not in environment(instance_pod.build(TEMPLATE, RECIPE)["spec"]["containers"][0])

    def test_the_template_hash_changes_if_the_pod_changes(self) -> None:
        first = instance_pod.template_hash(instance_pod.build(TEMPLATE, RECIPE))
        assert first == instance_pod.template_hash(instance_pod.build(copy.deepcopy(TEMPLATE), RECIPE))
        other = copy.deepcopy(TEMPLATE)
        other["spec"]["containers"][0]["image"] = "app:2"
        assert first != instance_pod.template_hash(instance_pod.build(other, RECIPE))

    def test_instances_prefer_separate_nodes_and_keep_the_preferences_of_the_user(self) -> None:
        template = copy.deepcopy(TEMPLATE)
        own = {"weight": 1, "podAffinityTerm": {"topologyKey": "zone"}}
        template["spec"]["affinity"] = {
            "podAntiAffinity": {"preferredDuringSchedulingIgnoredDuringExecution": [own]},
            "nodeAffinity": {"x": "y"},
        }
        affinity = instance_pod.build(template, RECIPE)["spec"]["affinity"]
        preferred = affinity["podAntiAffinity"]["preferredDuringSchedulingIgnoredDuringExecution"]
        assert preferred[0] == own
        assert preferred[1]["podAffinityTerm"]["labelSelector"] == {"matchLabels": {names.WORKLOAD: "w"}}
        assert preferred[2]["podAffinityTerm"]["labelSelector"] == {"matchLabels": {names.MONITORED: "w"}}
        assert preferred[2]["weight"] < preferred[1]["weight"], "an understudy away from the active pod comes first"
        assert affinity["nodeAffinity"] == {"x": "y"}

    def test_pods_leave_a_lost_node_soon_unless_the_user_sets_another_time(self) -> None:
        (not_ready, unreachable) = instance_pod.build(TEMPLATE, RECIPE)["spec"]["tolerations"]
        assert not_ready["tolerationSeconds"] == unreachable["tolerationSeconds"] == pod_placement.LOST_SECONDS
        template = copy.deepcopy(TEMPLATE)
        own = {"key": "node.kubernetes.io/unreachable", "operator": "Exists", "tolerationSeconds": 600}
        template["spec"]["tolerations"] = [own]
        found = instance_pod.build(template, RECIPE)["spec"]["tolerations"]
        assert found == [own, not_ready]

    @pytest.mark.parametrize(
        ("spec", "word"),
        [
            ({"containers": []}, "containers is empty"),
            ({"containers": [{"name": names.AGENT_CONTAINER}]}, "sidecar"),
            ({"containers": [{"name": "a", "ports": [{"containerPort": names.AGENT_PORT}]}]}, "8950"),
            ({"containers": [{"name": "a"}], "volumes": [{"name": "understudy"}]}, "volumes"),
            ({"containers": [{"name": "a"}], "hostNetwork": True}, "hostNetwork"),
        ],
    )
    def test_a_template_that_cannot_be_an_instance_is_reported_with_its_path(self, spec: Object, word: str) -> None:
        found = instance_pod.problem({"spec": spec}, held=False, path="spec.template")
        assert found is not None
        assert found.startswith("spec.template.spec")
        assert word in found

    @pytest.mark.parametrize("annotation", ["k8s.v1.cni.cncf.io/networks", "v1.multus-cni.io/default-network"])
    def test_a_template_with_other_networks_is_refused_because_they_bypass_the_gate(self, annotation: str) -> None:
        template = {"metadata": {"annotations": {annotation: "robot-lan"}}, "spec": {"containers": [{"name": "a"}]}}
        found = instance_pod.problem(template, held=False, path="spec.template")
        assert found is not None
        assert found.startswith(f"spec.template.metadata.annotations[{annotation}]")
        assert "Remove it" in found


class TestPolicies:
    def test_the_short_form_of_a_policy_lists_its_strategies(self) -> None:
        found = policy("hot", "spare", "gone", "Restart")
        assert policy_status.in_short(found, {"hot": hot(), "spare": spare()}) == (
            "Executing, Uninitialized, Fallback/gone, Restart"
        )

    def test_an_invalid_tree_is_refused_with_its_path(self) -> None:
        found = policy("Restart", tree={"parallel": [{"topic": {"name": "/scan", "gap": "500 parsecs"}}]})
        (accepted,) = policy_status.conditions(found, {}, {})
        assert (accepted.status, accepted.reason) == ("False", "TreeInvalid")
        assert "spec.monitoring.yaml.parallel[0].topic" in accepted.message

    def test_an_invalid_xml_tree_is_refused_with_its_line(self) -> None:
        found = policy("Restart")
        tree = '<root BTCPP_format="4">\n<BehaviorTree ID="A">\n  <Topic topic="/scan" gap="500 parsecs"/></BehaviorTree></root>'
        found["spec"]["monitoring"] = {"xml": tree}
        (accepted,) = policy_status.conditions(found, {}, {})
        assert (accepted.status, accepted.reason) == ("False", "TreeInvalid")
        assert_golden("operator", accepted.message, "spec.monitoring.xml", "line 3, column 3", "'500 parsecs'")
        found["spec"]["monitoring"] = {"xml": tree.replace("500 parsecs", "500ms")}
        assert policy_reader.problem(found, {}) is None

    def test_an_invalid_openscenario_tree_is_refused_with_its_line(self) -> None:
        found = policy("Restart")
        tree = 'import osc.understudy\nscenario healthy:\n    do topic("/scan", gap: 500parsec)\n'
        found["spec"]["monitoring"] = {"osc": tree}
        (accepted,) = policy_status.conditions(found, {}, {})
        assert (accepted.status, accepted.reason) == ("False", "TreeInvalid")
        assert_golden("operator", accepted.message, "spec.monitoring.osc", "line 3, column 28", "500parsec")
        found["spec"]["monitoring"] = {"osc": tree.replace("500parsec", "500ms")}
        assert policy_reader.problem(found, {}) is None

    @pytest.mark.parametrize(
        "monitoring",
        [{}, {"yaml": {"topic": {}}, "xml": "<root/>"}, {"xml": "<root/>", "osc": "scenario a"}],
    )
    def test_a_policy_with_no_tree_or_two_trees_is_refused(self, monitoring: Object) -> None:
        found = policy("Restart")
        found["spec"]["monitoring"] = monitoring
        (accepted,) = policy_status.conditions(found, {}, {})
        assert (accepted.status, accepted.reason) == ("False", "SpecInvalid")
        assert_golden("operator", accepted.message, "configMapKeyRef")

    def test_a_missing_pool_is_reported_with_a_similar_name(self) -> None:
        (accepted,) = policy_status.conditions(policy("hott"), {"hot": hot()}, {})
        assert (accepted.status, accepted.reason) == ("False", "PoolNotFound")
        assert 'did you mean "hot"?' in accepted.message

    def test_a_valid_policy_is_accepted(self) -> None:
        assert policy_status.conditions(policy("hot", "Restart"), {"hot": hot()}, {})[0].status == "True"

    def test_waiting_for_a_pool_that_is_not_shared_is_refused(self) -> None:
        found = policy("hot", "spare")
        found["spec"]["strategies"][1]["waitFor"] = "10s"
        pools = {"hot": hot(), "spare": spare()}
        assert policy_status.conditions(found, pools, {})[0].status == "True"
        found["spec"]["strategies"][0]["waitFor"] = "1s"
        (accepted,) = policy_status.conditions(found, pools, {})
        assert (accepted.status, accepted.reason) == ("False", "PoolNotShared")
        assert_golden("operator", accepted.message, "spec.strategies[0].waitFor", "FallbackPool hot")
        assert policy_reader.problem(found, {}) is None, "the rest of the policy is followed"


class TestRobots:
    def test_the_environment_follows_the_discovery_mode(self) -> None:
        managed = MIDDLEWARE.environment(Ros(), "10.0.0.1")
        assert managed["ROS_DISCOVERY_SERVER"] == "10.0.0.1:11811"
        assert MIDDLEWARE.environment(Ros(), "fd00::1")["ROS_DISCOVERY_SERVER"] == "[fd00::1]:11811"
        external = Ros.model_validate({"domainId": 5, "discovery": {"mode": "External", "server": "h:1"}})
        assert MIDDLEWARE.environment(external, None)["ROS_DISCOVERY_SERVER"] == "h:1"
        assert MIDDLEWARE.environment(external, None)["ROS_DOMAIN_ID"] == "5"
        multicast = Ros.model_validate({"discovery": {"mode": "Multicast"}})
        assert "ROS_DISCOVERY_SERVER" not in MIDDLEWARE.environment(multicast, None)

    def test_a_service_without_a_cluster_ip_has_no_address(self) -> None:
        assert discovery_server.address(None) is None
        assert discovery_server.address({"spec": {"clusterIP": "None"}}) is None
        assert discovery_server.address({"spec": {"clusterIP": "10.0.0.1"}}) == "10.0.0.1"


class TestMonitors:
    def test_the_service_account_has_the_name_that_the_admission_policy_recognizes(self) -> None:
        (_, account), *_ = monitor_deployment.access("w", source=("ReplicaSet", "w"), policy="p", pools=[])
        assert account["metadata"]["name"] == "w" + names.MONITOR_ACCOUNT_ENDING

    def test_the_monitor_may_read_but_not_scale_a_referenced_controller(self) -> None:
        role = dict(monitor_deployment.access("w", source=("StatefulSet", "arm"), policy="p", pools=[]))["Role"]
        rules = {tuple(rule["resources"]): rule for rule in role["rules"]}
        assert rules["statefulsets",]["resourceNames"] == ["arm"]
        assert set(rules["statefulsets",]["verbs"]) == {"get", "list", "watch"}
        assert ("replicasets/scale",) not in rules

    def test_the_monitor_may_read_the_gates_of_upstream_workloads_and_not_commit_to_them(self) -> None:
        (role,) = (
            item
            for kind, item in monitor_deployment.access(
                "w", source=("ReplicaSet", "w"), policy="p", pools=[], upstream=["b", "a"]
            )
            if kind == "Role"
        )
        read = {
            rule["resources"][0]: rule["verbs"]
            for rule in role["rules"]
            if rule.get("resourceNames") == [names.gate("a"), names.gate("b")]
        }
        assert read == {one.plural: ["get", "list", "watch"] for one in registry.GATE_RESOURCES}


class TestPodDiagnosis:
    def test_a_starting_pod_has_no_trouble(self) -> None:
        assert trouble(pod("a", ready=False, waiting="ContainerCreating")) is None
        assert trouble(pod("a", ready=False)) is None

    def test_a_pod_that_cannot_be_scheduled_is_reported(self) -> None:
        item = pod("a", ready=False)
        item["status"]["conditions"].append(
            {"type": "PodScheduled", "status": "False", "reason": "Unschedulable", "message": "0/3 nodes"}
        )
        found = trouble(item)
        assert found is not None
        assert found.reason == "Unschedulable"
        assert "0/3 nodes" in found.message

    def test_the_message_about_a_crash_loop_does_not_change_with_the_back_off(self) -> None:
        def crash(delay: str) -> Object:
            item = pod("a", ready=False, waiting="CrashLoopBackOff")
            item["status"]["containerStatuses"][0]["state"]["waiting"]["message"] = (
                f"back-off {delay} restarting failed"
            )
            return item

        assert trouble(crash("10s")) == trouble(crash("20s"))

    def test_a_container_that_runs_between_two_crashes_has_the_same_message(self) -> None:
        waiting, running = pod("a", ready=False, waiting="CrashLoopBackOff"), pod("a", ready=False)
        waiting["status"]["containerStatuses"][0]["state"]["waiting"]["message"] = "back-off 10s restarting failed"
        last = {"terminated": {"exitCode": 1, "reason": "Error"}}
        entry = {"name": "app", "image": "app:1", "state": {"running": {}}, "lastState": last, "restartCount": 3}
        running["status"]["containerStatuses"] = [entry]
        assert trouble(waiting) == trouble(running)
        running["status"]["conditions"][0]["status"] = "True"
        assert trouble(running) is None


class TestReferences:
    def test_only_pods_that_the_controller_owns_are_found(self) -> None:
        deployment = {"metadata": {"name": "nav2", "uid": "d"}, "spec": {}}
        own = {"metadata": {"name": "nav2-1", "uid": "r1", "ownerReferences": [{"uid": "d", "controller": True}]}}
        other = {"metadata": {"name": "x-1", "uid": "r2", "ownerReferences": [{"uid": "z", "controller": True}]}}
        mine = pod("a", owner={"uid": "r1", "controller": True})
        pods = [mine, pod("b", owner={"uid": "r2", "controller": True}), pod("c")]
        assert workload_reference.controlled(deployment, [own, other], pods) == [mine]
        assert workload_reference.controlled({"metadata": {"uid": "r2"}}, [], pods) == [pods[1]]
