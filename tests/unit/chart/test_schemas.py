"""Manifests that are applied to clusters match the schemas of their kinds: the rendered chart, the examples, and the docs.

kubeconform reports a misspelled field before a cluster exists. It is the only check for kinds that the cluster under test does
not have (those of the Prometheus operator), and for pod templates in our own kinds, which an API server checks when it creates
the pods. It does not default, admit or compile: a real API server judges the chart in tests/cluster/test_chart.py, and our kinds
in tests/cluster/test_crds.py.
"""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import program, unavailable
from tests.support import schemas
from tests.support.pages import PAGES
from tests.unit.chart.conftest import CHART, Run

REPOSITORY = CHART.parents[1]
EXAMPLES = sorted((REPOSITORY / "examples").rglob("*.yaml"))

ALL_VALUES = (
    "admission.enabled=false",
    "admission.labelWriters[0]=developer",
    "admission.monitorImages[0]=registry.example/monitors/*",
    "admission.podSecurity=baseline",
    "crds.keep=false",
    "images.monitorPullSecrets[0].name=registry",
    "images.pullSecrets[0].name=registry",
    "metrics.dashboards.enabled=true",
    "metrics.from[0].podSelector.matchLabels.app=prometheus",
    "metrics.podMonitors.enabled=true",
    "metrics.rules.enabled=true",
    "monitors.maxMemoryLimit=8Gi",
    "monitors.memoryLimit=2Gi",
    "monitors.priorityClassName=high",
    "operator.affinity.podAntiAffinity.requiredDuringSchedulingIgnoredDuringExecution[0].topologyKey=zone",
    "operator.env[0].name=EXTRA",
    "operator.env[0].value=x",
    "operator.nodeSelector.disk=ssd",
    "operator.podAnnotations.note=hi",
    "operator.podLabels.team=robots",
    "operator.priorityClassName=high",
    "operator.resources.limits.cpu=1",
    "operator.tolerations[0].operator=Exists",
    "serviceAccount.annotations.note=hi",
    "watchNamespaces={fleet-a,fleet-b}",
)

Conform = Callable[[str], "Judged"]


class Judged:
    """What kubeconform says of some manifests."""

    def __init__(self, output: str) -> None:
        results = json.loads(output)
        self.valid: int = results["summary"]["valid"]
        self.problems: list[str] = [
            f"{one['kind']} {one['name']}: {one['msg']}" for one in results.get("resources", [])
        ]


@pytest.fixture(scope="module")
def conform(tmp_path_factory: pytest.TempPathFactory) -> Conform:
    """Asks kubeconform of manifests."""
    if not schemas.folder().is_dir():
        unavailable("there are no schemas of Kubernetes' kinds: scripts/test makes them")
    ours = tmp_path_factory.mktemp("schemas")
    schemas.of_definitions((REPOSITORY / "crds").glob("*.yaml"), ours, schemas.folder())
    command = [program("kubeconform"), "-strict", "-summary", "-output", "json"]
    for folder in (schemas.folder(), ours):
        command += ["-schema-location", f"{folder}/{schemas.LOCATION}"]

    def ask(manifests: str) -> Judged:
        done = subprocess.run(command, input=manifests, capture_output=True, text=True, timeout=60)
        assert not done.stderr
        return Judged(done.stdout)

    return ask


@pytest.mark.parametrize(
    ("settings", "values"),
    [((), None), ((), CHART / "production.yaml"), (ALL_VALUES, None)],
    ids=["default-values", "production", "all-values"],
)
def test_the_chart_conforms(run: Run, conform: Conform, settings: tuple[str, ...], values: Path | None) -> None:
    judged = conform(run(*settings, values=values, tests=True).stdout)
    assert judged.problems == []
    assert judged.valid >= 15


@pytest.mark.parametrize("file", EXAMPLES, ids=lambda file: str(file.relative_to(REPOSITORY / "examples")))
def test_the_examples_conform(conform: Conform, file: Path) -> None:
    judged = conform(file.read_text())
    assert judged.problems == []
    assert judged.valid >= 1


def test_the_manifests_in_the_pages_conform(conform: Conform) -> None:
    written = [one for page in PAGES for one in re.findall(r"```yaml\n(.*?)```", page.read_text(), re.DOTALL)]
    judged = conform("\n---\n".join(one for one in written if one.startswith("apiVersion:")))
    assert judged.problems == []
    assert judged.valid >= 20


DEPLOYMENT = """
apiVersion: apps/v1
kind: Deployment
metadata: {name: one}
spec:
  replicas: 1
  selector: {matchLabels: {app: one}}
  template:
    metadata: {labels: {app: one}}
    spec:
      containers:
        - {name: main, image: one, ports: [{containerPort: 80}], resources: {limits: {memory: 1Gi, cpu: 1}}}
"""
WORKLOAD = (REPOSITORY / "examples" / "quickstart" / "manifests" / "robotworkload.yaml").read_text()
POLICY = (REPOSITORY / "examples" / "quickstart" / "manifests" / "strategies" / "restart.yaml").read_text()
POD_MONITOR = """
apiVersion: monitoring.coreos.com/v1
kind: PodMonitor
metadata: {name: one}
spec:
  selector: {matchLabels: {app: one}}
  podMetricsEndpoints: [{port: metrics, interval: 15s}]
"""


@pytest.mark.parametrize(
    ("manifest", "written", "instead", "problem"),
    [
        (DEPLOYMENT, "replicas: 1", "replica: 1", "additional properties 'replica' not allowed"),
        (DEPLOYMENT, "replicas: 1", "replicas: one", "at '/spec/replicas': got string, want integer"),
        (DEPLOYMENT, "replicas: 1", "replicas: 1\n  replicas: 2", "already set in map"),
        (DEPLOYMENT, "  selector: {matchLabels: {app: one}}\n", "", "missing property 'selector'"),
        (DEPLOYMENT, "containerPort: 80", "port: 80", "additional properties 'port' not allowed"),
        (DEPLOYMENT, "image: one", "image: [one]", "containers/0/image': got array, want string"),
        (DEPLOYMENT, "memory: 1Gi", "memory: [1]", "limits/memory': got array, want number"),
        (DEPLOYMENT, "apps/v1", "apps/v1beta1", "could not find schema for Deployment"),
        (WORKLOAD, "metadata:\n", "metadata:\n  label: x\n", "additional properties 'label' not allowed"),
        (WORKLOAD, "spec:\n", "spec:\n  policy: x\n", "at '/spec': additional properties 'policy' not allowed"),
        (WORKLOAD, "image:", "imagePullPolice: Always\n          image:", "'imagePullPolice' not allowed"),
        (POLICY, "strategies:", "strategy:", "additional properties 'strategy' not allowed"),
        (POD_MONITOR, "interval: 15s", "every: 15s", "additional properties 'every' not allowed"),
        (POD_MONITOR, "interval: 15s", "interval: often", "does not match pattern"),
    ],
)
def test_a_manifest_that_does_not_conform_is_reported(
    conform: Conform, manifest: str, written: str, instead: str, problem: str
) -> None:
    assert written in manifest
    assert conform(manifest).problems == []
    judged = conform(manifest.replace(written, instead, 1))
    assert len(judged.problems) == 1
    assert problem in judged.problems[0]
