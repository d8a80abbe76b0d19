"""The monitor is not on the node of the active instance for long, because the loss of that node would end both."""

from __future__ import annotations

from typing import Any

import pytest

from tests.unit.controller.nodes import node, on
from tests.unit.controller.world import NOW, World, applied, gate, hot, pod, policy, source_pod, stamp, workload
from understudy.api import names
from understudy.controller.desired import discovery_server, monitor_placement
from understudy.kube.client import Object

KEY = "preferredDuringSchedulingIgnoredDuringExecution"


def world(monitor: str = "a", *, age: float = 3600.0, **status: Any) -> World:
    """A robot that has been driven for an hour by a pod on node a."""
    made = World(workload(status={"health": "Healthy", **status}), policy("hot", "Restart"), hot())
    made.build()
    active = on("a", source_pod("w-active", template_hash=made.own_hash, age=4000.0))
    made.nodes, made.pods = [node("a"), node("b")], [active]
    made.monitors = [on(monitor, pod("w-monitor-1", age=age))]
    made.own(gate(made.workload, active=active, epoch=2))
    return made


def avoided(made: World) -> list[str]:
    """The instances whose nodes the monitor's pod template avoids, beside those of the workload in general."""
    spec = applied(made.plan(), "deployments")[names.monitor("w")]["spec"]["template"]["spec"]
    terms = spec["affinity"]["podAntiAffinity"][KEY]
    chosen = [term["podAffinityTerm"]["labelSelector"]["matchLabels"] for term in terms]
    assert {names.WORKLOAD: "w"} in chosen
    return [labels[names.INSTANCE] for labels in chosen if names.INSTANCE in labels]


def test_a_monitor_beside_the_active_instance_is_replaced_on_another_node_once() -> None:
    made = world()
    assert avoided(made) == ["w-active"], "the change of its template replaces the pod"
    made.build()
    assert avoided(made) == ["w-active"], "the scheduler found no room elsewhere"
    made.monitors = [on("b", pod("w-monitor-2"))]
    assert avoided(made) == ["w-active"], "it stays"


def test_a_monitor_elsewhere_keeps_its_template_when_the_active_instance_changes() -> None:
    made = world("b")
    assert avoided(made) == []
    made = world()
    made.build()
    made.monitors = [on("b", pod("w-monitor-2"))]
    successor = on("c", source_pod("w-next", template_hash=made.own_hash))
    made.pods = [successor]
    made.own(gate(made.workload, active=successor, epoch=3))
    assert avoided(made) == ["w-active"]


@pytest.mark.parametrize(
    "made",
    [
        world(health="Recovering"),
        world(health="Failed"),
        world(switchover={"phase": "Preparing"}),
        world(age=monitor_placement.SETTLED_SECONDS - 1.0),
        world(recoveries=[{"id": "r", "moments": {"detected": stamp(NOW - monitor_placement.SETTLED_SECONDS + 1.0)}}]),
    ],
)
def test_it_stays_while_it_may_be_needed_soon(made: World) -> None:
    assert avoided(made) == []


def test_it_stays_without_another_node_that_accepts_it() -> None:
    made = world()
    made.nodes = [node("a"), node("b", taints=[{"key": "robots", "effect": "NoSchedule"}])]
    assert avoided(made) == []


@pytest.mark.parametrize(("storage", "moves"), [({}, []), ({"storage": {"claimName": "kept"}}, ["w-active"])])
def test_it_stays_if_recordings_would_be_lost_with_its_pod(storage: Object, moves: list[str]) -> None:
    made = world()
    made.others[0]["spec"] |= {"blackBox": {}, **({"state": {"topics": [], **storage}} if storage else {})}
    assert avoided(made) == moves


def test_the_decision_is_made_again_when_the_time_has_passed() -> None:
    made = world(age=monitor_placement.SETTLED_SECONDS - 5.0)
    assert made.plan().again_after == pytest.approx(5.0)


def test_a_pod_on_an_unreachable_node_is_replaced_sooner_than_on_one_that_is_only_not_ready() -> None:
    seconds = {one["key"]: one["tolerationSeconds"] for one in discovery_server.TOLERATIONS}
    assert seconds == {"node.kubernetes.io/not-ready": 10, "node.kubernetes.io/unreachable": 2}
