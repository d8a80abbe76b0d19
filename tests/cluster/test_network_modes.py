"""The modes of the local cluster's network (`scripts/cluster network`), by packets between pods: what each of them lets through that
the network should not, and that it ends.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterator

import pytest

from tests.cluster.policy_pods import REPOSITORY, World, policy, selector
from tests.support.cluster import Cluster, Object, until

pytestmark = [pytest.mark.alone, pytest.mark.local_only]

PROGRAM = REPOSITORY / "scripts" / "cluster"
GATED = 7950
EVERY = 0.002
"""Seconds between two packets of a stream."""

LATE = 0.5
"""Delay that a busy machine may add, in seconds."""

SENDER = """
import socket, sys, time
talker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
number = 0
while True:
    try:
        talker.sendto(f"stream vanished {number} {time.time_ns()}".encode(), (sys.argv[1], 7950))
    except OSError:
        pass
    number += 1
    time.sleep(0.002)
"""


def program(*arguments: str) -> str:
    """What scripts/cluster says. Raises AssertionError if it fails."""
    done = subprocess.run([str(PROGRAM), *arguments], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def weaken(world: World) -> Iterator[Callable[..., None]]:
    """Gives the network of a node modes; it has none when the test has ended."""
    weak = set()

    def give(node: int, *modes: str) -> None:
        weak.add(world.nodes[node])
        program("network", world.nodes[node], *modes)

    world.enforce([])
    yield give
    for node in weak:
        program("network", node)


def shut(world: World, **labels: str) -> Object:
    """A policy that lets pods with these labels send nothing."""
    return policy(world, "shut", {"podSelector": selector(**labels), "policyTypes": ["Egress"]})


def stream(world: World, pod: str) -> None:
    """Have a pod send to the robot all the time."""
    world.expect([(pod, "robot", "udp", GATED)], [])
    world.agents[pod].ask("stream", name=pod, address=world.address("robot"), port=GATED, every=EVERY)


def last_sent(world: World, pod: str) -> float:
    """When the last packet of a pod was sent that arrived, in Unix seconds; the pod's stream ends."""
    world.agents[pod].ask("stop", name=pod)
    arrivals = world.agents["robot"].ask("arrivals")
    return max((sent for name, _, sent, _ in arrivals if name == pod), default=0) / 1e9


@pytest.mark.parametrize("protocol", ["udp", "tcp"])
def test_established_flows_live_on(world: World, weaken: Callable[..., None], protocol: str) -> None:
    world.expect([("active", "robot", protocol, 1000)], [])
    agent = world.agents["active"]
    assert agent.ask("open", flow=protocol, protocol=protocol, address=world.address("robot"), port=1000)
    weaken(0, "--established")
    world.enforce([shut(world, instance="active")])
    world.expect([], [("active", "robot", protocol, 1000)])
    assert agent.ask("say", flow=protocol), "the established flow has ended"
    weaken(0)
    assert not agent.ask("say", flow=protocol), "the flow goes on without the mode"


def test_a_stream_that_is_never_answered_is_established_too(world: World, weaken: Callable[..., None]) -> None:
    stream(world, "active")
    weaken(0, "--established")
    world.enforce([shut(world, instance="active")])
    world.expect([], [("active", "robot", "udp", GATED)])
    time.sleep(0.5)
    asked = time.time()
    weaken(0)
    ended = time.time()
    time.sleep(0.5)
    assert asked - LATE < last_sent(world, "active") < ended + 0.1


def test_a_deaf_node_applies_no_change(world: World, weaken: Callable[..., None]) -> None:
    world.expect([("active", "robot", "udp", GATED), ("distant", "robot", "udp", GATED)], [])
    weaken(0, "--deaf")
    world.enforce([policy(world, "shut", {"podSelector": {}, "policyTypes": ["Egress"]})])
    world.expect([("active", "robot", "udp", GATED)], [("distant", "robot", "udp", GATED)])
    time.sleep(1)
    assert not world.unexpected([("active", "robot", "udp", GATED)], [])
    weaken(0)
    world.expect([], [("active", "robot", "udp", GATED)])


def test_a_node_lags(world: World, weaken: Callable[..., None]) -> None:
    for pod in ("active", "distant"):
        stream(world, pod)
    weaken(0, "--lag", "800")
    asked = time.time()
    world.enforce([policy(world, "shut", {"podSelector": {}, "policyTypes": ["Egress"]})])
    time.sleep(0.8 + 2 * LATE)
    here, there = last_sent(world, "active"), last_sent(world, "distant")
    assert 0.5 < here - asked < 0.8 + LATE
    assert there - asked < LATE, "the other node lags too"


def test_a_change_of_labels_lags(world: World, weaken: Callable[..., None]) -> None:
    world.enforce([shut(world, instance="shut")])
    stream(world, "active")
    weaken(0, "--label-lag", "1.5")
    pod = world.pods["active"]
    asked = time.time()
    world.cluster.patch(pod, {"metadata": {"labels": {"instance": "shut"}}})
    try:
        world.cluster.create(policy(world, "other", {"podSelector": selector(app="camera"), "policyTypes": ["Egress"]}))
        world.expect([], [("camera", "robot", "udp", GATED)])
        time.sleep(max(0.0, asked + 1.5 + LATE - time.time()))
        assert 1.0 < last_sent(world, "active") - asked < 1.5 + LATE
    finally:
        world.cluster.patch(pod, {"metadata": {"labels": {"instance": "active"}}})


@pytest.fixture
def vanished(world: World, cluster: Cluster, weaken: Callable[..., None]) -> Iterator[str]:
    """A pod that sends to the robot and whose object is deleted by force, on a node whose kubelet cannot end it. The node."""
    world.agents["robot"].ask("arrivals")
    world.start("fleet", "vanished", {"app": "vanished"}, 2, [], ["python3", "-c", SENDER, world.address("robot")])
    world.ready()
    node = world.nodes[2 % len(world.nodes)]
    assert all(name == "vanished" or p["spec"]["nodeName"] != node for name, p in world.pods.items())
    weaken(2, "--keep-vanished")
    program("node", "stop-runtime", node)
    try:
        cluster.delete(world.pods.pop("vanished"))
        yield node
    finally:
        program("node", "start-runtime", node)
        until(lambda: _ready(cluster, node), f"{node} to be ready", seconds=60)


def test_a_vanished_pod_keeps_its_last_policy(world: World, vanished: str, weaken: Callable[..., None]) -> None:
    world.enforce([shut(world, app="vanished")])
    time.sleep(1)
    asked = time.time()
    world.agents["robot"].ask("arrivals")
    time.sleep(0.5)
    assert world.agents["robot"].ask("arrivals"), "the vanished pod is cut off"
    weaken(2)
    world.agents["robot"].ask("arrivals")
    ended = time.time()
    time.sleep(0.5)
    late = [sent for _, _, sent, _ in world.agents["robot"].ask("arrivals") if sent / 1e9 > ended]
    assert not late, f"{len(late)} packets of the vanished pod passed without the mode, {ended - asked:.1f} s after"


def test_unknown_modes_and_nodes_are_refused(world: World) -> None:
    done = subprocess.run([str(PROGRAM), "network", world.nodes[0], "--deff"], capture_output=True, text=True)
    assert (done.returncode, "--deff" in done.stderr) == (2, True), done.stderr
    done = subprocess.run([str(PROGRAM), "network", world.nodes[0], "--lag", "-1"], capture_output=True, text=True)
    assert (done.returncode, "negative" in done.stderr) == (1, True), done.stderr
    done = subprocess.run([str(PROGRAM), "network", "node99", "--deaf"], capture_output=True, text=True)
    assert (done.returncode, "no node 'node99'" in done.stderr) == (1, True), done.stderr


def _ready(cluster: Cluster, node: str) -> bool:
    found = cluster.get("v1", "Node", node)
    return any((c["type"], c["status"]) == ("Ready", "True") for c in found["status"]["conditions"])
