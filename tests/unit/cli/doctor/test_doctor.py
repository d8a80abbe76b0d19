"""``understudy doctor``: what findings look like, and how each check judges what it has found."""

from __future__ import annotations

import copy
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from tests.support import fleet
from tests.support.golden import assert_golden
from tests.unit.cli.doctor.server import ENFORCED, Server, deployment
from understudy import __version__
from understudy.api.schema.definitions import definitions
from understudy.cli.common.cluster_access.kubectl_proxy import Refused
from understudy.cli.doctor import (
    clock_check,
    discovery_check,
    findings,
    installation_check,
    packet_check,
)
from understudy.cli.doctor.clock_check import Clock
from understudy.cli.doctor.findings import Finding
from understudy.cli.doctor.installation_check import Installed
from understudy.kube.client import Object

FOUND = [
    Finding("clocks", "OK", "at most 2 ms apart"),
    Finding("gate", "WARN", "enforced late", "give it more CPU"),
    Finding(
        "discovery of robot-1",
        "FAIL",
        "no node is found by 10.0.0.7:11811 within 8 s, not even the monitor",
        "look there",
    ),
]


def test_findings_are_printed_in_columns_with_the_cure_below() -> None:
    assert_golden(
        "doctor",
        list(findings.lines(FOUND, columns=70, colours=False)),
        "2 ms",
        "robot-1",
        "10.0.0.7:11811",
        "3 checks",
        "1 failed",
        "1 warning",
    )


def test_colours_do_not_change_the_text() -> None:
    plain = list(findings.lines(FOUND, columns=70, colours=False))
    coloured = list(findings.lines(FOUND, columns=70, colours=True))
    assert coloured[0] == plain[0].replace("OK  ", "\x1b[36mOK  \x1b[0m", 1)
    assert [line for line in coloured if "\x1b" not in line] == [plain[2], plain[4], *plain[5:]]


def test_a_warning_does_not_fail_the_command() -> None:
    assert findings.is_well(FOUND[:2])
    assert not findings.is_well(FOUND)
    assert findings.summary(FOUND[:1]) == "1 check: no problem found"
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


def test_the_page_shows_the_printed_output() -> None:
    page = (Path(__file__).parents[4] / "docs" / "console.md").read_text()
    (printed,) = re.findall(r"```console\n\$ understudy doctor -n fleet\n(.*?)\n```", page, re.DOTALL)
    assert printed.splitlines() == list(findings.lines(shown(), columns=110, colours=False))


# -- what is installed ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("item", "level", "words"),
    [
        (deployment(), "OK", "2 of 2 ready"),
        (deployment(ready=1), "WARN", "1 of 2 ready"),
        (deployment(ready=0), "FAIL", "0 of 2 ready"),
        (deployment("0.0.9"), "WARN", f"version 0.0.9, 2 of 2 ready, and this command is of version {__version__}"),
    ],
)
def test_the_operator_must_be_ready_and_of_this_version(item: Object, level: str, words: str) -> None:
    found = installation_check.operator(Installed(item))
    assert found.level == level
    assert words in found.found
    assert bool(found.cure) == (level != "OK")


def test_without_the_right_to_list_deployments_the_check_of_the_operator_warns() -> None:
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


def test_a_changed_description_does_not_make_a_definition_outdated() -> None:
    for wanted in definitions().values():
        live = copy.deepcopy(wanted)
        live["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]["spec"]["description"] = "other words"
        live["spec"]["conversion"] = {"strategy": "None"}
        assert installation_check.definition("CRD", wanted, live).level == "OK"


def test_a_field_missing_from_an_older_definition_is_reported_by_its_path() -> None:
    live = served()
    spec = live["spec"]["versions"][0]["schema"]["openAPIV3Schema"]["properties"]["spec"]["properties"]
    del spec["pause"]
    found = installation_check.definition("CRD", served(), live)
    assert found.level == "FAIL"
    assert found.found == f"it is not that of version {__version__}: spec.pause is missing"
    assert "helm upgrade" in found.cure


def test_a_field_named_description_is_compared_like_any_other() -> None:
    wanted = {"properties": {"description": {"type": "string"}}}
    assert list(installation_check.differences(wanted, {"properties": {}})) == ["description is missing"]
    assert list(installation_check.differences({"maximum": 5}, {"maximum": 4}, "spec.replicas")) == [
        "spec.replicas.maximum is another"
    ]
    assert list(installation_check.differences({"enum": ["a", "b"]}, {"enum": ["a"]}, "spec.kind")) == [
        "spec.kind.enum is another"
    ]


def test_a_missing_or_unserved_definition_is_reported() -> None:
    live = served()
    live["spec"]["versions"][0]["served"] = False
    assert "v1alpha1 isn't served" in installation_check.definition("CRD", served(), live).found
    server = Server({"*": Refused(404, "not found")})
    assert {f.level for f in installation_check.definitions_served(server)} == {"FAIL"}  # type: ignore[arg-type]
    server = Server({"*": Refused(403, "forbidden")})
    assert {f.level for f in installation_check.definitions_served(server)} == {"WARN"}  # type: ignore[arg-type]
