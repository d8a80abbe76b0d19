"""``understudy doctor``: what findings look like, and how each check judges what it has found."""

from __future__ import annotations

import contextlib
import copy
import json
import re
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.support import fleet
from understudy import __version__
from understudy.api import names
from understudy.api.kinds.robot_workload import MonitorStatus
from understudy.api.schema.definitions import definitions
from understudy.cli.common.cluster_access.kubectl_proxy import Answer, Refused
from understudy.cli.doctor import (
    clock_check,
    discovery_check,
    findings,
    installation_check,
    packet_check,
    rights_check,
    test_pods,
)
from understudy.cli.doctor.clock_check import Clock
from understudy.cli.doctor.command import said_by_monitors
from understudy.cli.doctor.findings import Finding
from understudy.cli.doctor.installation_check import Installed
from understudy.cli.doctor.packet_check import Seen
from understudy.controller.plan import Images
from understudy.failover.progress import rfc3339
from understudy.kube.client import Object
from understudy.kube.gates import registry
from understudy.ros.rmw import MIDDLEWARE

ENFORCED = Seen(
    ("n1", "n2"), before=True, established=0.03, fresh=False, others=True, opened=0.02, closed=0.01, lifted=0.04
)
FOUND = [
    Finding("clocks", "OK", "at most 2 ms apart"),
    Finding("gate", "WARN", "enforced late", "give it more CPU"),
    Finding(
        "discovery of robot-1",
        "FAIL",
        "nobody is found by 10.0.0.7:11811 within 8 s, not even the monitor",
        "look there",
    ),
]


class Server:
    """Answers as an API server would, by path; whatever is refused raises."""

    def __init__(self, answers: dict[str, Any]) -> None:
        self.answers, self.asked = answers, list[tuple[str, Any]]()

    def get(self, path: str) -> Object:
        return self.request("GET", path).body

    def request(self, method: str, path: str, body: Any = None, *, kind: str = "") -> Answer:
        self.asked.append((path, body))
        found = self.answers[path] if path in self.answers else self.answers["*"]
        found = found(body) if callable(found) else found
        if isinstance(found, Refused):
            raise found
        return Answer(found, "", 0.0, 0.0)


def test_findings_stand_in_columns_with_the_cure_below() -> None:
    assert list(findings.lines(FOUND, columns=70, colours=False)) == [
        "OK    clocks                at most 2 ms apart",
        "WARN  gate                  enforced late",
        "                            cure: give it more CPU",
        "FAIL  discovery of robot-1  nobody is found by 10.0.0.7:11811 within 8",
        "                            s, not even the monitor",
        "                            cure: look there",
        "",
        "3 checks: 1 failed, 1 warning",
    ]


def test_colours_are_only_added_to_words() -> None:
    plain = list(findings.lines(FOUND, columns=70, colours=False))
    coloured = list(findings.lines(FOUND, columns=70, colours=True))
    assert coloured[0] == plain[0].replace("OK  ", "\x1b[32mOK  \x1b[0m", 1)
    assert [line for line in coloured if "\x1b" not in line] == [plain[2], plain[4], *plain[5:]]


def test_a_warning_is_no_failure() -> None:
    assert findings.is_well(FOUND[:2])
    assert not findings.is_well(FOUND)
    assert findings.summary(FOUND[:1]) == "1 check: all is well"
    assert json.dumps(findings.to_wire(FOUND[1:2])) == (
        '{"findings": [{"check": "gate", "level": "WARN", "found": "enforced late", "cure": "give it more CPU"}]}'
    )


def shown() -> list[Finding]:
    """What the page shows: a cluster that does all but one thing."""
    page = [
        Finding("Kubernetes", "OK", "v1.34.4"),
        installation_check.operator(Installed(deployment("0.0.9"))),
        *(
            Finding(f"CRD {kind}", "OK", f"v1alpha1 of version {__version__}")
            for kind in ("robotworkloads", "failurepolicies", "fallbackpools")
        ),
        Finding("your rights", "OK", "you have all rights that the verbs of this command need in fleet"),
        Finding(
            "operator's rights", "OK", "system:serviceaccount:system:account has all rights that it needs in fleet"
        ),
        *packet_check.judge(replace(ENFORCED, closed=0.034)),
        discovery_check.judge(
            fleet.well(),
            {"ROS_DISCOVERY_SERVER": "10.96.0.7:11811"},
            ["/base_driver", "/controller_server", "/understudy_monitor"],
        ),
        discovery_check.judge(fleet.degraded(), {"ROS_DISCOVERY_SERVER": "10.96.0.8:11811"}, []),
        clock_check.judge({"n1": Clock(0.0, 0.004), "n2": Clock(0.0001, 0.004)}, Clock(0.001, 0.009)),
    ]
    return page


def test_the_page_shows_what_is_printed() -> None:
    page = (Path(__file__).parents[4] / "docs" / "console.md").read_text()
    (told,) = re.findall(r"```console\n\$ understudy doctor -n fleet\n(.*?)\n```", page, re.DOTALL)
    assert told.splitlines() == list(findings.lines(shown(), columns=110, colours=False))


# -- what is installed ------------------------------------------------------------------------------------------------


def deployment(version: str = __version__, ready: int = 2) -> Object:
    environment = [
        {"name": "UNDERSTUDY_MONITOR_IMAGE", "value": "registry/monitor:1"},
        {"name": "UNDERSTUDY_IMAGE_PULL_POLICY", "value": "Always"},
        {"name": "UNDERSTUDY_IMAGE_PULL_SECRETS", "value": "one,two"},
        {"name": "POD_NAME", "valueFrom": {"fieldRef": {"fieldPath": "metadata.name"}}},
    ]
    return {
        "metadata": {
            "namespace": "system",
            "name": "operator",
            "labels": {"app.kubernetes.io/version": version},
        },
        "spec": {
            "replicas": 2,
            "template": {"spec": {"serviceAccountName": "account", "containers": [{"env": environment}]}},
        },
        "status": {"readyReplicas": ready} if ready else {},
    }


@pytest.mark.parametrize(
    ("item", "level", "words"),
    [
        (deployment(), "OK", "2 of 2 ready"),
        (deployment(ready=1), "WARN", "1 of 2 ready"),
        (deployment(ready=0), "FAIL", "0 of 2 ready"),
        (deployment("0.0.9"), "WARN", f"version 0.0.9, 2 of 2 ready, and this command is of version {__version__}"),
    ],
)
def test_an_operator_is_ready_and_of_this_version(item: Object, level: str, words: str) -> None:
    found = installation_check.operator(Installed(item))
    assert found.level == level
    assert words in found.found
    assert bool(found.cure) == (level != "OK")


def test_without_the_right_to_look_for_an_operator_there_is_none() -> None:
    server = Server({"*": Refused(403, "deployments.apps is forbidden")})
    assert installation_check.find(server) is None  # type: ignore[arg-type]
    assert installation_check.operator(None).level == "WARN"


@pytest.mark.parametrize(("minor", "level"), [("30", "OK"), ("34+", "OK"), ("29", "FAIL")])
def test_an_old_kubernetes_version_is_reported(minor: str, level: str) -> None:
    server = Server({"/version": {"major": "1", "minor": minor, "gitVersion": f"v1.{minor}"}})
    assert installation_check.kubernetes(server).level == level  # type: ignore[arg-type]


def served(name: str = "robotworkloads") -> Object:
    found = copy.deepcopy(definitions()[f"understudy.dev_{name}.yaml"])
    return found


def test_definitions_of_this_version_are_current_whatever_their_words() -> None:
    for wanted in definitions().values():
        live = copy.deepcopy(wanted)
        live["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]["spec"]["description"] = "other words"
        live["spec"]["conversion"] = {"strategy": "None"}
        assert installation_check.definition("CRD", wanted, live).level == "OK"


def test_what_an_older_definition_has_not_is_named_as_the_user_writes_it() -> None:
    live = served()
    spec = live["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]["spec"]["properties"]
    del spec["pause"]
    found = installation_check.definition("CRD", served(), live)
    assert found.level == "FAIL"
    assert found.found == f"it is not that of version {__version__}: spec.pause is missing"
    assert "helm upgrade" in found.cure


def test_a_field_called_description_is_a_field() -> None:
    wanted = {"properties": {"description": {"type": "string"}}}
    assert list(installation_check.differences(wanted, {"properties": {}})) == ["description is missing"]
    assert list(installation_check.differences({"maximum": 5}, {"maximum": 4}, "spec.replicas")) == [
        "spec.replicas.maximum is another"
    ]
    assert list(installation_check.differences({"enum": ["a", "b"]}, {"enum": ["a"]}, "spec.kind")) == [
        "spec.kind.enum is another"
    ]


def test_a_definition_that_is_not_there_or_not_served() -> None:
    live = served()
    live["spec"]["versions"][0]["served"] = False
    assert "v1alpha1 isn't served" in installation_check.definition("CRD", served(), live).found
    server = Server({"*": Refused(404, "not found")})
    assert {f.level for f in installation_check.definitions_served(server)} == {"FAIL"}  # type: ignore[arg-type]
    server = Server({"*": Refused(403, "forbidden")})
    assert {f.level for f in installation_check.definitions_served(server)} == {"WARN"}  # type: ignore[arg-type]


# -- rights -----------------------------------------------------------------------------------------------------------


def test_rights_that_are_missing_are_named_with_what_they_are_for() -> None:
    def review(body: Any) -> Any:
        wanted = body["spec"]["resourceAttributes"]
        return {"status": {"allowed": (wanted["resource"], wanted["subresource"]) != ("pods", "exec")}}

    server = Server({"*": review})
    found = rights_check.of_this_user(server, "fleet")  # type: ignore[arg-type]
    assert found.level == "WARN"
    assert found.found == "you lack rights in fleet: create pods/exec (for inject, doctor)"
    assert all(body["spec"]["resourceAttributes"]["namespace"] == "fleet" for _, body in server.asked)


def test_the_operator_s_rights_are_asked_for_in_its_name() -> None:
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
    ("seen", "level", "words"),
    [
        (
            ENFORCED,
            "OK",
            "are enforced for UDP (from n1 to n2); after the request to the API server: closed 30 ms, opened 20 ms",
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
def test_what_packets_say_of_the_network(seen: Seen, level: str, words: str) -> None:
    found = packet_check.judge(seen)
    assert (found[0].level, words in found[0].found) == (level, True), found
    assert bool(found[0].cure) == (level != "OK")


def test_the_pods_are_nothing_that_operator_and_monitors_look_after() -> None:
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


def test_the_policies_are_the_operator_s_own_with_other_labels() -> None:
    labels = test_pods.pod("doctor-1", "sender", Images("i"))["metadata"]["labels"]
    ((_, theirs),) = registry.DEFAULT.companions("doctor-1", [], None)
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
        (0.3, "WARN", "that of n2 is 300 ms ahead of that of n1, give or take 2 ms"),
        (-30.0, "FAIL", "that of n1 is 30.0 s ahead of that of n2"),
    ],
)
def test_clocks_are_compared_with_each_other_and_not_with_this_machine_s(ahead: float, level: str, words: str) -> None:
    away = 100.0  # this machine's clock is nobody's affair
    nodes = {"n1": Clock(away, 0.001), "n2": Clock(away + ahead, 0.001)}
    found = clock_check.judge(nodes, Clock(away + ahead / 2, 0.001))
    assert (found.level, words in found.found) == (level, True), found


def test_a_clock_that_was_told_vaguely_is_not_said_to_be_wrong() -> None:
    assert clock_check.judge({"n1": Clock(0.0, 0.2), "n2": Clock(0.3, 0.2)}, None).level == "OK"
    assert clock_check.judge({"n1": Clock(0.0, 0.2)}, None).level == "WARN"


def test_many_clocks_are_not_all_named() -> None:
    found = clock_check.judge({f"n{number}": Clock(0.0, 0.001) for number in range(9)}, None)
    assert "(n0, n1, n2, n3 and 5 more; this machine's is" in found.found


def test_a_clock_that_is_surely_wrong_counts_more_than_one_that_may_be() -> None:
    found = clock_check.judge({"n1": Clock(0.0, 0.001), "n2": Clock(0.6, 0.001), "n3": Clock(0.7, 0.3)}, None)
    assert found.found.startswith("that of n2 is 600 ms ahead of that of n1, give or take 2 ms")


def test_a_node_s_clock_is_told_by_when_its_lease_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clock_check, "LOOK", 0.05)
    ahead, begun = 30.0, time.time()

    class Leases:
        def request(self, method: str, path: str) -> Answer:
            now = time.time()
            renewed = rfc3339(begun + (0.4 if now > begun + 0.4 else 0.0) + ahead)
            return Answer(
                {"items": [{"metadata": {"name": "n1"}, "spec": {"renewTime": renewed}}]}, "", now, time.time()
            )

    with clock_check.OfNodes(Leases()) as nodes:  # type: ignore[arg-type]
        time.sleep(1.0)
    clock = nodes.clocks["n1"]
    assert abs(clock.ahead - ahead) <= clock.give + 0.001


# -- discovery --------------------------------------------------------------------------------------------------------


def test_a_graph_in_which_somebody_is_found_has_a_server() -> None:
    found = discovery_check.judge(fleet.well(), {"ROS_DISCOVERY_SERVER": "10.0.0.7:11811"}, ["/understudy_monitor"])
    assert (found.check, found.level) == ("discovery of robot-17-navigation", "OK")
    assert found.found == "1 node found by 10.0.0.7:11811: /understudy_monitor"


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
def test_an_empty_graph_is_told_with_what_to_look_at(discovery: Any, server: str, cure: str) -> None:
    item = fleet.well()
    item["spec"]["ros"] = {"discovery": discovery}
    found = discovery_check.judge(item, {"ROS_DISCOVERY_SERVER": server} if server else {}, [])
    assert found.level == "FAIL"
    assert cure in found.cure


def test_a_fleet_that_finds_nobody_is_not_waited_for_to_its_last_robot() -> None:
    class Pods:
        receiver, api = (
            None,
            Server({"*": {"data": {"ROS_DOMAIN_ID": "1", MIDDLEWARE.settings_variable: "/etc/p.xml"}}}),
        )
        kubectl = SimpleNamespace(namespace="fleet")

        @contextlib.contextmanager
        def talking(self, *_: object) -> Iterator[Any]:
            yield SimpleNamespace(ask=self.ask)

        def ask(self, what: str, *, environment: Any, **_: object) -> list[str]:
            assert environment == {"ROS_DOMAIN_ID": "1"}, "with the robot's profiles it would take the robot's ports"
            return []

    found = list(discovery_check.joined(Pods(), [fleet.well()] * 5, lambda _: None))  # type: ignore[arg-type]
    assert [one.level for one in found] == ["FAIL", "FAIL", "FAIL", "WARN"]
    assert found[-1].found == "2 graphs were not joined, after 3 without anybody"


def test_a_server_that_does_not_run_is_told_without_a_packet() -> None:
    pod = {
        "metadata": {"name": "robot-17-navigation-discovery-x", "namespace": "fleet"},
        "status": {
            "containerStatuses": [{"name": "discovery", "image": "i", "state": {"waiting": {"reason": "ErrImagePull"}}}]
        },
    }
    (found,) = discovery_check.servers(Server({"*": {"items": [pod]}}), "fleet", [fleet.well()])  # type: ignore[arg-type]
    assert found.level == "FAIL"
    assert (
        "its server does not run: pod robot-17-navigation-discovery-x: container discovery (image i) cannot start"
        in found.found
    )


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
def test_what_a_monitor_says_of_gate_and_readers_is_told_once(
    type_: str, status: Any, reason: str, expected: list[tuple[str, str, str]]
) -> None:
    item = fleet.workload(
        "robot-1", status=fleet.status("robot-1", "x", 1, fleet.said(type_, status, reason, "It is."))
    )
    assert [(one.check, one.level, one.cure) for one in said_by_monitors([item])] == expected


@pytest.mark.parametrize(
    ("monitor", "expected"),
    [
        (MonitorStatus(version=__version__, image="i"), []),
        (MonitorStatus(version="0.1.9", image="i"), ["it is of version 0.1.9, and this command of " + __version__]),
        (None, ["it is of a version before 0.2.0, and this command of " + __version__]),
    ],
)
def test_a_monitor_of_another_version_is_reported(monitor: MonitorStatus | None, expected: list[str]) -> None:
    item = fleet.workload("robot-1", status=fleet.status("robot-1", "x", 1, monitor=monitor))
    found = list(said_by_monitors([item]))
    assert [one.found for one in found] == expected
    assert all((one.check, one.level) == ("monitor of robot-1", "WARN") for one in found)
    item["status"] = {"conditions": []}
    assert list(said_by_monitors([item])) == [], "one that has said nothing yet"
