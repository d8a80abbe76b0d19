"""What the templates make of values: the suites in charts/understudy/tests, which helm-unittest runs."""

from __future__ import annotations

import subprocess
import tarfile
from pathlib import Path

import pytest

from tests.conftest import program
from tests.unit.chart.conftest import CHART

SUITES = sorted((CHART / "tests").glob("*_test.yaml"))


@pytest.mark.parametrize("suite", SUITES, ids=lambda suite: suite.stem.removesuffix("_test"))
def test_the_templates_pass_their_suites(suite: Path) -> None:
    command = [program("helm-unittest"), "--strict", "--file", f"tests/{suite.name}", str(CHART)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Test Suites: 1 passed, 1 total" in done.stdout


def test_every_template_has_a_suite() -> None:
    templates = {str(path.relative_to(CHART / "templates")) for path in (CHART / "templates").rglob("*.[yt]*")}
    texts = "\n".join(suite.read_text() for suite in SUITES)
    assert {name for name in templates if name not in texts} == {"_helpers.tpl"}


def test_the_packaged_chart_does_not_contain_the_suites(helm: str, tmp_path: Path) -> None:
    subprocess.run([helm, "package", str(CHART), "--destination", str(tmp_path)], capture_output=True, check=True)
    (package,) = tmp_path.iterdir()
    with tarfile.open(package) as file:
        names = {Path(name).relative_to("understudy") for name in file.getnames()}
    assert Path("templates/tests/verify.yaml") in names, "`helm test` goes with it"
    assert not [name for name in names if name.parts[0] == "tests"]
