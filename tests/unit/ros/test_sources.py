"""A sample is attributed to the pod that sent it, by the pod's address alone; a sample without a known source is reported."""

import itertools
import json
import os

import pytest

from tests.support.golden import assert_golden
from tests.support.network_namespaces import network
from understudy.ros.dds.host_ids import VENDOR, host_id
from understudy.ros.observe.sample_sources import Sources

SEEN = {
    # Host ids that Fast DDS 2.14 put into GIDs on hosts with these addresses.
    ("192.0.2.2",): "78fd",
    ("192.0.2.2", "198.18.0.254"): "23e3",
}


def gid(ip: str, tail: int = 1) -> bytes:
    return VENDOR + host_id(ip) + tail.to_bytes(12, "big")


def twins() -> tuple[str, str]:
    """Two addresses of one network with the same host id."""
    known: dict[bytes, str] = {}
    for third, fourth in itertools.product(range(256), range(1, 255)):
        ip = f"10.77.{third}.{fourth}"
        other = known.setdefault(host_id(ip), ip)
        if other != ip:
            return other, ip
    raise AssertionError("no two are the same")


@pytest.mark.parametrize(("ips", "expected"), SEEN.items())
def test_the_host_id_equals_that_of_fast_dds(ips, expected):
    assert host_id(*ips).hex() == expected


def test_a_sample_is_attributed_to_a_pod_by_its_address():
    sources = Sources({"p": "10.77.0.2", "f": "10.77.0.3"})
    assert (sources.pod(gid("10.77.0.2")), sources.pod(gid("10.77.0.3", 9)), sources.pod(gid("10.77.0.4"))) == (
        "p",
        "f",
        None,
    )
    assert sources.ambiguous == []
    assert list(sources.problems()) == []


def test_pods_with_the_same_host_id_are_not_distinguished_and_are_reported():
    first, second = twins()
    sources = Sources({"a": first, "b": second, "c": "192.0.2.2"})
    assert sources.pod(gid(first)) is None
    assert sources.candidates(gid(second)) == ("a", "b")
    assert sources.ambiguous == [("a", "b")]
    (problem,) = sources.problems()
    assert f"a ({first}), b ({second}) cannot be distinguished" in problem
    assert sources.pod(gid("192.0.2.2")) == "c"


def test_a_writer_of_another_implementation_belongs_to_no_pod():
    other = b"\x01\x10" + gid("10.77.0.2")[2:]
    assert Sources({"p": "10.77.0.2"}).candidates(other) == ()


@pytest.mark.parametrize("ip", ["", "fd00::1", "10.77.0"])
def test_a_pod_without_an_ipv4_address_is_unknown(ip):
    sources = Sources({"p": ip, "f": "10.77.0.3"})
    assert sources.unknown == ["p"]
    assert sources.pod(gid("10.77.0.3")) == "f"


def test_a_pod_with_an_ipv6_address_is_reported_and_one_without_an_address_is_not():
    (problem,) = Sources({"p": "fd00::1", "new": "", "f": "10.77.0.3"}).problems()
    assert_golden("monitor", problem, "p (fd00::1)", "IPv4")


needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")


@pytest.fixture
def lan(dds, monkeypatch):
    """Hosts on one switch, where nodes find each other by multicast."""
    monkeypatch.delenv("ROS_AUTOMATIC_DISCOVERY_RANGE")
    with network() as made:
        yield made


def watched(processes, lan, *, seconds=2.0, **wish):
    watcher = processes.node("watch", str(seconds), json.dumps(wish), inside=lan.host("10.77.200.1"))
    return json.loads(processes.line(watcher, 60))


@pytest.mark.ros
@needs_root
def test_real_publishers_on_separate_hosts_are_distinguished(lan, processes):
    pytest.importorskip("rclpy")
    pods = {"primary": "10.77.0.2", "fallback": "10.77.0.3"}
    for ip in pods.values():
        processes.node("publish", "/cmd_vel", "20", inside=lan.host(ip))
    processes.node("publish", "/scan", "10", inside=lan.host("10.77.100.1"))
    first, second = watched(
        processes, lan, topics={"/cmd_vel": 2, "/scan": 1}, instances=pods, active=["primary", "fallback"]
    )

    assert set(first["hosts"]["/cmd_vel"]) == {(VENDOR + host_id(ip)).hex() for ip in pods.values()}
    assert set(first["hosts"]["/scan"]) == {(VENDOR + host_id("10.77.100.1")).hex()}
    for source in (first, second):
        assert all(source["now"] - last < 1 for last in source["last"]["/cmd_vel"].values())
        # The robot's own topic counts whoever is in control, and is no pod's.
        assert source["counted"]["/scan"] == sum(count for count, _ in source["hosts"]["/scan"].values())
        assert source["others"]["/scan"] is None
    for source, active, other in ((first, "primary", "fallback"), (second, "fallback", "primary")):
        assert source["counted"]["/cmd_vel"] == source["hosts"]["/cmd_vel"][(VENDOR + host_id(pods[active])).hex()][0]
        assert source["others"]["/cmd_vel"][1] == other
    for pod in pods:
        assert 0 <= second["first"]["/cmd_vel"][pod] - second["switched"] < 1


@pytest.mark.ros
@needs_root
def test_real_publishers_with_the_same_host_id_count_and_are_reported(lan, processes):
    pytest.importorskip("rclpy")
    ips = twins()
    for ip in ips:
        processes.node("publish", "/cmd_vel", "20", inside=lan.host(ip))
    pods = dict(zip(("primary", "fallback"), ips, strict=True))
    (source,) = watched(processes, lan, topics={"/cmd_vel": 1}, instances=pods, active=["primary"])
    assert source["last"]["/cmd_vel"] == {"primary": None, "fallback": None}
    assert source["others"]["/cmd_vel"] is None
    assert source["counted"]["/cmd_vel"] > 30
    assert "cannot be distinguished" in source["problems"][0]
