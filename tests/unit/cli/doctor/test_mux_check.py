"""What doctor finds about workloads with a mux."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support import fleet
from tests.support.golden import assert_golden
from tests.unit.cli.doctor.server import Server
from understudy.api import names
from understudy.cli.common.cluster_access.kubectl_proxy import Refused
from understudy.cli.doctor import mux_check
from understudy.cli.doctor.command import monitor_findings, needs_network
from understudy.cli.doctor.findings import Finding
from understudy.kube.client import CONFIG_MAPS, LEASES, PODS, SECRETS, Object

NAME = "robot-17-navigation"
GONE = Refused(404, "not found")
FORBIDDEN = Refused(403, "forbidden")
EXAMPLE = Path(__file__).parents[4] / "examples/quickstart/manifests/mux/robot.yaml"


def robot(name: str = "robot-17") -> Object:
    """A pod that runs the robot and its mux, as in the example."""
    (deployment,) = yaml.safe_load_all(EXAMPLE.read_text().replace("robot-1-drive", NAME))
    return {
        "metadata": {"name": name, "namespace": "fleet"},
        "spec": deployment["spec"]["template"]["spec"],
        "status": {"phase": "Running"},
    }


def found(item: Object | None = None, pods: list[Object] | None = None, **changed: Any) -> list[Finding]:
    """What the check finds; ``changed`` has other answers of the API server."""
    item = item if item is not None else fleet.muxed()
    answers = {
        PODS.path("fleet"): {"items": [robot()] if pods is None else pods},
        CONFIG_MAPS.path("fleet", f"{NAME}-mux"): changed.get("config_map", {}),
        SECRETS.path("fleet", f"{NAME}-mux"): changed.get("secret", {}),
        LEASES.path("fleet", f"{NAME}-gate"): changed.get("gate", fleet.gate(item, None, active=f"{NAME}-x8v2m")),
    }
    return list(mux_check.check(Server(answers), "fleet", [item]))  # type: ignore[arg-type]


def silent() -> Object:
    return fleet.muxed(fleet.condition("GateEnforced", "False", "NoMux", "No mux reports at the robot."))


def test_a_mux_that_reports_is_found_in_its_pod_or_elsewhere() -> None:
    (finding,) = found()
    assert (finding.check, finding.level, finding.found) == (
        f"mux of {NAME}", "OK", "pod robot-17 runs it, and it reports",
    )  # fmt: skip
    (finding,) = found(pods=[])
    assert finding.level == "OK"
    assert_golden("doctor", finding.found, "so it runs elsewhere")
    refuses = fleet.muxed(fleet.condition("GateEnforced", "False", "OrderRefused", "It refuses the order."))
    assert [one.level for one in found(refuses)] == ["OK"], "the line of the gate reports it"


def test_workloads_without_a_mux_cost_no_request() -> None:
    assert list(mux_check.check(Server({}), "fleet", [fleet.well()])) == []  # type: ignore[arg-type]


@pytest.mark.parametrize("missing", ["config_map", "secret"])
def test_a_missing_object_of_the_mux_is_reported(missing: str) -> None:
    (finding,) = found(**{missing: GONE})
    assert (finding.level, finding.cure) == (
        "FAIL",
        f"the operator writes it for a workload that it accepts: understudy explain {NAME}",
    )
    assert f"{NAME}-mux does not exist" in finding.found


def test_objects_that_the_user_may_not_read_are_not_reported() -> None:
    assert [one.level for one in found(config_map=FORBIDDEN, secret=FORBIDDEN, gate=FORBIDDEN)] == ["OK"]


def test_a_mux_that_does_not_report_is_reported_with_its_pod() -> None:
    (finding,) = found(silent())
    assert finding.level == "WARN"
    assert_golden("doctor", [finding.found, finding.cure], "pod robot-17", "kubectl logs -n fleet robot-17")
    (finding,) = found(silent(), pods=[])
    assert finding.level == "FAIL"
    assert_golden("doctor", [finding.found, finding.cure], f"{NAME}-mux", "docs/mux.md")


def test_a_pod_that_waits_for_its_token_or_lacks_it_is_reported() -> None:
    waiting = robot()
    state = {"waiting": {"reason": "CreateContainerConfigError", "message": f'secret "{NAME}-mux" not found'}}
    waiting["status"]["containerStatuses"] = [{"name": "mux", "image": "i", "state": state}]
    (finding,) = found(silent(), [waiting])
    assert (finding.level, "CreateContainerConfigError" in finding.found) == ("FAIL", True)
    bare = copy.deepcopy(robot())
    bare["spec"]["volumes"] = []
    (finding,) = found(silent(), [bare])
    assert (finding.level, "the mux has no token" in finding.found) == ("FAIL", True)


def test_a_container_beside_an_instance_on_board_that_could_not_start_again_is_reported() -> None:
    pod = copy.deepcopy(robot())
    pod["spec"]["containers"].append({"name": "home", "envFrom": [{"configMapRef": {"name": names.on_board(NAME)}}]})
    (finding,) = found(pods=[pod])
    assert finding.level == "WARN"
    assert_golden("doctor", [finding.found, finding.cure], f"ConfigMap {NAME}-on-board,")


def test_two_muxes_of_one_workload_are_reported() -> None:
    (finding,) = found(pods=[robot("robot-17-a"), robot("robot-17-b")])
    assert finding.level == "FAIL"
    assert_golden("doctor", [finding.found, finding.cure], "robot-17-a, robot-17-b")


def test_a_missing_lease_and_one_that_differs_from_its_record_are_reported() -> None:
    _, finding = found(gate=GONE)
    assert (finding.check, finding.level) == (f"gate of {NAME}", "FAIL")
    assert f"Lease {NAME}-gate does not exist" in finding.found
    gate = fleet.gate(fleet.muxed(), None, active=f"{NAME}-x8v2m")
    gate["spec"]["holderIdentity"] = "somebody"
    _, finding = found(gate=gate)
    assert_golden("doctor", [finding.found, finding.cure], "lets through somebody", f"names {NAME}-x8v2m")


def test_the_network_is_tested_only_for_robots_whose_gates_it_enforces() -> None:
    assert needs_network([])
    assert needs_network([fleet.muxed(), fleet.well()])
    assert not needs_network([fleet.muxed()])


@pytest.mark.parametrize("reason", ["NoMux", "OrderRefused", "BesideTheMux"])
def test_what_the_monitor_reports_of_the_mux_refers_to_its_page(reason: str) -> None:
    item = fleet.muxed(fleet.condition("GateEnforced", "False", reason, "It is."))
    assert [(one.level, one.found, one.cure) for one in monitor_findings([item])] == [("FAIL", "It is.", "docs/mux.md")]
