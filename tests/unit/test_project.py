"""The project's own files agree with each other."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import understudy
from tests.cluster import strangers

REPOSITORY = Path(__file__).resolve().parents[2]


def test_the_chart_has_the_version_of_the_package() -> None:
    chart = yaml.safe_load((REPOSITORY / "charts" / "understudy" / "Chart.yaml").read_text())
    assert chart["version"] == chart["appVersion"] == understudy.__version__


@pytest.mark.parametrize("script", ["test", "lib.sh", "dashboards"])
def test_shell_scripts_are_valid(script: str) -> None:
    subprocess.run(["bash", "-n", str(REPOSITORY / "scripts" / script)], check=True)


@pytest.mark.parametrize(
    ("script", "arguments"),
    [
        *(("test", arguments) for arguments in (["--help"], ["e2e", "--help"], ["unit", "-x", "-h"])),
        *(
            (script, ["--help"])
            for script in ("bench", "cluster", "dashboards", "demo", "images", "prose", "record", "site")
        ),
    ],
)
def test_help_of_scripts_needs_no_setup(script: str, arguments: list[str], tmp_path: Path) -> None:
    environment = os.environ | {"HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    process = subprocess.Popen(
        [str(REPOSITORY / "scripts" / script), *arguments],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        output, _ = process.communicate(timeout=20)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 0
    assert f"scripts/{script}" in output
    assert not re.search(r"^\[ *\d+ s\]", output, re.MULTILINE), "something was set up"


def test_an_unknown_suite_is_refused() -> None:
    done = subprocess.run([str(REPOSITORY / "scripts" / "test"), "everything"], capture_output=True, text=True)
    assert done.returncode == 1
    assert "unknown suite everything" in done.stderr
    assert "lint, unit, cluster, e2e or all" in done.stderr


def test_files_may_be_named_in_any_order() -> None:
    """See pytest_configure in tests/conftest.py: the last file did not find the fixtures of tests/unit/cli/conftest.py."""
    files = ["cli/plan/test_size.py", "test_clock.py", "cli/test_commands.py"]
    command = [sys.executable, "-m", "pytest", "--setup-plan", "-q", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, *(f"tests/unit/{file}" for file in files)], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-2000:]


def test_the_ci_runs_all_suites() -> None:
    text = (REPOSITORY / ".ci" / "run").read_text()
    assert "scripts/test all" in text
    for path in (".ci/run", "scripts/test", "scripts/generate", "scripts/constraints"):
        assert (REPOSITORY / path).stat().st_mode & 0o111, f"{path} must be executable"


def test_the_table_of_the_strangers_names_tests_that_exist_and_all_of_theirs() -> None:
    named = set(re.findall(r"\b(?:tests|strangers|bench|charts)/[a-z_/]+(?:\.py|\.yaml)?", strangers.__doc__ or ""))
    folder = Path(strangers.__file__).parent
    assert {path for path in named if not (REPOSITORY / path).exists() and not (folder.parent / path).exists()} == set()
    assert {f"strangers/{path.name}" for path in folder.glob("test_*.py")} <= named


def test_the_journals_of_both_examples_are_equal() -> None:
    """Each image is made of its example's folder alone, as a reader would copy it, so that one module can't be in both."""
    files = ("navigation/src/navigation_robot/journal.py", "quickstart/src/understudy_quickstart/journal.py")
    (ones, others) = ((REPOSITORY / "examples" / file).read_text().splitlines() for file in files)
    assert "class Journal:" in ones
    assert ones[1:] == others[1:], "all but who writes it"
