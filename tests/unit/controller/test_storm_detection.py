"""A storm: so many workloads of a policy fail at once that it is said in the policy, once, and taken back by itself."""

from __future__ import annotations

from typing import Any

from tests.support.golden import assert_golden
from tests.unit.controller import world
from understudy.api import names
from understudy.api.conditions import Condition
from understudy.api.kinds.failure_policy import StormGuard
from understudy.controller.reconcile import change_index
from understudy.controller.reconcile.change_index import Key
from understudy.controller.reconcile.object_store import ObservedChange, Store
from understudy.controller.status import policy_status, storm_detection, workload_status
from understudy.failover.progress import Progress, rfc3339
from understudy.kube.client import NETWORK_POLICIES, WORKLOADS, Object

NOW = 1000.0
GUARD = StormGuard(percent=50, workloads=3, within="10s")


def robot(number: int, health: str = "Healthy", *, failed: float | None = None, **status: Any) -> Object:
    recoveries = [{"moments": {"detected": rfc3339(failed)}, "planned": False}] if failed is not None else []
    return world.workload(f"w-{number}", status={"health": health, "recoveries": recoveries, **status})


def judged(*workloads: Object, live: Condition | None = None) -> tuple[Condition, float | None]:
    policy = world.policy("Restart")
    if live is not None:
        policy["status"] = {"conditions": [live.to_wire()]}
    return storm_detection.judge(policy, GUARD, [(workload, None) for workload in workloads], NOW)


def gate(of: Object, progress: Progress | None) -> Object:
    made = world.gate(of, active=world.pod("w-0-a"), epoch=3)
    if progress is not None:
        made["metadata"]["annotations"][names.RECOVERY] = progress.model_dump_json()
    return made


def fleet(failing: int, of: int) -> list[Object]:
    return [robot(i, "Failed" if i < failing else "Healthy") for i in range(of)]


def test_a_storm_requires_more_failures_than_the_percentage() -> None:
    assert judged(*fleet(3, 6))[0].status == "False", "half of them isn't more than half"
    found, again = judged(*fleet(4, 6))
    assert (found.status, found.reason, again) == ("True", "ManyFail", None)
    assert_golden("operator", found.message, "4 of 6", "10s", "w-0", "w-1", "w-2", "w-3")


def test_a_storm_requires_at_least_three_failures() -> None:
    assert judged(*fleet(2, 2))[0].status == "False", "two robots of two are no storm"
    assert judged(*fleet(3, 3))[0].status == "True"


def test_recent_failures_count_for_a_limited_time_even_if_they_were_recovered() -> None:
    recent = [robot(0, failed=NOW - 4), robot(1, "Recovering", failed=NOW - 1), robot(2, failed=NOW - 7)]
    found, again = judged(*recent, robot(3))
    assert found.status == "True"
    assert again is not None
    assert round(again, 6) == 3.0
    assert judged(robot(0, failed=NOW - 10), *recent[1:], robot(3))[0].status == "False"


def test_a_planned_switchover_is_not_a_failure() -> None:
    handed = robot(0)
    handed["status"]["recoveries"] = [{"moments": {"detected": rfc3339(NOW - 1)}, "planned": True}]
    assert storm_detection.counted_until(handed, None, NOW, 10.0) is None
    progress = Progress.begin("slow", last_healthy=NOW - 1, detected=NOW - 1, planned=True)
    assert storm_detection.counted_until(robot(1), gate(robot(1), progress), NOW, 10.0) is None


def test_a_failure_known_only_from_the_gate_counts() -> None:
    workload = robot(0, failed=NOW - 50)
    progress = Progress.begin("crashed", last_healthy=NOW - 1, detected=NOW - 0.5)
    assert storm_detection.counted_until(workload, gate(workload, None), NOW, 10.0) is None
    until = storm_detection.counted_until(workload, gate(workload, progress), NOW, 10.0)
    assert until is not None
    assert round(until, 6) == NOW + 9.5
    assert storm_detection.counted_until(workload, gate(workload, progress), NOW + 9.5, 10.0) is None, (
        "given up, or told since"
    )
    unreadable = gate(workload, None)
    unreadable["metadata"]["annotations"][names.RECOVERY] = "{"
    assert storm_detection.counted_until(workload, unreadable, NOW, 10.0) is None


def test_paused_workloads_do_not_count() -> None:
    conditions = [{"type": "Paused", "status": "True", "reason": "Maintenance"}]
    paused = [robot(i, "Failed", conditions=conditions) for i in range(10, 14)]
    assert judged(*paused, robot(0))[0].status == "False"
    assert judged(*paused, *fleet(3, 4))[0].status == "True"


def test_the_message_stays_the_same_during_a_storm() -> None:
    first, _ = judged(*fleet(4, 6))
    later, _ = judged(*fleet(6, 6), live=first)
    assert later.message == first.message


def test_a_storm_causes_events_at_its_begin_and_end() -> None:
    policy = world.policy("Restart")
    calm, storm = judged(*fleet(0, 6))[0], judged(*fleet(6, 6))[0]

    def status(condition: Condition) -> Object:
        return policy_status.status(policy, pools={}, config_maps={}, users=[], storm=condition)

    def reasons(live: Object, desired: Object) -> list[tuple[str, str]]:
        found = workload_status.transitions(live, desired)
        return [(c["type"], c["status"]) for c in found if c["type"] == "Storm"]

    assert reasons({}, status(calm)) == []
    assert reasons({"status": status(calm)}, status(storm)) == [("Storm", "True")]
    assert reasons({"status": status(storm)}, status(calm)) == [("Storm", "False")]


def test_a_change_of_health_reconciles_only_policies_with_a_storm_guard() -> None:
    store, policy = Store(), world.policy("Restart")
    store.put(change_index.POLICIES, policy)
    key = Key("failurepolicies", world.NAMESPACE, "policy")
    well, failed = robot(0), robot(0, "Failed")
    assert key not in change_index.of(ObservedChange(WORKLOADS, well, failed), store).keys
    guarded = world.policy("Restart")
    guarded["spec"]["limits"] = {"stormGuard": {"percent": 40}}
    guarded["metadata"]["resourceVersion"] = "999"
    store.put(change_index.POLICIES, guarded)
    assert key in change_index.of(ObservedChange(WORKLOADS, well, failed), store).keys
    assert key not in change_index.of(ObservedChange(WORKLOADS, failed, failed), store).keys
    store.put(WORKLOADS, well)
    first = gate(well, Progress.begin("crashed", last_healthy=NOW - 1, detected=NOW))
    assert key in change_index.of(ObservedChange(NETWORK_POLICIES, gate(well, None), first), store).keys, (
        "its gate tells first"
    )
    opened = {**first, "spec": {"podSelector": {}}}
    assert key not in change_index.of(ObservedChange(NETWORK_POLICIES, first, opened), store).keys, (
        "of the same recovery"
    )
