"""What a monitor does to its own workload after one that it depends on was recovered."""

from __future__ import annotations

from tests.support.golden import assert_golden
from tests.unit.monitor.cluster_objects import parsed_spec, policy_of, settings_of
from tests.unit.monitor.upstream import BRING_UP, NOW, Upstream, active, recovery
from understudy.api.kinds.robot_workload import Attempt, DependencyRecovery
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.registry import choices
from understudy.kube.client import Object
from understudy.monitor.act.recovery.recovery_messages import describe
from understudy.monitor.observe.objects.dependencies import Dependencies, begin, following

COSTMAP = {"yaml": {"call_service": {"service": "/costmap/clear", "type": "std_srvs/srv/Empty"}}, "within": "5s"}


class TestRecoveryReactions:
    async def test_a_recovery_from_before_the_first_observation_causes_no_reaction(self) -> None:
        world = Upstream()
        await world.report_health("Healthy", recovery("r1", onset=NOW - 60, verified=NOW - 50))
        assert world.dependencies.due(active(), NOW) is None
        assert world.notices.status.followed == (DependencyRecovery(name="localization", recovery="r1"),)

    async def test_a_new_recovery_causes_one_reaction(self) -> None:
        world = Upstream()
        await world.report_health("Healthy")
        await world.report_health("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 1))
        found = world.dependencies.due(active(), NOW)
        assert found is not None
        world.dependencies.note(found.follows)
        assert world.dependencies.due(active(), NOW) is None
        assert world.notices.status.followed == (DependencyRecovery(name="localization", recovery="r1"),)

    async def test_a_new_monitor_continues_from_the_recoveries_in_the_status(self) -> None:
        done, left = Upstream(adopted="r1"), Upstream(adopted="r0")
        for world in (done, left):
            await world.report_health("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 1))
        assert done.dependencies.due(active(), NOW) is None
        assert left.dependencies.due(active(), NOW) is not None

    async def test_a_reaction_that_a_new_monitor_finishes_is_not_repeated(self) -> None:
        world = Upstream(adopted="r0")
        fresh = Dependencies(world.objects.view, world.notices, world.objects.wakeups)
        fresh.note([DependencyRecovery(name="localization", recovery="r1")])
        assert world.notices.status.followed == (DependencyRecovery(name="localization", recovery="r1"),)

    async def test_an_instance_that_started_after_the_recovery_needs_no_reaction(self) -> None:
        world = Upstream(adopted="r0")
        await world.report_health("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 3))
        assert world.dependencies.due(active(created=NOW - 1), NOW) is None
        assert world.notices.status.followed[0].recovery == "r1"

    async def test_without_an_action_the_recovery_counts_as_handled_at_once(self) -> None:
        world = Upstream({"name": "localization"}, adopted="r0")
        await world.report_health("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 3))
        assert world.dependencies.due(active(), NOW) is None
        assert world.notices.status.followed[0].recovery == "r1"

    async def test_a_procedure_that_needs_an_agent_is_reported_if_there_is_none(self) -> None:
        world = Upstream(adopted="r0")
        await world.report_health("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 3))
        assert world.dependencies.due(active(agent=False), NOW) is None
        (event,) = world.notices.events
        assert event[1] == "NoAgent"

    async def test_a_pod_without_an_agent_can_still_be_restarted(self) -> None:
        world = Upstream({"name": "localization", "onRecovery": "Restart"}, adopted="r0")
        await world.report_health("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 3))
        assert world.dependencies.due(active(agent=False), NOW) is not None


POLICY = policy_of({"type": "Restart", "verifyWithin": "45s"})


def carried_out(*depends_on: Object) -> list[tuple[str, float]]:
    """What is tried, in order, after the recovery of all of these."""
    found = [DependencyRecovery(name=one["name"], recovery="r1") for one in depends_on]
    spec = parsed_spec(bringUp=BRING_UP, dependsOn=list(depends_on))
    usual = choices(POLICY, settings_of("planning"), spec)
    return [(one.strategy.name, one.verify_within) for one in following(found, spec, usual)]


class TestReactionStrategies:
    def test_a_procedure_is_followed_by_the_strategies_of_the_policy(self) -> None:
        assert carried_out({"name": "a", "onRecovery": "Reinitialize"}) == [("Reinitialize", 30.0), ("Restart", 45.0)]
        own = {"name": "a", "onRecovery": "Procedure", "procedure": COSTMAP}
        assert carried_out(own) == [("Procedure", 15.0), ("Restart", 45.0)]

    def test_a_restart_has_the_time_limit_of_the_policy(self) -> None:
        assert carried_out({"name": "a", "onRecovery": "Restart"}) == [("Restart", 45.0), ("Restart", 45.0)]

    def test_procedures_of_several_dependencies_run_once_and_a_restart_replaces_them(self) -> None:
        again = {"name": "a", "onRecovery": "Reinitialize"}
        same = {"name": "b", "onRecovery": "Reinitialize"}
        own = {"name": "c", "onRecovery": "Procedure", "procedure": COSTMAP}
        assert carried_out(again, same, own)[0] == ("Procedure", 35.0)
        assert carried_out(again, own, {"name": "d", "onRecovery": "Restart"})[0] == ("Restart", 45.0)

    def test_a_restarted_pod_counts_as_failed(self) -> None:
        spec = parsed_spec(bringUp=BRING_UP, dependsOn=[{"name": "localization", "onRecovery": "Restart"}])
        found = [DependencyRecovery(name="localization", recovery="r1")]
        pod = PodIdentity(name="planning-1", uid="uid-1")
        progress = begin(found, pod, spec, onset=NOW - 1, detected=NOW)
        assert (progress.failed, progress.target) == ([pod], None)
        assert progress.reason == "localization, on which this workload depends, was recovered"


def test_a_recovery_after_a_dependency_is_described() -> None:
    progress = Progress.begin(
        "localization, on which this workload depends, was recovered", last_healthy=NOW, detected=NOW
    )
    progress.follows = [DependencyRecovery(name="localization", recovery="r1")]
    progress.target, progress.epoch = PodIdentity(name="planning-1", uid="uid-1"), 9
    progress.result, progress.strategy = "Recovered", "Reinitialize"
    progress.charge("reinitialization", NOW + 0.25)
    progress.attempts = [Attempt(strategy="Reinitialize", pod="planning-1", result="Verified")]
    assert_golden(
        "monitor", describe(progress.to_recovery(2)), "localization", "planning-1", "Reinitialize", "epoch 9", "0.250 s"
    )
