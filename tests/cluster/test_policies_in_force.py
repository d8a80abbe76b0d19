"""Degraded workloads, selected strategies and situations on a real API server."""

from __future__ import annotations

import json
import time

from tests.cluster.operator_objects import deployment
from tests.cluster.operators import CORE, Fleet, Operator, custom, hot, policy, spare, template, workload
from tests.support.cluster import Object, until
from understudy.api import names
from understudy.api.base import API_VERSION

# -- degraded -----------------------------------------------------------------------------------------------------------


def degrading(action: Object, *strategies: str) -> Object:
    made = policy(*strategies)
    well = {"yaml": {"topic": {"name": "/cmd_vel", "rate": "> 18 Hz"}}}
    made["spec"]["degraded"] = {"monitoring": well, "actions": [action]}
    return made


def say_degraded(fleet: Fleet, so: bool) -> None:
    """What the monitor says."""
    said = {
        "type": "Degraded",
        "status": "True" if so else "False",
        "reason": "NotWell" if so else "Well",
        "message": "",
        "lastTransitionTime": "2026-01-01T00:00:00Z",
    }
    status = {"health": "Degraded" if so else "Healthy", "conditions": [said]}
    item = {"apiVersion": API_VERSION, "kind": "RobotWorkload", "metadata": {"name": "w"}, "status": status}
    fleet.cluster.apply(item, fleet.namespace, subresource="status", manager="understudy-monitor")


def in_control(fleet: Fleet) -> str:
    """Put the workload's own pod in control; its name."""
    fleet.wait_built()
    fleet.make_parts_ready()
    (pod,) = until(fleet.instances, "the workload's own pod")
    fleet.make_ready(pod)
    fleet.commit(pod)
    name: str = pod["metadata"]["name"]
    return name


def cpu(fleet: Fleet, pod: str) -> tuple[str, str]:
    """The request and the limit of a pod's first container."""
    resources = fleet.get("Pod", pod, CORE)["spec"]["containers"][0]["resources"]
    return resources["requests"]["cpu"], resources["limits"]["cpu"]


def test_the_pod_in_control_gets_more_while_its_workload_is_degraded(fleet: Fleet, operator: Operator) -> None:
    resources = {"requests": {"cpu": "50m"}, "limits": {"cpu": "200m"}}
    asked = degrading({"resize": {"cpu": "300m"}}, "Restart")
    fleet.create(asked, workload(template=template(resources=resources)))
    pod = in_control(fleet)
    uid = fleet.get("Pod", pod, CORE)["metadata"]["uid"]
    say_degraded(fleet, False)
    time.sleep(2)
    assert cpu(fleet, pod) == ("50m", "200m"), "nothing is done while all is well"
    say_degraded(fleet, True)
    until(lambda: cpu(fleet, pod) == ("300m", "300m"), "it to have more")
    fleet.wait_condition("RobotWorkload", "w", "Resized", "Resized", "True")
    assert fleet.settled() == fleet.settled(), "and that is done once"
    say_degraded(fleet, False)
    until(lambda: not fleet.condition("RobotWorkload", "w", "Resized"), "nothing to be said of it any more")
    assert cpu(fleet, pod) == ("300m", "300m"), "what it has it keeps"
    assert fleet.get("Pod", pod, CORE)["metadata"]["uid"] == uid


def test_an_object_that_the_api_server_refuses_is_reported_and_changes_nothing_else(
    fleet: Fleet, operator: Operator
) -> None:
    """Request and limit would be the same then, of everything in the pod: another class of quality, which a pod can't change."""
    referred = deployment()
    resources = {"requests": {"cpu": "50m", "memory": "64Mi"}, "limits": {"cpu": "200m", "memory": "64Mi"}}
    referred["spec"]["template"]["spec"]["containers"][0]["resources"] = resources
    asked = degrading({"resize": {"cpu": "300m"}}, "Restart")
    fleet.create(referred, asked, workload(workloadRef={"kind": "Deployment", "name": "nav2"}))
    pod = in_control(fleet)
    say_degraded(fleet, True)
    said = fleet.wait_condition("RobotWorkload", "w", "Resized", "Refused")
    assert "qos" in said["message"].lower()
    assert cpu(fleet, pod) == ("50m", "200m")
    assert fleet.condition("RobotWorkload", "w", "Reconciled")["status"] == "True"


def test_a_pool_without_standbys_has_one_while_the_workload_is_degraded(fleet: Fleet, operator: Operator) -> None:
    asked = degrading({"prewarm": {"poolRef": {"name": "hot"}}}, "hot", "Restart")
    fleet.create(asked, hot(per_workload=0), workload())
    in_control(fleet)
    fleet.wait_condition("RobotWorkload", "w", "Protected", "FirstStrategyReady", "True")
    assert len(fleet.instances()) == 1
    say_degraded(fleet, True)
    (standby,) = until(lambda: fleet.pods(f"{names.WORKLOAD}=w,{names.POOL}=hot"), "a standby")
    assert fleet.condition("RobotWorkload", "w", "Protected")["status"] == "True"
    fleet.make_ready(standby)
    until(lambda: fleet.get("RobotWorkload", "w")["status"]["standby"] == "Executing (1/1)", "it to count")
    say_degraded(fleet, False)
    until(lambda: not fleet.pods(f"{names.WORKLOAD}=w,{names.POOL}=hot"), "it to go")
    assert fleet.condition("RobotWorkload", "w", "Protected")["status"] == "True"


# -- strategies that are left to be chosen ------------------------------------------------------------------------------


def requiring(**requirements: str) -> Object:
    made = policy("Restart")
    made["spec"]["strategies"] = [{"type": "Auto"}]
    made["spec"]["requirements"] = requirements
    return made


def chosen(fleet: Fleet) -> list[str]:
    """The settings that the monitor gets: the pools of the strategies, and Restart."""
    settings = json.loads(fleet.get("ConfigMap", names.settings("w"), CORE)["data"]["settings.json"])
    return [one.get("poolRef", {}).get("name", one["type"]) for one in settings["strategies"]]


def test_requirements_decide_which_standbys_are_kept(fleet: Fleet, operator: Operator) -> None:
    fleet.create(requiring(taskCriticality="High"), hot(), spare(), workload())
    fleet.wait_built()
    until(lambda: fleet.pods(f"{names.WORKLOAD}=w,{names.POOL}=hot"), "a standby")
    said = fleet.wait_condition("RobotWorkload", "w", "StrategiesChosen", "Chosen", "True")
    assert said["message"].startswith(
        "Chosen order: 1. Executing (hot), 2. Uninitialized (spare), 3. Restart. Required: a recovery within 500 ms"
    )
    assert chosen(fleet) == ["hot", "spare", "Restart"]
    assert fleet.get("FailurePolicy", "policy")["status"]["strategies"] == "Auto"
    fleet.cluster.patch(
        fleet.get("FailurePolicy", "policy"),
        {"spec": {"requirements": {"taskCriticality": "Low", "availability": "Low"}}},
    )
    until(lambda: not fleet.pods(f"{names.WORKLOAD}=w,{names.POOL}=hot"), "the standby to go")
    until(lambda: chosen(fleet) == ["spare", "Restart"], "the monitor to be told")
    until(
        lambda: fleet.get("RobotWorkload", "w")["status"]["strategies"] == "Uninitialized (spare), Restart",
        "it to be said",
    )
    until(lambda: fleet.get("FallbackPool", "hot")["status"]["desired"] == 0, "the pool to want none")
    assert fleet.settled() == fleet.settled(), "and that is done once"
    fleet.cluster.patch(fleet.get("FailurePolicy", "policy"), {"spec": {"strategies": [{"type": "Restart"}]}})
    until(lambda: not fleet.condition("RobotWorkload", "w", "StrategiesChosen"), "nothing to be said of it any more")


def test_a_pool_that_comes_later_is_chosen_from(fleet: Fleet, operator: Operator) -> None:
    fleet.create(requiring(availability="High", resourceUsage="High"), workload())
    said = fleet.wait_condition("RobotWorkload", "w", "StrategiesChosen", "RequirementsNotMet")
    assert "Not met: availability High requires a recovery within 500 ms" in said["message"]
    assert "the first, Restart, takes" in said["message"]
    fleet.create(hot())
    fleet.wait_condition("RobotWorkload", "w", "StrategiesChosen", "Chosen", "True")
    until(lambda: chosen(fleet) == ["hot", "Restart"], "the monitor to be told")


# -- situations ---------------------------------------------------------------------------------------------------------


def say_situation(fleet: Fleet, name: str) -> None:
    """What the monitor says; empty for none."""
    situation = {"situation": {"name": name, "since": "2026-01-01T00:00:00Z", "reason": "it is"}} if name else {}
    status = {"health": "Healthy", **situation}
    item = {"apiVersion": API_VERSION, "kind": "RobotWorkload", "metadata": {"name": "w"}, "status": status}
    fleet.cluster.apply(item, fleet.namespace, subresource="status", manager="understudy-monitor")


def test_a_situation_raises_the_standby_and_lets_the_former_one_go_when_that_is_ready(
    fleet: Fleet, operator: Operator
) -> None:
    asked = policy("calm", "Restart")
    raised = policy("hot", "Restart")["spec"]["strategies"]
    asked["spec"]["situations"] = [{"name": "carrying", "when": {"task": {"action": "/go"}}, "strategies": raised}]
    fleet.create(asked, custom("FallbackPool", "calm", hot()["spec"]), hot(), workload())

    def standbys(pool: str) -> list[Object]:
        return fleet.pods(f"{names.WORKLOAD}=w,{names.POOL}={pool}")

    fleet.wait_built()
    fleet.make_parts_ready()
    (own,) = until(lambda: fleet.pods(f"{names.WORKLOAD}=w,{names.SOURCE}=workload"), "the workload's own pod")
    fleet.make_ready(own)
    fleet.commit(own)
    (calm,) = until(lambda: standbys("calm"), "a standby")
    fleet.make_ready(calm)
    fleet.wait_condition("RobotWorkload", "w", "Protected", "FirstStrategyReady", "True")
    fleet.wait_condition("RobotWorkload", "w", "SituationCovered", "NoSituation", "True")
    assert chosen(fleet) == ["calm", "Restart"]
    assert standbys("hot") == []

    say_situation(fleet, "carrying")
    (standby,) = until(lambda: standbys("hot"), "another standby")
    said = fleet.wait_condition("RobotWorkload", "w", "SituationCovered", "StandbyNotReady", "False")
    assert said["message"].endswith(
        "the strategies stay Executing (calm), Restart: no pod of FallbackPool hot is ready for it."
    )
    assert fleet.settled() == fleet.settled(), "nothing is written while it is waited for"
    assert chosen(fleet) == ["calm", "Restart"]
    assert [pod["metadata"]["name"] for pod in standbys("calm")] == [calm["metadata"]["name"]]
    assert fleet.condition("RobotWorkload", "w", "Protected")["status"] == "True"

    fleet.make_ready(standby)
    until(lambda: chosen(fleet) == ["hot", "Restart"], "the monitor to be told")
    until(lambda: not standbys("calm"), "the former one to go")
    fleet.wait_condition("RobotWorkload", "w", "SituationCovered", "InForce", "True")
    assert fleet.condition("RobotWorkload", "w", "Protected")["status"] == "True"
    until(lambda: fleet.get("FallbackPool", "calm")["status"]["desired"] == 0, "its pool to want none")
    assert fleet.settled() == fleet.settled(), "and that is done once"

    say_situation(fleet, "")
    (calm,) = until(lambda: standbys("calm"), "one as before")
    assert chosen(fleet) == ["hot", "Restart"]
    fleet.make_ready(calm)
    until(lambda: not standbys("hot"), "that of the situation to go")
    assert chosen(fleet) == ["calm", "Restart"]
    fleet.wait_condition("RobotWorkload", "w", "SituationCovered", "NoSituation", "True")
