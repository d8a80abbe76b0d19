"""A real Prometheus scrapes the operator and a robot's monitor; alerts and dashboards are asked of it."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from testcluster import golang
from testcluster.progress import Progress
from tests.e2e.conftest import CHART, SYSTEM
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.scenario import Robot, eventually

pytestmark = [pytest.mark.long, pytest.mark.local_only]  # this machine must reach pods by their addresses

SOURCE = Path(__file__).parent / "prometheus"
ALERTS = CHART / "files" / "alerts.yaml"
MODULE = "github.com/prometheus/prometheus/cmd"
Query = Callable[[str], list[Object]]

SELDOM = ("understudy_claim_seconds", "understudy_pool", "understudy_kept", "understudy_tree_overruns")
"""What this robot has nothing of: no pool is shared, no state is kept, and a look may never have been late."""


@pytest.fixture(scope="module")
def programs() -> Path:
    """The folder of prometheus and promtool."""
    targets = [f"{MODULE}/prometheus", f"{MODULE}/promtool"]
    return golang.build("prometheus", SOURCE, targets, ["-ldflags=-s -w"], Progress(), "five to ten minutes, once")


def promtool(programs: Path, *arguments: str, given: str | None = None) -> None:
    command = [str(programs / "promtool"), *arguments]
    done = subprocess.run(command, input=given, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_alerts_are_well_formed_and_fire_when_they_should(programs: Path, tmp_path: Path) -> None:
    promtool(programs, "check", "rules", "--lint=all", "--lint-fatal", str(ALERTS))
    shutil.copy(ALERTS, tmp_path)
    shutil.copy(SOURCE / "alerts_test.yaml", tmp_path)
    promtool(programs, "test", "rules", str(tmp_path / "alerts_test.yaml"))


def scraping(kubeconfig: Path, namespace: str) -> Object:
    """What the Prometheus operator makes of the chart's PodMonitors, for one robot's namespace."""

    def pods(job: str, where: str, label: str, value: str, *more: Object, honor: bool = False) -> Object:
        return {
            "job_name": job,
            "scrape_interval": "1s",
            "honor_labels": honor,
            "kubernetes_sd_configs": [
                {"role": "pod", "kubeconfig_file": str(kubeconfig), "namespaces": {"names": [where]}}
            ],
            "relabel_configs": [
                {"source_labels": [f"__meta_kubernetes_pod_label_{label}"], "regex": value, "action": "keep"},
                {"source_labels": ["__meta_kubernetes_pod_container_port_name"], "regex": "metrics", "action": "keep"},
                {"source_labels": ["__meta_kubernetes_namespace"], "target_label": "namespace"},
                *more,
            ],
        }

    named = {"source_labels": ["__meta_kubernetes_pod_label_understudy_dev_monitored"], "target_label": "workload"}
    return {
        "global": {"evaluation_interval": "1s"},
        "rule_files": [str(ALERTS)],
        "scrape_configs": [
            pods("operator", SYSTEM, "app_kubernetes_io_name", "understudy", honor=True),
            pods("monitors", namespace, "understudy_dev_component", "monitor", named),
        ],
    }


@pytest.fixture
def prometheus(programs: Path, kubectl: Kubectl, tmp_path: Path) -> Iterator[Callable[[str], Any]]:
    """Asks a running Prometheus for a page of its API."""
    config = tmp_path / "prometheus.yaml"
    config.write_text(yaml.safe_dump(scraping(kubectl.kubeconfig, kubectl.namespace)))
    promtool(programs, "check", "config", str(config))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    command = [
        str(programs / "prometheus"), f"--config.file={config}", f"--storage.tsdb.path={tmp_path / 'data'}",
        f"--web.listen-address={address}",
    ]  # fmt: skip
    with (tmp_path / "prometheus.log").open("w") as log, subprocess.Popen(command, stdout=log, stderr=log) as process:

        def ask(path: str) -> Any:
            with urllib.request.urlopen(f"http://{address}/api/v1/{path}", timeout=10) as answer:
                return json.load(answer)["data"]

        def up() -> bool:
            try:
                return bool(ask("status/runtimeinfo"))
            except OSError:
                return False

        try:
            eventually(up, within=30, what="Prometheus answers", note=(tmp_path / "prometheus.log").read_text)
            yield ask
        finally:
            process.terminate()
            process.wait(20)


@pytest.fixture
def query(prometheus: Callable[[str], Any]) -> Query:
    """The series that an expression has now."""

    def ask(expression: str) -> list[Object]:
        found: list[Object] = prometheus(f"query?query={urllib.parse.quote(expression)}")["result"]
        return found

    return ask


def value(query: Query, expression: str) -> float:
    """The value of the only series of an expression. Raises IndexError while there is none."""
    found = query(expression)
    assert len(found) <= 1, found
    return float(found[0]["value"][1])


def expressions(kubectl: Kubectl, workload: str) -> list[str]:
    """Of every panel of the dashboards, as Grafana would ask them for this robot."""
    found = []
    for board in (CHART / "files" / "dashboards").glob("*.json"):
        for panel in json.loads(board.read_text())["panels"]:
            found += [target["expr"] for target in panel["targets"]]
    return [e.replace("$namespace", kubectl.namespace).replace("$workload", workload) for e in found]


def test_a_failover_is_seen_in_metrics_alerts_and_dashboards(
    executing: Robot, kubectl: Kubectl, release: Kubectl, programs: Path, query: Query, prometheus: Callable[[str], Any]
) -> None:
    old = executing.wait_protected()
    mine = f'namespace="{kubectl.namespace}",workload="{executing.workload}"'
    eventually(lambda: query(f'up{{job="monitors",{mine}}} == 1'), within=60, what="the monitor is scraped")
    eventually(lambda: query(f'understudy_workload_health{{{mine},health="Healthy"}}'), within=60, what="it is healthy")
    assert value(query, f'understudy_workload_condition{{condition="Protected",{mine}}}') == 1
    rate = f'rate(understudy_topic_messages_total{{topic="/cmd_vel",{mine}}}[10s])'
    eventually(lambda: 5 < value(query, rate) < 40, within=60, what="its commands have their rate")

    executing.fail(old, "frozen")
    executing.wait_recovered(1)
    eventually(
        lambda: value(query, f"understudy_workload_recoveries_total{{{mine}}}") == 1, within=60, what="it is counted"
    )
    assert value(query, f'understudy_recoveries_total{{result="Recovered",{mine}}}') == 1
    assert value(query, f"understudy_recovery_seconds_count{{{mine}}}") == 1
    assert value(query, f"understudy_gate_commit_seconds_count{{{mine}}}") >= 1
    executing.wait_protected()

    for expression in expressions(kubectl, executing.workload):
        series = query(expression)
        assert series or any(name in expression for name in SELDOM) or expression.endswith("== 0"), expression

    pool = next(iter(kubectl.list("fallbackpools")))["metadata"]["name"]
    kubectl.patch("fallbackpool", pool, {"spec": {"perWorkload": 0}})

    def told() -> bool:
        alerts = prometheus("alerts")["alerts"]
        return any(
            a["labels"]["alertname"] == "UnderstudyStandbyNotReady" and a["labels"]["workload"] == executing.workload
            for a in alerts
        )

    eventually(told, within=60, what="that it has no standby is about to be told")
    for pods, where in (("app.kubernetes.io/name=understudy", release), ("understudy.dev/component=monitor", kubectl)):
        for pod in where.list("pods", pods):
            if (address := pod["status"].get("podIP")) and not pod["metadata"].get("deletionTimestamp"):
                with urllib.request.urlopen(f"http://{address}:9108/metrics", timeout=10) as answer:
                    promtool(programs, "check", "metrics", given=answer.read().decode())
