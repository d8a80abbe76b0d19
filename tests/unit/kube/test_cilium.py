"""What Cilium's limits mean for a gate: how much of a policy map it needs, and which robots are at a node."""

from __future__ import annotations

import pytest

from tests.support.cilium import EACH, NAME, identity, policies
from understudy.api import names
from understudy.kube.client import Object
from understudy.kube.gates import cilium
from understudy.kube.gates.base import Reach
from understudy.kube.gates.cilium import ENTRIES, PolicyMapUse, Settings
from understudy.kube.gates.policy_entries import Peers

ROBOT: Object = {"podSelector": {"matchLabels": {"app": "robot-17"}}}


def use(identities: list[Object], mine: list[Object] | None = None) -> PolicyMapUse | None:
    found = {one["metadata"]["name"]: one for one in (policies() if mine is None else mine)}
    return cilium.policy_map_use(NAME, "fleet", found, Peers(map(cilium.peer, identities)), Settings())


def test_each_pod_of_the_namespace_needs_entries() -> None:
    found = use([identity(number) for number in range(100)])
    assert found is not None
    assert (found.needed, found.each) == (100 * EACH, EACH)


def test_a_workload_without_policies_or_without_peers_needs_none() -> None:
    assert use([identity(1)], []) is None
    assert use([]) is None


def test_pods_of_other_namespaces_count_only_if_a_peer_selects_their_namespace() -> None:
    elsewhere = identity(17, namespace="sites", namespace_labels={"site": "north"})
    own = identity(1, **{names.WORKLOAD: NAME})
    everything = [elsewhere, own]
    assert use(everything) is None
    for selector, count in (({"matchLabels": {"site": "north"}}, 1), ({"matchLabels": {"site": "south"}}, 0)):
        found = use(everything, policies(Reach(peers=({**ROBOT, "namespaceSelector": selector},))))
        assert (found.needed if found else 0) == count * EACH


def test_a_peer_that_several_entries_of_a_rule_select_counts_once() -> None:
    found = use([identity(17)], policies(Reach(peers=(ROBOT, {"podSelector": {}}))))
    assert found is not None
    assert found.needed == EACH


@pytest.mark.parametrize(
    ("needed", "is_low", "is_exceeded", "percent"),
    [
        (int(0.7 * ENTRIES), False, False, 70),
        (int(0.7 * ENTRIES) + 1, True, False, 71),
        (ENTRIES, True, False, 100),
        (ENTRIES + 1, True, True, 101),
    ],
)
def test_the_room_is_low_from_70_percent_and_exceeded_beyond_the_limit(
    needed: int, is_low: bool, is_exceeded: bool, percent: int
) -> None:
    found = PolicyMapUse(needed, EACH, Settings())
    assert (found.is_low, found.is_exceeded, found.percent) == (is_low, is_exceeded, percent)


def test_settings_are_read_from_the_data_of_the_config_map() -> None:
    assert Settings.of({}) == Settings(ENTRIES)
    data = {
        "bpf-policy-map-max": "65536",
        "enable-endpoint-lockdown-on-policy-overflow": "true",
        "policy-cidr-match-mode": "nodes",
    }
    assert Settings.of(data) == Settings(65536, closes=True, matches_nodes=True)


@pytest.mark.parametrize("text", ["", "many", "16k", "1.5", "-1", "0", "1_000", "٣"])
def test_a_size_of_the_maps_that_is_no_number_is_named_and_the_default_assumed(text: str) -> None:
    found = Settings.of({"bpf-policy-map-max": text})
    assert found.entries == ENTRIES
    assert "bpf-policy-map-max" in found.doubt
    assert repr(text) in found.doubt


def node(name: str, *addresses: object) -> Object:
    listed = [{"type": "Hostname", "address": name}, *({"type": "InternalIP", "address": one} for one in addresses)]
    return {"metadata": {"name": name}, "status": {"addresses": listed}}


@pytest.mark.parametrize(
    ("robot", "found"),
    [
        ("10.0.0.7/32", [("10.0.0.7", "node1")]),
        ("10.0.0.0/24", [("10.0.0.7", "node1"), ("10.0.0.8", "node2")]),
        ("fd00::7/128", [("fd00::7", "node1")]),
        ("192.168.7.20/32", []),
        ("no address", []),
        (7, []),
    ],
)
def test_robots_at_the_address_of_a_node_are_found(robot: object, found: list[tuple[str, str]]) -> None:
    nodes = [node("node1", "10.0.0.7", "fd00::7"), node("node2", "10.0.0.8"), node("node3", "nowhere", None), {}]
    assert list(cilium.at_nodes([robot], nodes)) == found
