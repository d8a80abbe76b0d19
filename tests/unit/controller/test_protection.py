"""What a failure now would lead to: what is protected, by what, and what is missing."""

from __future__ import annotations

import json

import pytest

from tests.support.golden import assert_golden
from tests.unit.controller.world import (
    World,
    applied,
    gate,
    held_pod,
    hot,
    pod,
    policy,
    source_pod,
    spare,
    standby_pod,
    workload,
)
from understudy.controller.status import workload_status
from understudy.kube.client import Object


def world(*others: Object, standby: Object | None = None, **active: object) -> World:
    made = World(workload(), *others)
    made.build()
    driving = source_pod("w-a", **active)  # type: ignore[arg-type]
    made.pods = [driving, *([standby] if standby else [])]
    made.own(gate(made.workload, active=driving, epoch=1))
    return made


def test_a_ready_standby_protects_the_workload() -> None:
    found = world(policy("hot", "Restart"), hot(), standby=standby_pod("w-s", of=workload()))
    protected = found.condition("Protected")
    assert protected["status"] == "True"
    assert_golden("operator", protected["message"], "pool hot", "w-s (Executing)")
    assert found.status()["standby"] == "Executing (1/1)"


@pytest.mark.parametrize(
    ("standby_on", "details"), [("one", ", on the same node as the active pod"), ("another", ""), ("", "")]
)
def test_a_standby_on_the_node_of_the_active_instance_is_reported(standby_on: str, details: str) -> None:
    found = world(policy("hot"), hot(), standby=standby_pod("w-s", of=workload()))
    active, standby = found.pods
    active["spec"], standby["spec"] = {"nodeName": "one"}, {"nodeName": standby_on}
    message = found.condition("Protected")["message"]
    assert_golden("operator", message, "pool hot", f"w-s (Executing){details}")


def test_a_standby_that_is_not_ready_does_not_protect_and_the_next_strategy_is_named() -> None:
    found = world(policy("hot", "Restart"), hot(), standby=standby_pod("w-s", of=workload(), ready=False))
    protected = found.condition("Protected")
    assert (protected["status"], protected["reason"]) == ("False", "StandbyNotReady")
    assert "If it failed now, Restart would be used" in protected["message"]
    assert found.status()["standby"] == "Executing (0/1)"


def test_after_a_failover_the_replacement_pod_is_the_standby() -> None:
    found = world(policy("hot"), hot())
    driving = standby_pod("w-s", of=workload())
    found.pods = [driving, source_pod("w-b")]
    found.own(gate(found.workload, active=driving, epoch=2))
    assert found.condition("Protected")["status"] == "True"
    assert found.status()["standby"] == "Executing (1/1)"


@pytest.mark.parametrize(
    ("type_", "status", "reason", "outlook"),
    [
        ("Paused", "True", "Paused", "If it failed now, the monitor would do nothing."),
        (
            "WithinBudget",
            "False",
            "BudgetSpent",
            "If it failed now, the monitor would fence the failed instance and not replace it.",
        ),
    ],
)
def test_a_pause_and_a_spent_budget_remove_protection(type_: str, status: str, reason: str, outlook: str) -> None:
    found = world(policy("hot", "Restart"), hot(), standby=standby_pod("w-s", of=workload()))
    before = found.status()
    condition = {"type": type_, "status": status, "reason": "Whatever", "message": "That is so."}
    found.workload["status"] = {"conditions": [condition]}
    protected = found.condition("Protected")
    assert (protected["status"], protected["reason"]) == ("False", reason)
    assert protected["message"] == f"That is so. {outlook}"
    types = [c["type"] for c in workload_status.transitions({"status": before}, found.status())]
    assert "Protected" not in types, "the monitor reports this condition"
    condition["status"] = {"True": "False", "False": "True"}[status]
    assert found.condition("Protected")["status"] == "True"


def test_a_workload_without_a_ready_monitor_is_not_protected() -> None:
    found = world(policy("hot"), hot(), standby=standby_pod("w-s", of=workload()))
    found.monitors = [pod("w-monitor-1", ready=False)]
    protected = found.condition("Protected")
    assert (protected["status"], protected["reason"]) == ("False", "MonitorNotReady")
    assert "a failure is not detected" in protected["message"]


def test_the_monitor_pod_whose_image_is_missing_is_named() -> None:
    found = world(policy("Restart"))
    found.monitors = [pod("w-monitor-1", ready=False, waiting="ErrImageNeverPull")]
    assert "w-monitor-1" in found.condition("Protected")["message"]


def test_without_a_discovery_server_only_a_running_standby_protects() -> None:
    found = world(policy("hot", "Restart"), hot(), standby=standby_pod("w-s", of=workload()))
    found.discovery = [pod("w-discovery-1", ready=False, waiting="CrashLoopBackOff")]
    assert found.condition("Protected")["status"] == "True"
    found.pods.pop()
    protected = found.condition("Protected")
    assert (protected["status"], protected["reason"]) == ("False", "DiscoveryNotReady")
    assert "w-discovery-1" in protected["message"]
    assert "no strategy of its policy could run" in protected["message"]
    found.workload["spec"]["ros"] = {"discovery": {"mode": "Multicast"}}
    assert "If it failed now, Restart would be used" in found.condition("Protected")["message"]


@pytest.mark.parametrize(
    ("waiting", "reason"),
    [
        ("ErrImagePull", "ImagePullBackOff"),
        ("ImagePullBackOff", "ImagePullBackOff"),
        ("ErrImageNeverPull", "ErrImageNeverPull"),
        ("CrashLoopBackOff", "CrashLoopBackOff"),
        ("CreateContainerConfigError", "CreateContainerConfigError"),
    ],
)
def test_an_image_that_cannot_start_is_reported_with_its_pod(waiting: str, reason: str) -> None:
    found = world(policy("Restart"), ready=False, waiting=waiting)
    protected = found.condition("Protected")
    assert (protected["status"], protected["reason"]) == ("False", reason)
    assert "pod w-a" in protected["message"]
    assert "app:1" in protected["message"]


def test_a_broken_new_template_leaves_protection_while_the_old_standby_is_ready() -> None:
    found = world(policy("hot"), hot(), standby=standby_pod("w-s", of=workload()))
    found.pods.append(standby_pod("w-n", of=workload(), ready=False, waiting="ErrImageNeverPull"))
    assert found.condition("Protected")["status"] == "True"
    reconciled = found.condition("Reconciled")
    assert (reconciled["status"], reconciled["reason"]) == ("False", "ErrImageNeverPull")
    assert "pod w-n" in reconciled["message"]


def test_the_status_reports_whether_a_shared_pool_has_a_ready_pod() -> None:
    found = world(policy("spare", "Restart"), spare(replicas=2))
    pool = spare(replicas=2)
    found.unclaimed = {"spare": [held_pod("spare-a", of=pool), held_pod("spare-b", of=pool, ready=False)]}
    assert found.status()["standby"] == "Uninitialized (1/1)"
    assert found.status()["stocked"] == ["spare"], "which its monitor goes by until it needs a pod"
    assert found.condition("Protected")["status"] == "True"
    found.unclaimed = {"spare": [held_pod("spare-b", of=pool, ready=False)]}
    assert found.status()["standby"] == "Uninitialized (0/1)"
    assert "stocked" not in found.status()
    assert found.condition("Protected")["status"] == "False"


def test_the_number_of_pods_in_a_shared_pool_does_not_change_the_status() -> None:
    """Or each claim would be a write for each workload of a fleet."""
    pool = spare(replicas=9)
    statuses = []
    for count in (1, 2, 9):
        found = world(policy("spare", "Restart"), pool)
        found.unclaimed = {"spare": [held_pod(f"spare-{n}", of=pool) for n in range(count)]}
        statuses.append(found.status())
    assert statuses[0] == statuses[1] == statuses[2]


@pytest.mark.parametrize(("priority", "status"), [(0, "False"), (100, "True")])
def test_reserved_pods_protect_only_workloads_with_sufficient_priority(priority: int, status: str) -> None:
    pool = spare(replicas=2, reserve={"pods": 1, "poolPriority": 100})
    made = World(workload(poolPriority=priority), policy("spare", "Restart"), pool)
    made.build()
    driving = source_pod("w-a")
    made.pods = [driving]
    made.own(gate(made.workload, active=driving, epoch=1))
    made.unclaimed = {"spare": [held_pod("spare-a", of=pool)]}
    protected = made.condition("Protected")
    assert protected["status"] == status
    assert made.status().get("stocked") == (["spare"] if priority else None)
    if not priority:
        assert protected["reason"] == "PodsReserved"
        assert_golden(
            "operator",
            protected["message"],
            "FallbackPool spare",
            "last ready pods (1",
            "spec.poolPriority",
            "spec.reserve",
        )


@pytest.mark.parametrize(("priority", "reserved"), [(99, 2), (100, 0)])
def test_the_monitor_receives_the_number_of_pods_reserved_for_others(priority: int, reserved: int) -> None:
    pool = spare(replicas=3, reserve={"pods": 2, "poolPriority": 100})
    made = World(workload(poolPriority=priority), policy("spare"), pool)
    text = applied(made.plan(), "configmaps")["w-settings"]["data"]["settings.json"]
    assert [choice["reserved"] for choice in json.loads(text)["pools"]] == [reserved]


def test_a_policy_with_only_a_restart_reports_no_standby_and_protection() -> None:
    found = world(policy("Restart"))
    assert found.status()["standby"] == "None"
    assert found.condition("Protected")["status"] == "True"


def test_a_pool_that_does_not_serve_the_workload_is_reported() -> None:
    found = world(policy("spare"), spare(workloadSelector={"matchLabels": {"a": "b"}}))
    protected = found.condition("Protected")
    assert protected["reason"] == "PoolDoesNotServe"
    assert "no strategy of its policy could run" in protected["message"]
