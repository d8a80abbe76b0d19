"""Which standby is let through beside the pod in control, when no longer, and what is said about it."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import pytest

from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.senses import GivenSenses
from understudy.api.protocol.agent_messages import AgentStatus
from understudy.failover.interfaces import GateState, Instance
from understudy.monitor.act.gate.reflex_guard import TOO_STRONG_FOR, ReflexGuard
from understudy.monitor.judge.gate_enforcement import SETTLE, SILENT
from understudy.monitor.judge.reflex_takeover import CHECK_PERIOD, ReflexTakeover

NOW = 1000.0
TOPIC = "/cmd_vel"


class World:
    """A workload with a reflex, one active pod and one standby."""

    def __init__(self) -> None:
        self.objects = ClusterObjects()
        self.senses = GivenSenses(self.objects)
        self.now = NOW
        self.pods: dict[str, Instance] = {}
        self.objects.put_workload(gate={"reflex": {"deadline": "100ms"}})
        self.objects.put_settings(pools=[{"name": "hot", "readiness": "Executing"}])
        self.objects.put_gate(GateState(epoch=1, active="w-1", active_uid="uid-w-1"))
        for name, strength in (("w-1", 200), ("w-2", 100)):
            self.add(name, strength)
        self.arrives("w-1", *(NOW - 0.05 * i for i in range(150)))
        self.takeover = ReflexTakeover(
            self.objects.view,
            self.objects.pods,
            self.objects.gate,
            self.senses.observer,
            self.senses.value.probes,
        )
        self.reflexes = ReflexGuard(self.objects.cluster, self.senses.value, self.takeover, self.objects.notices)

    def add(self, name: str, *strength: int, claim: str = "") -> None:
        """Have a pod whose writers have this strength: one, or from one up to another."""
        pool = "" if name == "w-1" else "hot"
        self.pods[name] = Instance(name=name, uid=f"uid-{name}", running=True, pool=pool, claim=claim)
        self.objects.put_pods(*self.pods.values())
        self.strength(name, *strength)

    def remove(self, name: str) -> None:
        """Have a pod no more."""
        del self.pods[name]
        self.objects.put_pods(*self.pods.values())

    def strength(self, name: str, *strength: int) -> None:
        """Have an agent report the strength of its instance's writers, or none."""
        found = (strength[0], strength[-1]) if strength else None
        self.senses.agents.statuses[f"uid-{name}"] = AgentStatus(strength=found)

    def unready(self, name: str) -> None:
        """Have a pod whose health tree fails."""
        self.senses.agents.unready[f"uid-{name}"] = "no /cmd_vel for 500 ms"

    def arrives(self, name: str, *moments: float) -> None:
        """Have the outputs of a pod be received at these times."""
        self.senses.observer.received[TOPIC, name] = sorted(moments)

    def arrivals(self, name: str) -> Sequence[float]:
        """When they were received."""
        return self.senses.observer.arrivals(TOPIC, name)

    def api_away(self) -> None:
        """Have no write be answered."""
        self.objects.client.failing = lambda method, name: TimeoutError()

    @property
    def writes(self) -> list[str]:
        """The standby in each write of the gate; empty for none."""
        return self.objects.admissions

    @property
    def message(self) -> str:
        """What the condition says."""
        return self.objects.notices.conditions["Reflex"][2]

    async def settle(self) -> None:
        """Let what was begun be done."""
        for _ in range(5):
            await asyncio.sleep(0)

    async def keep(self, *, enforced: str = "True", paused: bool = False, seconds: float = 10.0) -> tuple[str, str]:
        """Housekeeping for so long, while the pod in control goes on. Returns status and reason of the condition."""
        for _ in range(int(seconds)):
            self.now += 1
            self.arrives("w-1", *(time + 1 for time in self.arrivals("w-1")))
            self.reflexes.keep(self.now, enforced=(enforced, "Reason", "w-2 has net1."), paused=paused)
            await self.settle()
        return self.objects.notices.conditions["Reflex"][:2]


@pytest.fixture
def world() -> World:
    return World()


async def test_a_healthy_weaker_standby_is_admitted_after_the_gate_was_proven(world: World) -> None:
    assert await world.keep(enforced="Unknown") == ("Unknown", "GateNotProven")
    assert not world.writes
    assert await world.keep(seconds=2) == ("True", "Armed")
    assert world.writes == ["w-2"], "written once"


async def test_no_standby_is_admitted_while_the_gate_is_not_enforced_and_the_reason_is_reported(world: World) -> None:
    assert await world.keep(enforced="False") == ("False", "GateNotProven")
    assert not world.writes
    assert "w-2 has net1." in world.message


async def test_a_standby_is_admitted_after_it_was_ready_long_enough_for_the_proof(world: World) -> None:
    await world.keep(seconds=SETTLE)
    assert not world.writes
    await world.keep(seconds=2)
    assert world.writes == ["w-2"]


async def test_the_strongest_of_several_standbys_is_admitted(world: World) -> None:
    world.add("w-3", 150)
    world.add("w-4", 50)
    await world.keep()
    assert world.writes == ["w-3"]


async def test_a_standby_that_a_recovery_claimed_is_not_admitted(world: World) -> None:
    world.add("spare-1", 150, claim="recovery-1")
    await world.keep()
    assert world.writes == ["w-2"], "the other is about to be deleted"


async def test_a_standby_that_is_no_longer_healthy_is_shut_out_at_once(world: World) -> None:
    await world.keep()
    world.reflexes.guard()
    assert world.writes == ["w-2"], "while it's healthy nothing is written"
    world.unready("w-2")
    world.reflexes.guard()
    await world.settle()
    assert world.writes == ["w-2", ""]
    assert world.objects.gate.state.admitted == ""
    assert await world.keep() == ("False", "NoStandby")
    assert "w-2: no /cmd_vel for 500 ms" in world.message


async def test_no_standby_is_admitted_during_a_pause_and_one_is_afterwards(world: World) -> None:
    await world.keep()
    assert await world.keep(paused=True, seconds=2) == ("False", "Paused")
    assert world.writes == ["w-2", ""]
    assert await world.keep(paused=True) == ("False", "Paused")
    assert world.writes == ["w-2", ""]
    assert await world.keep(seconds=2) == ("True", "Armed")
    assert world.writes == ["w-2", "", "w-2"]


async def test_a_missing_standby_is_shut_out_too(world: World) -> None:
    await world.keep()
    world.remove("w-2")
    world.reflexes.guard()
    await world.settle()
    assert world.writes == ["w-2", ""]


async def test_a_failed_write_is_retried_after_a_while(world: World) -> None:
    await world.keep()
    world.api_away()
    world.unready("w-2")
    for _ in range(50):
        world.reflexes.guard()
        await world.settle()
    assert world.writes == ["w-2", ""]


@pytest.mark.parametrize("strength", [200, 201])
async def test_a_standby_that_is_not_weaker_than_the_active_instance_is_replaced(world: World, strength: int) -> None:
    world.strength("w-2", 50, strength)
    assert await world.keep(seconds=3) == ("False", "StandbyTooStrong")
    assert not world.objects.deleted
    await world.keep(seconds=TOO_STRONG_FOR + 10)
    assert world.objects.deleted == ["w-2"], "once: where clocks differ another would be no better"
    assert not world.writes


async def test_a_restarted_active_instance_counts_with_its_lowest_strength(world: World) -> None:
    world.strength("w-1", 90, 200)
    assert await world.keep(seconds=3) == ("False", "StandbyTooStrong")


async def test_while_the_active_strength_is_unknown_nothing_changes(world: World) -> None:
    await world.keep()
    world.strength("w-1")
    assert await world.keep() == ("Unknown", "StrengthUnknown")
    assert world.writes == ["w-2"]


async def test_commands_slower_than_the_deadline_are_reported_and_no_standby_is_admitted(world: World) -> None:
    world.arrives("w-1", *(NOW - 0.2 * i for i in range(50)))
    assert await world.keep() == ("False", "DeadlineTooShort")
    assert "gaps of up to 200 ms" in world.message
    assert not world.writes


async def test_no_standby_is_admitted_before_the_command_period_is_known(world: World) -> None:
    world.arrives("w-1")
    assert await world.keep() == ("Unknown", "Measuring")
    assert not world.writes


async def test_pods_that_cannot_be_distinguished_have_no_reflex(world: World) -> None:
    world.senses.observer.twins = {"w-1", "w-2"}
    assert await world.keep() == ("False", "Ambiguous")
    assert not world.writes


async def test_a_standby_whose_packets_do_not_arrive_is_reported(world: World) -> None:
    await world.keep()
    assert await world.keep(seconds=SILENT + 2) == ("False", "Blocked")
    world.objects.packets["uid-w-2"] = world.now
    assert await world.keep(seconds=1) == ("True", "Armed")


# -- noticing ------------------------------------------------------------------------------------------------------


async def test_a_takeover_by_the_admitted_standby_is_detected(world: World) -> None:
    await world.keep()
    last = world.arrivals("w-1")[-1]
    assert world.takeover.detect(last + 0.2) is None, "silence alone is nothing"
    world.arrives("w-2", last + 0.12)
    taken = world.takeover.detect(last + 0.13)
    assert taken is not None
    assert (taken.standby.name, taken.last, taken.first) == ("w-2", last, last + 0.12)


async def test_a_standby_that_is_not_admitted_cannot_take_over(world: World) -> None:
    world.arrives("w-2", world.arrivals("w-1")[-1] + 0.12)
    assert world.takeover.detect(world.arrivals("w-2")[-1] + 1) is None


async def test_a_takeover_is_checked_at_the_deadline_and_then_repeatedly_for_a_limited_time(world: World) -> None:
    assert world.takeover.next_check(NOW) is None, "nobody is let through"
    await world.keep()
    last = world.arrivals("w-1")[-1]
    assert world.takeover.next_check(last + 0.02) == pytest.approx(last + 0.1)
    assert world.takeover.next_check(last + 0.15) == pytest.approx(last + 0.15 + CHECK_PERIOD)
    assert world.takeover.next_check(last + 5) is None, "it may be at rest"


async def test_a_clock_that_is_set_back_does_not_shut_out_a_standby(world: World) -> None:
    await world.keep(enforced="False", seconds=1)
    world.now -= 3600
    world.arrives("w-1", *(time - 3600 for time in world.arrivals("w-1")))
    assert await world.keep() == ("True", "Armed")


async def test_with_a_mux_too_short_a_deadline_would_make_the_mux_switch() -> None:
    world = World()
    world.objects.put_workload(gate={"kind": "Mux", "reflex": {"deadline": "100ms"}})
    for name in ("w-1", "w-2"):
        world.strength(name)
    world.arrives("w-1", *(world.now - 3 + 0.2 * number for number in range(15)))
    assert await world.keep() == ("False", "DeadlineTooShort")
    assert "the mux would switch" in world.message


async def test_with_a_mux_a_ready_standby_is_admitted_whatever_the_strength_of_its_writers() -> None:
    world = World()
    world.objects.put_workload(gate={"kind": "Mux", "reflex": {"deadline": "100ms"}})
    for name in ("w-1", "w-2"):
        world.strength(name)
    assert await world.keep() == ("True", "Armed")
    assert world.writes == ["w-2"]
    assert "The mux switches to w-2 by itself if w-1 is silent for 100 ms" in world.message
