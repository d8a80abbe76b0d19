"""PodMonitors, alerts and dashboards: what they select and ask for is what there is."""

from __future__ import annotations

import json
import re
from typing import Any, get_args

import pytest
import yaml

from scripts.generation.metrics import exposed
from tests.unit.chart.alert_rules import ALERTS, OTHERS, alerts
from tests.unit.chart.conftest import CHART, Object, Render, one
from understudy.api import names
from understudy.api.kinds.robot_workload import Health
from understudy.controller.desired import monitor_deployment
from understudy.controller.runtime import fleet_metrics
from understudy.failover.interfaces import Instance
from understudy.monitor.judge import sole_driver
from understudy.monitor.judge.gate_enforcement import judge
from understudy.monitor.notices import ConditionReport

DASHBOARDS = {path.name: json.loads(path.read_text()) for path in (CHART / "files" / "dashboards").glob("*.json")}


def expressions() -> list[str]:
    panels = [panel for board in DASHBOARDS.values() for panel in board["panels"]]
    return [rule["expr"] for rule in alerts()] + [t["expr"] for panel in panels for t in panel["targets"]]


@pytest.mark.parametrize("expression", expressions())
def test_every_queried_metric_is_exported(expression: str) -> None:
    asked = set(re.findall(r"\b(?:understudy|process)_[a-z_]+", expression))
    assert asked
    assert asked <= exposed() | OTHERS


@pytest.mark.parametrize("expression", expressions())
def test_queried_states_and_conditions_exist(expression: str) -> None:
    for label, known in (("health", get_args(Health)), ("condition", fleet_metrics.CONDITIONS)):
        for value in re.findall(rf'\b{label}=~?"([^"$]+)"', expression):
            assert set(value.split("|")) <= set(known)


@pytest.mark.parametrize("alert", alerts(), ids=lambda alert: alert["alert"])
def test_an_alert_has_a_severity_a_description_and_documentation(alert: Object) -> None:
    assert alert["labels"]["severity"] in ("critical", "warning")
    assert alert["annotations"]["summary"].endswith(".")
    assert alert["annotations"]["description"]
    assert alert["alert"] in (CHART.parents[1] / "docs" / "metrics.md").read_text()


@pytest.mark.parametrize("alert", alerts(), ids=lambda alert: alert["alert"])
def test_each_alert_has_a_promtool_test_in_which_it_fires(alert: Object) -> None:
    suite = yaml.safe_load((CHART.parents[1] / "tests" / "e2e" / "prometheus" / "alerts_test.yaml").read_text())
    expected = [case for test in suite["tests"] for case in test["alert_rule_test"]]
    assert [case for case in expected if case["alertname"] == alert["alert"] and case["exp_alerts"]]


def test_a_gate_in_an_unknown_state_raises_no_alert() -> None:
    active, held = Instance(name="w-1", uid="1", running=True), Instance(name="w-2", uid="2", running=True)
    last = {"1": 99.0}
    unknown = [
        judge([active], "1", last, now=100.0, since=99.5),
        judge([], "1", last, now=100.0, since=0.0),
        judge([held], "", last, now=100.0, since=0.0),
        judge([active], "1", last, now=100.0, since=0.0),
        judge([active, held], "1", last, now=100.0, since=0.0, admitted_uid="2"),
    ]
    assert {status for status, _, _ in unknown} == {"Unknown"}
    (alert,) = (alert for alert in alerts() if alert["alert"] == "UnderstudyGateNotEnforced")
    (left_out,) = re.findall(r'reason!~"([^"]+)"', alert["expr"])
    assert sorted(left_out.split("|")) == sorted(reason for _, reason, _ in unknown)


def test_a_second_driver_raises_an_alert_and_an_unknown_sender_does_not() -> None:
    (alert,) = (alert for alert in alerts() if alert["alert"] == "UnderstudySeveralDrivers")
    (asked,) = re.findall(r'reason=~"([^"]+)"', alert["expr"])
    known, unknown = (_sole_driver(uid) for uid in ("1", ""))
    closed = _sole_driver("1", active="")
    assert (known[0], closed[0], unknown[0]) == ("False", "False", "Unknown")
    assert sorted(asked.split("|")) == sorted((known[1], closed[1]))


def _sole_driver(uid: str, active: str = "w-1") -> ConditionReport:
    """The condition SoleDriver while somebody else is heard: an instance with a UID, or an unknown sender."""
    track = sole_driver.Track(sole_driver.Sign("w-2", uid, "/cmd_vel", last=100.0), first=90.0)
    return sole_driver.judge({(uid, "/cmd_vel"): track}, active, 100.0)


def test_the_pod_monitor_selects_every_monitor_and_labels_it_with_its_workload(render: Render) -> None:
    watching = one(
        render("metrics.podMonitors.enabled=true,metrics.from[0].podSelector.matchLabels.app=prometheus"),
        "PodMonitor",
        "understudy-monitors",
    )["spec"]
    assert watching["selector"]["matchLabels"].items() <= monitor_deployment.labels("w").items()
    (relabelled,) = watching["podMetricsEndpoints"][0]["relabelings"]
    discovered = re.sub(r"[^a-zA-Z0-9_]", "_", names.MONITORED)
    assert relabelled["sourceLabels"] == [f"__meta_kubernetes_pod_label_{discovered}"]


def test_the_rules_in_the_chart_equal_the_file(render: Render) -> None:
    assert one(render("metrics.rules.enabled=true"), "PrometheusRule")["spec"] == ALERTS


def test_the_dashboards_in_the_chart_equal_the_files(render: Render) -> None:
    found = one(render("metrics.dashboards.enabled=true"), "ConfigMap")
    configured: dict[str, Any] = {
        name.removeprefix("understudy-"): json.loads(text) for name, text in found["data"].items()
    }
    assert configured == DASHBOARDS
