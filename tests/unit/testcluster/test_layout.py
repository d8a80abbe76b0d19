"""Addresses and names of local clusters: apart from each other and from what the machine already reaches."""

from __future__ import annotations

import ipaddress
from pathlib import Path

import pytest

from testcluster.local import layout
from testcluster.local.layout import BadSetting, Layout

pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="the local provider is for Linux")


@pytest.fixture(autouse=True)
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[ipaddress.IPv4Network]:
    """A machine without routes and links, and a cache of the test's own; the list is what it has routes to."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for variable in ("UNDERSTUDY_CLUSTER_ADDRESSES", "UNDERSTUDY_CLUSTER_NODES"):
        monkeypatch.delenv(variable, raising=False)
    routed: list[ipaddress.IPv4Network] = []
    monkeypatch.setattr(layout, "_routed", lambda: routed)
    monkeypatch.setattr(layout, "run", lambda *command: "[]")
    return routed


def made(name: str) -> Layout:
    decided = layout.decide(name)
    decided.save()
    return decided


def test_a_layout_is_stored_and_read_again() -> None:
    assert layout.load("one") is None
    decided = layout.decide("one", "cilium")
    decided.save()
    assert layout.load("one") == decided
    assert decided.enforcer == "cilium"


def test_two_clusters_share_neither_network_nor_link_nor_group() -> None:
    one, other = made("one"), made("other")
    assert not one.network.overlaps(other.network)
    assert one.host_link != other.host_link
    assert one.cgroup != other.cgroup


def test_the_same_name_in_another_cache_is_another_cluster(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    one = made("one")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "elsewhere"))
    assert layout.load("one") is None
    assert made("one").cgroup != one.cgroup


def test_a_network_that_the_machine_reaches_is_not_taken(machine: list[ipaddress.IPv4Network]) -> None:
    machine.append(ipaddress.IPv4Network("198.18.0.0/24"))
    assert not made("one").network.overlaps(machine[0])


def test_all_addresses_of_a_cluster_are_in_its_network_and_distinct(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UNDERSTUDY_CLUSTER_NODES", str(layout.MAX_NODES))
    decided = made("one")
    parts = [decided.services, *(decided.pod_network(node) for node in decided.nodes)]
    hosts = [decided.control_plane_ip, decided.host_ip, *(decided.node_ip(node) for node in decided.nodes)]
    hosts += [decided.machine_ip(machine) for machine in (1, 2)]
    parts += [ipaddress.IPv4Network(host) for host in hosts]
    assert all(part.subnet_of(decided.network) for part in parts)
    assert not any(a.overlaps(b) for number, a in enumerate(parts) for b in parts[:number])
    assert all(decided.pod_network(node).subnet_of(decided.pods) for node in decided.nodes)
    assert ipaddress.IPv4Address(decided.dns_ip) in decided.services


@pytest.mark.parametrize(
    ("variable", "value", "message"),
    [
        ("UNDERSTUDY_CLUSTER_ADDRESSES", "10.0.0.0/24", "a /18 is needed"),
        ("UNDERSTUDY_CLUSTER_ADDRESSES", "10.1.2.3/18", "host bits"),
        ("UNDERSTUDY_CLUSTER_ADDRESSES", "somewhere", "IPv4 network such as"),
        ("UNDERSTUDY_CLUSTER_NODES", "none", "a number from 0 to"),
        ("UNDERSTUDY_CLUSTER_NODES", "-1", "a number from 0 to"),
        ("UNDERSTUDY_CLUSTER_NODES", "32", "a number from 0 to"),
    ],
)
def test_an_invalid_setting_is_reported_with_its_name(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str, message: str
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(BadSetting, match=message) as refused:
        layout.decide("one")
    assert f"{variable}={value}" in str(refused.value)


def test_a_requested_network_that_is_in_use_is_refused(
    monkeypatch: pytest.MonkeyPatch, machine: list[ipaddress.IPv4Network]
) -> None:
    machine.append(ipaddress.IPv4Network("10.20.0.0/16"))
    monkeypatch.setenv("UNDERSTUDY_CLUSTER_ADDRESSES", "10.20.64.0/18")
    with pytest.raises(BadSetting, match=r"already reaches 10\.20\.0\.0/16"):
        layout.decide("one")


def test_an_unknown_node_is_refused_with_the_list_of_nodes() -> None:
    with pytest.raises(BadSetting, match="no node 'node9'; it has node1, node2, node3"):
        layout.node_number("node9", made("one"))
