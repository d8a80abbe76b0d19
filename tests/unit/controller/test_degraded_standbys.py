"""A standby more while a workload is degraded: made, counted on once it is ready, and taken away when all is well."""

from __future__ import annotations

import json

import pytest

from tests.support.golden import assert_golden
from tests.unit.controller.world import (
    World,
    applied,
    claimed_pod,
    created,
    deleted,
    gate,
    held_pod,
    hot,
    patched,
    policy,
    source_pod,
    spare,
    standby_pod,
    workload,
)
from understudy.controller.observed import degraded_measures, policy_reader, pool_reader
from understudy.controller.pods.pool_pods import Observed
from understudy.controller.status import policy_status, pool_status
from understudy.kube.client import Object

FAILOVER = ("hot", "spare", "Restart")


def prewarming(*strategies: str, pool: str = "hot") -> Object:
    made = policy(*(strategies or FAILOVER))
    tree = {"topic": {"name": "/cmd_vel", "rate": "> 18 Hz"}}
    made["spec"]["degraded"] = {"monitoring": {"yaml": tree}, "actions": [{"prewarm": {"poolRef": {"name": pool}}}]}
    return made


def status(degraded: str, health: str = "") -> Object:
    condition = {
        "type": "Degraded",
        "status": degraded,
        "reason": "NotWell",
        "lastTransitionTime": "2026-01-01T00:00:00Z",
    }
    return {"conditions": [condition], **({"health": health} if health else {})}


def world(degraded: str = "True", *, per_workload: int = 0, health: str = "", asked: Object | None = None) -> World:
    made = World(
        workload(status=status(degraded, health)), asked or prewarming(), hot(per_workload=per_workload), spare()
    )
    active = source_pod("w-a")
    made.pods = [active]
    made.own(gate(made.workload, active=active, epoch=3))
    made.unclaimed = {"spare": [held_pod("s-1", of=spare())]}
    return made


def test_a_pool_without_standbys_creates_one_while_the_workload_is_degraded() -> None:
    assert len(created(world("True").plan(), "pods")) == 1
    for degraded in ("False", "Unknown"):
        assert not created(world(degraded).plan(), "pods")


def test_the_additional_standby_is_added_to_the_regular_ones() -> None:
    made = world("True", per_workload=1)
    made.pods.append(standby_pod("w-s", of=made.workload, template_hash=made.template_hash))
    assert len(created(made.plan(), "pods")) == 1


def test_no_additional_standby_is_created_without_the_action_in_the_policy() -> None:
    assert not created(world("True", asked=policy(*FAILOVER)).plan(), "pods")


def test_one_additional_standby_is_enough_and_is_deleted_after_the_degradation() -> None:
    made = world("True")
    made.pods.append(standby_pod("w-s", of=made.workload, template_hash=made.template_hash))
    assert not created(made.plan(), "pods")
    assert not deleted(made.plan())
    made.workload["status"] = status("False")
    assert deleted(made.plan()) == ["w-s"]


@pytest.mark.parametrize("health", ["Degraded", "Failed", "Recovering"])
def test_the_additional_standby_stays_while_the_workload_fails_and_recovers(health: str) -> None:
    made = world("True", health=health)
    made.pods.append(standby_pod("w-s", of=made.workload, template_hash=made.template_hash))
    assert not deleted(made.plan())


def test_an_additional_standby_in_control_is_never_deleted() -> None:
    made = world("False")
    active = standby_pod("w-s", of=made.workload, template_hash=made.template_hash)
    made.pods = [active]
    made.own(gate(made.workload, active=active, epoch=4))
    assert deleted(made.plan()) == []


def test_the_controller_of_a_degraded_workload_keeps_a_pod_while_a_standby_is_active() -> None:
    made = world("True")
    made.build()
    active = standby_pod("w-s", of=made.workload, template_hash=made.template_hash)
    made.pods = [active]
    made.own(gate(made.workload, active=active, epoch=4))
    made.owned[("replicasets", "w")]["spec"]["replicas"] = 0
    assert patched(made.plan(), "replicasets")["w"] == {"spec": {"replicas": 1}}
    made.workload["status"] = status("False")
    made.owned[("replicasets", "w")]["spec"]["replicas"] = 1
    assert patched(made.plan(), "replicasets")["w"] == {"spec": {"replicas": 0}}


def test_an_additional_standby_is_created_while_a_claimed_pod_is_active() -> None:
    made = world("True")
    active = claimed_pod("s-1", of=spare(), by=made.workload)
    made.pods = [active]
    made.own(gate(made.workload, active=active, epoch=4))
    assert len(created(made.plan(), "pods")) == 1


def test_the_monitor_knows_the_pool_with_and_without_an_additional_standby() -> None:
    for degraded in ("True", "False"):
        settings = json.loads(applied(world(degraded).plan(), "configmaps")["w-settings"]["data"]["settings.json"])
        assert [pool["name"] for pool in settings["pools"]] == ["hot", "spare"]


class TestProtection:
    def test_an_additional_standby_does_not_protect_before_it_is_ready(self) -> None:
        for degraded in ("True", "False"):
            made = world(degraded)
            assert made.condition("Protected")["status"] == "True"
            assert "from pool spare" in made.condition("Protected")["message"]
            assert made.status()["standby"] == "Uninitialized (1/1)"

    def test_a_ready_additional_standby_is_the_first_choice(self) -> None:
        made = world("True")
        made.pods.append(standby_pod("w-s", of=made.workload, template_hash=made.template_hash))
        assert "from pool hot" in made.condition("Protected")["message"]
        assert made.status()["standby"] == "Executing (1/1)"

    def test_protection_stays_when_the_additional_standby_is_about_to_be_deleted(self) -> None:
        made = world("False")
        made.pods.append(standby_pod("w-s", of=made.workload, template_hash=made.template_hash))
        assert made.condition("Protected")["status"] == "True"
        assert "from pool spare" in made.condition("Protected")["message"]

    def test_an_empty_pool_is_reported_if_the_policy_has_no_other_strategy(self) -> None:
        made = world("False", asked=prewarming("hot"))
        assert made.condition("Protected")["reason"] == "PoolEmpty"

    def test_the_desired_count_of_a_pool_includes_additional_standbys(self) -> None:
        pool = hot(per_workload=0)
        observed = Observed(pool=pool, workloads={"w": workload()}, pods=[], owned={}, now=0.0, prewarmed=1)
        assert pool_status.count(observed, pool_reader.spec(pool)).desired == 1

    def test_prewarming_a_shared_pool_is_refused(self) -> None:
        asked = prewarming(pool="spare")
        found = policy_status.conditions(asked, {"hot": hot(), "spare": spare()}, {})
        assert (found[0].status, found[0].reason) == ("False", "PoolNotPrewarmed")
        assert_golden(
            "operator", found[0].message, "spec.degraded.actions[0].prewarm.poolRef.name", "FallbackPool spare"
        )
        assert policy_reader.problem(asked, {}) is None, "the rest of the policy is followed"


def test_an_invalid_policy_has_no_actions() -> None:
    broken = prewarming()
    broken["spec"]["strategies"] = []
    assert degraded_measures.actions(broken) == []
    assert degraded_measures.actions(None) == []
