"""What doctor finds about rights, the gate, clocks and discovery."""

from __future__ import annotations

import argparse
import contextlib
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from tests.support import fleet
from tests.support.golden import assert_golden
from tests.unit.cli.doctor.server import ENFORCED, Server, deployment
from understudy import __version__
from understudy.api import names
from understudy.api.kinds.robot_workload import MonitorStatus
from understudy.cli.common.cluster_access.kubectl import Kubectl
from understudy.cli.common.cluster_access.kubectl_proxy import Answer, Refused
from understudy.cli.doctor import (
    clock_check,
    discovery_check,
    packet_check,
    rights_check,
    test_pods,
)
from understudy.cli.doctor.clock_check import Clock
from understudy.cli.doctor.command import monitor_findings
from understudy.cli.doctor.installation_check import Installed
from understudy.cli.doctor.packet_check import GateTest
from understudy.controller.plan import Images
from understudy.failover.progress import rfc3339
from understudy.kube.gates import registry
from understudy.kube.gates.base import Reach
from understudy.ros.rmw import MIDDLEWARE

# -- rights -----------------------------------------------------------------------------------------------------------


def test_missing_rights_are_reported_with_their_purpose() -> None:
    def review(body: Any) -> Any:
        wanted = body["spec"]["resourceAttributes"]
        return {"status": {"allowed": (wanted["resource"], wanted["subresource"]) != ("pods", "exec")}}

    server = Server({"*": review})
    found = rights_check.of_this_user(server, "fleet")  # type: ignore[arg-type]
    assert found.level == "WARN"
    assert_golden("doctor", found.found, "in fleet", "create pods/exec")
    assert all(body["spec"]["resourceAttributes"]["namespace"] == "fleet" for _, body in server.asked)


def test_the_rights_of_the_operator_are_reviewed_in_its_name() -> None:
    operator = Installed(deployment())
    server = Server({"*": {"status": {"allowed": True}}})
    assert rights_check.of_the_operator(server, "fleet", operator).level == "OK"  # type: ignore[arg-type]
    path, body = server.asked[0]
    assert path.endswith("/subjectaccessreviews")
    assert body["spec"]["user"] == "system:serviceaccount:system:account"
    assert "system:serviceaccounts:system" in body["spec"]["groups"]
    server = Server({"*": {"status": {"allowed": False}}})
    found = rights_check.of_the_operator(server, "fleet", operator)  # type: ignore[arg-type]
    assert (found.level, "patch pods" in found.found) == ("FAIL", True)
    server = Server({"*": Refused(403, "forbidden")})
    assert rights_check.of_the_operator(server, "fleet", operator).level == "WARN"  # type: ignore[arg-type]


# -- the gate ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("measured", "level", "words"),
    [
        (
            ENFORCED,
            "OK",
            "are enforced for UDP (from n1 to n2); time after the request to the API server: closed 30 ms, opened 20 ms",
        ),
        (replace(ENFORCED, nodes=("n1", "n1")), "OK", "(on n1 only)"),
        (replace(ENFORCED, opened=2.5), "WARN", "opened 2.5 s"),
        (replace(ENFORCED, before=False), "FAIL", "UDP packets do not get from one pod to another at all"),
        (replace(ENFORCED, fresh=True), "FAIL", "gates are not enforced for UDP"),
        (replace(ENFORCED, others=False), "FAIL", "also stops UDP to other ports"),
        (
            replace(ENFORCED, established=None),
            "WARN",
            "an established flow still gets through 10.0 s after the gate was closed",
        ),
        (replace(ENFORCED, opened=None), "FAIL", "did not come through within 10.0 s after the gate was opened"),
        (replace(ENFORCED, closed=None), "WARN", "still came 10.0 s after an open gate was closed"),
    ],
)
def test_received_packets_determine_the_finding_about_the_network(measured: GateTest, level: str, words: str) -> None:
    found = packet_check.judge(measured)
    assert (found[0].level, words in found[0].found) == (level, True), found
    assert bool(found[0].cure) == (level != "OK")


def test_pods_of_the_doctor_have_no_label_that_operator_or_monitors_select() -> None:
    made = test_pods.pod("doctor-1", "sender", Images("registry/monitor:1", pull_secrets=("key",)))
    assert not set(made["metadata"]["labels"]) & {
        names.WORKLOAD,
        names.INSTANCE,
        names.POOL,
        names.HELD,
        names.COMPONENT,
    }
    assert made["spec"]["imagePullSecrets"] == [{"name": "key"}]
    assert made["spec"]["activeDeadlineSeconds"] > 0


def test_the_test_policies_are_those_of_the_operator_with_other_labels() -> None:
    labels = test_pods.pod("doctor-1", "sender", Images("i"))["metadata"]["labels"]
    ((_, theirs),) = registry.DEFAULT.companions("doctor-1", Reach())
    ours = test_pods.relabelled(theirs)
    assert ours["spec"]["egress"][0]["ports"] == theirs["spec"]["egress"][0]["ports"]
    selector = ours["spec"]["podSelector"]["matchLabels"]
    assert selector.items() <= labels.items()
    assert names.WORKLOAD not in json.dumps(ours)


# -- clocks -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ahead", "level", "words"),
    [
        (0.004, "OK", "at most 6 ms apart (n1, n2, the API server; this machine's is"),
        (0.3, "WARN", "the clock of n2 is 300 ms ahead of the clock of n1, with an uncertainty of 2 ms"),
        (-30.0, "FAIL", "the clock of n1 is 30.0 s ahead of the clock of n2"),
    ],
)
def test_clocks_are_compared_with_each_other_not_with_the_local_clock(ahead: float, level: str, words: str) -> None:
    away = 100.0  # this machine's clock is nobody's affair
    nodes = {"n1": Clock(away, 0.001), "n2": Clock(away + ahead, 0.001)}
    found = clock_check.judge(nodes, Clock(away + ahead / 2, 0.001))
    assert (found.level, words in found.found) == (level, True), found


def test_an_uncertain_clock_is_not_reported_as_wrong() -> None:
    assert clock_check.judge({"n1": Clock(0.0, 0.2), "n2": Clock(0.3, 0.2)}, None).level == "OK"
    assert clock_check.judge({"n1": Clock(0.0, 0.2)}, None).level == "WARN"


def test_a_long_list_of_clocks_is_shortened() -> None:
    found = clock_check.judge({f"n{number}": Clock(0.0, 0.001) for number in range(9)}, None)
    assert "(n0, n1, n2, n3 and 5 more; this machine's is" in found.found


def test_a_certain_clock_error_is_reported_before_a_possible_one() -> None:
    found = clock_check.judge({"n1": Clock(0.0, 0.001), "n2": Clock(0.6, 0.001), "n3": Clock(0.7, 0.3)}, None)
    assert_golden("doctor", found.found, "n2 is 600 ms", "n1", "2 ms")


def test_the_clock_of_a_node_is_measured_by_its_lease_renewal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock_check, "CHECK_PERIOD", 0.05)
    ahead, started_at = 30.0, time.time()

    class Leases:
        def request(self, method: str, path: str) -> Answer:
            now = time.time()
            renewed = rfc3339(started_at + (0.4 if now > started_at + 0.4 else 0.0) + ahead)
            return Answer(
                {"items": [{"metadata": {"name": "n1"}, "spec": {"renewTime": renewed}}]}, "", now, time.time()
            )

    with clock_check.NodeClocks(Leases()) as nodes:  # type: ignore[arg-type]
        time.sleep(1.0)
    clock = nodes.clocks["n1"]
    assert abs(clock.ahead - ahead) <= clock.give + 0.001


# -- discovery --------------------------------------------------------------------------------------------------------


def test_a_graph_with_a_discovered_node_passes_the_check() -> None:
    found = discovery_check.judge(fleet.well(), {"ROS_DISCOVERY_SERVER": "10.0.0.7:11811"}, ["/understudy_monitor"])
    assert (found.check, found.level) == ("discovery of robot-17-navigation", "OK")
    assert_golden("doctor", found.found, "1 node", "10.0.0.7:11811", "/understudy_monitor")


@pytest.mark.parametrize(
    ("discovery", "server", "cure"),
    [
        ({}, "10.0.0.7:11811", "check whether the Service robot-17-navigation-discovery has endpoints"),
        (
            {"mode": "External", "server": "ds:11811"},
            "ds:11811",
            "look whether a Fast DDS discovery server runs at ds:11811",
        ),
        ({"mode": "Multicast"}, "", "use spec.ros.discovery.mode Managed"),
    ],
)
def test_an_empty_graph_is_reported_with_a_cure(discovery: Any, server: str, cure: str) -> None:
    item = fleet.well()
    item["spec"]["ros"] = {"discovery": discovery}
    found = discovery_check.judge(item, {"ROS_DISCOVERY_SERVER": server} if server else {}, [])
    assert found.level == "FAIL"
    assert cure in found.cure


def test_the_discovery_check_stops_after_three_empty_graphs() -> None:
    class Pods:
        receiver, api = (
            None,
            Server({"*": {"data": {"ROS_DOMAIN_ID": "1", MIDDLEWARE.settings_variable: "/etc/p.xml"}}}),
        )
        kubectl = Kubectl(argparse.Namespace(context=None, kubeconfig=None, namespace="fleet"))

        @contextlib.contextmanager
        def talking(self, *_: object) -> Iterator[Pods]:
            yield self

        def ask(self, what: str, *, environment: Any, **_: object) -> list[str]:
            assert environment == {"ROS_DOMAIN_ID": "1"}, "with the robot's profiles it would take the robot's ports"
            return []

    found = list(discovery_check.joined(Pods(), [fleet.well()] * 5, lambda _: None))  # type: ignore[arg-type]
    assert [one.level for one in found] == ["FAIL", "FAIL", "FAIL", "WARN"]
    assert found[-1].found == "2 graphs were not joined, because 3 graphs had no node"


def test_a_discovery_server_that_does_not_run_is_reported_from_its_pod_status() -> None:
    pod = {
        "metadata": {"name": "robot-17-navigation-discovery-x", "namespace": "fleet"},
        "status": {
            "containerStatuses": [{"name": "discovery", "image": "i", "state": {"waiting": {"reason": "ErrImagePull"}}}]
        },
    }
    (found,) = discovery_check.servers(Server({"*": {"items": [pod]}}), "fleet", [fleet.well()])  # type: ignore[arg-type]
    assert found.level == "FAIL"
    assert_golden("doctor", found.found, "robot-17-navigation-discovery-x", "container discovery (image i)")


@pytest.mark.parametrize(
    ("type_", "status", "reason", "expected"),
    [
        ("GateEnforced", "True", "SeenFromPackets", []),
        ("GateEnforced", "False", "NotEnforced", [("gate of robot-1", "FAIL", "docs/how-to/network-policies.md")]),
        (
            "GateEnforced", "False", "ReaderWithoutProfile",
            [("gate of robot-1", "FAIL", "docs/how-to/robot-outside-the-cluster.md")],
        ),
        ("OutputsRead", "True", "AtGatedPorts", []),
        ("OutputsRead", "False", "ReaderWithoutProfile", []),
        (
            "OutputsRead", "Unknown", "NobodyReads",
            [("outputs of robot-1", "WARN", "docs/explanation/network-policies.md#who-reads-the-outputs")],
        ),
        (
            "OutputsRead", "True", "ReadPastTheGate",
            [("outputs of robot-1", "WARN", "docs/explanation/network-policies.md#who-reads-the-outputs")],
        ),
    ],
)  # fmt: skip
def test_a_condition_about_gate_or_readers_is_reported_once(
    type_: str, status: Any, reason: str, expected: list[tuple[str, str, str]]
) -> None:
    item = fleet.workload(
        "robot-1", status=fleet.status("robot-1", "x", 1, fleet.condition(type_, status, reason, "It is."))
    )
    assert [(one.check, one.level, one.cure) for one in monitor_findings([item])] == expected


@pytest.mark.parametrize(
    ("monitor", "expected"),
    [
        (MonitorStatus(version=__version__, image="i"), []),
        (
            MonitorStatus(version="0.1.9", image="i"),
            ["it has version 0.1.9, but this command has version " + __version__],
        ),
        (None, ["its version is earlier than 0.2.0, but this command has version " + __version__]),
    ],
)
def test_a_monitor_of_another_version_is_reported(monitor: MonitorStatus | None, expected: list[str]) -> None:
    item = fleet.workload("robot-1", status=fleet.status("robot-1", "x", 1, monitor=monitor))
    found = list(monitor_findings([item]))
    assert [one.found for one in found] == expected
    assert all((one.check, one.level) == ("monitor of robot-1", "WARN") for one in found)
    item["status"] = {"conditions": []}
    assert list(monitor_findings([item])) == [], "one that has said nothing yet"
