"""A real Prometheus scrapes the operator and a robot's monitor; alerts and dashboards are asked of it."""

from __future__ import annotations

import itertools
import json
import shutil
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path

import pytest
import yaml

from tests.e2e.conftest import CHART, SYSTEM
from tests.e2e.kubectl import Kubectl, Object
from tests.e2e.past import EVERY, Monitor, Operator, Recovery, every, openmetrics
from tests.e2e.scenario import Robot, eventually
from tests.support.prometheus import SOURCE, asked, built, fill, promtool, serving

pytestmark = [pytest.mark.long, pytest.mark.local_only]  # this machine must reach pods by their addresses

ALERTS = CHART / "files" / "alerts.yaml"
Query = Callable[[str], list[Object]]

SELDOM = (
    "understudy_claim_seconds", "understudy_pool", "understudy_kept", "understudy_budget", "understudy_recoveries_held",
    "understudy_tree_overruns", 'result!="Recovered"', "== 0", "GateEnforced",
)  # fmt: skip
"""What this robot has nothing of: no pool is shared, no state is kept, its policy has no budget, nothing was held, a look may never have
been late, no recovery failed, nothing is wrong; and for a while after a failover it is unknown whether its gate is enforced."""


@pytest.fixture(scope="module")
def programs() -> Path:
    """The folder of prometheus and promtool."""
    return built()


def test_the_alerts_are_well_formed_and_fire_when_they_should(programs: Path, tmp_path: Path) -> None:
    promtool(programs, "check", "rules", "--lint=all", "--lint-fatal", str(ALERTS))
    shutil.copy(ALERTS, tmp_path)
    shutil.copy(SOURCE / "alerts_test.yaml", tmp_path)
    promtool(programs, "test", "rules", str(tmp_path / "alerts_test.yaml"))


def past(begin: float, end: float) -> Operator:
    """Robots whose monitors run on, start, end and restart in a period, whatever that does to their counters."""
    hour, middle, before = 3600.0, (begin + end) / 2, begin - 3600.0
    monitors = [
        Monitor(
            "lives-on", "10.0.0.1", before, end + hour,
            [Recovery(before + 60), Recovery(before + 600), *(Recovery(begin + 600 * n) for n in (1, 2, 3))],
        ),
        Monitor(
            "fails-first", "10.0.0.2", before, end + hour,
            [
                Recovery(begin + 700), Recovery(begin + 1500, "Restart", cluster=3.0),
                Recovery(begin + 2500, "none", "Failed"),
            ],
        ),
        Monitor(
            "replaced", "10.0.0.3", before, middle, [Recovery(before + 60), Recovery(before + 120), Recovery(begin + 700)]
        ),
        Monitor("replaced", "10.0.0.4", middle + 60, end + hour, [Recovery(middle + 300), Recovery(middle + 900)]),
        Monitor(
            "restarted", "10.0.0.5", before, end + hour,
            [Recovery(before + 60), Recovery(begin + 700), Recovery(middle + 300), Recovery(middle + 900)],
            restarted=middle,
        ),
        Monitor(
            "scraped-late", "10.0.0.6", before, end + hour,
            [*(Recovery(before + 60 * n) for n in (1, 2, 3, 4)), Recovery(begin + 700), Recovery(middle + 900)],
            scraped=middle,
        ),
        Monitor("elsewhere", "10.0.0.7", before, end + hour, [Recovery(begin + 700)], namespace="lab"),
    ]  # fmt: skip
    return Operator(middle, monitors, lambda now: 0 if middle <= now < middle + 300 else 4)


def expressions(name: str, chosen: Mapping[str, str], seconds: int) -> dict[str, list[str]]:
    """Return the expressions of a dashboard's panels by title, as Grafana would send them for a shown time of this length."""
    shown = {"$__range_s": f"{seconds}", "$__range": f"{seconds}s", "$__rate_interval": "10s", "$__interval": "5s"}
    found: dict[str, list[str]] = {}
    for panel in json.loads((CHART / "files" / "dashboards" / f"{name}.json").read_text())["panels"]:
        for target in panel["targets"]:
            expression = target["expr"]
            for variable, text in {**chosen, **shown}.items():
                expression = expression.replace(variable, text)
            found.setdefault(panel["title"], []).append(expression)
    return found


TABLE = "Recoveries in this time range, with the mean time of each part"


def by_strategy(query: Query, name: str, chosen: Mapping[str, str], seconds: int) -> dict[str, dict[str, float]]:
    """Return the first columns of a dashboard's table of recoveries, each by strategy."""
    columns = zip(
        ("recovered", "failed", "mean", "detection", "cluster"), expressions(name, chosen, seconds)[TABLE], strict=False
    )
    return {
        column: {series["metric"]["strategy"]: float(series["value"][1]) for series in query(expression)}
        for column, expression in columns
    }


def test_the_dashboards_count_every_recovery_whatever_became_of_the_monitors(programs: Path, tmp_path: Path) -> None:
    length = 3 * 3600
    end = float(int(time.time()) // EVERY * EVERY - 600)
    operator = past(end - length, end)
    fill(programs, tmp_path, openmetrics(every(EVERY, end - length - 3600, end), [*operator.monitors, operator]))
    with serving(programs, tmp_path) as url:

        def query(expression: str, at: float = end) -> list[Object]:
            found: list[Object] = asked(url, f"query?query={urllib.parse.quote(expression)}&time={at:.0f}")["result"]
            return found

        fleet = by_strategy(query, "fleet", {"$namespace": "fleet"}, length)
        # All but one that came before its monitor was scraped. For the monitor that restarted in its pod, the count is interpolated.
        assert fleet["recovered"] == pytest.approx({"Fallback/Executing": 3 + 1 + 3 + 3 + 1, "Restart": 1}, abs=0.05)
        assert fleet["failed"] == {"none": 1}
        assert fleet["mean"] == pytest.approx({"Fallback/Executing": 0.506, "Restart": 3.5}, rel=0.01)
        assert fleet["cluster"] == pytest.approx({"Fallback/Executing": 0.006, "Restart": 3.0}, rel=0.01)
        robot = by_strategy(query, "robot", {"$namespace": "fleet", "$workload": "fails-first"}, length)
        assert robot["recovered"] == {"Fallback/Executing": 1, "Restart": 1}
        assert robot["failed"] == {"none": 1}
        everywhere = by_strategy(query, "fleet", {"$namespace": ".*"}, length)
        assert sum((everywhere["recovered"] | everywhere["failed"]).values()) == pytest.approx(14, abs=0.05)
        assert not any(by_strategy(query, "fleet", {"$namespace": "nowhere"}, length).values())
        (lacking,) = expressions("fleet", {"$namespace": "fleet"}, length)["Missing pods of pools, by namespace"]
        assert [query(lacking, at)[0]["value"][1] for at in (operator.handed_over + EVERY, end)] == ["4", "0"]


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
def prometheus(programs: Path, kubectl: Kubectl, tmp_path: Path) -> Iterator[str]:
    """The URL of a Prometheus that scrapes the operator and the monitors of kubectl's namespace."""
    config = tmp_path / "prometheus.yaml"
    config.write_text(yaml.safe_dump(scraping(kubectl.kubeconfig, kubectl.namespace)))
    promtool(programs, "check", "config", str(config))
    with serving(programs, tmp_path) as url:
        yield url


@pytest.fixture
def query(prometheus: str) -> Query:
    """The series that an expression has now."""

    def ask(expression: str) -> list[Object]:
        found: list[Object] = asked(prometheus, f"query?query={urllib.parse.quote(expression)}")["result"]
        return found

    return ask


def value(query: Query, expression: str) -> float:
    """The value of the only series of an expression. Raises IndexError while there is none."""
    found = query(expression)
    assert len(found) <= 1, found
    return float(found[0]["value"][1])


@pytest.mark.own_robot  # whose namespace is that of `kubectl`
def test_a_failover_is_seen_in_metrics_alerts_and_dashboards(
    executing: Robot, kubectl: Kubectl, release: Kubectl, programs: Path, query: Query, prometheus: str, tmp_path: Path
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
    # The operator counts it too, and is scraped at another time than the monitor.
    recovered = f'understudy_recoveries_total{{result="Recovered",{mine}}}'
    eventually(lambda: value(query, recovered) == 1, within=60, what="the monitor is scraped after the recovery")
    assert value(query, f"understudy_recovery_seconds_count{{{mine}}}") == 1
    assert value(query, f"understudy_gate_commit_seconds_count{{{mine}}}") >= 1
    executing.wait_protected()

    (record,) = executing.status()["recoveries"]
    chosen = {"$namespace": kubectl.namespace, "$workload": executing.workload}
    table = by_strategy(query, "robot", chosen, 3600)
    assert (table["recovered"], table["failed"]) == ({record["strategy"]: 1}, {})
    assert table["mean"] == pytest.approx({record["strategy"]: record["recoverySeconds"]}, abs=0.001)

    for name in ("fleet", "robot"):
        for expression in itertools.chain(*expressions(name, chosen, 3600).values()):
            if not any(metric in expression for metric in SELDOM):
                eventually(partial(query, expression), within=30, what=expression)
            else:
                query(expression)

    pool = next(iter(kubectl.list("fallbackpools")))["metadata"]["name"]
    kubectl.patch("fallbackpool", pool, {"spec": {"perWorkload": 0}})

    def told() -> bool:
        alerts = asked(prometheus, "alerts")["alerts"]
        return any(
            a["labels"]["alertname"] == "UnderstudyStandbyNotReady" and a["labels"]["workload"] == executing.workload
            for a in alerts
        )

    eventually(told, within=60, what="that it has no standby is about to be told")
    for pods, where in (("app.kubernetes.io/name=understudy", release), ("understudy.dev/component=monitor", kubectl)):
        for pod in where.list("pods", pods):
            if (address := pod["status"].get("podIP")) and not pod["metadata"].get("deletionTimestamp"):
                with urllib.request.urlopen(f"http://{address}:9108/metrics", timeout=10) as answer:
                    promtool(programs, "check", "metrics", stdin=answer.read().decode())
