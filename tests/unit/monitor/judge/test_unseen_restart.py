"""An instance that restarted in place while no monitor watched has failed, because its state is lost, although it is healthy."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tests.unit.monitor.cluster_objects import policy_of
from tests.unit.monitor.monitors import GivenMonitor
from tests.unit.monitor.senses import GivenObserver
from understudy.failover.decide import Recover, Trigger
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity, Progress
from understudy.monitor.judge import reassessment
from understudy.monitor.judge import unseen_restart as module
from understudy.state.state_capture import Key, Version
from understudy.state.state_store import StateSource, StateStore
from understudy.trees.core.health_tree import Verdict

OLD, NEW, OTHER = b"process-1", b"process-2", b"process-3"
ACTIVE = Instance(name="w-1", uid="uid-1", ip="10.0.0.1", running=True, ready=True, restarts=4)
KEPT = StateSource(ACTIVE.uid, 3, frozenset({OLD, OTHER}))
STATE = {"lifecycle": ["/amcl"]}
POLICY = policy_of(state=STATE)


def new_monitor(
    folder: Path, kept: StateSource | None = KEPT, *, active: Instance = ACTIVE, heard: bytes = NEW
) -> GivenMonitor:
    """A monitor that begins while this instance is healthy, with state that the monitor before it kept 10 s ago."""
    before = time.time() - 10
    StateStore(folder / "kept").save({Key("Lifecycle", "/amcl"): [Version(before, before, b"active")]}, kept)
    monitor = GivenMonitor(folder)
    monitor.objects.put_workload()
    monitor.objects.put_policy(POLICY)
    monitor.objects.put_settings()
    monitor.objects.put_pods(active)
    monitor.objects.put_gate(GateState(epoch=4, active=active.name, active_uid=active.uid))
    monitor.observer.health = Verdict("Healthy", "", "", None)
    monitor.observer.heard_processes = {active.name: frozenset({heard})}
    return monitor


@pytest.mark.parametrize(
    ("keeps_state", "gap", "is_seen"), [(True, 2.0, True), (True, 0.1, False), (False, 2.0, False)]
)
def test_a_restart_while_this_monitor_was_stalled_is_a_failure_if_it_keeps_state(
    monkeypatch: pytest.MonkeyPatch, keeps_state: bool, gap: float, is_seen: bool
) -> None:
    clock = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    observer = GivenObserver()
    observer.heard_processes = {ACTIVE.name: frozenset({OLD})}
    unseen = module.UnseenRestart(observer, None)
    before = replace(ACTIVE, restarts=3)
    assert unseen.onset(before, 1000.0, keeps_state=keeps_state) is None
    assert unseen.source(before) == StateSource(ACTIVE.uid, 3, frozenset({OLD}))

    clock[0] += gap
    assert unseen.onset(before, 1000.0 + gap, keeps_state=keeps_state) is None, "Kubernetes reports it later"
    observer.heard_processes = {ACTIVE.name: frozenset({NEW})}
    clock[0] += 0.5
    onset = unseen.onset(ACTIVE, 1000.5 + gap, keeps_state=keeps_state)
    assert onset == (1000.0 + gap if is_seen else None)


async def test_an_instance_that_restarted_during_a_recovery_that_failed_is_not_failed_for_that_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    clock = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])
    observer = GivenObserver()
    observer.heard_processes = {ACTIVE.name: frozenset({OLD})}
    unseen, before = module.UnseenRestart(observer, None), replace(ACTIVE, restarts=3)
    unseen.onset(before, 1000.0, keeps_state=True)
    unseen.source(before)
    unseen.rest()
    clock[0] += 10.0
    observer.heard_processes = {ACTIVE.name: frozenset({NEW})}
    assert unseen.onset(ACTIVE, 1010.0, keeps_state=True) is None


async def test_a_healthy_instance_whose_process_restarted_unseen_is_recovered_with_the_kept_state(
    tmp_path: Path,
) -> None:
    monitor = new_monitor(tmp_path)
    resolution = await monitor.loop.evaluate(POLICY, time.time())
    assert isinstance(resolution.decision, Recover)
    assert resolution.decision.trigger is Trigger.POD_LOST
    recovering = asyncio.create_task(monitor.loop.carry_through(resolution))
    async with asyncio.timeout(5):
        while not monitor.objects.commits:
            await asyncio.sleep(0.01)
    recovering.cancel()
    _, recovery = monitor.objects.commits[0]
    assert recovery is not None
    assert recovery.failed == [PodIdentity(name=ACTIVE.name, uid=ACTIVE.uid)]
    kept = monitor.state_manager.select(recovery.moments["last_healthy"])
    assert [(state.node, state.state) for state in kept.lifecycle] == [("/amcl", "active")]


@pytest.mark.parametrize(
    ("kept", "heard"),
    [
        (KEPT, OLD),
        (replace(KEPT, restarts=ACTIVE.restarts), NEW),
        (replace(KEPT, uid="uid-0"), NEW),
        (None, NEW),
    ],
    ids=["another container restarted", "a node restarted in its container", "another pod", "unknown"],
)
async def test_an_instance_that_may_have_its_state_is_not_recovered(
    tmp_path: Path, kept: StateSource | None, heard: bytes
) -> None:
    resolution = await new_monitor(tmp_path, kept, heard=heard).loop.evaluate(POLICY, time.time())
    assert not isinstance(resolution.decision, Recover)


async def test_an_instance_without_kept_state_goes_on_after_a_restart(tmp_path: Path) -> None:
    monitor = new_monitor(tmp_path)
    monitor.state_manager.follow(policy_of().state)
    assert not isinstance((await monitor.loop.evaluate(policy_of(), time.time())).decision, Recover)


async def test_a_restart_that_the_api_server_reports_late_counts(tmp_path: Path) -> None:
    monitor = new_monitor(tmp_path, active=replace(ACTIVE, restarts=3))
    assert not isinstance((await monitor.loop.evaluate(POLICY, time.time())).decision, Recover)
    monitor.objects.put_pods(ACTIVE)
    assert isinstance((await monitor.loop.evaluate(POLICY, time.time())).decision, Recover)


async def test_a_restart_that_this_monitor_could_see_does_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "REPORTED_WITHIN", 0.0)
    monitor = new_monitor(tmp_path, active=replace(ACTIVE, restarts=3), heard=OLD)
    await monitor.loop.evaluate(POLICY, time.time())
    monitor.objects.put_pods(ACTIVE)
    monitor.observer.heard_processes = {ACTIVE.name: frozenset({OLD, NEW})}
    assert not isinstance((await monitor.loop.evaluate(POLICY, time.time())).decision, Recover)


async def test_an_unseen_restart_of_a_paused_workload_is_left_to_the_user(tmp_path: Path) -> None:
    monitor = new_monitor(tmp_path)
    monitor.objects.put_workload(pause={"reason": "work on the robot", "owner": "somebody"})
    monitor.loop.decide.limits.pauses.update(time.time())
    await monitor.loop.evaluate(POLICY, time.time())
    monitor.objects.put_workload()
    monitor.loop.decide.limits.pauses.update(time.time())
    assert not isinstance((await monitor.loop.evaluate(POLICY, time.time())).decision, Recover)


async def test_an_instance_that_restarted_unseen_stays_failed_while_the_commit_is_delayed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reassessment, "OLD", 0.02)
    monitor = new_monitor(tmp_path)
    failed = [PodIdentity(name=ACTIVE.name, uid=ACTIVE.uid)]
    progress = Progress.begin("it restarted", last_healthy=time.time(), detected=time.time(), failed=failed)
    async with monitor.loop.judge.reassessment.during(progress):
        await asyncio.sleep(0.3)
    assert not progress.healthy_again


@pytest.mark.parametrize(
    ("heard", "restarts", "expected"),
    [
        (OLD, 3, KEPT),
        (NEW, 3, KEPT),
        (NEW, 4, StateSource("uid-2", 4, frozenset({NEW}))),
    ],
    ids=["nothing is new", "the restart may still be reported", "another pod"],
)
def test_state_is_stored_as_from_the_earlier_processes_while_a_restart_may_become_known(
    tmp_path: Path, heard: bytes, restarts: int, expected: StateSource
) -> None:
    active = replace(ACTIVE, uid=expected.uid, restarts=restarts)
    judged = new_monitor(tmp_path, active=active, heard=heard).loop.judge.unseen_restart
    judged.onset(active, time.time())
    assert judged.source(active) == expected


async def test_the_instance_is_stored_with_its_state(tmp_path: Path) -> None:
    monitor = new_monitor(tmp_path, None, active=replace(ACTIVE, restarts=3), heard=OLD)

    async def stored(holds: Callable[[StateSource | None], bool]) -> None:
        async with asyncio.timeout(5):
            while True:
                monitor.loop.act.supervise_standbys(POLICY, paused=False)
                store = StateStore(tmp_path / "kept")
                if store.load() and holds(store.source):
                    return
                await asyncio.sleep(0.05)

    monitor.state_manager.follow(POLICY.state)
    await monitor.loop.evaluate(POLICY, time.time())
    await stored(lambda source: source == replace(KEPT, processes=frozenset({OLD})))
    # A monitor that ends before it has fenced a failed instance has not recovered it: the next one must see the restart.
    monitor.observer.health = Verdict("Failed", "no /cmd_vel", "/cmd_vel", None)
    monitor.objects.put_pods(ACTIVE)
    await monitor.loop.evaluate(POLICY, time.time())
    monitor.loop.act.supervise_standbys(POLICY, paused=False)
    assert monitor.state_manager.source == replace(KEPT, processes=frozenset({OLD}))
