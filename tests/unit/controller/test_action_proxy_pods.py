"""Tasks change the pods of the workloads that have some, and of no others."""

from __future__ import annotations

import copy
import dataclasses
from typing import Any

import pytest

from tests.unit.controller.world import IMAGES, TEMPLATE, World, applied, hot, policy, workload
from understudy.action_proxy.process import LASTING, STATE
from understudy.api import names
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.kinds.task_spec import Task
from understudy.controller.desired import action_proxy_container
from understudy.controller.pods import instance_pod
from understudy.kube.client import Object
from understudy.ros.dds.profiles import instance_profiles_xml
from understudy.ros.rmw import MIDDLEWARE

TASKS = [{"action": "/goto", "type": "test_msgs/action/Fibonacci"}]
PROFILES = instance_profiles_xml([Task.model_validate(TASKS[0])])
RECIPE = instance_pod.Recipe(workload="w", namespace="fleet", images=IMAGES, secret="w-agent", profiles=PROFILES)


def env(container: Object, name: str) -> Any:
    return next((entry for entry in container["env"] if entry["name"] == name), None)


def mounts(container: Object) -> dict[str, str]:
    return {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}


class TestPods:
    def test_the_application_and_the_agent_read_the_profiles_of_their_pod(self) -> None:
        spec = instance_pod.build(TEMPLATE, RECIPE)["spec"]
        for container in spec["containers"]:
            path = env(container, MIDDLEWARE.settings_variable)["value"]
            assert path == f"{mounts(container)[names.INSTANCE_PROFILES_VOLUME]}/{names.PROFILES_KEY}"
            assert env(container, names.POD_VARIABLE)["valueFrom"]["fieldRef"]["fieldPath"] == "metadata.name"
        volume = next(v for v in spec["volumes"] if v["name"] == names.INSTANCE_PROFILES_VOLUME)
        assert volume["configMap"]["name"] == "w-instance-profiles"
        assert "initContainers" not in spec

    def test_the_init_container_prepares_profiles_that_contain_values_of_the_pod(self) -> None:
        recipe = dataclasses.replace(RECIPE, profiles=PROFILES + f"<!-- ${{{names.STRENGTH_VARIABLE}}} -->")
        template = copy.deepcopy(TEMPLATE)
        template["spec"]["initContainers"] = [{"name": "mine", "image": "app"}]
        spec = instance_pod.build(template, recipe)["spec"]
        first, second = spec["initContainers"]
        assert (first["name"], first["args"], second["name"]) == (names.INIT_CONTAINER, ["prepare"], "mine")
        for container in spec["containers"]:
            assert env(container, MIDDLEWARE.settings_variable)["value"] == "/understudy/profiles.xml"
            assert mounts(container)[names.AGENT_VOLUME] == "/understudy"

    def test_other_profiles_change_the_template_hash(self) -> None:
        other = dataclasses.replace(RECIPE, profiles=PROFILES.replace("goto", "dock"))
        hashes = {instance_pod.template_hash(instance_pod.build(TEMPLATE, recipe)) for recipe in (RECIPE, other)}
        assert len(hashes) == 2

    def test_a_container_keeps_its_own_profiles_and_the_problem_is_reported(self) -> None:
        template = copy.deepcopy(TEMPLATE)
        template["spec"]["containers"][0]["env"] = [{"name": MIDDLEWARE.settings_variable, "value": "/mine.xml"}]
        app = instance_pod.build(template, RECIPE)["spec"]["containers"][0]
        assert [e["value"] for e in app["env"] if e["name"] == MIDDLEWARE.settings_variable] == ["/mine.xml"]
        spec = RobotWorkloadSpec.model_validate(workload("w", tasks=TASKS)["spec"])
        words = action_proxy_container.problem("w", spec, template)
        assert (
            f"container {template['spec']['containers'][0]['name']} sets the environment variable {MIDDLEWARE.settings_variable}"
            in words
        )
        assert "w-instance-profiles" in words
        assert action_proxy_container.problem("w", spec, TEMPLATE) == ""


class TestWorkloads:
    @pytest.mark.parametrize("tasks", [[], TASKS])
    def test_only_a_workload_with_tasks_has_a_proxy_and_every_one_has_profiles(self, tasks: list[Object]) -> None:
        world = World(workload("w", tasks=tasks), policy("hot"), hot())
        plan = world.plan()
        pod = applied(plan, "deployments")["w-monitor"]["spec"]["template"]["spec"]
        containers = {container["name"]: container for container in pod["containers"]}
        config = applied(plan, "configmaps")
        assert ("tasks" in containers) == bool(tasks)
        template = applied(plan, "replicasets")["w"]["spec"]["template"]
        assert env(template["spec"]["containers"][0], MIDDLEWARE.settings_variable) is not None
        profiles = config["w-instance-profiles"]["data"]["profiles.xml"]
        assert profiles.count("<lifespan>") == 1, "of /cmd_vel"
        assert profiles.count("<partition>") == (16 if tasks else 0)
        if tasks:
            proxy = containers["tasks"]
            assert proxy["args"] == ["tasks"]
            assert mounts(proxy).items() >= {"tasks": "/run/understudy", "state": "/var/lib/understudy"}.items()
            assert mounts(containers["monitor"])["tasks"] == "/run/understudy"
            assert env(proxy, MIDDLEWARE.settings_variable) is None
            (port,) = (port["containerPort"] for port in proxy["ports"])
            (monitors,) = (port["containerPort"] for port in containers["monitor"]["ports"])
            assert port != monitors, "they share the pod's address"
            for one, its in ((proxy, port), (containers["monitor"], monitors)):
                assert one["livenessProbe"]["httpGet"] == {"path": "/healthz", "port": its}, (
                    "it is restarted if it hangs"
                )

    def test_the_goals_are_on_the_volume_that_outlives_the_pod_if_the_policy_has_one(self) -> None:
        protecting = policy("hot")
        protecting["spec"]["state"] = {"keep": [{"topic": "/amcl_pose"}], "storage": {"claimName": "robot-state"}}
        plan = World(workload("w", tasks=TASKS), protecting, hot()).plan()
        pod = applied(plan, "deployments")["w-monitor"]["spec"]["template"]["spec"]
        (proxy,) = (container for container in pod["containers"] if container["name"] == "tasks")
        assert mounts(proxy)["kept"] == f"{STATE}/{LASTING.split('/')[0]}"

    def test_the_pods_of_a_referenced_controller_have_no_proxy_and_the_problem_is_reported(self) -> None:
        reference = {"kind": "Deployment", "name": "arm"}
        spec = RobotWorkloadSpec.model_validate(workload("w", tasks=TASKS, workloadRef=reference)["spec"])
        assert "<partition>" not in action_proxy_container.instance_profiles(spec)
        assert not action_proxy_container.proxied(spec)
        assert "the pods of Deployment arm serve /goto directly" in action_proxy_container.problem("w", spec, TEMPLATE)
