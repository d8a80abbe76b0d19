"""The interfaces of instances that the gate does not control, from what their agents report and what their objects show."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest

from tests.unit.monitor.cluster_objects import NAMESPACE, ClusterObjects
from tests.unit.monitor.senses import GivenSenses
from understudy.api.protocol.agent_messages import AgentStatus
from understudy.failover.interfaces import Instance
from understudy.kube.client import PODS
from understudy.monitor.observe.pod_interfaces import PodInterfaces

ACTIVE = Instance("w-1", "uid-1", ip="10.0.0.1", running=True, ready=True)
STANDBY = Instance("w-2", "uid-2", ip="10.0.0.2", running=True, ready=True, pool="hot")


class World:
    """A workload with an active instance and a standby."""

    def __init__(self) -> None:
        self.objects = ClusterObjects()
        self.objects.put_pods(ACTIVE, STANDBY)
        self.agents = GivenSenses(self.objects).agents
        self.interfaces = PodInterfaces(self.objects.view, self.objects.pods, self.agents)

    def report(self, instance: Instance, **interfaces: tuple[str, ...]) -> None:
        """Have an instance's agent report these interfaces."""
        self.agents.statuses[instance.uid] = AgentStatus("Running", further_interfaces=interfaces)

    def change(self, instance: Instance, *, annotations: dict[str, str] | None = None, **spec: Any) -> None:
        """Have these annotations and fields of the spec in an instance's pod."""
        objects = self.objects
        pod = objects.view.pods.items[instance.name]
        metadata = {**pod["metadata"], "annotations": annotations or {}}
        changed = {**pod, "metadata": metadata, "spec": {**pod["spec"], **spec}}
        objects.view.pods.put(objects.client.store(PODS, NAMESPACE, changed))


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


POD_NETWORK = {"name": "kindnet", "interface": "eth0", "ips": ["10.0.0.2"], "default": True}
"""What Multus reports of the interface that every pod has."""


def _status(*networks: Any) -> dict[str, str]:
    return {"k8s.v1.cni.cncf.io/network-status": json.dumps(networks)}


def test_an_interface_in_the_annotation_of_a_pod_without_an_agent_is_named(world: World) -> None:
    source = dataclasses.replace(ACTIVE, has_agent=False)
    world.objects.put_pods(source, STANDBY)
    own = {"interface": "eth0", "ips": ["10.0.0.1"]}
    lan = {"name": "fleet/robot-lan", "interface": "net1", "ips": ["192.168.7.1"], "mac": "02:00:00:00:00:01"}
    world.change(source, annotations=_status(own, lan))
    assert "w-1 has net1 (192.168.7.1)." in world.interfaces.further()


def test_an_interface_without_an_address_in_the_annotation_counts(world: World) -> None:
    world.change(STANDBY, annotations=_status(POD_NETWORK, {"name": "fleet/raw", "interface": "net1"}))
    assert "w-2 has net1." in world.interfaces.further()


def test_an_interface_that_agent_and_annotation_report_is_named_once(world: World) -> None:
    world.report(STANDBY, net1=("192.168.7.2",))
    world.change(STANDBY, annotations=_status(POD_NETWORK, {"interface": "net1", "ips": ["192.168.7.2"]}))
    assert "w-2 has net1 (192.168.7.2)." in world.interfaces.further()


@pytest.mark.parametrize(
    "annotations",
    [
        _status(POD_NETWORK),
        _status({"name": "kindnet", "interface": "eth0", "ips": ["10.0.0.2"]}),
        _status(POD_NETWORK, {"name": "kindnet", "interface": "eth0", "ips": ["fd00::2"]}),
        _status(),
        *(
            {"k8s.v1.cni.cncf.io/network-status": text}
            for text in ("", "{", "{}", "[1]", '[{"ips": 1}]', "[" * 100_000)
        ),
    ],
    ids=["default", "by-address", "two-families", "none", "empty", "cut", "object", "number", "no-addresses", "nested"],
)
def test_the_pod_network_and_unreadable_annotations_are_no_further_interface(
    world: World, annotations: dict[str, str]
) -> None:
    world.change(STANDBY, annotations=annotations)
    assert world.interfaces.further() == ""


def test_a_pod_that_has_no_address_yet_is_not_known_to_have_further_interfaces(world: World) -> None:
    starting = dataclasses.replace(STANDBY, ip="", running=False)
    world.objects.put_pods(ACTIVE, starting)
    world.change(starting, annotations=_status({"interface": "eth0", "ips": ["10.0.0.2"]}))
    assert world.interfaces.further() == ""


@pytest.mark.parametrize("annotation", ["k8s.v1.cni.cncf.io/networks", "v1.multus-cni.io/default-network"])
def test_a_pod_that_asks_for_other_networks_is_named(world: World, annotation: str) -> None:
    world.change(STANDBY, annotations={annotation: "robot-lan"})
    assert f"metadata.annotations[{annotation}]" in world.interfaces.further()


def test_a_pod_in_the_network_of_its_node_is_named(world: World) -> None:
    world.change(ACTIVE, hostNetwork=True)
    assert "w-1 has the network of its node (spec.hostNetwork)" in world.interfaces.further()
