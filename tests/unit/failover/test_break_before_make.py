"""``handover: BreakBeforeMake``: the gate is opened for a standby only after it was seen to be closed for the former instance."""

from __future__ import annotations

import pytest

from tests.unit.failover.recoveries import choices, failure, protected
from tests.unit.failover.world import Killed, Leak, World
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.monitor_settings import PoolChoice, WorkloadSettings
from understudy.failover.protocol import recover
from understudy.failover.strategies import registry
from understudy.failover.strategies.base import Choice
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.restart import Restart
from understudy.failover.strategies.steps import CLOSED_FOR

BREAKS_FIRST = ExecutingFallback("hot", breaks_first=True)


async def test_the_gate_is_closed_and_then_opened_for_the_standby() -> None:
    store = protected(pool="hot")
    world = World(store)
    done = await recover(failure(world), choices(BREAKS_FIRST), world.context())
    assert (done.result, done.strategy) == ("Recovered", "Fallback/Executing")
    assert store.commits == ["", "w-2"]
    assert done.moments["committing"] >= done.moments["fenced"] + CLOSED_FOR


async def test_one_write_switches_without_it() -> None:
    store = protected(pool="hot")
    world = World(store)
    await recover(failure(world), choices(ExecutingFallback("hot")), world.context())
    assert store.commits == ["w-2"]


@pytest.mark.parametrize("heard_by", ["probes", "samples"])
async def test_it_waits_while_a_network_closes_the_gate_late(heard_by: str) -> None:
    store = protected(pool="hot")
    world = World(store)
    leak = Leak(0.01, world.clock(), until=world.clock() + 0.4)
    if heard_by == "probes":
        store.probes_through["uid-w-1"] = leak
    else:
        store.leaks["w-1"] = leak
    done = await recover(failure(world), [Choice(BREAKS_FIRST, 5.0)], world.context())
    assert done.moments["committing"] >= leak.until - leak.period + CLOSED_FOR
    assert "uid-w-1" in store.probed, "its agent sends packets, so that silence shows something"


async def test_a_gate_that_is_not_seen_closed_is_not_opened_and_the_next_strategy_is_tried() -> None:
    store = protected(pool="hot")
    world = World(store)
    store.probes_through["uid-w-1"] = Leak(0.01, world.clock(), until=world.clock() + 0.6)
    done = await recover(failure(world), [Choice(BREAKS_FIRST, 0.3), Choice(Restart(), 5.0)], world.context())
    first, *_ = done.attempts
    assert first.result != "Verified"
    assert "w-1 still reaches the robot, although the gate is closed (handover: BreakBeforeMake)" in first.message
    assert store.commits[0] == ""
    assert "w-2" not in store.commits


@pytest.mark.parametrize("dies_after", range(1, 9))
async def test_a_monitor_that_continues_it_opens_for_the_same_standby(dies_after: int) -> None:
    store = protected(pool="hot")
    world = World(store, dies_after=dies_after)
    progress = failure(world)
    try:
        await recover(progress, choices(BREAKS_FIRST), world.context())
    except Killed:
        world = World(store)
        recorded = store.gate.recovery or store.journal or progress
        await recover(recorded, choices(BREAKS_FIRST), world.context())
    assert store.gate.active == "w-2"
    assert store.commits[0] == ""


@pytest.mark.parametrize(("gate", "breaks_first"), [("NetworkPolicy", True), ("Mux", False)])
def test_a_gate_at_the_robot_switches_at_once_in_any_case(gate: str, breaks_first: bool) -> None:
    policy = FailurePolicySpec.model_validate(
        {
            "monitoring": {"yaml": {"topic": {"name": "/cmd_vel", "maxAge": "1s"}}},
            "strategies": [{"type": "Fallback", "poolRef": {"name": "hot"}, "handover": "BreakBeforeMake"}],
        }
    )
    workload = RobotWorkloadSpec.model_validate(
        {
            "failurePolicyRef": {"name": "p"},
            "template": {"spec": {"containers": [{"name": "drive", "image": "i"}]}},
            "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
            "gate": {"kind": gate},
        }
    )
    settings = WorkloadSettings.model_validate(
        {
            "workload": "w",
            "namespace": "fleet",
            "uid": "u",
            "source_kind": "ReplicaSet",
            "source_name": "w",
            "pools": [PoolChoice(name="hot", readiness="Executing").model_dump()],
        }
    )
    (choice,) = registry.choices(policy, settings, workload)
    assert isinstance(choice.strategy, ExecutingFallback)
    assert choice.strategy.breaks_first is breaks_first
