"""Planned switchovers: who asks for one, how often it is carried out, and what is said of it."""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import Sequence
from typing import Any, cast

import pytest

from tests.support.golden import assert_golden
from tests.support.notices import RecordedNotices
from tests.unit.failover.world import Store, World
from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.senses import GivenSenses
from understudy.api import names
from understudy.api.kinds.switchover_spec import Drain, request
from understudy.failover import switchover
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import GateState, Instance
from understudy.failover.progress import PodIdentity, Progress
from understudy.failover.strategies.base import Choice, Strategy, StrategyContext
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.initialized import InitializedFallback
from understudy.failover.switchover import Preparation
from understudy.monitor.act.instances.garbage_collection import GarbageCollection
from understudy.monitor.act.instances.state_manager import StateManager
from understudy.monitor.act.objects.cluster import Cluster
from understudy.monitor.act.objects.gate_control import GateControl
from understudy.monitor.act.objects.pod_control import PodControl
from understudy.monitor.act.recovery import planned_switchover
from understudy.monitor.act.recovery.planned_switchover import PlannedSwitchovers
from understudy.monitor.decide.strategy_options import StrategyOptions
from understudy.monitor.observe.objects.storm_condition import StormCondition

BRING_UP = BringUp("bringUp", {}, 0.2, "digest", False)


class LastingNotices(RecordedNotices):
    """What a monitor reports; it outlives that monitor, as the status does."""

    @property
    def phase(self) -> str:
        return self.status.switchover.phase if self.status.switchover is not None else ""

    @property
    def message(self) -> str:
        return self.status.switchover.message if self.status.switchover is not None else ""


class StoredPods(PodControl):
    """The pods of a store."""

    def __init__(self, objects: ClusterObjects, store: Store) -> None:
        super().__init__(objects.client, objects.view, objects.crash_points, objects.notices)
        self._store = store

    def of_workload(self) -> Sequence[Instance]:
        return list(self._store.pods.values())


class StoredGate(GateControl):
    """The gate of a store."""

    def __init__(self, objects: ClusterObjects, pods: PodControl, store: Store) -> None:
        super().__init__(objects.client, objects.view, pods, objects.proof, objects.crash_points, objects.notices)
        self._store = store

    @property
    def state(self) -> GateState:
        return self._store.gate


class GivenOptions(StrategyOptions):
    """Strategies as a test gives them, in a world."""

    def __init__(self, objects: ClusterObjects, world: World, strategies: Sequence[Strategy]) -> None:
        super().__init__(objects.view, StormCondition(objects.view), world.context())
        self.world, self._strategies = world, strategies

    def choices(self) -> list[Choice]:
        return [Choice(strategy, 0.3) for strategy in self._strategies]

    def context(self) -> StrategyContext:
        return self.world.context()


class Scene:
    """A monitor's switchovers in a world that w-1 drives, with w-2 as its standby."""

    def __init__(self, *strategies: Strategy, notices: LastingNotices | None = None, **standby: Any) -> None:
        self.store = Store(beside=True)
        self.store.add("w-1", node="node-1")
        self.store.add("w-2", **{"pool": "hot", "node": "node-2"} | standby)
        self.store.gate = GateState(epoch=1, active="w-1", active_uid="uid-w-1")
        self.notices = notices or LastingNotices()
        self.objects = ClusterObjects(notices=self.notices)
        self.ask(None)
        self.drain()
        pods = StoredPods(self.objects, self.store)
        gate = StoredGate(self.objects, pods, self.store)
        senses = GivenSenses(self.objects)
        self._options = GivenOptions(self.objects, World(self.store), strategies or (ExecutingFallback("hot"),))
        self._garbage = GarbageCollection(pods, gate, self.notices)
        cluster = Cluster(self.objects.view, pods, gate)
        self.switching = PlannedSwitchovers(
            cluster, self._options, senses.state_manager, senses.current, self._garbage, self.notices
        )

    @property
    def state(self) -> GateState:
        return self.store.gate

    @property
    def left(self) -> list[str]:
        """The pods that are of no use any more."""
        return [pod.name for pod in self._garbage.failed()]

    def restart_monitor(self) -> None:
        """Have a world with the pods that the store has now."""
        self._options.world = World(self.store)

    def ask(self, text: str | None) -> None:
        """Ask for a switchover, or take that back."""
        self.objects.put_workload(annotations={names.SWITCHOVER: text} if text else {})

    def drain(self, *nodes: str, uid: str = "uid-w-1") -> None:
        """Drain these nodes, where the instance with this UID is active; or none."""
        drain = Drain(uid=uid, node=nodes[0], since=time.time(), cordoned=list(nodes)) if nodes else None
        self.objects.put_settings(drain=drain)

    def look(self, lacking: str = "") -> Preparation | None:
        return self.switching.advance(lacking)

    async def looked(self, within: float = 1.0, lacking: str = "") -> Preparation | None:
        """The result after a while, in which the loop looks again and again."""
        end = time.monotonic() + within
        while time.monotonic() < end:
            if (found := self.look(lacking)) is not None:
                return found
            await asyncio.sleep(0.01)
        return None

    async def switch(self, prepared: Preparation) -> Progress:
        """As the supervisor does it."""
        outcome = await self.switching.carry_out(prepared)
        assert outcome is not None
        self.switching.done(outcome.progress, "it took over.")
        return outcome.progress


@pytest.fixture(autouse=True)
def quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planned_switchover, "CHECK_PERIOD", 0.02)


async def test_without_a_request_nothing_is_done() -> None:
    scene = Scene()
    assert await scene.looked(0.05) is None
    assert (scene.notices.status.switchover, scene.notices.events) == (None, [])


async def test_a_request_is_carried_out_once() -> None:
    scene = Scene()
    scene.ask(asked := request("failover", time.time()))
    found = await scene.looked()
    assert found is not None
    assert found.target is not None
    assert (found.target.name, found.progress.request, found.progress.switchover) == ("w-2", asked, "Failover")
    assert scene.notices.phase == "Preparing"
    done = await scene.switch(found)
    assert scene.notices.status.switchover is not None
    assert (scene.notices.phase, scene.notices.status.switchover.handled) == ("Done", asked)
    assert (scene.notices.status.switchover.recovery, scene.notices.status.switchover.target) == (done.id, "w-2")
    scene.store.add("w-3", pool="hot")
    assert await scene.looked(0.1) is None, "it was carried out"
    scene.ask(request("failover", time.time()))
    assert await scene.looked() is not None, "that's another one"


async def test_a_new_monitor_does_not_repeat_a_request_even_after_drains() -> None:
    scene = Scene()
    scene.ask(asked := request("failover", time.time()))
    found = await scene.looked()
    assert found is not None
    await scene.switch(found)
    scene.store.add("w-3", pool="hot", node="node-3")
    scene.drain("node-1", uid="uid-w-2")
    found = await scene.looked()
    assert found is not None
    assert found.progress.switchover == "Drain"
    await scene.switch(found)
    again = Scene(notices=scene.notices)
    again.ask(asked)
    assert await again.looked(0.1) is None


async def test_a_new_monitor_starts_again_with_a_switchover_that_was_being_prepared() -> None:
    scene = Scene(InitializedFallback("warm", recovery=BRING_UP), pool="warm")
    scene.store.broken.add("w-2")
    scene.ask(asked := request("failover", time.time()))
    assert await scene.looked(0.05) is None
    assert scene.notices.phase == "Preparing"
    again = Scene(notices=scene.notices)
    again.ask(asked)
    assert await again.looked() is not None
    assert scene.notices.reasons == ["SwitchoverBegun"], "which isn't told twice"


async def test_a_switchover_waits_for_a_standby_and_ends_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planned_switchover, "PATIENCE", 0.15)
    scene = Scene(ready=False)
    scene.ask(request("failover", time.time()))
    assert await scene.looked(0.1) is None
    assert (scene.notices.phase, scene.notices.message) == (
        "Waiting",
        "Fallback/Executing: w-2: no /cmd_vel for 500 ms.",
    )
    assert await scene.looked(0.2) is None
    assert scene.notices.phase == "NotDone"
    assert_golden("monitor", scene.notices.message, "Fallback/Executing", "w-2", "/cmd_vel")
    assert scene.notices.reasons[-1] == "SwitchoverNotDone"
    assert (scene.state.active, scene.store.commits) == ("w-1", [])


async def test_a_prepared_switchover_that_something_prevents_ends_with_the_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = Scene(InitializedFallback("warm", recovery=BRING_UP), pool="warm")
    scene.ask(asked := request("failover", time.time()))
    assert scene.look() is None
    assert await scene.looked(0.1, lacking="the workload is paused") is None
    assert (scene.notices.phase, scene.switching.preparing) == ("Preparing", "uid-w-2"), "the operator keeps the pod"
    assert_golden("monitor", scene.notices.message, "w-2", "the workload is paused")
    monkeypatch.setattr(planned_switchover, "PATIENCE", 0.0)
    assert scene.look("the workload is paused") is None
    assert scene.notices.status.switchover is not None
    assert (scene.notices.phase, scene.notices.status.switchover.handled) == ("NotDone", asked)
    assert_golden("monitor", scene.notices.message, "the workload is paused")
    assert (scene.left, scene.switching.preparing) == (["w-2"], "")
    assert await scene.looked(0.05) is None, "the request has ended"


async def test_a_drain_waits_with_its_prepared_standby_until_nothing_prevents_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(planned_switchover, "PATIENCE", 0.0)
    scene = Scene()
    scene.drain("node-1")
    assert scene.look() is None
    assert await scene.looked(0.1, lacking="the workload is paused") is None
    assert (scene.notices.phase, scene.notices.message) == (
        "Preparing",
        "w-2 is prepared, and waits: the workload is paused.",
    )
    assert await scene.looked() is not None


async def test_a_switchover_does_not_begin_while_the_active_instance_is_not_healthy() -> None:
    scene = Scene()
    scene.ask(request("failover", time.time()))
    assert scene.look("w-1 isn't healthy yet") is None
    assert (scene.notices.phase, scene.notices.message) == ("Waiting", "w-1 isn't healthy yet.")
    assert await scene.looked() is not None


async def test_an_old_or_unknown_request_is_reported_and_not_carried_out() -> None:
    scene = Scene()
    scene.ask(request("failover", time.time() - 3600))
    assert await scene.looked(0.05) is None
    assert re.search(r"no monitor handled it for 36\d\d s", scene.notices.message)
    scene.ask("failover now")
    assert await scene.looked(0.05) is None
    assert_golden("monitor", scene.notices.message, "'failover now'")
    assert scene.notices.reasons == ["SwitchoverNotDone"] * 2, "each is reported once"


async def test_a_failure_takes_precedence_and_ends_the_request() -> None:
    scene = Scene(InitializedFallback("warm", recovery=BRING_UP), pool="warm")
    scene.store.broken.add("w-2")
    scene.ask(request("failover", time.time()))
    assert await scene.looked(0.05) is None
    assert scene.switching.preparing == "uid-w-2"
    assert scene.switching.failed("no /cmd_vel for 500 ms") == PodIdentity(name="w-2", uid="uid-w-2")
    assert (scene.switching.preparing, scene.notices.phase, scene.left) == ("", "NotDone", [])
    assert "no /cmd_vel for 500 ms" in scene.notices.message
    assert await scene.looked(0.05) is None


async def test_a_request_from_before_a_recovery_is_not_carried_out() -> None:
    scene = Scene()
    scene.ask(request("failover", time.time() - 5))
    recovery = Progress.begin("it failed", last_healthy=time.time() - 2, detected=time.time() - 1)
    scene.store.gate = GateState(epoch=2, active="w-1", active_uid="uid-w-1", recovery=recovery)
    assert await scene.looked(0.05) is None
    assert "the active instance failed and was recovered" in scene.notices.message


async def test_a_late_status_of_an_earlier_monitor_does_not_repeat_a_switchover() -> None:
    scene = Scene()
    scene.ask(asked := request("failover", time.time()))
    found = await scene.looked()
    assert found is not None
    done = await scene.switch(found)
    done.moments["detected"] = time.time()  # the world's clock isn't that of who asks
    scene.store.gate = GateState(epoch=2, active="w-2", active_uid="uid-w-2", recovery=done)
    scene.store.add("w-3", pool="hot")
    scene.notices.set_switchover(cast(Any, None))
    assert await scene.looked(0.1) is None
    assert "another switchover took place" in scene.notices.message
    assert scene.notices.status.switchover is not None
    assert scene.notices.status.switchover.handled == asked


async def test_a_withdrawn_request_leaves_no_prepared_standby() -> None:
    scene = Scene(InitializedFallback("warm", recovery=BRING_UP), pool="warm")
    scene.store.broken.add("w-2")
    scene.ask(request("failover", time.time()))
    assert await scene.looked(0.05) is None
    scene.ask(None)
    assert await scene.looked(0.05) is None
    assert (scene.notices.phase, scene.left) == ("NotDone", ["w-2"]), "what was begun with is of no use"


async def test_a_waiting_switchover_ends_when_the_drain_ends() -> None:
    scene = Scene(ready=False)
    scene.drain("node-1")
    assert await scene.looked(0.05) is None
    assert scene.notices.phase == "Waiting"
    scene.drain()
    assert await scene.looked(0.05) is None
    assert (scene.notices.phase, scene.notices.message) == (
        "NotDone",
        "Nothing was changed: the request was withdrawn.",
    )


async def test_a_drain_waits_for_a_standby_on_a_node_that_is_not_drained() -> None:
    scene = Scene()
    scene.drain("node-1", "node-2")
    assert await scene.looked(0.05) is None
    assert scene.notices.phase == "Waiting"
    assert_golden("monitor", scene.notices.message, "Fallback/Executing: w-2", "node-2", "cordoned")
    scene.store.add("w-3", pool="hot", node="node-3")
    found = await scene.looked()
    assert found is not None
    assert found.target is not None
    assert (found.target.name, found.progress.reason) == ("w-3", "node node-1 is being drained (it is cordoned)")
    await scene.switch(found)
    assert await scene.looked(0.05) is None, "who drives now runs elsewhere"


class CountedFallback(ExecutingFallback):
    """Counts how often an understudy is prepared with it."""

    tries = 0

    async def make_ready(self, *arguments: Any, **more: Any) -> Instance:
        self.tries += 1
        return await super().make_ready(*arguments, **more)


async def test_a_drain_that_waits_is_logged_and_reported_once_however_often_it_is_tried(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, logger="understudy")
    fallback = CountedFallback("hot")
    scene = Scene(fallback, ready=False)
    scene.drain("node-1")
    assert await scene.looked(0.3) is None
    assert fallback.tries > 3
    assert scene.notices.phase == "Waiting"
    assert scene.notices.reasons == ["SwitchoverBegun"]
    assert len(caplog.messages) <= 1
    assert not any("prepares nothing" in message for message in caplog.messages)


async def test_a_drain_applies_only_to_the_instance_that_it_names() -> None:
    scene = Scene()
    scene.drain("node-1", uid="uid-of-one-before")
    assert await scene.looked(0.05) is None
    assert scene.notices.status.switchover is None


async def test_a_failback_is_done_if_the_own_pod_is_already_active() -> None:
    scene = Scene()
    scene.ask(request("failback", time.time()))
    assert await scene.looked(0.05) is None
    assert scene.notices.phase == "Done"
    assert_golden("monitor", scene.notices.message, "w-1")


async def test_a_failback_uses_only_the_pod_of_the_workload_controller() -> None:
    scene = Scene()
    scene.store.add("w-3", created="9")
    scene.store.add("w-4", pool="hot", created="1")
    scene.store.gate = GateState(epoch=4, active="w-2", active_uid="uid-w-2")
    scene.store.pods.pop("w-1")
    scene.restart_monitor()
    scene.ask(request("failback", time.time()))
    found = await scene.looked()
    assert found is not None
    assert found.target is not None
    assert (found.target.name, found.progress.strategy) == ("w-3", "Fallback/Executing")


async def test_a_failback_starts_the_own_pod_if_no_strategy_keeps_one() -> None:
    scene = Scene(ExecutingFallback("hot", with_source=False))
    scene.store.gate = GateState(epoch=4, active="w-2", active_uid="uid-w-2")
    scene.store.pods.pop("w-1")
    scene.restart_monitor()
    scene.ask(request("failback", time.time()))
    found = await scene.looked()
    assert found is not None
    assert found.target is not None
    assert (found.target.name, found.progress.strategy) == ("w-new1", "Restart")
    assert scene.state.active == "w-2"


async def test_a_switchover_that_took_effect_late_is_settled(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    scene.ask(request("failover", time.time()))
    found = await scene.looked()
    assert found is not None

    async def unanswered(prepared: Preparation, context: StrategyContext) -> Progress:
        raise TimeoutError

    monkeypatch.setattr(switchover, "switch", unanswered)
    assert await scene.switching.carry_out(found) is None
    assert (scene.notices.phase, scene.left) == ("NotDone", []), "an executing standby stays one"
    assert scene.switching.unsettled() is None
    progress = found.progress.model_copy(update={"target": PodIdentity(name="w-2", uid="uid-w-2")})
    scene.store.gate = GateState(epoch=2, active="w-2", active_uid="uid-w-2", recovery=progress)
    assert scene.switching.unsettled() == progress
    scene.notices.record(progress)
    assert scene.switching.unsettled() is None


async def test_a_monitor_that_has_just_started_switches_once_it_knows_the_state_of_the_active_instance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene, awaited = Scene(), ["this monitor has not yet received /pose of w-1, which is to be kept"]
    monkeypatch.setattr(StateManager, "awaited", lambda manager: "".join(awaited))
    scene.ask(request("failover", time.time()))
    assert await scene.looked() is None
    assert "has not yet received /pose" in scene.notices.message
    awaited.clear()
    assert await scene.looked() is not None
