"""A reflex that isn't safe is refused, with what to do about it; a safe one reaches pods and robot alike."""

from __future__ import annotations

import copy
from typing import Any

from tests.unit.controller.world import workload
from understudy.api import names
from understudy.api.workloads import RobotWorkloadSpec
from understudy.cluster.client import Object
from understudy.controller import instances, reflexes, robots, tasking
from understudy.controller.desired import Images

CMD_VEL = {"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}
LAMP = {"topic": "/lamp", "type": "std_msgs/msg/Bool"}
DOCK = {"service": "/dock", "type": "std_srvs/srv/Trigger"}


def spec(outputs: list[Object], *, accept: list[str] | None = None, **more: Any) -> RobotWorkloadSpec:
    made = workload("w")["spec"]
    made |= {"outputs": outputs, "gate": {"reflex": {"deadline": "100ms", "accept": accept or []}}, **more}
    return RobotWorkloadSpec.model_validate(made)


def problem(found: RobotWorkloadSpec) -> str:
    return reflexes.problem(found, found.template or {}) or ""


def test_one_topic_is_safe() -> None:
    assert problem(spec([CMD_VEL])) == ""
    assert problem(RobotWorkloadSpec.model_validate(workload("w")["spec"])) == "", "and no reflex is, too"


def test_several_topics_must_be_accepted_by_name() -> None:
    words = problem(spec([CMD_VEL, LAMP]))
    assert "each topic (/cmd_vel, /lamp) falls over by itself" in words
    assert "(missing: /cmd_vel, /lamp)" in words
    assert "(missing: /lamp)" in problem(spec([CMD_VEL, LAMP], accept=["/cmd_vel"]))
    assert problem(spec([CMD_VEL, LAMP], accept=["/lamp", "/cmd_vel"])) == ""


def test_a_service_has_no_owner() -> None:
    assert "/dock (service or action) has no owner" in problem(spec([CMD_VEL, DOCK]))
    assert problem(spec([CMD_VEL, DOCK], accept=["/dock", "/cmd_vel"])) == ""
    assert "outputs has no topic" in problem(spec([DOCK], accept=["/dock"]))


def test_pods_that_cannot_be_given_a_strength_are_refused() -> None:
    referring = spec([CMD_VEL], template=None, workload_ref={"kind": "Deployment", "name": "nav"})
    assert "Deployment nav" in problem(referring)
    own = spec([CMD_VEL])
    assert own.template is not None
    template = copy.deepcopy(own.template)
    template["spec"]["containers"][0]["env"] = [{"name": names.PROFILES_VARIABLE, "value": "/mine.xml"}]
    assert names.PROFILES_VARIABLE in (reflexes.problem(own, template) or "")


def test_a_strength_is_put_in_before_any_process_starts_and_the_robot_chooses_by_it() -> None:
    found = spec([CMD_VEL])
    profiles = tasking.instance_profiles(found)
    assert f"<value>${{{names.STRENGTH_VARIABLE}}}</value>" in profiles
    recipe = instances.Recipe(
        workload="w", namespace="fleet", images=Images("monitor"), secret="w-agent", profiles=profiles
    )
    pod = instances.build(found.template or {}, recipe)["spec"]
    assert [c["name"] for c in pod["initContainers"]] == [names.INIT_CONTAINER]
    robot = robots.config_maps("w", {}, found.outputs, found.gate.reflex)[1]["data"][robots.PROFILES_KEY]
    assert "<kind>EXCLUSIVE</kind>" in robot
