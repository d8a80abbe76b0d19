"""What the operator makes of procedures: mistakes are reported with their place, and monitors learn what pools need."""

from __future__ import annotations

import json

import pytest

from tests.support.golden import assert_golden
from tests.unit.controller.world import (
    World,
    applied,
    created,
    deleted,
    gate,
    hot,
    policy,
    source_pod,
    standby_pod,
    workload,
)
from understudy.controller.observed import policy_reader, pool_reader
from understudy.controller.pods import instance_pod
from understudy.kube.client import Object

INACTIVE = {"yaml": {"set_lifecycle": {"node": "/amcl", "state": "inactive"}}, "within": "20s"}
CHECK = {"yaml": {"lifecycle_is": {"node": "/amcl", "state": "inactive"}}, "period": "2s"}


def warm(**more: object) -> Object:
    return hot("warm", readiness="Initialized", initialization=INACTIVE, **more)


def test_an_initialized_pool_creates_standbys_as_an_executing_one_does() -> None:
    world = World(workload(), policy("warm", "Restart"), warm(per_workload=2))
    names = [pod["metadata"]["labels"]["understudy.dev/pool"] for pod in created(world.plan(), "pods")]
    assert names == ["warm", "warm"]


def test_monitors_receive_the_readiness_initialization_and_check_of_a_pool() -> None:
    world = World(workload(), policy("warm"), warm(readinessCheck=CHECK))
    (pool,) = json.loads(applied(world.plan(), "configmaps")["w-settings"]["data"]["settings.json"])["pools"]
    assert pool["readiness"] == "Initialized"
    assert pool["initialization"] == INACTIVE
    assert pool["readinessCheck"] == CHECK


def test_an_invalid_bring_up_is_reported_and_changes_nothing() -> None:
    world = World(workload(bringUp={"yaml": {"set_lifecycle": {"node": "/amcl", "state": "on"}}}), policy("Restart"))
    accepted = world.condition("Accepted")
    assert (accepted["status"], accepted["reason"]) == ("False", "TreeInvalid")
    assert_golden("operator", accepted["message"], "spec.bringUp.yaml.set_lifecycle.state", "'on'")
    assert world.plan().writes == []


def test_an_invalid_recovery_procedure_is_reported_in_the_policy() -> None:
    found = policy("Restart", "Restart")
    found["spec"]["strategies"][1]["recovery"] = {"yaml": {"restore_state": {"onyl": ["/amcl_pose"]}}}
    problem = policy_reader.problem(found, {})
    assert problem is not None
    assert problem.reason == "TreeInvalid"
    assert_golden(
        "operator", problem.message, "spec.strategies[1].recovery.yaml.restore_state.onyl", "'onyl'", "'only'"
    )


@pytest.mark.parametrize(("ready", "standby"), [(True, "Initialized (1/1)"), (False, "Initialized (0/1)")])
def test_the_standby_column_counts_ready_standbys(ready: bool, standby: str) -> None:
    world = World(workload(), policy("warm"), warm())
    world.build()
    driving = source_pod("w-a")
    world.pods = [driving, standby_pod("w-s", of=workload(), pool="warm", ready=ready)]
    world.own(gate(world.workload, active=driving, epoch=1))
    assert world.status()["standby"] == standby
    assert world.condition("Protected")["status"] == str(ready)


def test_standbys_of_two_readinesses_count_only_for_their_own_pool() -> None:
    world = World(workload(), policy("hot", "warm"), hot(), warm())
    world.build()
    driving = source_pod("w-a")
    world.pods = [driving, standby_pod("w-s", of=workload(), pool="warm")]
    world.own(gate(world.workload, active=driving, epoch=1))
    protected = world.condition("Protected")
    assert protected["status"] == "False"
    assert_golden("operator", protected["message"], "Fallback from pool warm")


BROKEN = {"yaml": {"set_lifecycle": {"node": "/amcl", "state": "on"}}}


def standing(spec: Object) -> tuple[World, Object]:
    """A world with a pod in control and a standby, as it is after everything was built, and the pool's spec then changed."""
    world = World(workload(), policy("warm"), warm())
    world.build()
    built = world.understood().builts["warm"]
    driving = source_pod("w-a")
    ready = standby_pod("w-s", of=workload(), pool="warm", template_hash=instance_pod.template_hash(built))
    world.pods = [driving, ready]
    world.own(gate(world.workload, active=driving, epoch=1))
    world.others = [policy("warm"), changed(spec)]
    return world, ready


def changed(spec: Object) -> Object:
    return hot("warm", readiness="Initialized", **spec)


def settings(world: World) -> Object:
    found: Object = json.loads(applied(world.plan(), "configmaps")["w-settings"]["data"]["settings.json"])
    return found


def test_a_pool_that_is_not_accepted_creates_no_standbys_and_is_reported() -> None:
    world = World(workload(), policy("warm"), changed({"initialization": BROKEN}))
    assert created(world.plan(), "pods") == []
    assert settings(world)["pools"] == [], "the monitor never hears of it"
    world.build()
    driving = source_pod("w-a")
    world.pods = [driving]
    world.own(gate(world.workload, active=driving, epoch=1))
    protected = world.condition("Protected")
    assert (protected["status"], protected["reason"]) == ("False", "PoolNotAccepted")
    assert "FallbackPool warm is not accepted" in protected["message"]
    assert_golden("operator", protected["message"], "spec.initialization.yaml.set_lifecycle.state", "'on'")


def test_standbys_of_a_pool_that_is_no_longer_accepted_stay_unchanged() -> None:
    world, _ = standing({"initialization": BROKEN})
    plan = world.plan()
    assert (created(plan, "pods"), deleted(plan)) == ([], [])
    assert settings(world)["pools"][0]["initialization"] == INACTIVE, "they are judged by what made them"
    assert world.condition("Protected")["status"] == "True"


def test_a_changed_initialization_replaces_a_standby_after_the_new_one_is_ready() -> None:
    world, old = standing({"initialization": {"yaml": {"wait_for": {"node": "/amcl"}}}})
    (made,) = created(world.plan(), "pods")
    assert deleted(world.plan()) == []
    made |= {
        "metadata": made["metadata"] | {"uid": "uid-new", "creationTimestamp": old["metadata"]["creationTimestamp"]}
    }
    made["status"] = {"phase": "Running", "conditions": [{"type": "Ready", "status": "False"}]}
    world.pods.append(made)
    assert (created(world.plan(), "pods"), deleted(world.plan())) == ([], [])
    made["status"]["conditions"][0]["status"] = "True"
    assert deleted(world.plan()) == ["w-s"]


def test_a_changed_time_limit_of_the_initialization_creates_no_new_standby() -> None:
    world, _ = standing({"initialization": INACTIVE | {"within": "90s"}})
    plan = world.plan()
    assert (created(plan, "pods"), deleted(plan)) == ([], [])


def test_a_new_template_that_waits_for_a_standby_names_the_pool_that_has_none() -> None:
    world, _ = standing({"initialization": BROKEN})
    world.workload["spec"]["template"]["spec"]["containers"][0]["image"] = "app:2"
    message = world.condition("Reconciled")["message"]
    assert_golden("operator", message, "FallbackPool warm")


def in_xml(*leaves: str) -> Object:
    inside = "\n".join(leaves)
    return {
        "xml": f'<root BTCPP_format="4">\n<BehaviorTree ID="A">\n{inside}\n</BehaviorTree>\n</root>',
        "within": "20s",
    }


def test_a_mistake_in_another_language_is_reported_with_its_place() -> None:
    world = World(workload(bringUp=in_xml('  <SetLifecycle node="/amcl" state="on"/>')), policy("Restart"))
    accepted = world.condition("Accepted")
    assert (accepted["status"], accepted["reason"]) == ("False", "TreeInvalid")
    assert_golden("operator", accepted["message"], "spec.bringUp.xml", "line 3, column 3", "SetLifecycle", "'on'")
    found = policy("Restart")
    found["spec"]["strategies"][0]["recovery"] = {
        "osc": "import osc.understudy\nscenario back:\n    do restore_stat()\n"
    }
    problem = policy_reader.problem(found, {})
    assert problem is not None
    assert_golden(
        "operator",
        problem.message,
        "spec.strategies[0].recovery.osc",
        "line 3, column 8",
        "restore_stat",
        "'restore_state'",
    )
    pool = warm(readinessCheck=in_xml('<SetLifecycle node="/amcl" state="active"/>') | {"period": "1s"})
    refused = pool_reader.problem(pool)
    assert refused is not None
    assert_golden("operator", refused.message, "spec.readinessCheck.xml", "line 3, column 1", "SetLifecycle")


def test_monitors_receive_a_procedure_as_it_was_written() -> None:
    initialization = in_xml('<SetLifecycle node="/amcl" state="inactive"/>')
    world = World(workload(), policy("warm"), hot("warm", readiness="Initialized", initialization=initialization))
    (pool,) = settings(world)["pools"]
    assert pool["initialization"] == initialization


def test_an_equivalent_procedure_in_another_language_does_not_replace_standbys() -> None:
    short = World(workload(), policy("warm"), warm())
    other = in_xml('<SetLifecycle node="/amcl" state="inactive"/>')
    world = World(workload(), policy("warm"), hot("warm", readiness="Initialized", initialization=other))
    hashes = [instance_pod.template_hash(one.understood().builts["warm"]) for one in (short, world)]
    assert hashes[0] == hashes[1]
