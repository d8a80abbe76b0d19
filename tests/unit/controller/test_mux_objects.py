"""With gate kind Mux, the gate object is a Lease, and instances, monitor and robot get what each of them needs for a mux."""

from __future__ import annotations

import copy
import json
from typing import Any

import pytest

from tests.unit.controller.world import TEMPLATE, World, applied, created, hot, policy, workload
from understudy.api import names
from understudy.controller.observed import kube_objects
from understudy.controller.plan import Plan
from understudy.kube.client import Object
from understudy.monitor.act.objects.pod_control import instance_of
from understudy.ros.rmw import MIDDLEWARE

PARTITION = "understudy-${UNDERSTUDY_POD}"


def plan(**spec: Any) -> Plan:
    return World(workload(gate={"kind": "Mux"}, **spec), policy("hot"), hot()).plan()


def refusal(**spec: Any) -> str:
    found: Object = World(workload(gate={"kind": "Mux"}, **spec), policy("hot"), hot()).condition("Accepted")
    assert found["status"] == "False"
    return str(found["message"])


def test_the_gate_object_is_a_lease_and_no_network_policy_restricts_the_instances() -> None:
    made = plan()
    (gate,) = created(made, "leases")
    assert (kube_objects.name(gate), gate["spec"], gate["metadata"]["annotations"][names.ACTIVE]) == ("w-gate", {}, "")
    assert created(made, "networkpolicies") == []
    assert set(applied(made, "networkpolicies")) == {"w-control-plane"}


def test_instances_are_in_a_partition_and_the_robot_needs_no_profile() -> None:
    maps = applied(plan(), "configmaps")
    assert PARTITION in maps["w-instance-profiles"]["data"]["profiles.xml"]
    assert "profile_name" not in maps["w-robot-profiles"]["data"]["profiles.xml"]
    assert MIDDLEWARE.settings_variable not in maps["w-robot-env"]["data"]
    settings = maps["w-mux"]["data"]
    assert (settings[names.NAMESPACE_VARIABLE], settings[names.WORKLOAD_VARIABLE]) == ("fleet", "w")
    assert json.loads(settings[names.OUTPUTS_VARIABLE]) == [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}]


def test_an_instance_on_board_gets_its_name_and_the_profile_of_the_instances() -> None:
    gate = {"kind": "Mux", "mux": {"onBoard": {"name": "home"}}}
    maps = applied(World(workload(gate=gate), policy("hot"), hot()).plan(), "configmaps")
    variables = maps["w-on-board"]["data"]
    assert variables == {names.POD_VARIABLE: "home", MIDDLEWARE.settings_variable: "/etc/understudy/profiles.xml"}
    assert "w-on-board" not in applied(plan(), "configmaps")


def test_an_instance_on_board_needs_a_topic_by_whose_silence_the_mux_notices_that_it_is_due() -> None:
    world = World(
        workload(
            gate={"kind": "Mux", "mux": {"onBoard": {}}}, outputs=[{"service": "/grip", "type": "std_srvs/srv/Trigger"}]
        ),
        policy("hot"),
        hot(),
    )
    found: Object = world.condition("Accepted")
    assert (found["status"], "spec.gate.mux.onBoard" in found["message"]) == ("False", True)


def test_the_monitor_reads_the_partitions_and_shares_a_token_with_the_mux_that_no_agent_has() -> None:
    made = plan()
    (container,) = applied(made, "deployments")["w-monitor"]["spec"]["template"]["spec"]["containers"]
    file = next(entry["value"] for entry in container["env"] if entry["name"] == MIDDLEWARE.settings_variable)
    profiles = applied(made, "configmaps")["w-robot-profiles"]["data"]
    assert "understudy-*" in profiles[file.rpartition("/")[2]]
    assert [kube_objects.name(one) for one in created(made, "secrets")] == ["w-agent", "w-mux"]
    rules = applied(made, "roles")["w-monitor"]["rules"]
    assert ["w-agent", "w-mux"] in [rule["resourceNames"] for rule in rules if rule["resources"] == ["secrets"]]
    assert ["w-gate"] in [rule.get("resourceNames") for rule in rules if rule["resources"] == ["leases"]]
    (pod,) = created(made, "pods")
    assert "w-mux" not in json.dumps(pod)


def test_the_mux_knows_the_nodes_that_may_write_beside_it() -> None:
    gate = {"kind": "Mux", "mux": {"allowedNodes": ["/joy_teleop"]}}
    maps = applied(World(workload(gate=gate), policy("hot"), hot()).plan(), "configmaps")
    assert json.loads(maps["w-mux"]["data"][names.ALLOWED_NODES_VARIABLE]) == ["/joy_teleop"]


def test_a_workload_keeps_its_token_of_the_mux() -> None:
    world = World(workload(gate={"kind": "Mux"}), policy("hot"), hot())
    (secret,) = (one for one in created(world.plan(), "secrets") if kube_objects.name(one) == "w-mux")
    world.own(secret)
    assert "w-mux" not in [kube_objects.name(one) for one in created(world.plan(), "secrets")]


def test_pods_that_would_reach_the_robot_beside_the_mux_are_refused() -> None:
    template = copy.deepcopy(TEMPLATE)
    template["spec"]["containers"][0]["env"] = [{"name": MIDDLEWARE.settings_variable, "value": "/mine.xml"}]
    assert "of spec.template sets the environment variable" in refusal(template=template)


@pytest.mark.parametrize(
    "change", [{"spec": {"hostNetwork": True}}, {"metadata": {"annotations": {"k8s.v1.cni.cncf.io/networks": "lab"}}}]
)
def test_pods_on_every_network_are_accepted(change: Object) -> None:
    template = copy.deepcopy(TEMPLATE)
    template["spec"] |= change.get("spec", {})
    template["metadata"] = {**template.get("metadata", {}), **change.get("metadata", {})}
    world = World(workload(gate={"kind": "Mux"}, template=template), policy("hot"), hot())
    assert world.condition("Accepted")["status"] == "True"
    refused = World(workload(template=template), policy("hot"), hot())
    assert refused.condition("Accepted")["status"] == "False"


def test_the_monitor_receives_instances_that_have_the_addresses_of_their_nodes() -> None:
    template = copy.deepcopy(TEMPLATE)
    template["spec"]["hostNetwork"] = True
    for spec, is_open in (({"template": template}, True), ({}, False)):
        rule = applied(plan(**spec), "networkpolicies")["w-control-plane"]["spec"]["ingress"][0]
        assert ("from" not in rule) == is_open


def pods(*, ports: tuple[int, ...] = (), **spec: Any) -> list[Object]:
    """The pods of a workload: that of its ReplicaSet, and its standbys."""
    template = copy.deepcopy(TEMPLATE)
    template["spec"] |= spec
    template["spec"]["containers"][0]["ports"] = [{"containerPort": port} for port in ports]
    found = plan(template=template)
    source = applied(found, "replicasets")["w"]["spec"]["template"]
    return [source, *created(found, "pods")]


def listening(pod: Object) -> tuple[int, int]:
    """The ports at which the agent of a pod listens."""
    agent = next(c for c in pod["spec"]["containers"] if c["name"] == names.AGENT_CONTAINER)
    variables = {entry["name"]: entry.get("value") for entry in agent["env"]}
    control = int(variables.get(names.AGENT_PORT_VARIABLE, names.AGENT_PORT))
    health = int(variables.get(names.AGENT_HEALTH_PORT_VARIABLE, names.AGENT_HEALTH_PORT))
    assert [port["containerPort"] for port in agent["ports"]] == [control, health]
    assert agent["readinessProbe"]["httpGet"]["port"] == health
    assert instance_of({**pod, "metadata": {"name": "w-x", "uid": "u"}}).agent_port == control
    return control, health


def test_agents_in_the_network_of_one_node_have_different_ports() -> None:
    active, standby = map(listening, pods(hostNetwork=True))
    assert len({*active, *standby}) == 4
    assert {*active, *standby} <= set(names.NODE_AGENT_PORTS)


def test_an_agent_leaves_the_ports_of_the_application_alone() -> None:
    (_, health), *_ = map(listening, pods(hostNetwork=True))
    moved, *_ = map(listening, pods(hostNetwork=True, ports=(health,)))
    assert health not in moved


def test_an_agent_in_a_network_of_its_own_has_the_usual_ports() -> None:
    assert set(map(listening, pods())) == {(names.AGENT_PORT, names.AGENT_HEALTH_PORT)}


def test_the_pods_of_a_referred_controller_are_refused() -> None:
    from understudy.api.kinds.robot_workload import RobotWorkloadSpec
    from understudy.controller.desired import mux_validation

    found = workload(gate={"kind": "Mux"}, workloadRef={"kind": "Deployment", "name": "nav"})["spec"]
    assert "the pods of Deployment nav" in (mux_validation.problem(RobotWorkloadSpec.model_validate(found), {}) or "")
