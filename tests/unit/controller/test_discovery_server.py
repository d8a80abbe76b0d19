"""A discovery server learns its predecessor on a lost node from the operator. Its Service is written again after a new server starts."""

from __future__ import annotations

import copy
from datetime import UTC, datetime

import pytest

from tests.unit.controller.world import World, applied, created, hot, pod, policy, workload
from understudy.api import names
from understudy.controller.plan import Delete, Patch
from understudy.kube.client import EVICTION, Object


@pytest.fixture
def world() -> World:
    made = World(workload(), policy("hot", "Restart"), hot())
    made.build()
    return made


def leaving(name: str, *, evicted: bool) -> Object:
    made = pod(name, ready=False, deletionTimestamp="2026-01-01T00:00:00Z")
    if evicted:
        made["status"]["conditions"].append({"type": "DisruptionTarget", "status": "True", "reason": EVICTION})
    return made


def writes(world: World) -> list[tuple[str, str]]:
    """The patches and deletions of discovery servers."""
    servers = {server["metadata"]["uid"] for server in world.discovery}
    return [
        (type(write).__name__, write.item["metadata"]["name"])
        for write in world.plan().writes
        if isinstance(write, Patch | Delete) and write.item["metadata"].get("uid") in servers
    ]


def marked(server: Object, beside: str) -> Object:
    found = copy.deepcopy(server)
    found["metadata"]["annotations"] = {names.BESIDE: beside}
    return found


def test_the_server_prefers_a_node_without_an_instance_of_its_workload(world: World) -> None:
    template = applied(world.plan(), "deployments")["w-discovery"]["spec"]["template"]
    (term,) = template["spec"]["affinity"]["podAntiAffinity"]["preferredDuringSchedulingIgnoredDuringExecution"]
    assert term["weight"] == 100, "no other preference outweighs it"
    assert term["podAffinityTerm"]["topologyKey"] == "kubernetes.io/hostname"
    avoided = term["podAffinityTerm"]["labelSelector"]["matchLabels"].items()
    (standby,) = created(World(workload(), policy("hot"), hot()).plan(), "pods")
    active = applied(world.plan(), "replicasets")["w"]["spec"]["template"]
    assert avoided <= active["metadata"]["labels"].items()
    assert avoided <= standby["metadata"]["labels"].items()
    assert not avoided <= template["metadata"]["labels"].items(), "it does not avoid its own predecessor"


def test_a_server_learns_beside_which_one_on_a_lost_node_it_began(world: World) -> None:
    lost, successor = leaving("w-discovery-1", evicted=True), pod("w-discovery-2")
    lost["status"]["podIP"] = "10.0.0.7"
    world.discovery = [lost, successor]
    assert writes(world) == [("Patch", "w-discovery-2")]
    (patch,) = (write for write in world.plan().writes if isinstance(write, Patch) and write.item == successor)
    note = patch.body["metadata"]["annotations"][names.BESIDE]
    assert note == "uid-w-discovery-1/10.0.0.7", "with its address, the successor can end one that comes back"
    world.discovery = [lost, marked(successor, note)]
    assert writes(world) == [], "it may still live on"
    world.discovery = [marked(successor, note)]
    assert writes(world) == [], "its process may outlive the object"
    next_lost = leaving("w-discovery-3", evicted=True)
    world.discovery = [next_lost, marked(successor, note)]
    assert writes(world) == [("Patch", "w-discovery-2")]


def test_the_service_is_written_again_at_intervals_after_a_new_server_is_ready(world: World) -> None:
    def service(age: float, *servers: Object) -> tuple[str | None, float | None]:
        for server in servers:
            server["metadata"]["creationTimestamp"] = datetime.fromtimestamp(world.now - age, UTC).isoformat()
        world.discovery = list(servers)
        plan = world.plan()
        found = applied(plan, "services")["w-discovery"]["metadata"].get("annotations") or {}
        return found.get(names.SERVER), plan.again_after

    first = pod("w-discovery-1")
    assert service(4.0, first) == ("uid-w-discovery-1/0s", pytest.approx(6.0))
    assert service(12.0, first) == ("uid-w-discovery-1/10s", pytest.approx(18.0))
    assert service(1000.0, first) == ("uid-w-discovery-1/90s", None)
    world.build()
    not_ready = pod("w-discovery-2", ready=False)
    assert service(1.0, not_ready) == ("uid-w-discovery-1/90s", None), "it is not written for that"
    assert service(1.0, pod("w-discovery-2"))[0] == "uid-w-discovery-2/0s"


def test_a_server_whose_predecessor_was_deleted_otherwise_stays(world: World) -> None:
    world.discovery = [leaving("w-discovery-1", evicted=False), pod("w-discovery-2")]
    assert writes(world) == []
    world.discovery = [pod("w-discovery-2")]
    assert writes(world) == []
