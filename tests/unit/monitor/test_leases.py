"""What becomes of an instance that was cut off, and who may show that one isn't."""

from __future__ import annotations

import pytest

from understudy.api import names
from understudy.cluster.client import Object
from understudy.mitigation.interfaces import GateState, Instance
from understudy.mitigation.progress import PodIdentity, Progress
from understudy.monitor.leases import Word, witnesses, word
from understudy.ros.sources import VENDOR, host_id

ACTIVE, STANDBY = Instance("a", "uid-a", running=True), Instance("s", "uid-s", running=True)
BEFORE, AFTER = GateState(3, "a", "uid-a"), GateState(4, "s", "uid-s")
CLOSED = GateState(4)


def recovery(*failed: Instance, reflex: bool = False) -> Progress:
    pods = [PodIdentity(name=i.name, uid=i.uid) for i in failed]
    progress = Progress.begin("silent", last_healthy=0.0, detected=1.0, failed=pods)
    progress.taken_over = PodIdentity(name="s", uid="uid-s") if reflex else None
    return progress


@pytest.mark.parametrize(
    ("instance", "state", "replaced", "recovering", "expected"),
    [
        (ACTIVE, BEFORE, set(), None, "Go"),
        (STANDBY, BEFORE, set(), None, "Go"),
        (STANDBY, BEFORE, {"uid-s"}, None, "Stay"),
        (ACTIVE, BEFORE, {"uid-a"}, None, "Go"),
        (ACTIVE, BEFORE, set(), recovery(ACTIVE), "Go"),
        (ACTIVE, BEFORE, set(), recovery(ACTIVE, reflex=True), "Stay"),
        (STANDBY, BEFORE, set(), recovery(ACTIVE, reflex=True), "Go"),
        (STANDBY, BEFORE, set(), recovery(ACTIVE, STANDBY), "Stay"),
        (ACTIVE, CLOSED, set(), recovery(ACTIVE), "Stay"),
        (STANDBY, CLOSED, set(), recovery(ACTIVE), "Go"),
        (ACTIVE, AFTER, {"uid-a"}, None, "Stay"),
        (STANDBY, AFTER, {"uid-a"}, None, "Go"),
        (ACTIVE, AFTER, set(), recovery(ACTIVE, reflex=True), "Stay"),
    ],
)
def test_only_who_drives_or_stands_by_goes_on(
    instance: Instance, state: GateState, replaced: set[str], recovering: Progress | None, expected: Word
) -> None:
    assert word(instance, state, replaced, recovering) == expected
    ending = Instance(instance.name, instance.uid, running=True, terminating=True)
    assert word(ending, state, replaced, recovering) == "Stay"


def pod(name: str, ip: str, node: str, *, phase: str = "Running", host: bool = False, **labels: str) -> Object:
    return {
        "metadata": {
            "name": name,
            "uid": f"uid-{name}",
            "labels": {f"understudy.dev/{k}": v for k, v in labels.items()},
        },
        "spec": {"nodeName": node, **({"hostNetwork": True} if host else {})},
        "status": {"phase": phase, "podIP": ip},
    }


PODS = [
    pod("a", "10.1.1.1", "node1", workload="w"),
    pod("s", "10.1.2.1", "node2", workload="w"),
    pod("robot", "10.1.1.2", "node1"),
    pod("monitor", "10.1.2.2", "node2", monitored="w"),
    pod("near", "10.1.1.3", "node1"),
    pod("far-1", "10.1.2.3", "node2"),
    pod("far-2", "10.1.2.4", "node2"),
    pod("far-3", "10.1.2.5", "node2"),
    pod("further", "10.1.3.1", "node3"),
    pod("held", "10.1.3.2", "node3", held="true"),
    pod("done", "10.1.3.3", "node3", phase="Succeeded"),
    pod("daemon", "192.168.0.3", "node3", host=True),
]


def readers(*ips: str) -> set[bytes]:
    return {VENDOR + host_id(ip) for ip in ips}


def test_names_are_those_of_the_labels() -> None:
    assert {names.WORKLOAD, names.HELD, names.MONITORED} == {
        f"understudy.dev/{label}" for label in ("workload", "held", "monitored")
    }


def test_a_robot_counts_wherever_it_is_and_others_on_other_nodes_only() -> None:
    heard = readers("10.1.1.2", "10.1.2.2", "10.1.1.1")
    found = witnesses(ACTIVE, PODS, workload="w", readers=heard, robots=["203.0.113.7/32", "198.51.100.0/24"])
    assert found[:2] == ["203.0.113.7", "10.1.1.2"]
    assert set(found[2:4]) == {"10.1.2.3", "10.1.3.1"}, "of as many nodes as possible"
    assert len(found) == 5
    assert "10.1.1.3" not in found, "it would answer although the node is cut off"


def test_the_standby_on_another_node_has_others() -> None:
    found = witnesses(STANDBY, PODS, workload="w", readers=readers("10.1.1.2"), robots=[])
    assert found[0] == "10.1.1.2"
    assert set(found[1:]) >= {"10.1.1.3", "10.1.3.1"}
    assert not {"10.1.1.1", "10.1.3.2", "10.1.3.3", "192.168.0.3", "10.1.2.3"} & set(found)


def test_where_the_node_is_not_known_only_robots_count() -> None:
    stranger = Instance("x", "uid-x")
    assert witnesses(stranger, PODS, workload="w", readers=readers("10.1.1.2"), robots=[]) == ["10.1.1.2"]
