"""What a monitor sees of the workloads that its own depends on, and what it does about its own."""

from __future__ import annotations

import asyncio
import time
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.support.notices import RecordedNotices
from tests.unit.kube.memory import MemoryClient
from tests.unit.monitor.blank_parts import blank_parts, observer
from tests.unit.monitor.gates import gate
from tests.unit.monitor.pool_views import view
from understudy.api import names
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import Attempt, DependencyRecovery, RobotWorkloadSpec, RobotWorkloadStatus
from understudy.api.protocol.monitor_settings import WorkloadSettings
from understudy.failover.decide import Recover
from understudy.failover.dependency import Due
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity, Progress, rfc3339
from understudy.failover.strategies.registry import choices
from understudy.kube.client import NETWORK_POLICIES, Object
from understudy.monitor.act.recovery.recovery_messages import describe
from understudy.monitor.decide.stage import Resolution
from understudy.monitor.judge.failure_detection import Failure
from understudy.monitor.loop import MonitorLoop
from understudy.monitor.notices import Notices, PublishedStatus
from understudy.monitor.observe.objects.dependencies import Dependencies, begin, following
from understudy.monitor.observe.wakeups import Wakeups
from understudy.monitor.report.status_writer import QUIET, StatusWriter
from understudy.trees.core.health_tree import Verdict

NOW = datetime(2026, 11, 22, 14, 2, 11, tzinfo=UTC).timestamp()
BRING_UP = {"yaml": {"set_lifecycle": {"node": "/plan", "state": "active"}}, "within": "20s"}
COSTMAP = {"yaml": {"call_service": {"service": "/costmap/clear", "type": "std_srvs/srv/Empty"}}, "within": "5s"}


class Silent(MemoryClient):
    """An API server that never answers: what is known is put in by the tests."""

    async def list(self, *_: Any, **__: Any) -> Object:
        await asyncio.Event().wait()
        raise AssertionError


def spec(*depends_on: Object) -> RobotWorkloadSpec:
    given = {
        "template": {"spec": {}},
        "outputs": [{"topic": "/plan", "type": "nav_msgs/msg/Path"}],
        "bringUp": BRING_UP,
        "dependsOn": list(depends_on),
        "failurePolicyRef": {"name": "policy"},
    }
    return RobotWorkloadSpec.model_validate(given)


def settings(*upstream: str) -> WorkloadSettings:
    return WorkloadSettings.model_validate(
        {
            "workload": "planning",
            "namespace": "fleet",
            "uid": "uid-w",
            "sourceKind": "ReplicaSet",
            "sourceName": "planning",
            "upstream": [{"name": name} for name in upstream],
        }
    )


def recovery(id: str, *, onset: float, verified: float | None = None, result: str = "Recovered") -> Progress:
    progress = Progress.begin("no /pose for 500 ms", last_healthy=onset, detected=onset + 0.5)
    progress.id, progress.result = id, result  # type: ignore[assignment]
    if verified is not None:
        progress.moments["verified"] = verified
    return progress


def active(*, created: float = NOW - 3600, agent: bool = True) -> Instance:
    return Instance(
        name="planning-1", uid="uid-1", created=rfc3339(created)[:19] + "Z", has_agent=agent, running=True, ready=True
    )


class Watching:
    """A monitor's view of localization."""

    def __init__(self, *depends_on: Object, adopted: str | None = None) -> None:
        before = DependencyRecovery(name="localization", recovery=adopted or "")
        status = PublishedStatus(followed=(before,) if adopted is not None else ())
        self.notices, self.wakeups, self._version = RecordedNotices(status), Wakeups(), 0
        self.spec = spec(*(depends_on or ({"name": "localization", "onRecovery": "Reinitialize"},)))
        view: Any = SimpleNamespace(client=Silent(), namespace="fleet", spec=self.spec)
        self.dependencies = Dependencies(view, self.notices, self.wakeups)
        self.given = settings("localization")
        self.dependencies.follow(self.given)

    def _put(self, reflector: Any, name: str, item: Object) -> None:
        self._version += 1
        reflector.put(
            {**item, "metadata": {**item.get("metadata", {}), "name": name, "resourceVersion": str(self._version)}}
        )
        reflector.synced.set()

    def said(self, health: str, *recoveries: Progress, now: float = NOW, **status: Any) -> None:
        """Localization's monitor says how it is."""
        told = [one.to_recovery(number) for number, one in enumerate(recoveries, 1)]
        found = RobotWorkloadStatus(health=health, recoveries=told[::-1], **status)  # type: ignore[arg-type]
        self._put(self.dependencies._watched["localization"].statuses, "localization", {"status": found.to_wire()})
        self.dependencies.look(now)

    def told(self, notices: Notices, now: float = NOW) -> None:
        """Localization's monitor writes its status."""
        reflector = self.dependencies._watched["localization"].statuses
        self._put(reflector, "localization", {"status": notices.status.to_wire()})
        self.dependencies.look(now)

    def committed(self, progress: Progress, now: float = NOW) -> None:
        """Its gate is committed by a recovery."""
        notes = {names.RECOVERY: progress.model_dump_json(), names.EPOCH: "7"}
        reflector = self.dependencies._watched["localization"].gates[0]
        self._put(reflector, names.gate("localization"), {"metadata": {"annotations": notes}})
        self.dependencies.look(now)

    def condition(self) -> tuple[str, str, str]:
        found = self.notices.status.find("DependencyFailed")
        assert found is not None
        return found.status, found.reason, found.message


async def test_a_failure_is_put_off_for_a_moment_and_acted_on_where_nobody_else_has_failed() -> None:
    world = Watching()
    world.said("Healthy")
    world.dependencies.notice(NOW - 0.5, NOW)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW) == pytest.approx(NOW + 0.3)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 0.31) is None
    assert world.notices.status.find("DependencyFailed") is None, "nothing is said of a look"


async def test_a_failure_that_is_noticed_before_the_one_it_follows_from_is_held_as_soon_as_that_one_s_gate_tells() -> (
    None
):
    world = Watching()
    world.said("Healthy")
    world.dependencies.notice(NOW - 0.5, NOW)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW) is not None
    world.wakeups.look.clear()
    world.committed(recovery("r1", onset=NOW - 0.52, result="Running"), NOW + 0.05)
    assert world.wakeups.look.is_set(), "and it is looked at once"
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 0.05) == pytest.approx(NOW + 120)
    status, reason, message = world.condition()
    assert (status, reason) == ("True", "Held")
    assert message == (
        "no /plan for 500 ms; localization, on which it depends, is Recovering; it is recovered first, and this workload at "
        "14:04:11 UTC at the latest."
    )
    assert [event[1] for event in world.notices.events] == ["DependencyFailed"]


async def test_it_settles_and_is_then_a_failure_of_its_own() -> None:
    world = Watching({"name": "localization"})
    world.said("Healthy")
    world.dependencies.notice(NOW - 0.5, NOW)
    world.committed(recovery("r1", onset=NOW - 0.52, result="Running"), NOW + 0.05)
    world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 0.05)
    world.said("Healthy", recovery("r1", onset=NOW - 0.52, verified=NOW + 4), now=NOW + 5)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 5) == pytest.approx(NOW + 14)
    assert world.condition()[:2] == ("True", "Settling")
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 14.1) is None
    assert world.condition()[:2] == ("False", "OwnFailure")
    assert len(world.notices.events) == 1, "it is told once"


async def test_what_is_said_of_it_does_not_change_with_its_figures() -> None:
    world = Watching()
    world.said("Failed", failing_since=rfc3339(NOW - 1))
    world.dependencies.notice(NOW - 0.5, NOW)
    for rate in ("3.9", "3.7"):
        world.dependencies.hold(f"/plan at {rate} Hz, below 5 Hz over 2 s", NOW - 0.5, NOW + 1)
        assert world.condition()[2].startswith("/plan at 3.9 Hz, below 5 Hz")


async def test_one_that_gets_well_again_is_held_no_longer() -> None:
    world = Watching()
    world.said("Failed", failing_since=rfc3339(NOW - 1))
    world.dependencies.notice(NOW - 0.5, NOW)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW) is not None
    world.dependencies.well("planning-1")
    assert world.condition()[:2] == ("False", "HealthyAgain")


async def test_a_failure_before_that_of_the_other_is_acted_on_as_ever() -> None:
    world = Watching()
    world.said("Failed", failing_since=rfc3339(NOW - 1))
    world.dependencies.notice(NOW - 2, NOW - 1.5)
    assert world.dependencies.hold("no /plan for 500 ms", NOW - 2, NOW) is None


async def test_those_that_depend_on_this_one_in_turn_are_told_at_once_that_it_fails() -> None:
    world = Watching()
    flushed, nobody = asyncio.Event(), cast(Any, None)

    class Writer(StatusWriter):
        async def flush(self) -> None:
            flushed.set()

    view: Any = SimpleNamespace(object=None)
    writer = Writer(nobody, view, nobody, world.notices)
    world.dependencies.notice(NOW - 0.5, NOW)
    world.notices.set(health="Failed")
    assert world.notices.status.failing_since == NOW - 0.5
    writing = asyncio.create_task(writer.run())
    async with asyncio.timeout(QUIET / 2):
        await flushed.wait()
    writing.cancel()


async def test_without_dependencies_nothing_is_watched_said_or_put_off() -> None:
    world = Watching()
    world.said("Failed", failing_since=rfc3339(NOW - 1))
    world.dependencies.follow(settings())
    world.dependencies.look(NOW)
    world.dependencies.notice(NOW, NOW)
    assert world.dependencies.hold("no /plan for 500 ms", NOW, NOW) is None
    assert world.dependencies.due(active(), NOW) is None
    assert world.notices.status.followed == ()
    assert world.notices.status.failing_since is None


class TestAfterARecovery:
    async def test_what_was_recovered_before_it_was_first_seen_asks_for_nothing(self) -> None:
        world = Watching()
        world.said("Healthy", recovery("r1", onset=NOW - 60, verified=NOW - 50))
        assert world.dependencies.due(active(), NOW) is None
        assert world.notices.status.followed == (DependencyRecovery(name="localization", recovery="r1"),)

    async def test_a_new_recovery_does_and_once(self) -> None:
        world = Watching()
        world.said("Healthy")
        world.said("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 1))
        found = world.dependencies.due(active(), NOW)
        assert found is not None
        world.dependencies.note(found.follows)
        assert world.dependencies.due(active(), NOW) is None
        assert world.notices.status.followed == (DependencyRecovery(name="localization", recovery="r1"),)

    async def test_a_new_monitor_goes_by_what_the_one_before_it_has_said(self) -> None:
        done, left = Watching(adopted="r1"), Watching(adopted="r0")
        for world in (done, left):
            world.said("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 1))
        assert done.dependencies.due(active(), NOW) is None
        assert left.dependencies.due(active(), NOW) is not None

    async def test_a_recovery_that_a_new_monitor_finishes_first_is_not_done_again(self) -> None:
        world = Watching(adopted="r0")
        fresh = Dependencies(cast(Any, world.dependencies._view), world.notices, world.wakeups)
        fresh.note([DependencyRecovery(name="localization", recovery="r1")])
        assert world.notices.status.followed == (DependencyRecovery(name="localization", recovery="r1"),)

    async def test_an_instance_that_began_after_it_needs_nothing(self) -> None:
        world = Watching(adopted="r0")
        world.said("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 3))
        assert world.dependencies.due(active(created=NOW - 1), NOW) is None
        assert world.notices.status.followed[0].recovery == "r1"

    async def test_where_nothing_is_to_be_done_that_is_done_at_once(self) -> None:
        world = Watching({"name": "localization"}, adopted="r0")
        world.said("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 3))
        assert world.dependencies.due(active(), NOW) is None
        assert world.notices.status.followed[0].recovery == "r1"

    async def test_what_can_not_be_done_without_an_agent_is_told(self) -> None:
        world = Watching(adopted="r0")
        world.said("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 3))
        assert world.dependencies.due(active(agent=False), NOW) is None
        (event,) = world.notices.events
        assert event[1] == "NoAgent"

    async def test_a_pod_without_an_agent_is_restarted_all_the_same(self) -> None:
        world = Watching({"name": "localization", "onRecovery": "Restart"}, adopted="r0")
        world.said("Healthy", recovery("r1", onset=NOW - 5, verified=NOW - 3))
        assert world.dependencies.due(active(agent=False), NOW) is not None


POLICY = FailurePolicySpec.model_validate(
    {
        "monitoring": {"yaml": {"topic": {"name": "/plan", "gap": "500ms"}}},
        "strategies": [{"type": "Restart", "verifyWithin": "45s"}],
    }
)


def carried_out(*depends_on: Object) -> list[tuple[str, float]]:
    """What is tried, in order, after the recovery of all of these."""
    found = [DependencyRecovery(name=one["name"], recovery="r1") for one in depends_on]
    usual = choices(POLICY, settings(), spec())
    return [(one.strategy.name, one.verify_within) for one in following(found, spec(*depends_on), usual)]


class TestWhatIsCarriedOut:
    def test_bring_up_or_a_procedure_and_then_the_policy_s_strategies(self) -> None:
        assert carried_out({"name": "a", "onRecovery": "Reinitialize"}) == [("Reinitialize", 30.0), ("Restart", 45.0)]
        own = {"name": "a", "onRecovery": "Procedure", "procedure": COSTMAP}
        assert carried_out(own) == [("Procedure", 15.0), ("Restart", 45.0)]

    def test_a_restart_as_the_policy_has_it(self) -> None:
        assert carried_out({"name": "a", "onRecovery": "Restart"}) == [("Restart", 45.0), ("Restart", 45.0)]

    def test_for_several_each_procedure_once_and_a_restart_makes_them_needless(self) -> None:
        again = {"name": "a", "onRecovery": "Reinitialize"}
        same = {"name": "b", "onRecovery": "Reinitialize"}
        own = {"name": "c", "onRecovery": "Procedure", "procedure": COSTMAP}
        assert carried_out(again, same, own)[0] == ("Procedure", 35.0)
        assert carried_out(again, own, {"name": "d", "onRecovery": "Restart"})[0] == ("Restart", 45.0)

    async def test_a_pod_that_is_restarted_counts_as_the_one_that_failed(self) -> None:
        world = Watching({"name": "localization", "onRecovery": "Restart"}, adopted="r0")
        found = [DependencyRecovery(name="localization", recovery="r1")]
        pod = PodIdentity(name="planning-1", uid="uid-1")
        progress = begin(found, pod, world.spec, onset=NOW - 1, detected=NOW)
        assert (progress.failed, progress.target) == ([pod], None)
        assert progress.reason == "localization, on which it depends, was recovered"


def test_it_is_told_what_was_done() -> None:
    progress = Progress.begin("localization, on which it depends, was recovered", last_healthy=NOW, detected=NOW)
    progress.follows = [DependencyRecovery(name="localization", recovery="r1")]
    progress.target, progress.epoch = PodIdentity(name="planning-1", uid="uid-1"), 9
    progress.result, progress.strategy = "Recovered", "Reinitialize"
    progress.charge("reinitialization", NOW + 0.25)
    progress.attempts = [Attempt(strategy="Reinitialize", pod="planning-1", result="Verified")]
    assert describe(progress.to_recovery(2)) == (
        "localization, on which it depends, was recovered. planning-1 is active again after Reinitialize in 0.250 s, epoch 9"
    )


def test_the_beginning_of_a_failure_is_said_until_it_is_over_also_by_the_next_monitor() -> None:
    notices = RecordedNotices()
    notices.set(health="Failed", failing_since=NOW)
    notices.set(health="Recovering", failing_since=NOW + 5)
    status = notices.status.to_wire()
    assert status["failingSince"] == rfc3339(NOW)
    following_it = Notices(PublishedStatus.adopt({"status": status}))
    assert following_it.status.failing_since == NOW
    for each in (notices, following_it):
        each.set(health="Healthy")
        assert "failingSince" not in each.status.to_wire()


class Held:
    """Dependencies from whose failure everything may follow."""

    def __init__(self, until: float | None, follows: Any = None) -> None:
        self.until, self.follows = until, follows
        self.noticed: list[float] = []

    def due(self, active: Instance, now: float) -> Any:
        return self.follows

    def well(self, pod: str) -> None:
        return

    def notice(self, onset: float, detected: float) -> None:
        self.noticed.append(onset)

    def hold(self, reason: str, onset: float, now: float) -> float | None:
        return self.until


def supervising(dependencies: Held, state: str = "Failed", pod: Instance | None = None) -> MonitorLoop:
    verdict = Verdict(cast(Any, state), "no /plan for 500 ms", "plan", NOW)
    seen = observer(
        verdict=lambda now, since: verdict,
        wellness=lambda now, since: verdict,
        deadline=lambda now, since: None,
    )
    parts = blank_parts(
        view=SimpleNamespace(policy=POLICY, settings=settings(), spec=spec(), object=None),
        pods=SimpleNamespace(find=lambda uid: pod),
        gate=SimpleNamespace(state=GateState(epoch=3, active="planning-1", active_uid="uid-1"), exists=True),
        observer=seen,
        notices=RecordedNotices(),
    )
    watching = MonitorLoop(parts)
    for name in ("due", "well", "notice", "hold"):
        setattr(watching.observe.dependencies, name, getattr(dependencies, name))
    return watching


def recovered(found: Resolution) -> Failure | None:
    """What is recovered now, if anything is."""
    return found.failure if isinstance(found.decision, Recover) else None


class TestInTheMonitorsLoop:
    async def test_a_failure_that_is_held_is_none_yet_and_is_looked_at_again_in_time(self) -> None:
        held, now = Held(time.time() + 5), time.time()
        found = await supervising(held, pod=active()).look(POLICY, now)
        assert (found.decision.reason, found.deadline) == ("UpstreamFailure", held.until)
        assert held.noticed == [NOW]

    async def test_one_that_is_not_held_is_acted_on_in_the_same_look(self) -> None:
        failure = recovered(await supervising(Held(None), pod=active()).look(POLICY, time.time()))
        assert failure is not None
        assert failure.onset == NOW

    async def test_what_is_critical_to_safety_is_never_held(self) -> None:
        critical = POLICY.model_copy(update={"priority": "Safety"})
        failure = recovered(await supervising(Held(time.time() + 5), pod=active()).look(critical, time.time()))
        assert failure is not None

    async def test_a_pod_that_is_gone_is_acted_on_whatever_has_failed_besides(self) -> None:
        failure = recovered(await supervising(Held(time.time() + 5)).look(POLICY, time.time()))
        assert failure is not None
        assert failure.reason == "pod planning-1 is gone"

    @pytest.mark.parametrize("state", ["Healthy", "Failed"])
    async def test_what_is_due_after_another_was_recovered_comes_first(self, state: str) -> None:
        follows = [DependencyRecovery(name="localization", recovery="r1")]
        watching = supervising(Held(time.time() + 5, Due(follows, NOW)), state, active())
        failure = recovered(await watching.look(POLICY, time.time()))
        assert failure is not None
        assert list(failure.follows) == follows

    async def test_but_not_while_it_starts_nor_within_the_pause_after_a_recovery(self) -> None:
        due = Due([DependencyRecovery(name="localization", recovery="r1")], NOW)
        failure = recovered(await supervising(Held(None, due), "Starting", active()).look(POLICY, time.time()))
        assert failure is None
        watching = supervising(Held(None, due), "Healthy", active())
        watching.decide.limits.retries.after(10.0)
        failure = recovered(await watching.look(POLICY, time.time()))
        assert failure is None


class TestBetweenMonitors:
    """What one writes is what the other reads: without that nobody would be held, and nothing be done."""

    async def test_the_first_commit_of_a_recovery_tells_of_the_failure(self, tmp_path: Path) -> None:
        client = MemoryClient()
        switch = await gate(client, view(client, "localization"), tmp_path)
        world = Watching()
        world.said("Healthy")
        world.dependencies.notice(NOW - 0.5, NOW)
        await switch.commit(None, recovery("r1", onset=NOW - 0.52, result="Running"))
        reflector = world.dependencies._watched["localization"].gates[0]
        reflector.put(await client.get(NETWORK_POLICIES, "fleet", names.gate("localization")))
        world.dependencies.look(NOW + 0.05)
        world.dependencies.hold("no /plan for 500 ms", NOW - 0.5, NOW + 0.05)
        assert world.condition()[:2] == ("True", "Held")

    async def test_its_record_tells_that_it_is_over_and_that_something_is_to_be_done(self) -> None:
        first, world = RecordedNotices(), Watching(adopted="")
        first.set(health="Recovering", failing_since=NOW - 5)
        world.told(first)
        assert world.dependencies._watched["localization"].seen.failing
        assert world.dependencies.due(active(), NOW) is None, "not before it is over"
        first.record(recovery("r1", onset=NOW - 5, verified=NOW - 1))
        first.set(health="Healthy")
        world.told(first)
        found = world.dependencies.due(active(), NOW)
        assert found is not None
        assert (found.follows[0].recovery, found.since) == ("r1", pytest.approx(NOW - 1))

    async def test_a_failure_that_is_held_is_known_to_those_that_wait_for_it_in_turn(self) -> None:
        """Of a chain the middle one commits nothing: its status has to tell."""
        middle, last = Watching(), Watching()
        middle.said("Failed", failing_since=rfc3339(NOW - 1))
        middle.notices.set(health="Failed")
        middle.dependencies.notice(NOW - 0.7, NOW)
        last.told(middle.notices)
        last.dependencies.notice(NOW - 0.4, NOW + 0.1)
        last.dependencies.hold("no /cmd_vel for 500 ms", NOW - 0.4, NOW + 0.1)
        assert last.condition()[:2] == ("True", "Held")
