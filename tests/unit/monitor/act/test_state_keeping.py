"""The monitor keeps state of real topics, over its own restart, reports it, and keeps standbys up to date with it."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.clock import set_clock
from tests.support.golden import assert_golden

pytest.importorskip("rclpy")

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import DurabilityPolicy, QoSProfile

from tests.unit.dds import isolate_discovery
from tests.unit.monitor.cluster_objects import ClusterObjects, policy_of, settings_of
from tests.unit.monitor.monitors import GivenMonitor
from tests.unit.monitor.senses import GivenSenses
from tests.unit.monitor.state_monitor import ACTIVE, POSE, STANDBY, STATE, Monitor, next_monitor
from understudy.api.kinds.robot_workload import Recovery
from understudy.api.kinds.state_spec import RestoredState, State
from understudy.api.protocol.kept_state import KeptState, NotRestored
from understudy.api.protocol.monitor_settings import PoolChoice
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity, Progress
from understudy.monitor.act.instances import state_manager as module
from understudy.monitor.act.instances.standby_supervision import receivers
from understudy.ros.runtime.graph_node import Graph
from understudy.state import state_capture as pure
from understudy.state.state_store import StateSource, StateStore

pytestmark = pytest.mark.ros


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    isolate_discovery(monkeypatch)
    made = Graph("keeper")
    yield made
    made.close()


@pytest.fixture
async def monitor(graph: Graph, tmp_path: Path) -> Monitor:
    return Monitor(graph, tmp_path)


@pytest.fixture
def say(graph: Graph) -> Callable[[float], None]:
    """Publish a pose, latched as AMCL does."""
    qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = graph.node.create_publisher(PoseWithCovarianceStamped, "/amcl_pose", qos)

    def publish(x: float) -> None:
        message = PoseWithCovarianceStamped()
        message.header.frame_id = "map"
        message.pose.pose.position.x = x
        publisher.publish(message)

    return publish


async def test_the_last_healthy_pose_is_kept_and_reported(monitor: Monitor, say: Callable[[float], None]) -> None:
    say(1.0)
    await monitor.until(lambda: monitor.x() == 1.0 and monitor.notices.conditions.get("StateKept"))
    await monitor.until(lambda: monitor.notices.conditions["StateKept"] == ("True", "Kept", "Keeping /amcl_pose."))
    (status,) = monitor.notices.status.kept
    assert (status.name, status.kind, status.message) == ("/amcl_pose", "Topic", "")
    assert status.bytes > 300
    assert status.taken_at
    say(2.0)
    await monitor.until(lambda: monitor.x() == 2.0)


async def test_messages_received_while_the_workload_fails_are_never_restored(monitor: Monitor, graph: Graph) -> None:
    publisher = graph.node.create_publisher(PoseWithCovarianceStamped, "/amcl_pose", 1)

    def say(x: float) -> None:
        message = PoseWithCovarianceStamped()
        message.pose.pose.position.x = x
        publisher.publish(message)

    await monitor.until(lambda: monitor.x() == 1.0, each=lambda: say(1.0))
    onset = time.time()
    monitor.health = "Failed"
    say(9.0)
    end = time.monotonic() + 1.0
    await monitor.until(lambda: time.monotonic() > end)
    monitor.health = "Healthy"
    end = time.monotonic() + 1.0
    await monitor.until(lambda: time.monotonic() > end)
    assert monitor.x(onset) == monitor.x() == 1.0


async def test_kept_state_survives_a_restart_of_the_monitor(
    monitor: Monitor, say: Callable[[float], None], tmp_path: Path
) -> None:
    say(1.0)
    await monitor.until(lambda: monitor.x() == 1.0)
    onset = time.time()
    kept = monitor.state_manager.select(onset)

    def outlasts() -> bool:
        with next_monitor(tmp_path) as later:
            later.health = "Starting"
            later.state_manager.take(STATE, {}, "w-1")
            return later.x(onset) == 1.0 and later.state_manager.select(onset) == kept

    await monitor.until(outlasts)


async def test_state_that_a_recovery_selects_is_stored_at_once(
    monitor: Monitor, say: Callable[[float], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The monitor does its other work, as storing what is new, after the recovery only."""
    say(1.0)
    await monitor.until(lambda: monitor.x() == 1.0 and StateStore(tmp_path).load())
    monkeypatch.setattr(monitor.state_manager, "_next_persist", float("inf"))
    say(2.0)
    await monitor.until(lambda: monitor.x() == 2.0)
    onset, stored = time.time(), StateStore(tmp_path).load()
    kept = monitor.state_manager.select_for_recovery(onset)
    async with asyncio.timeout(10):
        while StateStore(tmp_path).load() == stored:
            await asyncio.sleep(0.02)
    with next_monitor(tmp_path) as later:
        later.health = "Starting"
        later.state_manager.take(STATE, {}, "w-1")
        assert later.state_manager.select(onset) == kept


async def test_state_that_a_recovery_selects_is_stored_although_older_state_is_being_stored(
    monitor: Monitor, say: Callable[[float], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    say(1.0)
    await monitor.until(lambda: monitor.x() == 1.0 and StateStore(tmp_path).load())
    shelf, begun, may_end = monitor.state_manager._shelf, threading.Event(), threading.Event()
    save = shelf.save

    def slow(*kept: Any) -> None:
        begun.set()
        may_end.wait(10)
        save(*kept)

    monkeypatch.setattr(shelf, "save", slow)
    say(2.0)
    await monitor.until(lambda: monitor.x() == 2.0 and begun.is_set())
    say(3.0)
    await monitor.until(lambda: monitor.x() == 3.0)
    kept = monitor.state_manager.select_for_recovery(onset := time.time())
    may_end.set()

    def restored() -> KeptState:
        with next_monitor(tmp_path) as later:
            later.health = "Starting"
            later.state_manager.take(STATE, {}, "w-1")
            return later.state_manager.select(onset)

    async with asyncio.timeout(10):
        while restored() != kept:
            await asyncio.sleep(0.05)


async def test_a_monitor_that_does_not_hear_the_instance_restores_what_another_monitor_has_stored_since(
    monitor: Monitor, say: Callable[[float], None], graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after the loss of a node that comes back: its discovery server lives on beside the next one, and its monitor beside this one."""
    monkeypatch.setattr(module, "PERSIST", 0.1)
    monitor.source = StateSource(ACTIVE.uid, 0)
    say(1.0)
    await monitor.until(lambda: monitor.x() == 1.0 and StateStore(tmp_path).load())
    deaf = Monitor(graph, tmp_path)
    deaf.health = "Starting"
    deaf.look()
    say(2.0)
    await monitor.until(lambda: monitor.x() == 2.0, each=deaf.look)
    kept = monitor.state_manager.select_for_recovery(onset := time.time())
    async with asyncio.timeout(10):
        while deaf.state_manager.select(onset) != kept:
            deaf.state_manager.housekeeping(None, ())  # the other monitor has closed the gate
            await asyncio.sleep(0.02)
    assert deaf.state_manager.source == monitor.source


async def test_a_new_monitor_does_not_replace_what_another_monitor_stores_meanwhile(
    graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PERSIST", 0.02)
    other, source = StateStore(tmp_path), StateSource(ACTIVE.uid, 0)
    earlier, later = (
        pure.Version(at, at, text, POSE) for at, text in ((time.time() - 9, b"a"), (time.time() - 1, b"b"))
    )
    other.save({pure.Key("Topic", "/amcl_pose"): [earlier]}, source)
    here = Monitor(graph, tmp_path)
    here.health = "Starting"
    other.save({pure.Key("Topic", "/amcl_pose"): [earlier, later]}, source)
    await here.until(lambda: [s.data for s in here.state_manager.select(time.time()).samples] == [b"b"], within=5.0)
    assert [s.data for s in here.state_manager.select(time.time() - 5).samples] == [b"a"]


async def test_a_pose_that_is_propagated_is_not_adopted_from_another_monitor(
    graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The odometry that this monitor received belongs to the pose that it has."""
    monkeypatch.setattr(module, "PERSIST", 0.02)
    pose = {"topic": "/amcl_pose", "type": POSE, "restoreTo": "/initialpose", "carriedBy": {"topic": "/odom"}}
    other, source = StateStore(tmp_path), StateSource(ACTIVE.uid, 0)
    keys = [pure.Key("Topic", name) for name in ("/amcl_pose", "/plan_pose")]
    earlier, later = (
        pure.Version(at, at, text, POSE) for at, text in ((time.time() - 9, b"a"), (time.time() - 1, b"b"))
    )
    other.save({key: [earlier] for key in keys}, source)
    here = Monitor(graph, tmp_path)
    here.health, here.state = "Starting", State.model_validate({"keep": [pose, {"topic": "/plan_pose", "type": POSE}]})
    other.save({key: [earlier, later] for key in keys}, source)

    def selected() -> dict[str, bytes]:
        return {sample.topic: sample.data for sample in here.state_manager.select(time.time()).samples}

    await here.until(lambda: selected().get("/plan_pose") == b"b", within=5.0)
    assert selected()["/amcl_pose"] == b"a"


@pytest.mark.parametrize(("max_age", "useless"), [("1m", False), ("5s", True)])
async def test_a_new_monitor_knows_whether_the_kept_state_can_still_be_restored(
    graph: Graph, tmp_path: Path, max_age: str, useless: bool
) -> None:
    before = time.time() - 10
    version = pure.Version(before, before, b"a pose", POSE)
    StateStore(tmp_path).save({pure.Key("Topic", "/amcl_pose"): [version]})
    later = Monitor(graph, tmp_path)
    keep = [{"topic": "/amcl_pose", "type": POSE, "restoreTo": "/initialpose", "maxAge": max_age}]
    later.state_manager.take(State.model_validate({"keep": keep}), {}, "w-1")
    assert later.state_manager.adopted_nothing == useless


async def test_kept_state_is_available_to_a_recovery_that_an_earlier_monitor_started(
    monitor: Monitor, say: Callable[[float], None], graph: Graph, tmp_path: Path
) -> None:
    say(1.0)
    await monitor.until(lambda: monitor.x() == 1.0 and (tmp_path / "kept").exists() and StateStore(tmp_path).load())
    onset = time.time()
    later = Monitor(graph, tmp_path)
    monitored = GivenMonitor(tmp_path, notices=later.notices, state_manager=later.state_manager)
    monitored.objects.put_workload()
    monitored.objects.put_policy(policy_of(state=STATE.to_wire()))
    monitored.objects.put_settings()
    monitored.objects.put_gate(GateState(epoch=4, active=ACTIVE.name, active_uid=ACTIVE.uid))
    failed = [PodIdentity(name=ACTIVE.name, uid=ACTIVE.uid)]
    progress = Progress.begin("it ended", last_healthy=onset, detected=onset, failed=failed)
    recovering = asyncio.create_task(monitored.loop.carry_out(progress))
    async with asyncio.timeout(25):
        while not monitored.objects.commits:
            await asyncio.sleep(0.01)
    assert [sample.topic for sample in later.state_manager.select(onset).samples] == ["/amcl_pose"]
    recovering.cancel()


async def test_a_topic_that_nobody_publishes_is_reported(monitor: Monitor, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pure, "PATIENCE", 0.3)
    await monitor.until(lambda: monitor.notices.conditions.get("StateKept", ("",))[0] == "False")
    messages = (
        "/amcl_pose: nobody publishes it (state.keep[0] of the policy). State that was never received cannot be restored on "
        "the instance that takes over. Correct the topic's name in the policy, or let the application publish it."
    )
    assert monitor.notices.conditions["StateKept"] == ("False", "NeverCame", messages)
    assert monitor.notices.events == [("Warning", "StateNeverCame", messages)]
    assert monitor.state_manager.select(time.time()).left_out == (
        NotRestored("/amcl_pose", "nobody publishes it", failed=False),
    )


async def test_a_type_that_is_not_installed_is_reported_at_once(monitor: Monitor) -> None:
    monitor.state = State.model_validate({"keep": [{"topic": "/plan", "type": "nav2_msgs/msg/Plan"}]})
    await monitor.until(lambda: "StateKept" in monitor.notices.conditions)
    status, reason, message = monitor.notices.conditions["StateKept"]
    assert (status, reason) == ("False", "TypeNotInstalled")
    assert_golden("monitor", message, "/plan", "nav2_msgs/msg/Plan")


async def test_state_that_is_too_old_is_reported(monitor: Monitor, say: Callable[[float], None]) -> None:
    monitor.state = State.model_validate({"keep": [{"topic": "/amcl_pose", "maxAge": "500ms"}], "margin": "0s"})
    say(1.0)
    await monitor.until(lambda: monitor.notices.conditions.get("StateKept", ("", ""))[1] == "TooOld")
    assert "older than maxAge (500ms)" in monitor.notices.conditions["StateKept"][2]
    (left,) = monitor.state_manager.select(time.time()).left_out
    assert "more than maxAge (500ms)" in left.reason


async def test_a_changed_age_alone_is_written_rarely(monitor: Monitor, say: Callable[[float], None]) -> None:
    count = [0.0]

    def move() -> None:
        count[0] += 1
        say(count[0])

    await monitor.until(lambda: monitor.x() is not None, each=move)
    end = time.monotonic() + 1.5
    await monitor.until(lambda: time.monotonic() > end, each=move)
    assert monitor.notices.changes <= 6
    assert count[0] > 10


async def test_parameters_and_lifecycle_states_are_requested_from_the_agent(monitor: Monitor) -> None:
    monitor.state = State.model_validate(
        {"parameters": [{"node": "/controller", "names": ["speed"]}], "lifecycle": ["/amcl"], "margin": "0s"}
    )
    monitor.agents.answer = {
        "parameters": {"/controller": {"speed": 0.3}},
        "lifecycle": {"/amcl": "active"},
        "problems": [],
    }
    await monitor.until(lambda: len(monitor.state_manager.select(time.time()).lifecycle) == 1)
    kept = monitor.state_manager.select(time.time())
    assert kept.parameters[0].values == {"speed": 0.3}
    assert (kept.lifecycle[0].node, kept.lifecycle[0].state) == ("/amcl", "active")


async def test_an_agent_that_does_not_answer_is_reported(monitor: Monitor) -> None:
    monitor.state = State.model_validate({"lifecycle": ["/amcl"]})
    await monitor.until(lambda: monitor.notices.conditions.get("StateKept", ("", ""))[1] == "NotAsked")
    assert_golden("monitor", monitor.notices.conditions["StateKept"][2], "/amcl", "state.lifecycle[0]")


async def test_a_pod_without_an_agent_is_reported(monitor: Monitor) -> None:
    monitor.state = State.model_validate({"lifecycle": ["/amcl"]})
    monitor.active = Instance("w-1", "uid-1", running=True, has_agent=False)
    await monitor.until(lambda: monitor.notices.conditions.get("StateKept", ("", ""))[1] == "NotAsked")
    assert "pod w-1 has no agent, because" in monitor.notices.conditions["StateKept"][2]


async def test_a_standby_receives_only_changed_state(monitor: Monitor, say: Callable[[float], None]) -> None:
    monitor.waiting = [(STANDBY, 0.1)]
    monitor.state = STATE.model_copy(update={"lifecycle": ["/amcl"]})
    monitor.agents.answer = {"parameters": {}, "lifecycle": {"/amcl": "active"}, "problems": []}
    say(1.0)
    await monitor.until(lambda: monitor.agents.restored and monitor.state_manager.select(time.time()).lifecycle)
    end = time.monotonic() + 1.0
    await monitor.until(lambda: time.monotonic() > end)
    ((name, first),) = monitor.agents.restored
    assert (name, len(first.samples), first.lifecycle) == ("w-2", 1, ()), "it isn't made to drive before its time"
    say(2.0)
    await monitor.until(lambda: len(monitor.agents.restored) == 2)
    assert monitor.agents.restored[1][1].samples[0].data != first.samples[0].data


async def test_a_standby_that_cannot_be_kept_up_to_date_is_reported_once(
    monitor: Monitor, say: Callable[[float], None]
) -> None:
    monitor.waiting = [(STANDBY, 0.1)]
    monitor.agents.refusal = "nobody subscribes to /initialpose"
    say(1.0)
    await monitor.until(lambda: len(monitor.agents.restored) > 3)
    ((level, reason, message),) = monitor.notices.events
    assert (level, reason) == ("Warning", "StandbyNotKeptUp")
    assert_golden("monitor", message, "w-2", "/amcl_pose", "/initialpose")


async def test_standbys_receive_no_state_while_the_workload_is_not_healthy(
    monitor: Monitor, say: Callable[[float], None]
) -> None:
    say(1.0)
    await monitor.until(lambda: monitor.x() == 1.0)
    monitor.health = "Failed"
    monitor.waiting = [(STANDBY, 0.1)]
    end = time.monotonic() + 0.5
    await monitor.until(lambda: time.monotonic() > end)
    assert monitor.agents.restored == []


async def test_the_state_restored_in_a_recovery_is_reported(monitor: Monitor) -> None:
    monitor.state = State.model_validate({"keep": [{"topic": "/amcl_pose"}, {"topic": "/map"}]})
    monitor.state_manager.take(monitor.state, {}, ACTIVE.name)
    restored = RestoredState(name="/amcl_pose", restored=True, age_seconds=0.75)
    missing = RestoredState(name="/map", restored=False, message="what is kept is 61.0 s old, more than maxAge (1m)")
    recovery = Recovery(id="1", reason="x", result="Recovered", to_pod="w-2", state=[restored])
    monitor.state_manager.report_restored(recovery)
    assert monitor.notices.conditions["StateRestored"] == (
        "True",
        "Restored",
        "w-2 was given /amcl_pose (0.8 s old).",
    )
    assert not monitor.notices.events
    monitor.state_manager.report_restored(recovery.model_copy(update={"state": [restored, missing]}))
    assert monitor.notices.conditions["StateRestored"][:2] == ("False", "NotRestored")
    ((_, reason, message),) = monitor.notices.events
    assert reason == "StateNotRestored"
    assert_golden("monitor", message, "w-2", "/map", "61.0 s", "1m", "state.keep", "restore_state")
    assert "It received /amcl_pose (0.8 s old)." in monitor.notices.conditions["StateRestored"][2]


async def test_a_recovery_without_restored_state_withdraws_the_last_report(monitor: Monitor) -> None:
    monitor.notices.condition("StateRestored", "False", "NotRestored", "w-2 was not given ...")
    monitor.state_manager.report_restored(Recovery(id="2", reason="x", result="Failed"))
    assert "StateRestored" in monitor.notices.conditions
    monitor.state_manager.report_restored(Recovery(id="2", reason="x", result="Recovered", to_pod="w-3"))
    assert "StateRestored" not in monitor.notices.conditions


@pytest.mark.parametrize("step", [-3600.0, 3600.0])
async def test_a_clock_step_changes_no_age(
    monitor: Monitor, say: Callable[[float], None], monkeypatch: pytest.MonkeyPatch, step: float
) -> None:
    say(1.0)
    await monitor.until(lambda: monitor.x() == 1.0)

    (before,) = monitor.state_manager.select(time.time()).samples
    set_clock(monkeypatch, step)
    monitor.state_manager.take(STATE, {}, "w-1")
    (after,) = monitor.state_manager.select(time.time()).samples
    assert after.taken_at - before.taken_at == pytest.approx(step, abs=0.5)


def test_only_ready_standbys_of_pools_with_keep_up_are_kept_up_to_date(tmp_path: Path) -> None:
    warm = PoolChoice(name="warm", readiness="Initialized", keep_up="2s")
    settings = settings_of(pools=[warm, PoolChoice(name="hot", readiness="Executing")])
    of_source = Instance("w-3", "uid-3", running=True)
    others = [
        Instance("w-4", "uid-4", running=True, pool="hot"),
        Instance("w-5", "uid-5", running=True, pool="warm", terminating=True),
        Instance("w-6", "uid-6", running=True, pool="warm", has_agent=False),
        Instance("w-7", "uid-7", running=True, pool="warm"),
    ]
    agents = GivenSenses(ClusterObjects(tmp_path)).agents
    agents.unready["uid-7"] = "starting"
    targets = receivers([ACTIVE, STANDBY, of_source, *others], settings, agents, active_uid=ACTIVE.uid)
    assert targets == [(STANDBY, 2.0), (of_source, 2.0)]
    settings.pools.pop(0)
    assert receivers([STANDBY], settings, agents, active_uid=ACTIVE.uid) == []
