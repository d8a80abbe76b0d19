"""The monitor's loop where a failure may follow from that of another workload, or something is due after its recovery."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Literal

import pytest

from tests.support.notices import RecordedNotices
from tests.unit.monitor.cluster_objects import policy_of
from tests.unit.monitor.monitors import GivenMonitor
from tests.unit.monitor.upstream import Upstream, active, adopted_status, planning, recovery
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import DependencyRecovery
from understudy.failover.decide import Recover
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import rfc3339
from understudy.monitor.decide.stage import Resolution
from understudy.monitor.judge.failure_detection import Failure
from understudy.trees.core.health_tree import Verdict

State = Literal["Starting", "Healthy", "Failed"]
POLICY = policy_of(
    {"type": "Restart", "verifyWithin": "45s"}, monitoring={"yaml": {"topic": {"name": "/plan", "gap": "500ms"}}}
)


def recovered(found: Resolution) -> Failure | None:
    """What is recovered now, if anything is."""
    return found.failure if isinstance(found.decision, Recover) else None


class Planning:
    """The monitor of planning, whose health tree has this state since half a second."""

    def __init__(
        self, folder: Path, state: State = "Failed", *pods: Instance, policy: FailurePolicySpec = POLICY
    ) -> None:
        self.now, self.policy = time.time(), policy
        notices = RecordedNotices(adopted_status("r0"))
        self.monitor = GivenMonitor(folder, notices=notices, workload="planning")
        self.objects, self.dependencies = self.monitor.objects, self.monitor.loop.observe.dependencies
        self.objects.put_workload(**planning())
        self.objects.put_policy(policy)
        self.objects.put_settings()
        self.objects.put_pods(*pods)
        self.objects.put_gate(GateState(epoch=3, active="planning-1", active_uid="uid-1"))
        self.onset = self.now - 0.5
        self.monitor.observer.health = Verdict(state, "no /plan for 500 ms", "plan", self.onset)

    async def upstream_fails(self) -> None:
        """Have localization fail before."""
        upstream = Upstream(objects=self.objects, dependencies=self.dependencies)
        await upstream.report_health("Failed", failing_since=rfc3339(self.now - 1), now=self.now)

    async def upstream_recovers(self) -> None:
        """Have localization be recovered."""
        upstream = Upstream(objects=self.objects, dependencies=self.dependencies)
        over = recovery("r1", onset=self.now - 5, verified=self.now - 1)
        await upstream.report_health("Healthy", over, now=self.now)

    async def look(self) -> Resolution:
        """Look once."""
        return await self.monitor.loop.evaluate(self.policy, self.now)


async def test_a_held_failure_causes_no_recovery_and_is_evaluated_again_in_time(tmp_path: Path) -> None:
    planning = Planning(tmp_path, "Failed", active())
    await planning.upstream_fails()
    found = await planning.look()
    assert found.decision.reason == "UpstreamFailure"
    assert found.deadline == pytest.approx(planning.now + 120, abs=1)
    assert planning.monitor.notices.status.failing_since == planning.onset, "others learn of it"


async def test_a_failure_that_is_not_held_is_acted_on_at_once(tmp_path: Path) -> None:
    planning = Planning(tmp_path, "Failed", active())
    failure = recovered(await planning.look())
    assert failure is not None
    assert failure.onset == planning.onset


async def test_a_failure_with_priority_safety_is_never_held(tmp_path: Path) -> None:
    critical = POLICY.model_copy(update={"priority": "Safety"})
    planning = Planning(tmp_path, "Failed", active(), policy=critical)
    await planning.upstream_fails()
    assert recovered(await planning.look()) is not None


async def test_a_missing_pod_is_acted_on_despite_a_failed_dependency(tmp_path: Path) -> None:
    planning = Planning(tmp_path)
    await planning.upstream_fails()
    failure = recovered(await planning.look())
    assert failure is not None
    assert failure.reason == "pod planning-1 is gone"


@pytest.mark.parametrize("state", ["Healthy", "Failed"])
async def test_a_reaction_to_a_recovered_dependency_takes_precedence(tmp_path: Path, state: State) -> None:
    planning = Planning(tmp_path, state, active())
    await planning.upstream_recovers()
    failure = recovered(await planning.look())
    assert failure is not None
    assert list(failure.follows) == [DependencyRecovery(name="localization", recovery="r1")]


async def test_a_reaction_waits_for_the_start_of_the_instance_and_for_the_cooldown(tmp_path: Path) -> None:
    starting = Planning(tmp_path, "Starting", active())
    await starting.upstream_recovers()
    assert recovered(await starting.look()) is None
    waiting = Planning(tmp_path, "Healthy", active())
    await waiting.upstream_recovers()
    waiting.monitor.loop.decide.limits.retries.after(10.0)
    assert recovered(await waiting.look()) is None
