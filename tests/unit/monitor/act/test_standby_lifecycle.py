"""Which instance is brought where, when a standby counts as ready, and when it is replaced."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from tests.support.notices import RecordedNotices
from understudy.api.kinds.failure_policy import FailurePolicySpec
from understudy.api.kinds.procedure_spec import Check, Procedure
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.agent_messages import AgentStatus
from understudy.api.protocol.kept_state import KeptState, RestoreReport
from understudy.api.protocol.monitor_settings import PoolChoice, WorkloadSettings
from understudy.failover.interfaces import Instance, NotVerified
from understudy.failover.strategies.executing import ExecutingFallback
from understudy.failover.strategies.initialized import InitializedFallback
from understudy.failover.strategies.registry import choices
from understudy.failover.strategies.restart import Restart
from understudy.monitor.act.instances import standby_lifecycle
from understudy.monitor.act.instances.standby_lifecycle import Bringing
from understudy.monitor.observe import agent_connections
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles, Role, managed, role_of

UP = {"yaml": {"set_lifecycle": {"node": "/nav", "state": "active"}}}
INIT = Procedure(yaml={"set_lifecycle": {"node": "/nav", "state": "inactive"}}, within="7s")
CHECK = Check(yaml={"lifecycle_is": {"node": "/nav", "state": "inactive"}}, period="2s")
ACTIVE = Instance("w-1", "uid-1", running=True)
SOURCE = Instance("w-2", "uid-2", running=True, ready=True)
STANDBY = Instance("w-3", "uid-3", pool="warm", running=True, ready=True)


def workload(**more: Any) -> RobotWorkloadSpec:
    return RobotWorkloadSpec.model_validate(
        {
            "template": {"spec": {}},
            "outputs": [{"topic": "/cmd_vel", "type": "geometry_msgs/msg/Twist"}],
            "failurePolicyRef": {"name": "p"},
            **more,
        }
    )


def settings(*pools: PoolChoice) -> WorkloadSettings:
    return WorkloadSettings(
        workload="w", namespace="n", uid="u", source_kind="ReplicaSet", source_name="w", pools=list(pools)
    )


def policy(*strategies: dict[str, Any]) -> FailurePolicySpec:
    return FailurePolicySpec.model_validate(
        {
            "monitoring": {"yaml": {"topic": {"name": "/cmd_vel", "gap": "500ms"}}},
            "strategies": list(strategies) or [{"type": "Restart"}],
        }
    )


WARM = PoolChoice(name="warm", readiness="Initialized", initialization=INIT, readiness_check=CHECK)
HOT = PoolChoice(name="hot", readiness="Executing")


def test_without_procedures_the_health_tree_alone_counts() -> None:
    for instance in (ACTIVE, SOURCE, replace(STANDBY, pool="hot")):
        assert role_of(instance, workload(), settings(HOT), active_uid="uid-1") == Role()


def test_a_standby_of_an_initialized_pool_is_initialized_and_checked() -> None:
    found = role_of(STANDBY, workload(bringUp=UP), settings(WARM), active_uid="uid-1")
    assert found.procedure is not None
    assert (found.procedure.name, found.procedure.within) == ("initialization", 7.0)
    assert found.brought.startswith("init:")
    assert found.standby == {"brought": found.brought, "tree": False, "check": CHECK.yaml, "period": 2.0}


def test_a_container_that_was_started_again_is_to_be_initialized_again() -> None:
    first, again = (
        role_of(replace(STANDBY, restarts=restarts), workload(), settings(WARM), active_uid="uid-1").brought
        for restarts in (0, 1)
    )
    assert first != again


def test_what_the_controller_makes_beside_the_one_in_control_waits_as_the_first_pools() -> None:
    pools = settings(PoolChoice(name="spare", readiness="Uninitialized"), WARM, HOT)
    assert role_of(SOURCE, workload(bringUp=UP), pools, active_uid="uid-1").procedure.name == "initialization"


def test_the_first_instance_is_brought_up_before_it_is_ready() -> None:
    for pools in (settings(), settings(WARM)):
        found = role_of(SOURCE, workload(bringUp=UP), pools, active_uid="")
        assert found.procedure is not None
        assert found.procedure.name == "bringUp"
        assert found.brought.startswith("up:")
        assert found.standby == {"brought": found.brought}


def test_an_executing_standby_is_initialized_by_the_bring_up_and_judged_by_its_health_tree() -> None:
    standby = replace(STANDBY, pool="hot")
    found = role_of(standby, workload(bringUp=UP), settings(HOT), active_uid="uid-1")
    assert found.procedure is not None
    assert found.procedure.name == "bringUp"
    assert found.standby == {"brought": found.brought, "tree": True}


def test_the_one_in_control_is_brought_up_where_that_was_not_done() -> None:
    spec = workload(bringUp=UP)
    assert role_of(ACTIVE, spec, settings(WARM), active_uid="uid-1").procedure is not None
    assert role_of(ACTIVE, spec, settings(WARM), active_uid="uid-1", brought="up:x:0").procedure is None
    took_over = replace(STANDBY, uid="uid-1")
    assert role_of(took_over, spec, settings(WARM), active_uid="uid-1", brought="init:x:0").procedure is not None
    executing = replace(took_over, pool="hot")
    assert role_of(executing, spec, settings(HOT), active_uid="uid-1", brought="init:x:0").procedure is None
    assert role_of(ACTIVE, spec, settings(WARM), active_uid="uid-1").standby is None


def test_a_claimed_pod_is_left_to_the_strategy_that_claimed_it() -> None:
    claimed = Instance("s-1", "uid-4", pool="spare", claim="u/1", running=True)
    pools = settings(PoolChoice(name="spare", readiness="Uninitialized"))
    assert role_of(claimed, workload(bringUp=UP), pools, active_uid="") == Role()


def test_procedures_make_a_workload_managed() -> None:
    assert not managed(workload(), settings(HOT), policy())
    assert managed(workload(bringUp=UP), settings(), policy())
    assert managed(workload(), settings(WARM), policy())
    assert managed(workload(), settings(), policy({"type": "Restart", "recovery": UP}))


def test_strategies_bring_up_what_is_not_driving_yet() -> None:
    fallback = {"type": "Fallback", "poolRef": {"name": "warm"}}
    hot = {"type": "Fallback", "poolRef": {"name": "hot"}}
    restart = {"type": "Restart", "recovery": {"yaml": {"resend_goals": {}}}}
    found = choices(policy(fallback, hot, restart), settings(WARM, HOT), workload(bringUp=UP))
    warm, executing, again = (choice.strategy for choice in found)
    assert isinstance(warm, InitializedFallback)
    assert warm._recovery.name == "bringUp"
    assert type(executing) is ExecutingFallback
    assert executing._recovery is None, "it drives already"
    assert not executing._with_source, "what the controller makes waits in the first pool"
    assert isinstance(again, Restart)
    assert again._recovery.name == "strategies[2].recovery", "instead of the workload's bringUp"


class Sidecars:
    """Agents that do what is requested."""

    def __init__(self) -> None:
        self.ran: list[tuple[str, str]] = []
        self.brought: dict[str, str] = {}
        self.fails = ""
        self.endless = 0.0
        """Procedures that are given so many seconds don't end."""
        self.ready = {"uid-3": True}

    def status(self, instance: Instance) -> AgentStatus:
        return AgentStatus("Running", configured=True, initialized=self.brought.get(instance.uid, ""))

    def is_ready(self, instance: Instance) -> tuple[bool, str]:
        ready = self.ready.get(instance.uid, False) and bool(self.brought.get(instance.uid))
        return ready, "" if ready else "node /nav is gone"

    async def run(self, instance: Instance, procedure: Any, *, brought: str, **more: Any) -> RestoreReport:
        self.ran.append((instance.name, procedure.name))
        if procedure.within == self.endless:
            await asyncio.Event().wait()
        if self.fails:
            raise NotVerified(self.fails)
        self.brought[instance.uid] = brought
        return RestoreReport()


class Fleet:
    def __init__(self) -> None:
        self.retired: list[str] = []

    async def retire(self, instance: Instance) -> None:
        self.retired.append(instance.name)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    found = SimpleNamespace(fleet=Fleet(), agents=Sidecars(), notices=RecordedNotices(), clock=1000.0)
    found.notices.set(health="Healthy")
    found.roles = InstanceRoles(None, None, CurrentRecovery())  # type: ignore[arg-type]
    found.bringing = Bringing(found.fleet, found.agents, found.roles, found.notices)  # type: ignore[arg-type]
    monkeypatch.setattr(standby_lifecycle, "time", SimpleNamespace(monotonic=lambda: found.clock))
    found.agents.brought["uid-1"] = "up:x:0"

    async def look(*instances: Instance, **more: Any) -> None:
        found.bringing.housekeeping(
            instances or (ACTIVE, STANDBY),
            policy(),
            more.get("spec", workload(bringUp=UP)),
            settings(more.get("pool", WARM)),
            more.get("active", "uid-1"),
            KeptState,
        )
        for _ in range(5):
            await asyncio.sleep(0)

    found.look = look
    return found


async def test_each_instance_is_brought_there_once(world: SimpleNamespace) -> None:
    await world.look()
    assert world.notices.conditions["BroughtUp"][:2] == ("Unknown", "UnderWay")
    await world.look()
    assert world.agents.ran == [("w-3", "initialization")]
    assert world.notices.conditions["BroughtUp"][:2] == ("True", "BroughtUp")


async def test_a_failure_is_told_once_and_tried_again_later(world: SimpleNamespace) -> None:
    world.agents.fails = "initialization.set_lifecycle: node /nav did not configure"
    await world.look()
    await world.look()
    assert world.notices.conditions["BroughtUp"] == (
        "False",
        "ProcedureFailed",
        "w-3: initialization.set_lifecycle: node /nav did not configure. Correct spec.initialization of FallbackPool warm, "
        "or what it waits for there. It is tried again.",
    )
    assert len(world.agents.ran) == 1
    world.clock += standby_lifecycle.RETRY_FIRST
    await world.look()
    assert len(world.agents.ran) == 2
    assert world.notices.reasons == ["NotBroughtUp"]


OTHER = Procedure(yaml={"wait_for": {"node": "/nav"}}, within="7s")


async def test_a_correction_is_tried_at_once_and_nothing_is_said_of_what_it_corrects(world: SimpleNamespace) -> None:
    world.agents.ready["uid-3"] = False
    world.agents.fails = "initialization.set_lifecycle: node /nav did not configure"
    for _ in range(4):  # the wait for the next try grows
        await world.look()
        world.clock += standby_lifecycle.RETRY_MOST
    world.agents.fails = ""
    await world.look(pool=WARM.model_copy(update={"initialization": OTHER}))
    assert "did not configure" not in world.notices.conditions["BroughtUp"][2]
    await world.look(pool=WARM.model_copy(update={"initialization": OTHER}))
    assert world.notices.conditions["BroughtUp"][:2] == ("True", "BroughtUp")


async def test_a_procedure_that_does_not_end_is_cut_short_when_its_time_is_corrected(world: SimpleNamespace) -> None:
    world.agents.endless = 3600.0
    endless = WARM.model_copy(update={"initialization": INIT.model_copy(update={"within": "1h"})})
    await world.look(pool=endless)
    await world.look(pool=endless)
    assert len(world.agents.ran) == 1
    await world.look()
    await world.look()
    assert len(world.agents.ran) == 2
    assert world.notices.conditions["BroughtUp"][:2] == ("True", "BroughtUp")


async def test_a_standby_that_is_not_ready_for_a_moment_is_not_given_another_procedure(world: SimpleNamespace) -> None:
    await world.look()
    await world.look()
    world.agents.ready["uid-3"] = False
    await world.look(pool=WARM.model_copy(update={"initialization": OTHER}))
    assert world.agents.ran == [("w-3", "initialization")]
    assert world.roles.was_ready(STANDBY)


@pytest.mark.parametrize("before", ["init:other:0", ""])
def test_a_standby_that_is_ready_as_it_is_waits_so(before: str) -> None:
    found = role_of(STANDBY, workload(), settings(WARM), active_uid="uid-1", brought=before, ready=True)
    assert (found.brought, found.outdated) == (before, True)
    assert found.standby is not None
    assert found.standby["brought"] == before
    assert not role_of(STANDBY, workload(), settings(WARM), active_uid="uid-1", brought=before).outdated


@pytest.mark.parametrize("before", ["up:other:0", "init:other:1"])
def test_what_was_brought_elsewhere_or_was_started_again_since_is_initialized(before: str) -> None:
    found = role_of(STANDBY, workload(), settings(WARM), active_uid="uid-1", brought=before, ready=True)
    assert found.brought.startswith("init:")
    assert (found.brought == before, found.outdated) == (False, False)


async def test_a_standby_that_waits_as_an_earlier_procedure_left_it_is_named(world: SimpleNamespace) -> None:
    world.agents.brought["uid-3"] = "init:other:0"
    await world.look()
    assert world.agents.ran == []
    status, _, message = world.notices.conditions["BroughtUp"]
    assert status == "True"
    assert "An earlier version of the procedure prepared w-3: delete the pod" in message


async def test_a_standby_that_lost_its_readiness_for_long_is_replaced_and_reported(world: SimpleNamespace) -> None:
    await world.look()
    await world.look()
    world.agents.ready["uid-3"] = False
    await world.look()
    world.clock += standby_lifecycle.LOST_FOR - 0.1
    await world.look()
    assert world.fleet.retired == []
    world.clock += 0.2
    await world.look()
    await world.look()
    assert world.fleet.retired == ["w-3"]
    assert world.notices.events[-1][1] == "StandbyReplaced"
    assert "node /nav is gone" in world.notices.events[-1][2]


async def test_a_standby_that_comes_back_stays(world: SimpleNamespace) -> None:
    await world.look()
    world.agents.ready["uid-3"] = False
    await world.look()
    world.agents.ready["uid-3"] = True
    world.clock += standby_lifecycle.LOST_FOR
    await world.look()
    world.agents.ready["uid-3"] = False
    await world.look()
    assert world.fleet.retired == []


async def test_standbys_stay_while_the_one_in_control_is_not_healthy_either(world: SimpleNamespace) -> None:
    """The reason may be the robot, whose sensors are silent for all of them."""
    await world.look()
    world.agents.ready["uid-3"] = False
    world.notices.set(health="Failed")
    for _ in range(3):
        await world.look()
        world.clock += standby_lifecycle.LOST_FOR
    assert world.fleet.retired == []


async def test_a_standby_that_was_never_ready_is_not_replaced_for_that(world: SimpleNamespace) -> None:
    world.agents.ready["uid-3"] = False
    for _ in range(3):
        await world.look()
        world.clock += standby_lifecycle.LOST_FOR
    assert world.fleet.retired == []


async def test_pods_without_an_agent_are_named(world: SimpleNamespace) -> None:
    await world.look(replace(ACTIVE, has_agent=False))
    status, reason, message = world.notices.conditions["BroughtUp"]
    assert (status, reason) == ("False", "NoAgent")
    assert message.startswith("w-1 has no agent")


async def test_nothing_is_said_where_nothing_is_to_be_done(world: SimpleNamespace) -> None:
    world.bringing.housekeeping((ACTIVE,), policy(), workload(), settings(HOT), "uid-1", KeptState)
    assert world.notices.conditions == {}


async def test_what_was_told_is_taken_back_when_the_procedures_are_gone(world: SimpleNamespace) -> None:
    await world.look()
    world.bringing.housekeeping((ACTIVE,), policy(), workload(), settings(HOT), "uid-1", KeptState)
    assert world.notices.conditions["BroughtUp"][:2] == ("True", "NothingToDo")


XML_CHECK = """<root BTCPP_format="4">
<BehaviorTree ID="Ready">
<LifecycleIs node="/nav" state="inactive"/>
</BehaviorTree>
</root>"""


def test_agents_are_told_in_the_short_form_whatever_a_check_is_written_in() -> None:
    pool = WARM.model_copy(update={"readiness_check": Check(xml=XML_CHECK, period="2s")})
    found = role_of(STANDBY, workload(), settings(pool), active_uid="uid-1")
    assert found.standby == {
        "brought": found.brought,
        "tree": False,
        "check": CHECK.yaml,
        "period": 2.0,
        "places": {"lifecycle_is": "line 3, column 1: <LifecycleIs>"},
    }


def test_a_check_that_can_not_be_read_is_left_to_the_agent_to_refuse() -> None:
    pool = WARM.model_copy(update={"readiness_check": Check(xml="<root/>")})
    found = role_of(STANDBY, workload(), settings(pool), active_uid="uid-1")
    assert found.standby is not None
    assert found.standby["check"] == "<root/>"


async def test_a_procedure_that_can_not_be_read_fails_with_its_place() -> None:
    procedure = standby_lifecycle.BringUp.of(
        "recovery", Procedure(xml=XML_CHECK.replace("LifecycleIs", "LifecycleWas"))
    )
    assert procedure is not None
    with pytest.raises(NotVerified) as failure:
        await agent_connections.AgentConnections.run(
            SimpleNamespace(), STANDBY, procedure, within=1.0, state=KeptState(), brought=""
        )  # type: ignore[arg-type]
    assert str(failure.value) == (
        "recovery, line 3, column 1: <LifecycleWas>: unknown node, did you mean 'LifecycleIs'?"
    )
