"""The interfaces of instances that the gate does not control, from what their agents report."""

from __future__ import annotations

import pytest

from tests.unit.monitor.cluster_objects import ClusterObjects
from tests.unit.monitor.senses import GivenSenses
from understudy.api.protocol.agent_messages import AgentStatus
from understudy.failover.interfaces import Instance
from understudy.monitor.observe.pod_interfaces import PodInterfaces

ACTIVE = Instance("w-1", "uid-1", ip="10.0.0.1", running=True, ready=True)
STANDBY = Instance("w-2", "uid-2", ip="10.0.0.2", running=True, ready=True, pool="hot")


class World:
    """A workload with an active instance and a standby."""

    def __init__(self) -> None:
        self.objects = ClusterObjects()
        self.objects.put_pods(ACTIVE, STANDBY)
        self.agents = GivenSenses(self.objects).agents
        self.interfaces = PodInterfaces(self.objects.pods, self.agents)

    def report(self, instance: Instance, **interfaces: tuple[str, ...]) -> None:
        """Have an instance's agent report these interfaces."""
        self.agents.statuses[instance.uid] = AgentStatus("Running", further_interfaces=interfaces)


@pytest.fixture
def world() -> World:
    return World()


def test_nothing_is_found_if_no_agent_reports_an_interface(world: World) -> None:
    world.report(ACTIVE)
    assert world.interfaces.further() == ""


@pytest.mark.parametrize("instance", [ACTIVE, STANDBY], ids=["active", "standby"])
def test_the_instance_the_interface_and_its_addresses_are_named(world: World, instance: Instance) -> None:
    world.report(instance, net1=("192.168.7.2", "fd12::2"))
    found = world.interfaces.further()
    assert f"{instance.name} has net1 (192.168.7.2, fd12::2)" in found
    other = STANDBY if instance is ACTIVE else ACTIVE
    assert other.name not in found


def test_every_instance_and_interface_is_named(world: World) -> None:
    world.report(STANDBY, net1=("192.168.7.2",), net2=("192.168.8.2",))
    world.report(ACTIVE, net1=("192.168.7.1",))
    found = world.interfaces.further()
    assert "w-1 has net1 (192.168.7.1); w-2 has net1 (192.168.7.2), net2 (192.168.8.2)" in found


def test_an_interface_stays_while_its_agent_is_not_connected(world: World) -> None:
    world.report(STANDBY, net1=("192.168.7.2",))
    before = world.interfaces.further()
    world.agents.statuses.clear()
    assert world.interfaces.further() == before != ""
    world.report(STANDBY)
    assert world.interfaces.further() == ""


def test_the_interfaces_of_a_pod_that_is_gone_do_not_count(world: World) -> None:
    world.report(STANDBY, net1=("192.168.7.2",))
    assert world.interfaces.further()
    world.objects.put_pods(ACTIVE)
    assert world.interfaces.further() == ""
