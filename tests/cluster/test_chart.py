"""The chart's objects as a real API server takes them: stricter than any schema, since it also defaults, admits and compiles."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
import yaml

from tests.cluster.conftest import REPOSITORY, Release
from tests.support.chart import SET_IMAGES

CHART = REPOSITORY / "charts" / "understudy"
PRODUCTION = CHART / "production.yaml"


@pytest.mark.parametrize(
    "arguments",
    [
        ("--set", "allNamespaces=true"),
        ("--values", str(PRODUCTION), "--set", "watchNamespaces={default}"),
        ("--set", "watchNamespaces={default}"),
        (
            "--set",
            "allNamespaces=true",
            "--set",
            "metrics.dashboards.enabled=true",
            "--set",
            "admission.enabled=false",
            "--set",
            "crds.keep=false",
        ),
    ],
    ids=["all-namespaces", "production", "named-namespaces", "other-parts"],
)
def test_every_object_is_accepted_strictly(
    release: Release, helm: str, kubeconfig: Path, arguments: tuple[str, ...]
) -> None:
    # The pod of `helm test` may be there from an earlier one, and pods can't be changed.
    command = [
        helm, "template", release.name, str(CHART), "--namespace", release.namespace, "--kube-version", "1.34", "--skip-tests",
        "--set", SET_IMAGES,
    ]  # fmt: skip
    rendered = subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=60, check=True).stdout
    items = [item for item in yaml.safe_load_all(rendered) if item]
    # There is no Prometheus operator in this cluster; tests/e2e/test_prometheus.py asks Prometheus itself.
    known = [item for item in items if not item["apiVersion"].startswith("monitoring.coreos.com/")]
    assert len(known) >= 15
    done = subprocess.run(
        ["kubectl", "apply", "--server-side", "--force-conflicts", "--dry-run=server", "--validate=strict", "-f", "-"],
        input=yaml.safe_dump_all(known),
        env={**os.environ, "KUBECONFIG": str(kubeconfig)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    assert len(done.stdout.splitlines()) == len(known)
