"""What NetworkPolicies do to packets between the pods of the cluster under test.

The gate of a workload stands on them, so they are tested themselves: with the table that the local cluster's enforcer is tested with
(testcluster/local/netpol), and, there, with what the enforcer promises beyond the specification.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tests.cluster.policy_pods import World, between_pods, policy, selector, table
from tests.support.cluster import Object

pytestmark = pytest.mark.xdist_group("network policies")  # one process starts the pods of the table

TABLE = table()
GATED = 7950
SWITCHES = 50


@pytest.mark.parametrize("case", TABLE["cases"], ids=[case["name"] for case in TABLE["cases"]])
def test_table(world: World, case: Object) -> None:
    world.enforce(world.policies(case))
    world.expect(between_pods(case.get("allowed", [])), between_pods(case.get("denied", [])))


def test_a_service_is_judged_by_its_pods(world: World) -> None:
    world.enforce([])
    service = world.cluster.create(
        {
            "apiVersion": "v1",
            "kind": "Service",
            "metadata": {"name": "robot", "namespace": world.spaces["fleet"]},
            "spec": {
                "selector": {"app": "robot"},
                "ports": [
                    {"name": "command", "protocol": "UDP", "port": 53, "targetPort": GATED},
                    {"name": "web", "protocol": "TCP", "port": 443, "targetPort": 8080},
                    {"name": "other", "protocol": "TCP", "port": 8080, "targetPort": 80},
                ],
            },
        }
    )
    address = service["spec"]["clusterIP"]
    active = [("active", "robot", "udp", 53), ("active", "robot", "tcp", 443)]
    standby = [("standby", "robot", "udp", 53), ("standby", "robot", "tcp", 443)]
    try:
        world.expect([*active, *standby, ("active", "robot", "tcp", 8080)], [], address)
        ports = [{"protocol": "UDP", "port": GATED}, {"protocol": "TCP", "port": 8080}]
        rule = {"from": [{"podSelector": selector(instance="active")}], "ports": ports}
        spec = {"podSelector": selector(app="robot"), "policyTypes": ["Ingress"], "ingress": [rule]}
        world.enforce([policy(world, "service", spec)])
        world.expect(active, [*standby, ("active", "robot", "tcp", 8080)], address)
    finally:
        world.cluster.delete({"apiVersion": "v1", "kind": "Service", "metadata": service["metadata"]})


@pytest.mark.local_only
@pytest.mark.parametrize("direction", ["Ingress", "Egress"])
@pytest.mark.parametrize("protocol", ["udp", "tcp"])
def test_an_established_flow_ends_with_its_permission(world: World, protocol: str, direction: str) -> None:
    world.enforce([])
    world.expect([("active", "robot", protocol, 1000)], [])
    agent, flow = world.agents["active"], f"{protocol} {direction}"
    assert agent.ask("open", flow=flow, protocol=protocol, address=world.address("robot"), port=1000)
    subject = {"Ingress": "robot", "Egress": "nav"}[direction]
    world.enforce([policy(world, "deny", {"podSelector": selector(app=subject), "policyTypes": [direction]})])
    world.expect([], [("active", "robot", protocol, 1000)])
    assert not agent.ask("say", flow=flow), "the established flow goes on"
    world.enforce([])
    world.expect([("active", "robot", protocol, 1000)], [])
    assert any(agent.ask("say", flow=flow) for _ in range(5)), "the flow does not go on after it was allowed again"


@pytest.fixture(scope="module")
def crowd(world: World) -> Iterator[int]:
    """UNDERSTUDY_TEST_CROWD more pods on the first node, a third as many workloads with a gate each: for figures at that size."""
    size = int(os.environ.get("UNDERSTUDY_TEST_CROWD", "0"))
    if size:
        space = f"{world.spaces['fleet']}-crowd"
        item = world.cluster.create({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": space}})
        world.spaces["crowd"] = space
        try:
            for number in range(size):
                instance = ("a", "b", "robot")[number % 3]
                app = f"w{number // 3}" if instance != "robot" else f"robot-of-w{number // 3}"
                name = f"w{number // 3}-{instance}"
                world.start("crowd", name, {"app": app, "instance": instance}, 0, [], ["sleep", "infinity"])
            world.ready()
            yield size
        finally:
            world.pods = {name: pod for name, pod in world.pods.items() if pod["metadata"]["namespace"] != space}
            del world.spaces["crowd"]
            world.cluster.delete(item)
    else:
        yield 0


def _crowds_policies(world: World, size: int) -> list[Object]:
    policies = []
    for workload in {f"w{number // 3}" for number in range(size)}:
        others = {"matchExpressions": [{"key": "app", "operator": "NotIn", "values": [workload]}]}
        peers: list[Object] = [{"namespaceSelector": {}, "podSelector": others}]
        open_ports: list[Object] = [{"protocol": "TCP", "port": 1, "endPort": 65535}]
        open_ports += [{"protocol": "UDP", "port": p, "endPort": q} for p, q in ((1, 7949), (8150, 65535))]
        standby: Object = {"podSelector": selector(app=workload), "policyTypes": ["Ingress", "Egress"]}
        standby |= {"ingress": [{"from": peers}], "egress": [{"to": peers, "ports": open_ports}]}
        gate = {"podSelector": selector(app=workload, instance="a"), "policyTypes": ["Egress"], "egress": [{}]}
        for name, spec in (("standby", standby), ("gate", gate)):
            item = policy(world, f"{workload}-{name}", spec)
            item["metadata"]["namespace"] = world.spaces["crowd"]
            policies.append(item)
    return policies


@pytest.mark.alone  # packets are counted in milliseconds
@pytest.mark.local_only
@pytest.mark.parametrize("other", ["standby", "distant"], ids=["on one node", "on two nodes"])
def test_a_gate_is_switched(world: World, crowd: int, other: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Two instances send all the time; the gate is switched between them; the receiver says whom it heard, and when."""
    closed = {
        "podSelector": {"matchExpressions": [{"key": "instance", "operator": "Exists"}]},
        "policyTypes": ["Egress"],
    }
    opened = {"podSelector": selector(instance="active"), "policyTypes": ["Egress"], "egress": [{}]}
    world.enforce([policy(world, "standby", closed), policy(world, "gate", opened), *_crowds_policies(world, crowd)])
    world.expect([("active", "robot", "udp", GATED)], [(other, "robot", "udp", GATED)])
    senders = ("active", other)
    for name in senders:
        world.agents[name].ask("stream", name=name, address=world.address("robot"), port=GATED, every=0.0005)
    gate = world.cluster.get("networking.k8s.io/v1", "NetworkPolicy", "gate", world.spaces["fleet"])
    gate = {"apiVersion": "networking.k8s.io/v1", "kind": "NetworkPolicy", **gate}
    world.agents["robot"].ask("arrivals")
    turns: list[Any] = []
    for turn in range(SWITCHES):
        to = senders[(turn + 1) % 2]
        asked = time.time_ns()
        world.cluster.patch(gate, {"spec": {"podSelector": selector(instance=to)}})
        turns.append((to, asked, time.time_ns()))
        time.sleep(0.08)
    ended = time.time_ns()
    for name in senders:
        world.agents[name].ask("stop", name=name)
    time.sleep(0.1)
    arrivals = world.agents["robot"].ask("arrivals")
    last_old, first_new, overlaps, missed = [], [], [], 0
    for (to, asked, answered), (_, ends, _) in zip(turns, [*turns[1:], ("", ended, 0)], strict=True):
        # Whoever sent and arrived between two requests was judged between them.
        own = [(name, sent, got) for name, _, sent, got in arrivals if asked <= sent and got < ends]
        new = [(sent, got) for name, sent, got in own if name == to]
        old = [sent for name, sent, _ in own if name != to]
        # On a busy machine an enforcer, or a sender, may miss a whole turn.
        first_new.append((min([sent for sent, _ in new], default=ends) - answered) / 1e6)
        missed += not new
        last_old.append((max(old, default=asked) - answered) / 1e6)
        # Sent after the first packet of the other had arrived: at this moment both were let through.
        heard = min([got for _, got in new], default=ends)
        overlaps.append(max([(sent - heard) / 1e6 for sent in old], default=-1.0))
    with capsys.disabled():
        title = f"gate between active and {other}, {crowd} more pods, {len(turns)} switches"
        print(f"\n  {title}, ms after the API's answer to the PATCH")
        for what, values in (("last packet let through of the old", last_old), ("first of the new", first_new)):
            ordered = sorted(values)
            p50, p95 = ordered[len(ordered) // 2], ordered[int(len(ordered) * 0.95)]
            print(f"  {what:36} p50 {p50:7.2f}  p95 {p95:7.2f}  max {ordered[-1]:7.2f}")
        both = [value for value in overlaps if value > 0]
        print(f"  both at once: {len(both)} times, longest {max(both, default=0.0):.2f} ms")
    assert missed <= len(turns) // 10, f"in {missed} of {len(turns)} turns nothing of the new instance arrived"
    if other == "standby":  # both on one node: one transaction
        assert not both, f"both were let through at once, for up to {max(both):.2f} ms"
    assert max(last_old) < 1000, "the gate did not close within a second"


# Sends from its first moment on, to an allowed port and to a gated one.
IMPATIENT = """
import socket, sys, time
talker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
number = 0
while True:
    for port in (1000, 7950):
        try:
            talker.sendto(f"stream {port} {number} {time.time_ns()}".encode(), (sys.argv[1], port))
        except OSError:
            pass
    number += 1
    time.sleep(0.002)
"""


@pytest.fixture
def impatient(world: World) -> Iterator[str]:
    """An instance behind a closed gate that sends to the robot all the time, from its start."""
    closed = {
        "podSelector": selector(app="impatient"),
        "policyTypes": ["Egress"],
        "egress": [{"to": [{"podSelector": {}}], "ports": [{"protocol": "UDP", "port": 1000}]}],
    }
    world.enforce([policy(world, "closed", closed)])
    world.expect([("active", "robot", "udp", GATED)], [])
    world.agents["robot"].ask("arrivals")
    command = ["python3", "-c", IMPATIENT, world.address("robot")]
    world.start("fleet", "impatient", {"app": "impatient"}, 0, [], command)
    world.ready()
    yield "impatient"
    world.cluster.delete(world.pods.pop("impatient"))


def _heard(world: World) -> dict[str, list[int]]:
    """When the robot heard something on which port (wall clock, ns)."""
    heard: dict[str, list[int]] = {"1000": [], "7950": []}
    for port, _, _, got in world.agents["robot"].ask("arrivals"):
        heard[port].append(got)
    return heard


@pytest.mark.local_only
def test_a_new_pod_is_judged_from_its_first_packet_on(world: World, impatient: str) -> None:
    time.sleep(0.5)
    heard = _heard(world)
    assert heard["1000"], "nothing arrives of what is allowed"
    assert not heard["7950"], f"{len(heard['7950'])} packets of a new pod passed a closed gate"


@pytest.mark.local_only
def test_a_pod_deleted_by_force_stays_behind_the_gate(world: World, impatient: str) -> None:
    """Its object is gone at once, its processes are not."""
    assert _heard(world)["1000"]
    asked = time.time_ns()
    world.cluster.delete(world.pods[impatient])
    time.sleep(2.0)
    heard = _heard(world)
    assert not heard["7950"], f"{len(heard['7950'])} packets passed the closed gate after the pod's object was deleted"
    late = [got for got in heard["1000"] if got - asked > 1e9]
    assert not late, "the pod is no pod any more, and still heard"
