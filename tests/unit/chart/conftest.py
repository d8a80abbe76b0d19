"""The chart as Helm renders it."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.support.chart import SET_IMAGES

CHART = Path(__file__).resolve().parents[3] / "charts" / "understudy"

Object = dict[str, Any]
Run = Callable[..., subprocess.CompletedProcess[str]]
Render = Callable[..., list[Object]]


@pytest.fixture(scope="session")
def run(helm: str) -> Run:
    """Runs ``helm template``."""

    def template(
        *settings: str, release: str = "understudy", tests: bool = False, values: Path | None = None
    ) -> subprocess.CompletedProcess[str]:
        named = values or any(setting.startswith("watchNamespaces=") for setting in settings)
        words = [] if values else ["--set", SET_IMAGES]
        words += [word for setting in settings for word in ("--set", setting)]
        words += [] if named else ["--set", "allNamespaces=true"]
        words += ["--values", str(values)] if values else []
        words += [] if tests else ["--skip-tests"]
        command = [helm, "template", release, str(CHART), "--namespace", "system", "--kube-version", "1.34", *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    return template


@pytest.fixture(scope="session")
def render(run: Run) -> Render:
    """The objects that the chart renders to with some values; with ``tests`` also what only ``helm test`` makes."""

    def objects(*settings: str, release: str = "understudy", tests: bool = False) -> list[Object]:
        done = run(*settings, release=release, tests=tests)
        assert done.returncode == 0, done.stderr
        return [item for item in yaml.safe_load_all(done.stdout) if item]

    return objects


def one(items: list[Object], kind: str, name: str | None = None) -> Object:
    """The one object of a kind (and name)."""
    found = [item for item in items if item["kind"] == kind and name in (None, item["metadata"]["name"])]
    assert len(found) == 1, [item["metadata"]["name"] for item in found]
    return found[0]
