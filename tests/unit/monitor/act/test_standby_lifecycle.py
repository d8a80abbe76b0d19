"""When instances are brought to their readiness, and when a standby that lost it is replaced."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from tests.support.clock import Clock
from tests.support.golden import assert_golden
from tests.unit.monitor.cluster_objects import ClusterObjects, parsed_spec, policy_of
from tests.unit.monitor.readiness import ACTIVE, HOT, INIT, STANDBY, UP, WARM, XML_CHECK, settings
from tests.unit.monitor.senses import GivenAgents
from understudy.api.kinds.procedure_spec import Procedure
from understudy.api.kinds.robot_workload import RobotWorkloadSpec
from understudy.api.protocol.agent_messages import AgentStatus
from understudy.api.protocol.kept_state import KeptState, RestoreReport
from understudy.api.protocol.monitor_settings import PoolChoice
from understudy.failover.bring_up import BringUp
from understudy.failover.interfaces import Instance, NotVerified
from understudy.monitor.act.instances import standby_lifecycle
from understudy.monitor.act.instances.standby_lifecycle import StandbyLifecycle
from understudy.monitor.observe.agent_connections import AgentConnections
from understudy.monitor.observe.current_recovery import CurrentRecovery
from understudy.monitor.observe.instance_roles import InstanceRoles


class Sidecars(GivenAgents):
    """Agents that do what is requested."""

    def __init__(self, objects: ClusterObjects, roles: InstanceRoles) -> None:
        super().__init__(objects, roles)
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

    async def run(
        self, instance: Instance, procedure: BringUp, *, within: float, state: KeptState, brought: str
    ) -> RestoreReport:
        self.ran.append((instance.name, procedure.name))
        if procedure.within == self.endless:
            await asyncio.Event().wait()
        if self.fails:
            raise NotVerified(self.fails)
        self.brought[instance.uid] = brought
        return RestoreReport()


class World:
    """A healthy workload with an instance that drives, and a standby of a warm pool."""

    def __init__(self) -> None:
        self.clock, self.objects = Clock(), ClusterObjects()
        self.objects.put_settings(pools=[WARM])
        self.notices = self.objects.notices
        self.notices.set(health="Healthy")
        self.roles = InstanceRoles(self.objects.view, self.objects.gate, CurrentRecovery())
        self.agents = Sidecars(self.objects, self.roles)
        self.agents.brought["uid-1"] = "up:x:0"
        self.bringing = StandbyLifecycle(self.objects.pods, self.agents, self.roles, self.notices)

    async def look(self, *instances: Instance, pool: PoolChoice = WARM) -> None:
        """Look at these instances, and let what was begun be done."""
        self.keep_house(*(instances or (ACTIVE, STANDBY)), spec=parsed_spec(bringUp=UP), pool=pool)
        for _ in range(5):
            await asyncio.sleep(0)

    def keep_house(self, *instances: Instance, spec: RobotWorkloadSpec, pool: PoolChoice) -> None:
        """Look at these instances once."""
        self.bringing.housekeeping(instances, policy_of(), spec, settings(pool), "uid-1", KeptState)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    found = World()
    monkeypatch.setattr(standby_lifecycle, "time", found.clock)
    return found


async def test_each_instance_is_brought_up_once(world: World) -> None:
    await world.look()
    assert world.notices.conditions["BroughtUp"][:2] == ("Unknown", "UnderWay")
    await world.look()
    assert world.agents.ran == [("w-3", "initialization")]
    assert world.notices.conditions["BroughtUp"][:2] == ("True", "BroughtUp")


async def test_a_failed_procedure_is_reported_once_and_tried_again_later(world: World) -> None:
    world.agents.fails = "initialization.set_lifecycle: node /nav did not configure"
    await world.look()
    await world.look()
    status, reason, message = world.notices.conditions["BroughtUp"]
    assert (status, reason) == ("False", "ProcedureFailed")
    assert_golden(
        "monitor", message, "w-3: initialization.set_lifecycle", "/nav", "spec.initialization", "FallbackPool warm"
    )
    assert len(world.agents.ran) == 1
    world.clock.now += standby_lifecycle.RETRY_FIRST
    await world.look()
    assert len(world.agents.ran) == 2
    assert world.notices.reasons == ["NotBroughtUp"]


OTHER = Procedure(yaml={"wait_for": {"node": "/nav"}}, within="7s")


async def test_a_corrected_procedure_runs_at_once_and_the_problem_is_no_longer_reported(world: World) -> None:
    world.agents.ready["uid-3"] = False
    world.agents.fails = "initialization.set_lifecycle: node /nav did not configure"
    for _ in range(4):  # the wait for the next try grows
        await world.look()
        world.clock.now += standby_lifecycle.RETRY_MOST
    world.agents.fails = ""
    await world.look(pool=WARM.model_copy(update={"initialization": OTHER}))
    assert "did not configure" not in world.notices.conditions["BroughtUp"][2]
    await world.look(pool=WARM.model_copy(update={"initialization": OTHER}))
    assert world.notices.conditions["BroughtUp"][:2] == ("True", "BroughtUp")


async def test_a_procedure_that_does_not_end_is_stopped_when_its_time_limit_is_corrected(world: World) -> None:
    world.agents.endless = 3600.0
    endless = WARM.model_copy(update={"initialization": INIT.model_copy(update={"within": "1h"})})
    await world.look(pool=endless)
    await world.look(pool=endless)
    assert len(world.agents.ran) == 1
    await world.look()
    await world.look()
    assert len(world.agents.ran) == 2
    assert world.notices.conditions["BroughtUp"][:2] == ("True", "BroughtUp")


async def test_a_standby_that_is_briefly_not_ready_is_not_brought_up_again(world: World) -> None:
    await world.look()
    await world.look()
    world.agents.ready["uid-3"] = False
    await world.look(pool=WARM.model_copy(update={"initialization": OTHER}))
    assert world.agents.ran == [("w-3", "initialization")]
    assert world.roles.was_ready(STANDBY)


async def test_a_standby_whose_readiness_an_interrupted_procedure_took_away_is_brought_up_again(world: World) -> None:
    await world.look()
    await world.look()
    world.agents.brought["uid-3"] = (
        ""  # another monitor began a procedure on it and was stopped, or its container restarted
    )
    await world.look()
    assert world.agents.ran == [("w-3", "initialization")] * 2


async def test_a_standby_that_an_earlier_procedure_brought_up_is_reported(world: World) -> None:
    world.agents.brought["uid-3"] = "init:other:0"
    await world.look()
    assert world.agents.ran == []
    status, _, message = world.notices.conditions["BroughtUp"]
    assert status == "True"
    assert_golden("monitor", message, "w-3")


async def test_a_standby_that_is_not_ready_for_long_is_replaced_and_reported(world: World) -> None:
    await world.look()
    await world.look()
    world.agents.ready["uid-3"] = False
    await world.look()
    world.clock.now += standby_lifecycle.LOST_FOR - 0.1
    await world.look()
    assert world.objects.deleted == []
    world.clock.now += 0.2
    await world.look()
    await world.look()
    assert world.objects.deleted == ["w-3"]
    assert world.notices.events[-1][1] == "StandbyReplaced"
    assert "node /nav is gone" in world.notices.events[-1][2]


async def test_a_standby_that_becomes_ready_again_is_not_replaced(world: World) -> None:
    await world.look()
    world.agents.ready["uid-3"] = False
    await world.look()
    world.agents.ready["uid-3"] = True
    world.clock.now += standby_lifecycle.LOST_FOR
    await world.look()
    world.agents.ready["uid-3"] = False
    await world.look()
    assert world.objects.deleted == []


async def test_standbys_are_not_replaced_while_the_active_instance_fails(world: World) -> None:
    """The reason may be the robot, whose sensors are silent for all of them."""
    await world.look()
    world.agents.ready["uid-3"] = False
    world.notices.set(health="Failed")
    for _ in range(3):
        await world.look()
        world.clock.now += standby_lifecycle.LOST_FOR
    assert world.objects.deleted == []


async def test_a_standby_that_was_never_ready_is_not_replaced(world: World) -> None:
    world.agents.ready["uid-3"] = False
    for _ in range(3):
        await world.look()
        world.clock.now += standby_lifecycle.LOST_FOR
    assert world.objects.deleted == []


async def test_a_pod_without_an_agent_is_reported(world: World) -> None:
    await world.look(replace(ACTIVE, has_agent=False))
    status, reason, message = world.notices.conditions["BroughtUp"]
    assert (status, reason) == ("False", "NoAgent")
    assert message.startswith("The controller in spec.workloadRef created w-1, so the pod has no agent")


async def test_without_procedures_nothing_is_reported(world: World) -> None:
    world.keep_house(ACTIVE, spec=parsed_spec(), pool=HOT)
    assert world.notices.conditions == {}


async def test_the_condition_reports_that_there_are_no_procedures_after_their_removal(world: World) -> None:
    await world.look()
    world.keep_house(ACTIVE, spec=parsed_spec(), pool=HOT)
    assert world.notices.conditions["BroughtUp"][:2] == ("True", "NothingToDo")


async def test_an_unreadable_procedure_fails_with_its_place() -> None:
    procedure = BringUp.of("recovery", Procedure(xml=XML_CHECK.replace("LifecycleIs", "LifecycleWas")))
    assert procedure is not None
    objects = ClusterObjects()
    roles = InstanceRoles(objects.view, objects.gate, CurrentRecovery())
    agents = AgentConnections(
        objects.client, objects.view, "127.0.0.1", objects.crash_points, roles, objects.wakeups, objects.proof
    )
    with pytest.raises(NotVerified) as failure:
        await agents.run(STANDBY, procedure, within=1.0, state=KeptState(), brought="")
    assert_golden("monitor", str(failure.value), "line 3, column 1", "LifecycleWas", "'LifecycleIs'")
