"""The monitor, the condition Protected and ``understudy explain`` give the same answer for the same facts."""

from __future__ import annotations

import asyncio
from unittest.mock import patch

from hypothesis import given
from hypothesis import strategies as st

from tests.support.clock import Clock
from tests.unit.controller import world as objects
from tests.unit.failover.world import Store
from tests.unit.failover.world import World as Cluster
from tests.unit.monitor.cluster_objects import ClusterObjects, settings_of
from understudy.api.conditions import condition
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadStatus
from understudy.cli.common.robots import robot
from understudy.cli.inspect import limit_text
from understudy.controller.observed import policy_reader
from understudy.controller.status import protection
from understudy.failover.decide import LIMITS, Facts, Limit, Occurrence, Recover, Trigger, decide
from understudy.failover.interfaces import GateState
from understudy.failover.progress import PodIdentity, Progress, rfc3339
from understudy.failover.strategies.registry import choices
from understudy.kube.client import POLICIES, WORKLOADS, Object
from understudy.monitor.decide import retry_backoff
from understudy.monitor.decide.limits import Limits
from understudy.monitor.notices import Notices

NOW = objects.NOW
LIMITED = {"budget": {"recoveries": 2, "within": "10m"}, "cooldown": "1m", "stormGuard": {"holdFor": "1m"}}
FAILURE = Occurrence(Trigger.HEALTH_FAILED, "no /cmd_vel for 500 ms")


def a_pod_ready(*, ready: bool) -> objects.World:
    """A workload with an active pod and one standby of pool hot."""
    item = objects.workload()
    made = objects.World(item, objects.policy("hot", "Restart"), objects.hot())
    made.build()
    active = objects.source_pod("w-a")
    made.pods = [active, objects.standby_pod("w-s", of=item, ready=ready)]
    made.own(objects.gate(item, active=active, epoch=1))
    return made


@given(
    pause_ends=st.sampled_from([None, NOW - 10, NOW + 600]),
    spent=st.lists(st.floats(1, 1200), max_size=4),
    resumed=st.one_of(st.none(), st.floats(1, 1200)),
    recovered=st.one_of(st.none(), st.floats(1, 120)),
    storm=st.one_of(st.none(), st.integers(1, 120)),
    ready=st.booleans(),
)
def test_monitor_and_explain_agree_on_what_a_limit_prevents(
    pause_ends: float | None,
    spent: list[float],
    resumed: float | None,
    recovered: float | None,
    storm: int | None,
    ready: bool,
) -> None:
    made = a_pod_ready(ready=ready)
    item, policy = made.workload, made.others[0]
    policy["spec"]["limits"] = LIMITED
    if pause_ends is not None:
        item["spec"]["pause"] = {"reason": "a new gripper", "owner": "ann", "until": rfc3339(pause_ends)}
    if resumed is not None:
        item["metadata"]["annotations"] = {"understudy.dev/resumed": rfc3339(NOW - resumed)}
    if storm is not None:
        found = condition("Storm", True, "ManyFail", "4 of 6 workloads fail.").to_wire()
        policy["status"] = {"conditions": [found | {"lastTransitionTime": rfc3339(NOW - storm)}]}

    # The monitor, from what it watches and remembers.
    given_policy = policy_reader.spec(policy)
    watched = ClusterObjects()
    view = watched.view
    watched.put_settings()
    view.workloads.put(watched.client.store(WORKLOADS, "fleet", item))
    view.policies.put(watched.client.store(POLICIES, "fleet", policy))
    reported = Notices()
    reported.set_spent([NOW - ago for ago in spent])
    limits = Limits(view, reported)
    limits.retries.update(limits.spending.resumed, NOW - 2000)
    if recovered is not None:
        with patch.object(retry_backoff, "time", Clock(NOW - recovered)):
            limits.retries.after_recovery(given_policy)
    limits.pauses.update(NOW)
    limits.spending.report(NOW)
    decision = decide(Facts(NOW, (FAILURE,), limits.in_force(NOW), standby_ready=ready))

    # The operator, from the conditions; and the command, from the objects.
    recoveries = []
    if recovered is not None:
        done = Progress.begin("it ended", last_healthy=NOW - recovered, detected=NOW - recovered)
        done.result, done.target = "Recovered", PodIdentity(name="w-a", uid="uid-w-a")
        done.moments["verified"] = NOW - recovered
        recoveries = [done.to_recovery(1).to_wire()]
    item["status"] = {
        "conditions": [one.to_wire() for one in reported.status.conditions],
        "spent": list(reported.status.spent_times),
        "recoveries": recoveries,
    }
    protected = made.condition("Protected")
    status = RobotWorkloadStatus.model_validate(item["status"])
    in_force = limit_text.limits_in_force(
        view.spec, given_policy, policy, status, item, robot(item, made.observed().gate, NOW), NOW
    )
    sentences = list(limit_text.sentences(in_force, "w", NOW, standby_ready=ready))

    assert decide(Facts(NOW, (FAILURE,), in_force, standby_ready=ready)).reason == decision.reason
    assert any(prevents for _, prevents in sentences) == (not isinstance(decision, Recover))
    clearing = {"Paused": limits.in_force(NOW).pause, "BudgetSpent": limits.in_force(NOW).budget}
    expected = next((reason for reason, found in clearing.items() if found is not None), None)
    if expected is not None:
        assert (protected["status"], protected["reason"]) == ("False", expected)
    else:
        assert protected["reason"] == ("FirstStrategyReady" if ready else "StandbyNotReady")


def test_the_limits_that_clear_protected_equal_those_reported_by_the_monitor() -> None:
    assert {row.reason for row in LIMITS if not row.protected} == set(protection.LIMIT_CONDITIONS.values())
    assert {row.limit for row in LIMITS if not row.protected} == {Limit.PAUSE, Limit.BUDGET}


@given(
    standbys=st.lists(st.booleans(), max_size=2),
    spare=st.lists(st.booleans(), max_size=3),
    reserved=st.integers(0, 2),
    order=st.permutations(["hot", "spare", "Restart"]),
)
def test_monitor_and_explain_agree_on_which_strategies_can_run(
    standbys: list[bool], spare: list[bool], reserved: int, order: list[str]
) -> None:
    item, policy = objects.workload(), objects.policy(*order)
    reserve: Object = {"reserve": {"pods": reserved, "poolPriority": 100}} if reserved else {}
    made = objects.World(item, policy, objects.hot(), objects.spare(replicas=3, **reserve))
    made.build()
    active = objects.source_pod("w-a")
    made.own(objects.gate(item, active=active, epoch=1))
    made.pods = [
        active,
        *(objects.standby_pod(f"w-s{i}", of=item, ready=ready) for i, ready in enumerate(standbys)),
    ]
    held = dict(enumerate(spare))
    pool = made.others[2]
    made.unclaimed = {"spare": [objects.held_pod(f"p-{i}", of=pool, ready=ready) for i, ready in held.items()]}
    found = protection.considered(made.observed(), made.understood())

    async def by_the_monitor() -> list[bool]:
        store = Store()
        store.add("w-a")
        store.gate = GateState(epoch=1, active="w-a", active_uid="uid-w-a")
        for i, ready in enumerate(standbys):
            store.add(f"w-s{i}", pool="hot", ready=ready)
            if not ready:
                store.broken.add(f"w-s{i}")
        for i, ready in held.items():
            if ready:
                store.add(f"p-{i}", pool="spare", held=True)
        settings = settings_of(
            pools=[
                {"name": "hot", "readiness": "Executing"},
                {"name": "spare", "readiness": "Uninitialized", "reserved": reserved},
            ]
        )
        context = Cluster(store).context()
        listed = choices(FailurePolicySpec.model_validate(policy["spec"]), settings, None)
        for choice in listed:
            await choice.strategy.refresh(context)
        return [choice.strategy.available(context) is None for choice in listed]

    assert [one.availability.available for one in found] == asyncio.run(by_the_monitor())
