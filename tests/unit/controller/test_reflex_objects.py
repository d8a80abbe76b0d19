"""A reflex that isn't safe is refused, with what to do about it; a safe one reaches pods and robot alike."""

from __future__ import annotations

import copy
from typing import Any

from tests.unit.controller.world import workload
from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol import freeze_script
from understudy.controller.desired import action_proxy_container, reflex_validation
from understudy.controller.plan import Images
from understudy.controller.pods import instance_pod, ros_environment
from understudy.kube.client import Object
from understudy.ros.rmw import MIDDLEWARE

CMD_VEL = {"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}
LAMP = {"topic": "/lamp", "type": "std_msgs/msg/Bool"}
DOCK = {"service": "/dock", "type": "std_srvs/srv/Trigger"}


def spec(outputs: list[Object], *, accept: list[str] | None = None, **more: Any) -> RobotWorkloadSpec:
    made = workload("w")["spec"]
    made |= {"outputs": outputs, "gate": {"reflex": {"deadline": "100ms", "accept": accept or []}}, **more}
    return RobotWorkloadSpec.model_validate(made)


def problem(found: RobotWorkloadSpec) -> str:
    return reflex_validation.problem(found, found.template or {}) or ""


def test_one_topic_is_accepted() -> None:
    assert problem(spec([CMD_VEL])) == ""
    assert problem(RobotWorkloadSpec.model_validate(workload("w")["spec"])) == "", "and no reflex is, too"


def test_several_topics_must_be_accepted_by_name() -> None:
    words = problem(spec([CMD_VEL, LAMP]))
    assert "each of the topics (/cmd_vel, /lamp) switches independently" in words
    assert "(missing: /cmd_vel, /lamp)" in words
    assert "(missing: /lamp)" in problem(spec([CMD_VEL, LAMP], accept=["/cmd_vel"]))
    assert problem(spec([CMD_VEL, LAMP], accept=["/lamp", "/cmd_vel"])) == ""


def test_a_service_must_be_accepted_and_cannot_be_the_only_output() -> None:
    assert "/dock (service or action) has no exclusive owner" in problem(spec([CMD_VEL, DOCK]))
    assert problem(spec([CMD_VEL, DOCK], accept=["/dock", "/cmd_vel"])) == ""
    assert "outputs has no topic" in problem(spec([DOCK], accept=["/dock"]))


def test_a_mux_switches_all_outputs_at_once_and_needs_a_topic_too() -> None:
    def muxed(*outputs: Object) -> RobotWorkloadSpec:
        found = workload("w")["spec"]
        gate = {"kind": "Mux", "reflex": {"deadline": "100ms"}}
        return RobotWorkloadSpec.model_validate({**found, "outputs": list(outputs), "gate": gate})

    assert problem(muxed(CMD_VEL, LAMP, DOCK)) == ""
    assert "outputs has no topic" in problem(muxed(DOCK))


def test_pods_that_cannot_receive_a_strength_are_refused() -> None:
    referring = spec([CMD_VEL], template=None, workload_ref={"kind": "Deployment", "name": "nav"})
    assert "Deployment nav" in problem(referring)
    own = spec([CMD_VEL])
    assert own.template is not None
    template = copy.deepcopy(own.template)
    template["spec"]["containers"][0]["env"] = [{"name": MIDDLEWARE.settings_variable, "value": "/mine.xml"}]
    assert MIDDLEWARE.settings_variable in (reflex_validation.problem(own, template) or "")


def test_a_strength_is_set_before_any_process_starts_and_the_robot_selects_by_it() -> None:
    found = spec([CMD_VEL])
    profiles = action_proxy_container.instance_profiles(found)
    assert f"<value>${{{names.STRENGTH_VARIABLE}}}</value>" in profiles
    recipe = instance_pod.Recipe(
        workload="w", namespace="fleet", images=Images("monitor"), secret="w-agent", profiles=profiles
    )
    pod = instance_pod.build(found.template or {}, recipe)["spec"]
    assert [c["name"] for c in pod["initContainers"]] == [names.INIT_CONTAINER]
    robot = ros_environment.config_maps("w", {}, found.outputs, found.gate)[1]["data"][ros_environment.PROFILES_KEY]
    assert "<kind>EXCLUSIVE</kind>" in robot


def built(**more: Any) -> Object:
    found = spec([CMD_VEL])
    template = copy.deepcopy(found.template or {})
    template["spec"] |= more
    recipe = instance_pod.Recipe(
        workload="w",
        namespace="fleet",
        images=Images("monitor"),
        secret="w-agent",
        profiles=action_proxy_container.instance_profiles(found),
    )
    pod: Object = instance_pod.build(template, recipe)["spec"]
    return pod


def environment(container: Object) -> dict[str, str]:
    return {entry["name"]: entry.get("value", "") for entry in container["env"]}


def test_the_agent_can_fence_containers_with_a_known_command() -> None:
    pod = built(
        containers=[
            {"name": "drive", "image": "i", "command": ["python3", "drive.py"], "args": ["--fast"]},
            {"name": "lamp", "image": "i", "args": ["--on"]},
        ]
    )
    drive, lamp, agent = pod["containers"]
    assert drive["command"] == freeze_script.fenced_command("drive", ["python3", "drive.py"], ["--fast"], scope="all")
    assert "args" not in drive
    assert (lamp.get("command"), lamp["args"]) == (None, ["--on"])
    assert environment(agent)[names.FENCED_VARIABLE] == "drive"
    assert environment(agent)[names.UNFENCED_VARIABLE] == "lamp"
    assert environment(pod["initContainers"][0])[names.FENCED_VARIABLE] == "drive"


def test_a_sidecar_joins_the_robot_graph_and_is_not_fenced() -> None:
    """It runs as long as the application (KEP-753), and may publish what the robot hears."""
    pod = built(
        containers=[{"name": "drive", "image": "i", "command": ["drive"]}],
        initContainers=[{"name": "bridge", "image": "b", "restartPolicy": "Always"}, {"name": "fetch", "image": "f"}],
    )
    prepare, bridge, fetch = pod["initContainers"]
    assert (prepare["name"], bridge["name"], fetch) == (names.INIT_CONTAINER, "bridge", {"name": "fetch", "image": "f"})
    drive, agent = pod["containers"]
    assert environment(bridge).items() >= environment(drive).items() != set()
    assert {mount["name"] for mount in bridge["volumeMounts"]} == {names.AGENT_VOLUME}
    assert environment(agent)[names.UNFENCED_VARIABLE] == "bridge"


def test_a_sidecar_of_an_unclaimed_pod_is_unchanged() -> None:
    bridge = {"name": "bridge", "image": "b", "restartPolicy": "Always"}
    template = {"spec": {"containers": [{"name": "drive", "image": "i", "command": ["d"]}], "initContainers": [bridge]}}
    recipe = instance_pod.Recipe(workload="", namespace="n", images=Images("m"), secret="s", pool="spare", held=True)
    assert instance_pod.build(template, recipe)["spec"]["initContainers"] == [bridge]


def test_in_a_shared_process_namespace_only_the_processes_of_the_container_are_fenced() -> None:
    containers = [{"name": "drive", "image": "i", "command": ["drive"]}]
    pod = built(containers=containers, shareProcessNamespace=True)
    assert pod["containers"][0]["command"][6] == "own"


def test_without_a_reflex_the_command_of_the_user_is_unchanged() -> None:
    plain = RobotWorkloadSpec.model_validate(workload("w")["spec"])
    recipe = instance_pod.Recipe(workload="w", namespace="fleet", images=Images("monitor"), secret="w-agent")
    before = (plain.template or {})["spec"]["containers"][0]
    after = instance_pod.build(plain.template or {}, recipe)["spec"]["containers"]
    assert after[0].get("command") == before.get("command")
    assert names.FENCED_VARIABLE not in environment(after[1])
